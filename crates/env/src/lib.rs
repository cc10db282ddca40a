//! Task pairs in MuJoCo: scenes, resets, success predicates, cameras, control and scripted demonstrators.
//!
//! Knows nothing about learning: an environment takes actions and gives observations. The only crate that names MuJoCo.
//! Everything random is drawn from the generator that is passed in, and the same seed gives the same bytes whatever the
//! number of environments or threads.
//!
//! ```no_run
//! use e2h_core::{Direction, Origin, stream};
//! use e2h_env::{Env, EnvConfig, TaskOptions, demonstrate, task};
//!
//! let task = task("nut_assembly", &TaskOptions::default())?;
//! let mut env = Env::new(task.clone(), &EnvConfig::default())?;
//! let origin = Origin::demonstration(task.name(), Direction::Easy, 0, 42);
//! let mut rng = stream(42, "demonstration", 0, 0);
//! let episode = demonstrate(&mut env, Direction::Easy, task.demonstrator(), origin, &mut rng)?;
//! assert!(episode.outcome.is_success());
//! # Ok::<(), e2h_env::Error>(())
//! ```

mod arm;
mod config;
mod env;
mod expert;
mod logging;
mod mjcf;
mod pick_place;
mod probe;
mod record;
mod render;
mod scene;
mod sim;
mod tabletop;
mod task;
mod tasks;
#[cfg(feature = "viewer")]
mod window;

pub use arm::PosturePull;
pub use config::{DemonstratorConfig, EnvConfig, TaskOptions};
pub use env::{CAMERAS, Env, Snapshot};
pub use expert::{Expert, Phase, Script};
pub use probe::{Blind, Probed, probe};
pub use record::{demonstrate, demonstration_stream, replay};
pub use render::{MOST_PIXELS, Style};
pub use scene::{TableCamera, compose, finer};
pub use sim::{MAX_OPENING, Sim};
pub use task::Task;
pub use tasks::*;
#[cfg(feature = "viewer")]
pub use window::{Key, Panel, Window};

/// What pick-and-place pairs are made of: regions and pieces of predicates, grasps, and the one script of their demonstrators.
pub mod toolkit {
    pub use crate::expert::{draw, scatter};
    pub use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place};
    pub use crate::tabletop::{Region, beside, left_alone, near_middle, tilt, turn};
}

/// What can go wrong in an environment.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A name that the registry does not have.
    #[error("unknown {what} `{name}`: {}known: {known}", guess(.nearest))]
    Unknown {
        /// Kind of name.
        what: &'static str,
        /// The name asked for.
        name: String,
        /// The nearest known one; empty when none is near.
        nearest: String,
        /// All known ones.
        known: String,
    },
    /// Settings that cannot work; all of them.
    #[error("environment: {0}")]
    Config(String),
    /// A picture without pixels, or with too many.
    #[error("picture: expected sides of 1 to {most} pixels, got {width} x {height}", most = MOST_PIXELS)]
    Picture {
        /// Columns asked for.
        width: usize,
        /// Rows asked for.
        height: usize,
    },
    /// MuJoCo refused something; the message is its own.
    #[error("MuJoCo: {0}")]
    MuJoCo(String),
    /// The simulation ran away where no episode is recorded; MuJoCo has set it back, and a reset goes on.
    #[error("the simulation diverged: {0}")]
    Diverged(&'static str),
    /// The window cannot be opened, or cannot draw.
    #[error("window: {0}")]
    Window(String),
    /// A scene lacks something that the environment needs.
    #[error("the scene has no {what} `{name}`")]
    Missing {
        /// Kind of thing.
        what: &'static str,
        /// Its name.
        name: String,
    },
    /// The arm cannot reach a pose of the task.
    #[error("the arm cannot reach the {what}: {error:.4} (m plus rad) left over")]
    Unreachable {
        /// Which pose.
        what: &'static str,
        /// Distance left over, m plus rad.
        error: f64,
    },
    /// A clearance that a task's scene has no room for.
    #[error("clearance of `{task}`: expected {expected}, got {found}")]
    Clearance {
        /// The task.
        task: &'static str,
        /// What it can be.
        expected: String,
        /// What was asked for, m per side.
        found: f64,
    },
    /// An action that no controller can follow.
    #[error("action: expected {expected}, got {found:?}")]
    Action {
        /// What an action has to be.
        expected: &'static str,
        /// The action.
        found: e2h_core::Action,
    },
    /// A camera that the scene does not have.
    #[error("unknown camera `{name}`: the scene has {known}")]
    Camera {
        /// The name asked for.
        name: String,
        /// All known ones.
        known: String,
    },
    /// A saved state that does not fit.
    #[error("saved state: expected {expected} numbers, got {found}")]
    State {
        /// Numbers expected.
        expected: usize,
        /// Numbers found.
        found: usize,
    },
    /// A recording does not fit together.
    #[error(transparent)]
    Core(#[from] e2h_core::Error),
}

/// Version of the MuJoCo library that this process has loaded.
#[must_use]
pub fn mujoco_version() -> &'static str {
    mujoco_rs::mujoco_version()
}

fn guess(nearest: &str) -> String {
    if nearest.is_empty() { String::new() } else { format!("did you mean `{nearest}`? ") }
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
