//! What failed, in which file, and what would mend it.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The one error of the host. Every message says what was being done, to which file, and how to mend it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file says something that cannot be used.
    #[error("{}{}: {message}", path.display(), line.map(|l| format!(":{l}")).unwrap_or_default())]
    Input {
        /// The file.
        path: PathBuf,
        /// The line at fault, counted from 1, where one line is.
        line: Option<u64>,
        /// What is wrong, and the mend.
        message: String,
    },
    /// The operating system refused a file.
    #[error("{doing} {}: {}", path.display(), reason(source))]
    Io {
        /// What was being done: "reading", "writing" ….
        doing: &'static str,
        /// To which file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The request itself makes no sense.
    #[error("{0}")]
    Usage(String),
}

/// Why the system refused a file, and the mend where there is one.
fn reason(error: &std::io::Error) -> String {
    match error.kind() {
        ErrorKind::NotFound => "there is no such file or folder; mend the name".to_owned(),
        ErrorKind::PermissionDenied => "permission denied; allow it, or choose another file".to_owned(),
        ErrorKind::NotADirectory => "a part of the path is no folder; mend the name".to_owned(),
        ErrorKind::IsADirectory => "it is a folder; name a file in it".to_owned(),
        _ => error.to_string(),
    }
}

/// What the host's functions return.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    /// An [`Error::Input`] about a whole file.
    pub fn input(path: impl AsRef<Path>, message: impl Into<String>) -> Self {
        Self::Input { path: path.as_ref().to_owned(), line: None, message: message.into() }
    }

    /// An [`Error::Input`] about one line, counted from 1.
    pub fn line(path: impl AsRef<Path>, line: u64, message: impl Into<String>) -> Self {
        Self::Input { path: path.as_ref().to_owned(), line: Some(line), message: message.into() }
    }

    /// An [`Error::Io`], for `map_err`.
    pub fn io(doing: &'static str, path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_owned();
        move |source| Self::Io { doing, path, source }
    }
}
