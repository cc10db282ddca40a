use std::path::PathBuf;

/// What can go wrong with data.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The file system refused.
    #[error("cannot {action} {}: {source}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// On which file or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file is not what it should be.
    #[error("{}: {what}: expected {expected}, found {found}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// Which part of it.
        what: String,
        /// What should be there.
        expected: String,
        /// What is there.
        found: String,
    },
    /// The episode contradicts itself.
    #[error("episode `{name}`: {source}")]
    Episode {
        /// Its name.
        name: String,
        /// What is wrong.
        source: e2h_core::Error,
    },
    /// Ranges cannot be taken from nothing.
    #[error("normaliser: expected episodes with rows, found none")]
    NoRows,
    /// A range is not finite or not positive.
    #[error("normaliser: {column} entry {index}: expected finite ends with min < max, found {min} and {max}")]
    Range {
        /// `state` or `action`.
        column: &'static str,
        /// Entry of the row.
        index: usize,
        /// Lower end.
        min: f32,
        /// Upper end.
        max: f32,
    },
    /// A list of numbers has the wrong length.
    #[error("normaliser: expected {expected} numbers, found {found}")]
    Length {
        /// Numbers needed.
        expected: usize,
        /// Numbers given.
        found: usize,
    },
    /// A table does not fit the features of its dataset.
    #[error("column `{column}`: expected {expected}, found {found}")]
    Column {
        /// Name of the column.
        column: String,
        /// What the feature asks for.
        expected: String,
        /// What the table holds.
        found: String,
    },
    /// Videos cannot be read here.
    #[error("{}: expected {needs}, found {found}", path.display())]
    Video {
        /// The video file.
        path: PathBuf,
        /// What reading it takes.
        needs: &'static str,
        /// What there is.
        found: String,
    },
    /// A file may be whole, but holds what is not read here.
    #[error("{}: {what}: expected {expected}, found {found}: not supported here", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// Which part of it.
        what: String,
        /// What is read here.
        expected: String,
        /// What is there.
        found: String,
    },
    /// Data that a policy cannot learn from; all that is in the way.
    #[error("{what}: {}", problems.iter().map(|p| e2h_core::one_line(p)).collect::<Vec<_>>().join("; "))]
    Misfit {
        /// What was looked at.
        what: String,
        /// Every problem, with what was expected and found.
        problems: Vec<String>,
    },
    /// There is nothing to draw from.
    #[error("sampler: expected windows in at least one set, found none")]
    NoWindows,
}

impl Error {
    /// True where what was found may be whole, and is only not read here or now: an unknown format, a missing decoder, a file
    /// that may not be opened. False for damage, a missing file included.
    #[must_use]
    pub fn is_unsupported(&self) -> bool {
        match self {
            Self::Unsupported { .. } | Self::Video { .. } => true,
            Self::Io { source, .. } => {
                !matches!(source.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::UnexpectedEof)
            }
            _ => false,
        }
    }
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
