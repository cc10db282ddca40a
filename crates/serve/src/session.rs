//! One client: metadata first, then an answer to every message, until something is wrong or one of both goes.

use crate::inference::{Answer, Job};
use crate::request::{Request, STREAM, actions, write_stream};
use crate::server::Shared;
use crate::wire::Value;
use crate::{Error, Result};
use axum::extract::ws::{CloseFrame, Message, WebSocket, close_code};
use e2h_core::{Rng, stream};
use rand::RngCore as _;
use std::time::{Duration, Instant};
use tokio::sync::oneshot;
use tokio::time::timeout;

/// How long a client that is being left may take to say goodbye.
const GOODBYE: Duration = Duration::from_secs(1);

/// Random numbers of a connection.
struct Seeds {
    server: u64,
    connection: u64,
    resets: u64,
    rng: Rng,
}

impl Seeds {
    fn new(server: u64, connection: u64) -> Self {
        Self { server, connection, resets: 0, rng: Self::begin(server, connection, 0) }
    }

    fn begin(server: u64, connection: u64, resets: u64) -> Rng {
        stream(server, "serve/connection", connection, resets)
    }

    fn reset(&mut self) {
        self.resets += 1;
        self.rng = Self::begin(self.server, self.connection, self.resets);
    }

    /// The next seed; of 53 bits, which every language reads back exactly.
    fn next(&mut self) -> u64 {
        self.rng.next_u64() >> 11
    }
}

/// The stream of an answer with a seed.
pub(crate) fn seeded(seed: u64) -> Rng {
    stream(seed, "serve/act", 0, 0)
}

pub(crate) async fn session(mut socket: WebSocket, shared: &Shared, number: u64) {
    let ended = converse(&mut socket, shared, number).await;
    let (code, words) = match ended {
        Ok(()) => (close_code::AWAY, "the server stops".to_owned()),
        Err(None) => return,
        Err(Some(error)) => {
            shared.metrics.errors.inc();
            let text = error.to_string();
            // As openpi's server does: the words as text, then the close.
            let sent = socket.send(Message::Text(text.clone().into()));
            if !matches!(timeout(GOODBYE, sent).await, Ok(Ok(()))) {
                return;
            }
            (close_code::ERROR, text)
        }
    };
    // A reason has 123 bytes at most.
    let mut end = words.len().min(123);
    while !words.is_char_boundary(end) {
        end -= 1;
    }
    let frame = CloseFrame { code, reason: words[..end].into() };
    if matches!(timeout(GOODBYE, socket.send(Message::Close(Some(frame)))).await, Ok(Ok(()))) {
        // What is still on its way is read, so that the system does not cut off the last words.
        let _ = timeout(GOODBYE, async { while let Some(Ok(_)) = socket.recv().await {} }).await;
    }
}

/// Until the server stops (Ok), the client has gone (None), or something was wrong.
async fn converse(
    socket: &mut WebSocket,
    shared: &Shared,
    number: u64,
) -> std::result::Result<(), Option<Error>> {
    let settings = &shared.settings;
    let mut seeds = Seeds::new(settings.seed, number);
    let mut stop = shared.stop.clone();
    let mut previous = None;
    send(socket, shared.metadata.clone(), settings.idle).await?;
    loop {
        let received = tokio::select! {
            // What has arrived is answered before the server stops.
            biased;
            received = timeout(settings.idle, socket.recv()) => received,
            _ = stop.wait_for(|stop| *stop) => return Ok(()),
        };
        let start = Instant::now();
        let message = match received {
            Err(_) => return Err(Some(Error::Idle { limit: settings.idle })),
            Ok(None) => return Err(None),
            Ok(Some(Ok(message))) => message,
            Ok(Some(Err(error))) => {
                let error = error.into_inner();
                if error.downcast_ref().is_some_and(cut_off) {
                    return Err(None);
                }
                let most = settings.max_message;
                let expected = format!("one of the websocket protocol, of at most {most} bytes");
                return Err(Some(Error::mismatch("message", expected, error.to_string())));
            }
        };
        let bytes = match message {
            Message::Binary(bytes) => bytes,
            Message::Text(_) => return Err(Some(Error::mismatch("message", "a binary one", "text"))),
            Message::Close(_) => return Err(None),
            Message::Ping(_) | Message::Pong(_) => continue,
        };
        let reply = answer(&bytes, shared, &mut seeds, previous).await.map_err(Some)?;
        send(socket, reply, settings.idle).await?;
        previous = Some(start.elapsed().as_secs_f64());
        shared.metrics.requests.inc();
        shared.metrics.latency.observe(start.elapsed().as_secs_f64());
        if *stop.borrow() {
            return Ok(());
        }
    }
}

/// Whether a client has gone without a word.
fn cut_off(error: &tungstenite::Error) -> bool {
    use tungstenite::Error::{AlreadyClosed, ConnectionClosed, Io, Protocol};
    use tungstenite::error::ProtocolError::ResetWithoutClosingHandshake;
    matches!(error, Io(_) | ConnectionClosed | AlreadyClosed | Protocol(ResetWithoutClosingHandshake))
}

/// Sends bytes to a client that takes them; one that does not has gone.
async fn send(
    socket: &mut WebSocket,
    bytes: Vec<u8>,
    limit: Duration,
) -> std::result::Result<(), Option<Error>> {
    match timeout(limit, socket.send(Message::Binary(bytes.into()))).await {
        Ok(Ok(())) => Ok(()),
        _ => Err(None),
    }
}

async fn answer(bytes: &[u8], shared: &Shared, seeds: &mut Seeds, previous: Option<f64>) -> Result<Vec<u8>> {
    let request = Request::read(&Value::decode(bytes)?, &shared.inputs)?;
    if request.reset {
        seeds.reset();
    }
    let own_stream = request.stream.is_some();
    let seed = request.seed.unwrap_or_else(|| seeds.next());
    let rng = request.stream.unwrap_or_else(|| seeded(seed));
    let (reply, answered) = oneshot::channel();
    let gone = || Error::Inference("its thread has ended".to_owned());
    let limit = shared.settings.inference;
    let ask = async {
        let job = Job { history: request.history, rng, reply };
        shared.jobs.send(job).await.map_err(|_| gone())?;
        answered.await.map_err(|_| gone())?
    };
    let Answer { actions: chunk, rng, infer_ms } =
        timeout(limit, ask).await.map_err(|_| Error::Slow { limit })??;
    let mut timing = vec![("infer_ms", Value::Float(infer_ms))];
    timing.extend(previous.map(|seconds| ("prev_total_ms", Value::Float(seconds * 1e3))));
    let mut all = vec![
        ("actions", Value::from(actions(&chunk, shared.inputs.action))),
        ("server_timing", Value::map(timing)),
    ];
    if own_stream {
        all.push((STREAM, write_stream(&rng)));
    } else {
        all.push(("seed", seed.into()));
    }
    Ok(Value::map(all).encode())
}
