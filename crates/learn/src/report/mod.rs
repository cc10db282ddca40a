//! One self-contained page a run, and the pictures in it.
//!
//! Everything here is a pure function of its arguments: the same results give the same bytes. Nothing refers to a
//! file or a server outside the page; pictures are inline SVG or base64 PNG.

pub mod animation;
pub mod chart;
pub mod curve;
pub(crate) mod fate;
pub mod filter;
pub mod page;
pub(crate) mod png_image;
pub(crate) mod svg;
pub mod table;

#[cfg(test)]
pub(crate) mod sample;

use crate::record::RunResults;
use std::io::Write as _;
use std::path::{Path, PathBuf};

pub use page::Pictures;
pub use png_image::png_bytes;

/// What can go wrong while a picture or a page is made or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file system refused.
    #[error("{action} {}: {source}", path.display())]
    Io {
        /// What was being done, for example `writing`.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The PNG encoder refused.
    #[error("encoding {picture}: {source}")]
    Encode {
        /// Which picture, in words.
        picture: &'static str,
        /// What the encoder said.
        source: png::EncodingError,
    },
    /// An image's bytes do not fill its rows and columns.
    #[error("image of {height} x {width} pixels: expected {expected} bytes, got {found}")]
    ImageBytes {
        /// Rows.
        height: usize,
        /// Columns.
        width: usize,
        /// 3 bytes a pixel.
        expected: usize,
        /// Bytes found.
        found: usize,
    },
    /// A frame of an animation differs in size from the first.
    #[error("animation frame {index}: expected {expected:?} (height, width), got {found:?}")]
    FrameSize {
        /// Index of the frame.
        index: usize,
        /// Height and width of the first frame.
        expected: (usize, usize),
        /// Height and width of this frame.
        found: (usize, usize),
    },
    /// An animation without frames was asked for.
    #[error("an animation needs at least one frame, got none")]
    NoFrames,
    /// A picture could not be made for a file.
    #[error("making the picture {}: {source}", path.display())]
    Picture {
        /// The file that was to be written.
        path: PathBuf,
        /// What was wrong.
        source: Box<Error>,
    },
}

/// Shorthand for a result with the report's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;

/// Name of the page in a run's folder.
pub const REPORT_FILE: &str = "report.html";

/// Writes [`REPORT_FILE`] into `dir` (made when missing) and returns its path. An older page stays whole until the new
/// one replaces it.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write_report(
    dir: &Path,
    results: &RunResults,
    config_toml: &str,
    pictures: &Pictures,
) -> Result<PathBuf> {
    std::fs::create_dir_all(dir).map_err(|source| Error::Io {
        action: "making the folder",
        path: dir.to_owned(),
        source,
    })?;
    let path = dir.join(REPORT_FILE);
    write_atomic(&path, page::html(results, config_toml, pictures).as_bytes())?;
    Ok(path)
}

/// Writes a drawing to `path`, whole or not at all.
///
/// # Errors
/// [`Error::Io`] with the path.
pub fn write_svg(path: &Path, svg: &str) -> Result<()> {
    write_atomic(path, svg.as_bytes())
}

/// Writes `bytes` beside `path` first and renames: whoever reads sees the old file or the new one, never a part.
pub(crate) fn write_atomic(path: &Path, bytes: &[u8]) -> Result<()> {
    let failed = |action| move |source| Error::Io { action, path: path.to_owned(), source };
    let dir = path.parent().filter(|d| !d.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    // Temporary files are private by default; a result is as readable as the user's other files.
    #[cfg(unix)]
    let builder = {
        use std::os::unix::fs::PermissionsExt as _;
        builder.permissions(std::fs::Permissions::from_mode(0o666))
    };
    let mut file = builder.tempfile_in(dir).map_err(failed("making a temporary file for"))?;
    file.write_all(bytes).map_err(failed("writing"))?;
    file.as_file().sync_all().map_err(failed("flushing"))?;
    file.persist(path).map_err(|e| failed("replacing")(e.error))?;
    // Without this the rename itself can be lost in a power cut; not every file system allows it.
    #[cfg(unix)]
    if let Ok(folder) = std::fs::File::open(dir) {
        let _ = folder.sync_all();
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_report_replaces_the_one_before_and_leaves_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("run");
        let results = sample::results(1, 3);
        write_report(&folder, &results, "seed = 1\n", &Pictures::default()).unwrap();
        let path = write_report(&folder, &results, "seed = 2\n", &Pictures::default()).unwrap();
        assert!(std::fs::read_to_string(&path).unwrap().contains("seed = 2"));
        assert_eq!(std::fs::read_dir(&folder).unwrap().count(), 1);
    }

    #[test]
    fn a_missing_folder_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("none").join("x.png");
        let message = write_atomic(&path, b"x").unwrap_err().to_string();
        assert!(message.contains("x.png") && message.contains("temporary"), "{message}");
    }
}
