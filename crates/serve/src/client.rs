//! A robot's side of the protocol, whatever its widths are.

use crate::Result;
use crate::remote::{Socket, dial, receive, socket_error};
use crate::token::Token;
use crate::wire::Value;
use std::time::Duration;
use tungstenite::Message;

/// How a server is reached.
#[derive(Debug, Clone, PartialEq)]
pub struct ClientSettings {
    /// `ws://HOST:PORT`.
    pub url: String,
    /// What the server wants to be told.
    pub token: Option<Token>,
    /// How long an answer may take.
    pub patience: Duration,
}

impl ClientSettings {
    /// A server without a token, and a minute of patience.
    #[must_use]
    pub fn new(url: &str) -> Self {
        Self { url: url.to_owned(), token: None, patience: Duration::from_secs(60) }
    }
}

/// A connection to any server of openpi's protocol.
///
/// ```no_run
/// use e2h_serve::{Client, ClientSettings, wire::{Array, Value}};
///
/// let mut client = Client::connect(&ClientSettings::new("ws://127.0.0.1:8000"))?;
/// let state = Array::f32(&[6], &[0.0; 6]);
/// let reply = client.infer(&Value::map([("observation/state", state.into()), ("prompt", "plug it in".into())]))?;
/// if let Some(Value::Array(actions)) = reply.get("actions") {
///     println!("{:?}", actions.shape());
/// }
/// # Ok::<(), e2h_serve::Error>(())
/// ```
pub struct Client {
    url: String,
    socket: Socket,
    metadata: Value,
}

impl Client {
    /// Connects, and reads what the server says of itself.
    ///
    /// # Errors
    /// When there is no such server, or it refuses.
    pub fn connect(settings: &ClientSettings) -> Result<Self> {
        let (socket, metadata) = dial(&settings.url, settings.token.as_ref(), settings.patience)?;
        Ok(Self { url: settings.url.clone(), socket, metadata })
    }

    /// What the server says of itself: for one of ours, the entries of [`crate::Inputs::metadata`].
    #[must_use]
    pub fn metadata(&self) -> &Value {
        &self.metadata
    }

    /// Sends observations, and waits for what the server answers.
    ///
    /// # Errors
    /// [`crate::Error::Server`] with the server's own words where it refuses; when the connection breaks or patience ends, after which a
    /// new one is needed.
    pub fn infer(&mut self, observation: &Value) -> Result<Value> {
        let asked = self.socket.send(Message::Binary(observation.encode().into()));
        asked.map_err(|e| socket_error(&self.url, "asking", e))?;
        receive(&mut self.socket, &self.url)
    }
}
