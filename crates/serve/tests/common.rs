//! A small policy, a server of it, and clients that know the protocol and nothing else.

use e2h_core::{Direction, Episode, Image, Observation, Origin, Rng, stream};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_policy::{DiffusionPolicy, PolicyConfig};
use e2h_serve::wire::{Array, Value};
use e2h_serve::{Inputs, Result, Seen, Servable, Server, Settings};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;
use tungstenite::{Message, WebSocket};

/// A policy of ours with drawn weights.
pub(crate) fn policy(cameras: &[&str]) -> DiffusionPolicy {
    let config =
        PolicyConfig { cameras: cameras.iter().map(|c| (*c).to_owned()).collect(), ..PolicyConfig::tiny() };
    let mut path = Episode::new(Origin::demonstration("made up", Direction::Hard, 0, 0), &[]);
    for t in 0..50_u16 {
        let x = f32::from(t) * 0.01;
        let state = [x, -x, 0.5 * x + 0.1, 0., 1., 0., 0., 0.3 + x, x, 0.1, 1., 0., 0., 0., 0.03 + 0.1 * x];
        path.push(&Observation { state, frames: vec![] }, &[x, -x, 0.5 * x, 0., 1., 0., 0., 1.]).unwrap();
    }
    let margin = NormaliserConfig { margin: 0.1, ..NormaliserConfig::default() };
    DiffusionPolicy::untrained(&config, &Normaliser::fit(&[path], &margin).unwrap(), 7).unwrap()
}

pub(crate) fn settings() -> Settings {
    Settings { listen: SocketAddr::from(([127, 0, 0, 1], 0)), ..Settings::default() }
}

/// A policy that thinks for a while.
pub(crate) struct Slow(pub(crate) DiffusionPolicy, pub(crate) Duration);

impl Servable for Slow {
    fn inputs(&self) -> Inputs {
        self.0.inputs()
    }

    fn act(&self, histories: Vec<Vec<Seen>>, rngs: &mut [Rng]) -> Result<Vec<Vec<Vec<f32>>>> {
        std::thread::sleep(self.1);
        self.0.act(histories, rngs)
    }
}

/// An observation by its number, and what a client of it sends.
pub(crate) fn seen(k: u64, inputs: &Inputs) -> Seen {
    let number = |i: usize| (((k * 13 + i as u64 * 7) % 23) as f32) * 0.02;
    let image = |c: usize| {
        let (height, width) = (inputs.cameras[c].height, inputs.cameras[c].width);
        let byte = |i: usize| ((i as u64).wrapping_mul(2_654_435_761 + k * 977 + c as u64) >> 11) as u8;
        Image { height, width, data: (0..height * width * 3).map(byte).collect() }
    };
    Seen {
        state: (0..inputs.state).map(number).collect(),
        environment: vec![],
        images: (0..inputs.cameras.len()).map(image).collect(),
    }
}

pub(crate) fn entries(seen: &Seen, inputs: &Inputs) -> Vec<(String, Value)> {
    let mut all = vec![("observation/state".to_owned(), Array::f32(&[seen.state.len()], &seen.state).into())];
    for (camera, image) in inputs.cameras.iter().zip(&seen.images) {
        all.push((format!("observation/images/{}", camera.name), Array::image(image).into()));
    }
    all
}

pub(crate) fn message(entries: Vec<(String, Value)>) -> Value {
    Value::Map(entries.into_iter().collect())
}

/// What the policy itself answers to an observation with a seed.
pub(crate) fn direct(policy: &dyn Servable, k: u64, seed: u64) -> Vec<f32> {
    let inputs = policy.inputs();
    let history = vec![seen(k, &inputs); inputs.n_obs_steps];
    policy.act(vec![history], &mut [stream(seed, "serve/act", 0, 0)]).unwrap().remove(0).concat()
}

pub(crate) struct Client {
    pub(crate) socket: WebSocket<TcpStream>,
    pub(crate) metadata: Value,
}

impl Client {
    pub(crate) fn new(server: &Server) -> Self {
        Self::with(server.address(), None).unwrap()
    }

    pub(crate) fn with(
        address: SocketAddr,
        authorization: Option<&str>,
    ) -> std::result::Result<Self, String> {
        let stream = TcpStream::connect(address).map_err(|e| e.to_string())?;
        stream.set_read_timeout(Some(Duration::from_secs(60))).unwrap();
        let mut request =
            tungstenite::client::IntoClientRequest::into_client_request(format!("ws://{address}")).unwrap();
        if let Some(value) = authorization {
            request.headers_mut().insert("authorization", value.parse().unwrap());
        }
        let (mut socket, _) = tungstenite::client(request, stream).map_err(|e| e.to_string())?;
        let first = socket.read().map_err(|e| e.to_string())?;
        Ok(Self { metadata: Value::decode(&first.into_data()).map_err(|e| e.to_string())?, socket })
    }

    pub(crate) fn send(&mut self, bytes: Vec<u8>) {
        self.socket.send(Message::Binary(bytes.into())).unwrap();
    }

    pub(crate) fn receive(&mut self) -> Message {
        self.socket.read().unwrap()
    }

    /// The answer to a request.
    pub(crate) fn infer(&mut self, request: &Value) -> Value {
        self.send(request.encode());
        match self.receive() {
            Message::Binary(bytes) => Value::decode(&bytes).unwrap(),
            other => panic!("expected an answer, got {other:?}"),
        }
    }

    /// The words of the error that follows, and then the close with 1011.
    pub(crate) fn error(&mut self) -> String {
        let words = match self.receive() {
            Message::Text(words) => words.to_string(),
            other => panic!("expected an error, got {} bytes of another kind", other.len()),
        };
        match self.receive() {
            Message::Close(Some(frame)) => assert_eq!(u16::from(frame.code), 1011),
            other => panic!("expected a close, got {other:?}"),
        }
        words
    }
}

pub(crate) fn actions(answer: &Value) -> Vec<f32> {
    match answer.get("actions") {
        Some(Value::Array(array)) => array.to_f32(),
        other => panic!("expected actions, got {other:?}"),
    }
}

/// A page over HTTP: status line and body.
pub(crate) fn page(address: SocketAddr, path: &str, header: &str) -> (String, String) {
    use std::io::{Read as _, Write as _};
    let mut stream = TcpStream::connect(address).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: x\r\nConnection: close\r\n{header}\r\n").unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    let (head, body) = text.split_once("\r\n\r\n").unwrap();
    (head.lines().next().unwrap().to_owned(), body.to_owned())
}

/// A number of `/metrics`.
pub(crate) fn metric(server: &Server, name: &str) -> f64 {
    let text = page(server.address(), "/metrics", "").1;
    let line = text.lines().find_map(|l| l.strip_prefix(name)?.strip_prefix(' ').map(str::to_owned));
    line.unwrap_or_else(|| panic!("{name} in {text}")).parse().unwrap()
}
