//! Regular files, and errors that say what is wrong with one.

use crate::atomic::io;
use crate::{Error, Result};
use e2h_core::one_line;
use std::fs::File;
use std::io::Read;
use std::path::Path;

pub(crate) fn file_error(
    path: &Path,
    what: &str,
    expected: impl Into<String>,
    found: impl Into<String>,
) -> Error {
    Error::File {
        path: path.to_owned(),
        what: one_line(what),
        expected: one_line(&expected.into()),
        found: one_line(&found.into()),
    }
}

pub(crate) fn unsupported(
    path: &Path,
    what: &str,
    expected: impl Into<String>,
    found: impl Into<String>,
) -> Error {
    Error::Unsupported {
        path: path.to_owned(),
        what: one_line(what),
        expected: one_line(&expected.into()),
        found: one_line(&found.into()),
    }
}

/// Opens a regular file, or a link to one. Reading from pipes waits for ever, and devices never end: they are refused before
/// they are opened.
pub(crate) fn open_regular(path: &Path) -> Result<File> {
    let found = std::fs::metadata(path).map_err(io("open", path))?;
    if !found.is_file() {
        let kind = if found.is_dir() { "a folder" } else { "a pipe, a device or a socket" };
        return Err(unsupported(path, "file", "a regular file", kind));
    }
    File::open(path).map_err(io("open", path))
}

/// The bytes of a regular file of at most `limit` bytes.
///
/// # Errors
/// When it is a folder, a pipe or a device (it is not opened then), when it is larger, or when the file system refuses.
pub fn read_regular(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let file = open_regular(path)?;
    let length = file.metadata().map_err(io("read", path))?.len();
    let large = |found: u64| unsupported(path, "file", format!("at most {limit} bytes"), found.to_string());
    if length > limit {
        return Err(large(length));
    }
    let mut bytes = vec![];
    // It may grow while it is read.
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes).map_err(io("read", path))?;
    if bytes.len() as u64 > limit { Err(large(bytes.len() as u64)) } else { Ok(bytes) }
}

/// Most bytes of a description or a record that is text, 1 GiB.
pub const MOST_TEXT: u64 = 1 << 30;
/// Most bytes of a file of weights, 64 GiB.
pub const MOST_WEIGHTS: u64 = 64 << 30;

/// As [`read_regular`], for those who tell errors of the system in words of their own.
///
/// # Errors
/// Those of the system; `InvalidInput` for what is no regular file or too large.
pub fn read_file(path: &Path, limit: u64) -> std::io::Result<Vec<u8>> {
    read_regular(path, limit).map_err(|e| match e {
        Error::Io { source, .. } => source,
        Error::Unsupported { expected, found, .. } => std::io::Error::new(
            std::io::ErrorKind::InvalidInput,
            format!("expected {expected}, found {found}"),
        ),
        other => std::io::Error::other(other),
    })
}

/// The same, as text.
///
/// # Errors
/// As [`read_file`], and `InvalidData` for what is no UTF-8.
pub fn read_text(path: &Path) -> std::io::Result<String> {
    let text = String::from_utf8(read_file(path, MOST_TEXT)?);
    text.map_err(|e| std::io::Error::new(std::io::ErrorKind::InvalidData, e.utf8_error()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_within_the_limit_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        std::fs::write(&path, b"12345").unwrap();
        assert_eq!(read_regular(&path, 5).unwrap(), b"12345");
        let large = read_regular(&path, 4).unwrap_err();
        assert!(large.is_unsupported() && large.to_string().contains("at most 4 bytes, found 5"), "{large}");
        assert!(read_regular(folder.path(), 5).unwrap_err().to_string().contains("found a folder"));
        assert!(!read_regular(&folder.path().join("none"), 5).unwrap_err().is_unsupported());
        #[cfg(unix)]
        {
            let zero = read_regular(Path::new("/dev/zero"), 5).unwrap_err().to_string();
            assert!(zero.contains("expected a regular file, found a pipe, a device or a socket"), "{zero}");
            let pipe = folder.path().join("pipe");
            assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
            assert!(read_regular(&pipe, 5).unwrap_err().to_string().contains("a pipe"));
            std::os::unix::fs::symlink(&path, folder.path().join("link")).unwrap();
            assert_eq!(read_regular(&folder.path().join("link"), 5).unwrap(), b"12345");
        }
    }
}
