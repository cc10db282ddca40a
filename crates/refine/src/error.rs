/// What can be wrong with a request for refinement.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// There must be one list of numbers per episode.
    #[error("expected one list of {what} for each of {expected} episode(s), got {found}")]
    Episodes {
        /// What the lists hold.
        what: &'static str,
        /// Episodes.
        expected: usize,
        /// Lists.
        found: usize,
    },
    /// There must be one number per frame.
    #[error("episode {episode}: expected {expected} {what}, one per frame, got {found}")]
    Frames {
        /// What the numbers are.
        what: &'static str,
        /// Index of the episode.
        episode: usize,
        /// Frames of the episode.
        expected: usize,
        /// Numbers given.
        found: usize,
    },
    /// A number that should be finite is not.
    #[error("episode {episode}, row {row}: expected a finite {what}, got {found}")]
    NotFinite {
        /// What the number is.
        what: &'static str,
        /// Index of the episode.
        episode: usize,
        /// Row index.
        row: usize,
        /// The number.
        found: f32,
    },
    /// A rate is not positive.
    #[error("expected a positive rate, Hz, got {found}")]
    Rate {
        /// The rate.
        found: f64,
    },
    /// A later stage must account for exactly the frames that the stage before kept.
    #[error("expected fates for the {expected} frame(s) that the stage before kept, got {found}")]
    Fates {
        /// Frames kept before.
        expected: usize,
        /// Fates given.
        found: usize,
    },
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
