use std::path::PathBuf;

/// What can stop a run. Nothing already made is lost: files are written beside their place and renamed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A configuration that cannot work.
    #[error("configuration: {0}")]
    Config(String),
    /// The run directory is there already.
    #[error("{0} exists: give --resume to go on with it, or --out another folder")]
    Exists(PathBuf),
    /// There is no run directory to go on with.
    #[error("{0}: nothing to go on with; leave --resume out to start a run, or give --out the folder of one")]
    Nothing(PathBuf),
    /// Another process works in the run directory.
    #[error("{path} is in use by {owner}: wait until it ends, or give --out another folder")]
    Busy {
        /// The run directory.
        path: PathBuf,
        /// The process.
        owner: String,
    },
    /// The run directory belongs to another run.
    #[error("{path}: {quantity}: expected {expected}, found {found}")]
    Foreign {
        /// The run directory or file.
        path: PathBuf,
        /// What differs.
        quantity: String,
        /// What this run needs.
        expected: String,
        /// What is there.
        found: String,
    },
    /// Somebody asked the program to stop. What is done is saved.
    #[error("stopped by {}; --resume goes on from here", signal_name(.signal))]
    Stopped {
        /// Number of the signal.
        signal: i32,
    },
    /// The system does not let signals be handled.
    #[error("handling signals: {0}")]
    Signals(std::io::Error),
    /// A dataset that a run was given cannot stand in for its demonstrator; all that does not fit.
    #[error("{path}: these demonstrations do not fit the run: {}", problems.join("; "))]
    Given {
        /// The dataset.
        path: PathBuf,
        /// What was expected, and what was found.
        problems: Vec<String>,
    },
    /// A demonstrator could not do its task.
    #[error("{0}")]
    Demonstrations(String),
    /// The hub, or the way there, did not do what was asked; one line that says what to do.
    #[error("{address}: {problem}")]
    Hub {
        /// Repository, as it was given.
        address: String,
        /// What is wrong.
        problem: String,
    },
    /// Rank 0 of a team failed, and has said so.
    #[error("{0}")]
    Led(String),
    /// Ranks of a team that should have the same weights have others.
    #[error(
        "{stage}, step {step}: expected the same weights on all {size} ranks, found others on rank {ranks}: processors that round \
         differently, or programs that were built differently; start on machines of one kind"
    )]
    Unlike {
        /// The stage.
        stage: String,
        /// Steps done in it.
        step: usize,
        /// Ranks that differ from rank 0.
        ranks: String,
        /// How many ranks there are.
        size: usize,
    },
    /// What came from another rank is not what this one expects.
    #[error("team: {0}")]
    Team(String),
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
    /// The simulation failed.
    #[error(transparent)]
    Env(#[from] e2h_env::Error),
    /// A device or a network failed.
    #[error(transparent)]
    Nn(#[from] e2h_nn::Error),
    /// A policy or critic failed.
    #[error(transparent)]
    Policy(#[from] e2h_policy::Error),
    /// Episodes on disk, windows or normaliser failed.
    #[error(transparent)]
    Data(#[from] e2h_data::Error),
    /// Refinement failed.
    #[error(transparent)]
    Refine(#[from] e2h_refine::Error),
    /// An episode does not hold together.
    #[error(transparent)]
    Core(#[from] e2h_core::Error),
    /// A record could not be read, or a page, picture or event file could not be made.
    #[error(transparent)]
    Report(#[from] e2h_report::Error),
}

fn signal_name(signal: &i32) -> String {
    match *signal {
        signal_hook::consts::SIGINT => "SIGINT".to_owned(),
        signal_hook::consts::SIGTERM => "SIGTERM".to_owned(),
        other => format!("signal {other}"),
    }
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
