use crate::lerobot::Obstacle;
use e2h_core::one_line;
use std::path::PathBuf;

/// What can go wrong with a policy, its training or its checkpoint.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A configuration that cannot work; one line a problem.
    #[error("policy configuration: {}", printable(.0))]
    Config(String),
    /// Observations that do not fit the policy.
    #[error("observation: {quantity}: expected {expected}, got {found}")]
    Observation {
        /// What was looked at.
        quantity: String,
        /// What the policy was made for.
        expected: String,
        /// What came.
        found: String,
    },
    /// Training data that does not fit, or is missing.
    #[error("training data: {0}")]
    Data(String),
    /// The loss is not a finite number.
    #[error(
        "training diverged: the loss is {loss} at step {step} (seed {seed}); the last sound state is kept"
    )]
    NotFinite {
        /// Step at which it appeared.
        step: usize,
        /// Seed of the training run.
        seed: u64,
        /// The loss.
        loss: f32,
    },
    /// A weight, or a number beside it that training goes on from, is not finite.
    #[error(
        "training diverged: `{name}`: expected finite numbers, found {found} after step {step} (seed {seed}); it is not written, \
         the last sound state is kept"
    )]
    Weight {
        /// The tensor.
        name: String,
        /// The first number that is none.
        found: f32,
        /// Steps done.
        step: usize,
        /// Seed of the training run.
        seed: u64,
    },
    /// Nothing is learned any more.
    #[error(
        "training diverged: the gradient's length was {norm} in {steps} steps in a row, up to step {step} (seed {seed}), and the \
         optimiser left them out; the last sound state is kept, try a smaller learning rate"
    )]
    Skipped {
        /// Steps in a row.
        steps: usize,
        /// The length of the last gradient.
        norm: f32,
        /// The last step.
        step: usize,
        /// Seed of the training run.
        seed: u64,
    },
    /// Training ended early because the caller asked for it.
    #[error("stopped after {step} steps, as asked")]
    Stopped {
        /// Steps done.
        step: usize,
    },
    /// A checkpoint that does not match what is asked of it; lists all that differs.
    #[error("checkpoint {path}: {}", printable(.problem))]
    Checkpoint {
        /// Folder or file.
        path: PathBuf,
        /// What was expected and what was found.
        problem: String,
    },
    /// What LeRobot cannot express of a policy of ours, or we of one of LeRobot's; all of it.
    #[error("{doing} {path}: {}", list(.obstacles))]
    Lerobot {
        /// What was being done.
        doing: &'static str,
        /// Folder.
        path: PathBuf,
        /// Every setting with what was expected and found.
        obstacles: Vec<Obstacle>,
    },
    /// Reading or writing failed.
    #[error("{doing} {path}: {source}")]
    Io {
        /// What was being done.
        doing: &'static str,
        /// File or folder.
        path: PathBuf,
        /// The system's answer.
        source: std::io::Error,
    },
    /// The network library failed.
    #[error(transparent)]
    Nn(#[from] e2h_nn::Error),
    /// Candle failed.
    #[error("tensor operation: {0}")]
    Candle(#[from] candle_core::Error),
    /// Windows or normaliser failed.
    #[error(transparent)]
    Dataset(#[from] e2h_data::Error),
    /// Images of an episode could not be read.
    #[error(transparent)]
    Images(#[from] e2h_core::Error),
}

fn list(obstacles: &[Obstacle]) -> String {
    obstacles.iter().map(|o| one_line(&o.to_string())).collect::<Vec<_>>().join("; ")
}

/// Text of a file for a message of one line; lists of tensors stay whole.
fn printable(text: &str) -> String {
    text.replace(char::is_control, "\u{fffd}")
}

impl From<Error> for e2h_core::Error {
    fn from(error: Error) -> Self {
        Self::Model(error.to_string())
    }
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
