//! Demonstrations recorded by hand: what keys and gamepads steer, when a take begins and ends, and the dataset that it goes into.
//!
//! Knows nothing about learning, and nothing here needs a display: a [`Session`] is told which controls were touched and what time it
//! is, and takes one control step. The window and the gamepad, behind the feature `viewer`, only tell it.
//!
//! ```
//! use e2h_core::Direction;
//! use e2h_env::{EnvConfig, TaskOptions, task};
//! use e2h_teleop::{Control, Event, Session, Settings};
//!
//! let folder = tempfile::tempdir()?;
//! let settings = Settings::new(Direction::Easy, folder.path().join("by_hand"));
//! let config = EnvConfig { image_size: 16, ..EnvConfig::default() };
//! let mut session = Session::open(task("nut_assembly", &TaskOptions::default())?, &config, settings)?;
//! session.step(&[Event::Press(Control::Record), Event::Press(Control::Up)], 0.0)?;
//! for k in 1..20 {
//!     session.step(&[], f64::from(k) / 20.0)?;
//! }
//! assert_eq!(session.status().rows, 20);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod controls;
#[cfg(feature = "viewer")]
mod gamepad;
mod pilot;
mod session;
mod store;

pub use controls::{BINDINGS, Binding, Control, Event, Sticks, button, key};
#[cfg(feature = "viewer")]
pub use gamepad::Gamepads;
pub use pilot::{Limits, Pilot};
pub use session::{Phase, Session, Settings, Status};
pub use store::Store;

use std::path::PathBuf;

/// What can go wrong while recording by hand.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A folder that this recording cannot go into; all that does not fit.
    #[error("{path} cannot take these demonstrations: {}; give --out another folder", problems.join("; "))]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What was expected, and what was found.
        problems: Vec<String>,
    },
    /// Another process records into the folder.
    #[error("{0} is recorded into by another process")]
    Busy(PathBuf),
    /// Limits that nobody can steer with.
    #[error("limits: {}", .0.join("; "))]
    Limits(Vec<String>),
    /// No start could be made.
    #[error("{0} starts in a row diverged")]
    Starts(u32),
    /// The file system refused.
    #[error("{path}: {source}")]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Its answer.
        source: std::io::Error,
    },
    /// The simulation failed.
    #[error(transparent)]
    Env(#[from] e2h_env::Error),
    /// The dataset failed.
    #[error(transparent)]
    Data(#[from] e2h_data::Error),
    /// An episode does not hold together.
    #[error(transparent)]
    Core(#[from] e2h_core::Error),
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
