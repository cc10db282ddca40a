//! Files that appear whole or not at all: written beside their place, synced, renamed.

use crate::{Error, Result};
use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

/// What names of unfinished files begin with; a killed writer leaves such files behind, and no reader looks at them.
pub(crate) const UNFINISHED: &str = ".new-";

pub(crate) fn io(action: &'static str, path: &Path) -> impl Fn(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { action, path: path.clone(), source }
}

/// An empty file beside its later place in `folder`.
pub(crate) fn unfinished(folder: &Path) -> Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(UNFINISHED);
    // Temporary files are private by default; a result is as readable as the user's other files.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder).map_err(io("write in", folder))
}

/// Moves a finished file to its place.
pub(crate) fn persist(file: NamedTempFile, path: &Path) -> Result<()> {
    file.as_file().sync_all().map_err(io("write", path))?;
    #[cfg(test)]
    fuse::burn(path)?;
    file.persist(path).map_err(|e| io("replace", path)(e.error))?;
    sync(folder_of(path))
}

/// The folder that a file is in; a bare name is in the current one.
fn folder_of(path: &Path) -> &Path {
    path.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Writes or replaces a file, and makes its folder where it is not there. At any instant the old file or the new one is
/// there, whole.
///
/// # Errors
/// When the file system refuses; the file is then what it was.
pub fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    let folder = folder_of(path);
    make_folder(folder)?;
    let mut file = unfinished(folder)?;
    file.write_all(bytes).map_err(io("write", path))?;
    persist(file, path)
}

/// A rename is safe only once its folder is. Where the file system cannot sync a folder, that is all that can be done.
pub(crate) fn sync(folder: &Path) -> Result<()> {
    use std::io::ErrorKind::{InvalidInput, Unsupported};
    #[cfg(unix)]
    match File::open(folder).and_then(|f| f.sync_all()) {
        Err(e) if !matches!(e.kind(), InvalidInput | Unsupported) => {
            return Err(io("sync the folder", folder)(e));
        }
        _ => {}
    }
    Ok(())
}

/// Makes the folder and those above it, each safe before the next.
pub(crate) fn make_folder(folder: &Path) -> Result<()> {
    let missing: Vec<&Path> =
        folder.ancestors().take_while(|f| !f.as_os_str().is_empty() && !f.exists()).collect();
    for folder in missing.into_iter().rev() {
        match fs::create_dir(folder) {
            Err(e) if e.kind() != std::io::ErrorKind::AlreadyExists => {
                return Err(io("make the folder", folder)(e));
            }
            _ => sync(folder_of(folder))?,
        }
    }
    Ok(())
}

/// Names in a folder, sorted; none where there is no such folder.
pub(crate) fn names(folder: &Path) -> Result<Vec<PathBuf>> {
    let read = io("read the folder", folder);
    let entries = match fs::read_dir(folder) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(vec![]),
        other => other.map_err(&read)?,
    };
    let mut found =
        entries.map(|e| e.map(|e| e.path())).collect::<std::io::Result<Vec<_>>>().map_err(&read)?;
    found.sort();
    Ok(found)
}

/// Lets a test stop a writer between two of its files, as a kill would.
#[cfg(test)]
pub(crate) mod fuse {
    use super::{Path, Result, io};
    use std::cell::Cell;

    thread_local! { static LEFT: Cell<Option<usize>> = const { Cell::new(None) }; }

    /// The file after the next `files` files is not put at its place, nor is any after it; none lets all pass.
    pub(crate) fn set(files: Option<usize>) {
        LEFT.set(files);
    }

    pub(super) fn burn(path: &Path) -> Result<()> {
        match LEFT.get() {
            Some(0) => Err(io("replace", path)(std::io::Error::other("killed"))),
            left => {
                LEFT.set(left.map(|n| n - 1));
                Ok(())
            }
        }
    }
}
