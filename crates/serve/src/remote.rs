//! A policy behind a socket: any server of openpi's protocol, ours or another.

use crate::request::{OPENPI_IMAGES, STREAM, read_stream, write_stream};
use crate::token::Token;
use crate::wire::{Array, Value};
use crate::{Camera, Error, Result};
use e2h_core::{ACTION_DIM, Action, ActionChunk, Observation, Policy, Rng, STATE_DIM};
use rand::RngCore as _;
use std::net::{TcpStream, ToSocketAddrs as _};
use std::sync::Mutex;
use std::time::Duration;
use tungstenite::client::{IntoClientRequest as _, uri_mode};
use tungstenite::http::HeaderValue;
use tungstenite::http::header::AUTHORIZATION;
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Message, WebSocket};

/// Actions of one answer that are read.
const MOST_ACTIONS: usize = 10_000;
/// Where openpi's servers listen.
const PORT: u16 = 8000;

/// How a server is asked.
#[derive(Debug, Clone, PartialEq)]
pub struct RemoteSettings {
    /// `ws://HOST:PORT`.
    pub url: String,
    /// What the server wants to be told.
    pub token: Option<Token>,
    /// Connections, each of which has one request on its way; a server that batches answers them together.
    pub connections: usize,
    /// How long an answer may take.
    pub patience: Duration,
    /// What the robot is to do, for policies that read it.
    pub prompt: String,
    /// Names of the observations' cameras, in order, for servers that do not name theirs.
    pub cameras: Vec<String>,
    /// Actions of an answer that are executed at most before the server is asked again.
    pub most_actions: Option<usize>,
}

/// What a server says of itself. Servers may say nothing.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Metadata {
    /// Class of the policy.
    pub kind: Option<String>,
    /// The task that it was trained for.
    pub task: Option<String>,
    /// Which task of the pair it does.
    pub direction: Option<String>,
    /// Configuration of the run that trained it, JSON.
    pub run: Option<String>,
    /// Its cameras, if it names them.
    pub cameras: Option<Vec<Camera>>,
    /// Observations of a history.
    pub n_obs_steps: usize,
    /// Whether it answers from a stream of the client's.
    stream: bool,
}

impl Metadata {
    fn read(value: &Value) -> Result<Self> {
        let text = |value: &Value, key: &str| value.get(key).and_then(Value::as_str).map(str::to_owned);
        for (key, ours) in [("state_width", STATE_DIM), ("action_width", ACTION_DIM)] {
            match value.get(key) {
                Some(found) if found.as_usize() != Some(ours) => {
                    return Err(Error::mismatch(
                        &format!("metadata `{key}`"),
                        ours.to_string(),
                        found.kind(),
                    ));
                }
                _ => {}
            }
        }
        let n_obs_steps = match value.get("n_obs_steps") {
            None => 1,
            Some(n) => n
                .as_usize()
                .filter(|n| (1..=1024).contains(n))
                .ok_or_else(|| Error::mismatch("metadata `n_obs_steps`", "1 to 1024", n.kind()))?,
        };
        let camera = |v: &Value| {
            let (height, width) = (v.get("height")?.as_usize()?, v.get("width")?.as_usize()?);
            Some(Camera { name: text(v, "name")?, height, width })
        };
        let cameras = match value.get("cameras") {
            Some(Value::List(list)) => list.iter().map(camera).collect(),
            _ => None,
        };
        Ok(Self {
            kind: text(value, "kind"),
            task: text(value, "task"),
            direction: text(value, "direction"),
            run: value.get("provenance").and_then(|p| text(p, "run")),
            cameras,
            n_obs_steps,
            stream: value.get(STREAM) == Some(&Value::Bool(true)),
        })
    }
}

pub(crate) type Socket = WebSocket<TcpStream>;

/// A server as a policy of this project's: 15 numbers of state, 8 of action, the environment's images.
///
/// With a server of ours, answers are those of the policy itself, to the last bit: the caller's random streams travel with the
/// requests and come back as far as they were used. Other servers are sent a `seed` from the stream, which they may use.
pub struct RemotePolicy {
    settings: RemoteSettings,
    metadata: Metadata,
    sockets: Mutex<Vec<Socket>>,
}

impl RemotePolicy {
    /// Connects, and reads what the server says of itself.
    ///
    /// # Errors
    /// When there is no such server, it refuses, or its policy has other states or actions than this project's.
    pub fn connect(settings: RemoteSettings) -> Result<Self> {
        if settings.connections == 0 || settings.most_actions == Some(0) {
            let found = "0".to_owned();
            return Err(Error::Setting { setting: "connections and actions", expected: "at least 1", found });
        }
        let (first, metadata) = open(&settings)?;
        let metadata = Metadata::read(&metadata)?;
        let mut sockets = vec![first];
        for _ in 1..settings.connections {
            sockets.push(open(&settings)?.0);
        }
        Ok(Self { settings, metadata, sockets: Mutex::new(sockets) })
    }

    /// What the server says of itself.
    #[must_use]
    pub fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// The same for observations of these cameras, in order, over so many connections.
    ///
    /// # Errors
    /// When the server does not take that many.
    pub fn prepare(mut self, cameras: &[String], connections: usize) -> Result<Self> {
        self.settings.cameras = cameras.to_vec();
        let sockets = self.sockets.get_mut().unwrap_or_else(std::sync::PoisonError::into_inner);
        while sockets.len() < connections {
            sockets.push(open(&self.settings)?.0);
        }
        Ok(self)
    }

    fn request(&self, history: &[&Observation], rng: &mut Rng) -> Result<Vec<u8>> {
        let steps = |each: &dyn Fn(&Observation) -> Option<Array>| -> Result<Array> {
            let parts: Vec<Array> = history.iter().filter_map(|o| each(o)).collect();
            let one = self.metadata.n_obs_steps == 1;
            let found = || format!("{} of {}", parts.len(), history.len());
            let whole = if one { parts.last().cloned() } else { Array::stack(&parts) };
            whole.filter(|_| parts.len() == history.len()).ok_or_else(|| {
                Error::mismatch("observations of a history", "arrays of one shape in each", found())
            })
        };
        let state = steps(&|o| Some(Array::f32(&[STATE_DIM], &o.state)))?;
        let mut all = vec![("observation/state".to_owned(), Value::from(state))];
        let exact = self.metadata.cameras.is_some();
        for (i, name) in self.settings.cameras.iter().enumerate() {
            let images = steps(&|o| o.frames.get(i).map(Array::image))?;
            if exact {
                all.push((format!("observation/images/{name}"), images.into()));
            } else {
                // Whichever of both the server looks at.
                all.extend(OPENPI_IMAGES.get(i).map(|key| ((*key).to_owned(), images.clone().into())));
                all.push((format!("observation/images/{name}"), images.into()));
            }
        }
        all.push(("prompt".to_owned(), Value::Text(self.settings.prompt.clone())));
        if self.metadata.stream {
            all.push((STREAM.to_owned(), write_stream(rng)));
        } else {
            all.push(("seed".to_owned(), Value::from(rng.next_u64() >> 11)));
        }
        Ok(Value::Map(all.into_iter().collect()).encode())
    }

    fn read(&self, reply: &Value, rng: &mut Rng) -> Result<ActionChunk> {
        let found = reply.get("actions");
        let wrong = |found: String| {
            Error::mismatch("answer `actions`", format!("finite numbers of shape [T, {ACTION_DIM}]"), found)
        };
        let Some(Value::Array(array)) = found else {
            return Err(wrong(found.map_or_else(|| "none".to_owned(), Value::kind)));
        };
        match *array.shape() {
            [1..=MOST_ACTIONS, ACTION_DIM] => {}
            _ => return Err(wrong(array.to_string())),
        }
        let rows = array.to_f32();
        if let Some(v) = rows.iter().find(|v| !v.is_finite()) {
            return Err(wrong(format!("{array} with {v}")));
        }
        if self.metadata.stream {
            *rng = read_stream(reply.get(STREAM).unwrap_or(&Value::Nil))?;
        }
        let most = self.settings.most_actions.unwrap_or(MOST_ACTIONS);
        let rows: &[Action] = rows.as_chunks().0;
        Ok(rows.iter().take(most).copied().collect())
    }

    fn ask(&self, histories: &[Vec<&Observation>], rngs: &mut [Rng]) -> Result<Vec<ActionChunk>> {
        let url = &self.settings.url;
        let broken = |doing: &'static str| move |source| socket_error(url, doing, source);
        let mut sockets = self.sockets.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let mut chunks = vec![];
        let n = sockets.len();
        for (histories, rngs) in histories.chunks(n).zip(rngs.chunks_mut(n)) {
            // All are asked before the first is listened to: the server answers them together.
            for ((socket, history), rng) in sockets.iter_mut().zip(histories).zip(rngs.iter_mut()) {
                let message = self.request(history, rng)?;
                socket.send(Message::Binary(message.into())).map_err(broken("asking"))?;
            }
            for (socket, rng) in sockets.iter_mut().zip(rngs).take(histories.len()) {
                chunks.push(self.read(&receive(socket, url)?, rng)?);
            }
        }
        Ok(chunks)
    }
}

impl Policy for RemotePolicy {
    fn n_obs_steps(&self) -> usize {
        self.metadata.n_obs_steps
    }

    fn act(&self, histories: &[Vec<&Observation>], rngs: &mut [Rng]) -> e2h_core::Result<Vec<ActionChunk>> {
        Ok(self.ask(histories, rngs)?)
    }
}

pub(crate) fn socket_error(url: &str, doing: &'static str, source: tungstenite::Error) -> Error {
    Error::Socket { url: url.to_owned(), doing, source: Box::new(source) }
}

/// The next message; words where actions should be are the server's error.
pub(crate) fn receive(socket: &mut Socket, url: &str) -> Result<Value> {
    loop {
        match socket.read().map_err(|e| socket_error(url, "waiting for an answer", e))? {
            Message::Binary(bytes) => return Value::decode(&bytes),
            Message::Text(text) => {
                return Err(Error::Server { url: url.to_owned(), message: text.trim().to_owned() });
            }
            Message::Close(frame) => {
                let message = frame.map_or_else(|| "it closed the connection".to_owned(), |f| f.to_string());
                return Err(Error::Server { url: url.to_owned(), message });
            }
            Message::Ping(_) | Message::Pong(_) | Message::Frame(_) => {}
        }
    }
}

/// A connection, and the first message of the server.
fn open(settings: &RemoteSettings) -> Result<(Socket, Value)> {
    dial(&settings.url, settings.token.as_ref(), settings.patience)
}

/// The same for a server at `url`.
pub(crate) fn dial(url: &str, token: Option<&Token>, patience: Duration) -> Result<(Socket, Value)> {
    let failed = |doing: &'static str| move |source| socket_error(url, doing, source);
    let io = |e| failed("connecting")(tungstenite::Error::Io(e));
    let mut request = url.into_client_request().map_err(failed("reading the address"))?;
    let address = |e| failed("reading the address")(e);
    match uri_mode(request.uri()).map_err(address)? {
        tungstenite::stream::Mode::Plain => {}
        tungstenite::stream::Mode::Tls => {
            return Err(Error::mismatch(
                url,
                "ws://HOST:PORT",
                "wss://, for which a proxy in front of this program is needed",
            ));
        }
    }
    let host = request.uri().host().unwrap_or_default().trim_matches(['[', ']']).to_owned();
    let port = request.uri().port_u16().unwrap_or(PORT);
    if let Some(token) = token {
        let value = HeaderValue::from_str(&token.header()).map_err(|e| {
            failed("writing the token")(tungstenite::Error::from(tungstenite::http::Error::from(e)))
        })?;
        request.headers_mut().insert(AUTHORIZATION, value);
    }
    let mut last = std::io::Error::from(std::io::ErrorKind::AddrNotAvailable);
    let mut stream = None;
    for address in (host.as_str(), port).to_socket_addrs().map_err(io)? {
        match TcpStream::connect_timeout(&address, Duration::from_secs(10)) {
            Ok(connected) => {
                stream = Some(connected);
                break;
            }
            Err(e) => last = e,
        }
    }
    let stream = stream.ok_or_else(|| io(last))?;
    stream.set_nodelay(true).map_err(io)?;
    stream.set_read_timeout(Some(patience)).map_err(io)?;
    stream.set_write_timeout(Some(patience)).map_err(io)?;
    let config = WebSocketConfig::default();
    let (mut socket, _) =
        tungstenite::client::client_with_config(request, stream, Some(config)).map_err(|e| match e {
            tungstenite::HandshakeError::Failure(e) => failed("shaking hands")(e),
            tungstenite::HandshakeError::Interrupted(_) => {
                failed("shaking hands")(tungstenite::Error::Io(std::io::ErrorKind::TimedOut.into()))
            }
        })?;
    let metadata = receive(&mut socket, url)?;
    Ok((socket, metadata))
}
