//! A text file, statement by statement: any line ends, continued lines joined, every line counted.

use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// The longest line that is read: far beyond the largest face anyone wrote, far below memory.
const MAX_LINE: usize = 1 << 30;

/// Statements of a file, as bytes, without their line ends.
///
/// Lines end in LF, CRLF or CR. A `\` at the end joins a line with the next, except in comments,
/// where it is more likely the end of a Windows path. Costs one buffer as long as the longest line.
pub(super) struct Lines<R> {
    path: PathBuf,
    source: R,
    buffer: Vec<u8>,
    start: usize, // what is in the buffer and was not given out yet
    end: usize,
    line: u64, // lines given out
    after_cr: bool,
    at_end: bool,
    joined: Vec<u8>,
}

impl<R: Read> Lines<R> {
    pub(super) fn new(path: &Path, source: R) -> Self {
        let path = path.to_owned();
        let (buffer, joined) = (vec![0; 1 << 16], Vec::new());
        Self { path, source, buffer, start: 0, end: 0, line: 0, after_cr: false, at_end: false, joined }
    }

    /// The next statement and the number of its first line, counted from 1.
    pub(super) fn next(&mut self) -> Result<Option<(u64, &[u8])>> {
        let Some(mut text) = self.physical()? else { return Ok(None) };
        let line = self.line;
        if !self.is_continued(&text) {
            return Ok(Some((line, &self.buffer[text])));
        }
        self.joined.clear();
        while self.is_continued(&text) {
            self.joined.extend_from_slice(&self.buffer[text.start..text.end - 1]);
            self.joined.push(b' ');
            if self.joined.len() > MAX_LINE {
                return Err(self.too_long(line));
            }
            text = self.physical()?.unwrap_or(0..0);
        }
        self.joined.extend_from_slice(&self.buffer[text]);
        Ok(Some((line, &self.joined)))
    }

    fn is_continued(&self, text: &Range<usize>) -> bool {
        let bytes = &self.buffer[text.clone()];
        bytes.last() == Some(&b'\\') && bytes.trim_ascii_start().first() != Some(&b'#')
    }

    /// Where the next line stands in the buffer.
    fn physical(&mut self) -> Result<Option<Range<usize>>> {
        let mut scanned = self.start;
        let mut text = loop {
            let is_end = |&b: &u8| b == b'\n' || b == b'\r';
            if let Some(at) = self.buffer[scanned..self.end].iter().position(is_end) {
                let stop = scanned + at;
                let text = self.start..stop;
                let is_cr = self.buffer[stop] == b'\r';
                let ends_crlf = self.after_cr && !is_cr && text.is_empty();
                self.after_cr = is_cr;
                self.start = stop + 1;
                scanned = self.start;
                if ends_crlf {
                    continue;
                }
                break text;
            }
            if self.at_end {
                if self.start == self.end {
                    return Ok(None);
                }
                let text = self.start..self.end;
                self.start = self.end;
                break text;
            }
            self.buffer.copy_within(self.start..self.end, 0);
            self.end -= self.start;
            self.start = 0;
            scanned = self.end;
            self.fill()?;
        };
        self.line += 1;
        if self.line == 1 {
            let bytes = &self.buffer[text.clone()];
            if bytes.starts_with(b"\xff\xfe") || bytes.starts_with(b"\xfe\xff") {
                return Err(Error::line(&self.path, 1, "the text is UTF-16; save it as UTF-8 or ASCII"));
            }
            if bytes.starts_with(b"\xef\xbb\xbf") {
                text.start += 3;
            }
        }
        if self.buffer[text.clone()].contains(&0) {
            let what = "a NUL byte; the file is damaged or is not text, so export it again";
            return Err(Error::line(&self.path, self.line, what));
        }
        Ok(Some(text))
    }

    /// Reads more behind `end`.
    fn fill(&mut self) -> Result<()> {
        if self.end == self.buffer.len() {
            if self.end > MAX_LINE {
                return Err(self.too_long(self.line + 1));
            }
            self.buffer.resize(self.end * 2, 0);
        }
        match self.source.read(&mut self.buffer[self.end..]) {
            Ok(0) => self.at_end = true,
            Ok(n) => self.end += n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(Error::io("reading", &self.path)(e)),
        }
        Ok(())
    }

    fn too_long(&self, line: u64) -> Error {
        Error::line(&self.path, line, "the line is longer than 1 GiB; split it")
    }
}

/// Splits the keyword from the rest of a statement; `None` for a blank line or a comment.
pub(super) fn keyword(text: &[u8]) -> Option<(&[u8], &[u8])> {
    let text = text.trim_ascii();
    let end = text.iter().position(u8::is_ascii_whitespace).unwrap_or(text.len());
    let (word, rest) = text.split_at(end);
    (!word.is_empty() && word[0] != b'#').then_some((word, rest.trim_ascii_start()))
}

/// The words of a statement, up to a comment.
pub(super) fn words(rest: &[u8]) -> impl Iterator<Item = &[u8]> {
    let words = rest.split(u8::is_ascii_whitespace).filter(|w| !w.is_empty());
    words.take_while(|w| w[0] != b'#')
}

/// Whether this could be a statement of some dialect, rather than what is read from a binary file.
pub(super) fn is_plausible(keyword: &[u8]) -> bool {
    keyword.len() <= 32
        && keyword[0].is_ascii_alphabetic()
        && keyword.iter().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'-' | b'.'))
}

/// A word of the file as it can stand in a message: short, and without control characters.
pub(super) fn shown(word: &[u8]) -> String {
    let text = String::from_utf8_lossy(&word[..word.len().min(200)]);
    let mut short: String = text.chars().take(40).flat_map(char::escape_debug).collect();
    if word.len() > 200 || text.chars().count() > 40 {
        short.push_str("...");
    }
    short
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gives out a few bytes at a time, so that every line end meets the end of the buffer.
    struct Drip<'a>(&'a [u8], usize);

    impl Read for Drip<'_> {
        fn read(&mut self, to: &mut [u8]) -> std::io::Result<usize> {
            let n = self.1.min(self.0.len()).min(to.len());
            to[..n].copy_from_slice(&self.0[..n]);
            self.0 = &self.0[n..];
            Ok(n)
        }
    }

    fn statements(text: &[u8]) -> Vec<(u64, String)> {
        let read = |step| {
            let mut lines = Lines::new(Path::new("x"), Drip(text, step));
            let mut all = Vec::new();
            while let Some((line, text)) = lines.next().unwrap() {
                all.push((line, String::from_utf8_lossy(text).into_owned()));
            }
            all
        };
        let whole = read(usize::MAX);
        (1..4).for_each(|step| assert_eq!(read(step), whole));
        whole
    }

    fn own(lines: &[(u64, &str)]) -> Vec<(u64, String)> {
        lines.iter().map(|&(n, t)| (n, t.to_owned())).collect()
    }

    #[test]
    fn any_line_end() {
        for end in ["\n", "\r\n", "\r"] {
            let text = ["a", "", "b c", "d"].join(end);
            let whole = own(&[(1, "a"), (2, ""), (3, "b c"), (4, "d")]);
            assert_eq!(statements(text.as_bytes()), whole);
            assert_eq!(statements((text + end).as_bytes()), whole);
        }
        assert_eq!(statements(b""), []);
        assert_eq!(statements(b"\xef\xbb\xbfa"), own(&[(1, "a")]));
    }

    #[test]
    fn continued_lines_keep_their_first_number() {
        assert_eq!(statements(b"a\\\nb\\\r\nc\nd"), own(&[(1, "a b c"), (4, "d")]));
        assert_eq!(statements(b"# C:\\\nb\\"), own(&[(1, "# C:\\"), (2, "b ")]));
    }

    #[test]
    fn a_line_longer_than_the_buffer() {
        let mut text = vec![b'#'; 1 << 20];
        text.extend_from_slice(b"\nb");
        let mut lines = Lines::new(Path::new("x"), &text[..]);
        assert_eq!(lines.next().unwrap().unwrap().1.len(), 1 << 20);
        assert_eq!(lines.next().unwrap(), Some((2, &b"b"[..])));
    }

    #[test]
    fn bytes_that_are_not_text() {
        let fault = |text: &[u8]| {
            let mut lines = Lines::new(Path::new("x.obj"), text);
            loop {
                match lines.next() {
                    Ok(Some(_)) => {}
                    Ok(None) => panic!("no fault in {text:?}"),
                    Err(e) => break e.to_string(),
                }
            }
        };
        assert!(fault(b"a\nb\0").starts_with("x.obj:2: "));
        assert!(fault(b"\xff\xfev\0").contains("UTF-16"));
    }
}
