use e2h_core::one_line;
use std::net::SocketAddr;
use std::time::Duration;

/// What can go wrong on either side of the socket.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A message, or a part of it, that is not what it should be.
    #[error("{what}: expected {expected}, found {found}")]
    Mismatch {
        /// What was looked at: a key of the request, a field of an array, the message.
        what: String,
        /// What would have been right.
        expected: String,
        /// What came.
        found: String,
    },
    /// The policy refused the observation, or failed.
    #[error(transparent)]
    Policy(#[from] e2h_policy::Error),
    /// The network ended without an answer.
    #[error("the policy gave no answer: {0}")]
    Inference(String),
    /// An answer that took too long.
    #[error("inference: expected an answer within {limit:?}, found none; the connection ends")]
    Slow {
        /// How long it may take.
        limit: Duration,
    },
    /// A client that says nothing for too long.
    #[error("client: expected a message within {limit:?}, found none; the connection ends")]
    Idle {
        /// How long it may be silent.
        limit: Duration,
    },
    /// An address that others reach, without a token.
    #[error(
        "listen address {address}: expected a loopback address such as 127.0.0.1 where no token is asked for, found one that other \
         machines may reach; give a token"
    )]
    Open {
        /// The address.
        address: SocketAddr,
    },
    /// A setting that cannot work.
    #[error("{setting}: expected {expected}, found {found}")]
    Setting {
        /// Its name.
        setting: &'static str,
        /// What would have been right.
        expected: &'static str,
        /// What it is.
        found: String,
    },
    /// The server cannot begin.
    #[error("{doing}: {source}")]
    Io {
        /// What was tried.
        doing: String,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A server that cannot be talked to.
    #[error("{url}: {doing}: {source}")]
    Socket {
        /// Its address.
        url: String,
        /// What was tried.
        doing: &'static str,
        /// Why it failed.
        source: Box<tungstenite::Error>,
    },
    /// What a server answered instead of actions.
    #[error("{url} answered with an error: {}", one_line(.message))]
    Server {
        /// Its address.
        url: String,
        /// Its words.
        message: String,
    },
}

impl Error {
    pub(crate) fn mismatch(what: &str, expected: impl Into<String>, found: impl Into<String>) -> Self {
        Self::Mismatch { what: one_line(what), expected: expected.into(), found: one_line(&found.into()) }
    }
}

impl From<Error> for e2h_core::Error {
    fn from(error: Error) -> Self {
        Self::Model(error.to_string())
    }
}

/// Shorthand for a result with this crate's [`enum@Error`].
pub type Result<T> = std::result::Result<T, Error>;
