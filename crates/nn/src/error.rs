use std::path::PathBuf;

/// What can go wrong in this crate. Every variant says what was expected and what was found.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A tensor has the wrong shape for the layer it was given to.
    #[error("{what}: expected shape {expected}, found {found:?}")]
    Shape {
        /// The layer and the argument.
        what: &'static str,
        /// The shape in words, with the layer's sizes filled in.
        expected: String,
        /// The shape that arrived.
        found: Vec<usize>,
    },
    /// A size or a setting that no layer can be built with.
    #[error("{what}: expected {expected}, found {found}")]
    Config {
        /// The setting.
        what: &'static str,
        /// The values that work.
        expected: &'static str,
        /// The value that arrived.
        found: String,
    },
    /// Weights that do not belong to these parameters. Nothing was changed.
    #[error(
        "weights do not fit: missing {missing:?}, unexpected {unexpected:?}, of another shape {misshaped:?}"
    )]
    Import {
        /// Parameters that the weights lack.
        missing: Vec<String>,
        /// Entries that are no parameter.
        unexpected: Vec<String>,
        /// `name: expected [..], found [..]`.
        misshaped: Vec<String>,
    },
    /// A device that cannot compute.
    #[error("device `{asked}`: {problem}")]
    Device {
        /// The name that was asked for.
        asked: String,
        /// What was expected and what was found, in one line.
        problem: String,
    },
    /// A parameter name was used twice while layers were built.
    #[error("parameter `{0}`: expected a name of its own, found it twice")]
    Duplicate(String),
    /// Gradients or optimiser state of another set of parameters.
    #[error("{what}: expected {expected} parameters in the order of this network, found {found} of another")]
    OtherParams {
        /// What was given.
        what: &'static str,
        /// Parameters here.
        expected: usize,
        /// Parameters there.
        found: usize,
    },
    /// Weight gradients were asked for through Candle's own `backward`, which has no place for them.
    #[error("weight gradients: expected a call to `e2h_nn::backward`, found Candle's `Tensor::backward`")]
    NotRecording,
    /// A second backward pass through one forward pass.
    #[error(
        "backward pass: expected a new forward pass, found one whose values an earlier backward pass has freed"
    )]
    Freed,
    /// A file could not be read or written.
    #[error("{doing} {}: {source}", path.display())]
    Io {
        /// What was being done.
        doing: &'static str,
        /// The file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A file is not a weight file.
    #[error("{}: expected {expected}, found {found}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What a weight file holds.
        expected: &'static str,
        /// What this one holds.
        found: String,
    },
    /// Candle refused an operation.
    #[error("tensor operation: {0}")]
    Candle(#[from] candle_core::Error),
}

/// For layers that implement Candle's `Module`.
impl From<Error> for candle_core::Error {
    fn from(error: Error) -> Self {
        match error {
            Error::Candle(e) => e,
            other => Self::wrap(other),
        }
    }
}

/// Results of this crate.
pub type Result<T> = std::result::Result<T, Error>;
