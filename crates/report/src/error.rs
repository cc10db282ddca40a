use std::path::{Path, PathBuf};

/// What can go wrong while a page, a picture or an event file is made, and while a run is read for it.
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
    /// A file or folder is not what it should be.
    #[error("{}: {quantity}: expected {expected}, found {found}", path.display())]
    Foreign {
        /// The file or folder.
        path: PathBuf,
        /// What differs.
        quantity: String,
        /// What is needed.
        expected: String,
        /// What is there.
        found: String,
    },
    /// What was asked for cannot be drawn.
    #[error("{0}")]
    Options(String),
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
        /// 3 bytes per pixel.
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
    /// Episodes on disk failed, or a file could not be written.
    #[error(transparent)]
    Data(#[from] e2h_data::Error),
    /// Images of an episode could not be read.
    #[error(transparent)]
    Images(#[from] e2h_core::Error),
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;

pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { action, path, source }
}
