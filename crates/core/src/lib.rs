//! What every other crate of Auto-E2H speaks in: episodes, observations, poses, directions, seeded random streams.
//!
//! Deliberately knows neither Candle nor MuJoCo: a program that only reads episodes needs neither.
//!
//! ```
//! use e2h_core::{Direction, Episode, Observation, Origin, Outcome};
//!
//! let origin = Origin::demonstration("nut_assembly", Direction::Easy, 0, 42);
//! let mut episode = Episode::new(origin, &[]);
//! episode.push(&Observation { state: [0.0; 15], frames: vec![] }, &[0.0; 8])?;
//! episode.outcome = Outcome::Success { at: 0 };
//! assert_eq!(episode.len(), 1);
//! # Ok::<(), e2h_core::Error>(())
//! ```

mod episode;
mod failure;
mod pixels;
mod pose;
mod random;
mod say;
mod spelling;
pub mod state;
mod team;
mod traits;

pub use episode::{
    Action, Direction, Episode, Excursion, Frames, Image, Kind, Observation, Origin, Outcome, State,
};
pub use failure::Failure;
pub use pixels::{ImageStore, Pixels};
pub use pose::{Pose, align_hemisphere, continue_signs};
pub use random::{Rng, fnv1a, stream};
pub use say::{mention, say};
pub use spelling::{nearest, one_line};
pub use team::{Solo, Team, Threads, all_alike, tree_sum};
pub use traits::{ActionChunk, Policy};

/// Entries of a state row: eef position 3, eef quaternion 4, object position 3, object quaternion 4, gripper opening 1.
pub const STATE_DIM: usize = 15;
/// Entries of an action row: goal position 3, goal quaternion 4, gripper 1.
pub const ACTION_DIM: usize = 8;
/// Control steps a second, Hz; one row of an [`Episode`] is one control step.
pub const CONTROL_HZ: f64 = 20.0;

/// What can be wrong with an episode or a request made of it.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The observation's cameras are not those of the episode.
    #[error("episode expects {expected} camera image(s) an observation, got {found}")]
    Cameras {
        /// Cameras of the episode.
        expected: usize,
        /// Images in the observation.
        found: usize,
    },
    /// Images that are kept on the disk cannot be written or read.
    #[error("images that are kept on the disk of {}: {doing} failed: {source}", folder.display())]
    Store {
        /// What was tried.
        doing: &'static str,
        /// Folder on whose disk they lie.
        folder: std::path::PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// An image differs in size from those before it.
    #[error("camera `{camera}`: expected {expected:?} (height, width), got {found:?}")]
    ImageSize {
        /// Name of the camera.
        camera: String,
        /// Height and width so far.
        expected: (usize, usize),
        /// Height and width of the offending image.
        found: (usize, usize),
    },
    /// An image has more or fewer bytes than its camera's height, width and three channels make.
    #[error("camera `{camera}`, row {row}: expected an image of {expected} bytes, got {found}")]
    ImageBytes {
        /// Name of the camera.
        camera: String,
        /// Row index.
        row: usize,
        /// Bytes of an image of this camera.
        expected: usize,
        /// Bytes of the image.
        found: usize,
    },
    /// Columns of an episode differ in length.
    #[error("episode column `{column}`: expected {expected} rows, got {found}")]
    Rows {
        /// Name of the column.
        column: String,
        /// Rows of the state column.
        expected: usize,
        /// Rows found.
        found: usize,
    },
    /// A number that should be finite is not.
    #[error("episode column `{column}`, row {row}: a number is not finite")]
    NotFinite {
        /// Name of the column.
        column: &'static str,
        /// Row index.
        row: usize,
    },
    /// Another rank of a team cannot be reached.
    #[error("rank {rank}: expected an answer, but {problem}")]
    Team {
        /// The rank.
        rank: usize,
        /// What is known of it.
        problem: String,
    },
    /// A policy or value function failed; the message is the underlying library's.
    #[error("{0}")]
    Model(String),
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
