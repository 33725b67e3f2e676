//! The folder that a page and its data are written to.

use crate::error::{Error, Result};
use crate::output::{self, MadeFolders};
use std::fs;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};

/// The page's file.
pub const INDEX: &str = "index.html";

/// Within how many bytes of its beginning a page names its maker.
const HEAD: u64 = 1024;

/// A folder that may be written to.
///
/// Files appear in it whole or not at all. One that was made for the page and stays empty is removed again.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    _made: MadeFolders,
}

impl Folder {
    /// Makes the folder, and those above it, if it is not there; a folder that is there has to be empty, or to hold
    /// an earlier page by the same `maker`, which is then replaced. With `force` anything may be in it.
    ///
    /// Whether the page and these files of `data` can be written is tried at once, since it may take minutes until
    /// they are there.
    pub fn claim(path: &Path, maker: &str, data: &[&str], force: bool) -> Result<Self> {
        let occupied = match fs::read_dir(path) {
            Ok(mut entries) => entries.next().is_some(),
            Err(error) if error.kind() == ErrorKind::NotFound => false,
            Err(error) if error.kind() == ErrorKind::NotADirectory => {
                return Err(Error::input(path, "this is a file, and a folder is wanted: name another one"));
            }
            Err(error) => return Err(Error::io("reading", path)(error)),
        };
        if occupied && !force && !made_by(&path.join(INDEX), maker) {
            return Err(Error::input(
                path,
                format!(
                    "the folder is not empty and holds no page of `{maker}`: name another one, or pass --force"
                ),
            ));
        }
        let folder = Self { path: path.to_owned(), _made: MadeFolders::make(path)? };
        for name in data.iter().chain([&INDEX]) {
            output::check_writable_bytes(path.join(name))?;
        }
        Ok(folder)
    }

    /// Writes a file.
    pub fn write(&self, name: &str, bytes: &[u8]) -> Result<()> {
        output::write_bytes(self.path.join(name), bytes)
    }

    /// Where a file of this name is.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }
}

/// Whether a file is a page that names this maker.
fn made_by(file: &Path, maker: &str) -> bool {
    let mut head = Vec::new();
    let read = fs::File::open(file).and_then(|file| file.take(HEAD).read_to_end(&mut head));
    read.is_ok() && String::from_utf8_lossy(&head).contains(&super::generator(maker))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::page::Page;

    #[test]
    fn foreign_folders_are_left_alone() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a/b");
        let page = Page::new("occlude test", "title", "lead");
        Folder::claim(&path, "occlude test", &[], false)
            .unwrap()
            .write(INDEX, page.html("").as_bytes())
            .unwrap();
        drop(Folder::claim(&path, "occlude test", &[], false).unwrap());
        let said = Folder::claim(&path, "occlude other", &[], false).unwrap_err().to_string();
        assert!(said.contains("--force") && said.contains("occlude other"), "{said}");
        drop(Folder::claim(&path, "occlude other", &[], true).unwrap());
        fs::write(root.path().join("file"), "x").unwrap();
        let said = Folder::claim(root.path(), "occlude test", &[], false).unwrap_err().to_string();
        assert!(said.contains("not empty"), "{said}");
        for below in ["file", "file/below"] {
            let said =
                Folder::claim(&root.path().join(below), "occlude test", &[], false).unwrap_err().to_string();
            assert!(said.contains("file"), "{said}");
        }
    }

    #[test]
    fn what_cannot_be_written_is_known_at_once() {
        let root = tempfile::tempdir().unwrap();
        fs::create_dir(root.path().join("a.csv")).unwrap();
        let said = Folder::claim(root.path(), "occlude test", &["a.csv"], true).unwrap_err().to_string();
        assert!(said.contains("a.csv: it is a folder"), "{said}");
        assert!(root.path().join("a.csv").exists());
    }

    #[test]
    fn what_stays_empty_goes_again() {
        let root = tempfile::tempdir().unwrap();
        drop(Folder::claim(&root.path().join("a/b/c"), "occlude test", &[], false).unwrap());
        assert!(!root.path().join("a").exists());
        fs::create_dir(root.path().join("mine")).unwrap();
        drop(Folder::claim(&root.path().join("mine"), "occlude test", &[], false).unwrap());
        assert!(root.path().join("mine").exists());
    }
}
