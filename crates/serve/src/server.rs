//! The server: its settings, its life, and the addresses that it answers.

use crate::inference::{Job, answer};
use crate::metrics::Metrics;
use crate::servable::{Inputs, Servable};
use crate::session::session;
use crate::token::Token;
use crate::{Error, Result};
use axum::Router;
use axum::extract::State;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::ws::rejection::WebSocketUpgradeRejection;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use http::{HeaderMap, StatusCode};
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;
use tokio::sync::{Semaphore, mpsc, watch};

/// Connections beside those of clients, for health and metrics.
const OTHERS: usize = 64;
/// How long an HTTP request may take to arrive.
const HEADERS: Duration = Duration::from_secs(10);

/// How a server serves.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Where it listens. Other addresses than loopback want a token.
    pub listen: SocketAddr,
    /// Requests that one call of the network answers at most.
    pub max_batch: usize,
    /// Clients at once.
    pub max_clients: usize,
    /// Bytes of a message.
    pub max_message: usize,
    /// How long a client may be silent, or in the middle of a message.
    pub idle: Duration,
    /// How long an answer may take, waiting included.
    pub inference: Duration,
    /// What clients have to know.
    pub token: Option<Token>,
    /// Where the random numbers of clients begin that send no seed.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            listen: SocketAddr::from(([127, 0, 0, 1], 8000)),
            max_batch: 16,
            max_clients: 64,
            max_message: 64 << 20,
            idle: Duration::from_secs(600),
            inference: Duration::from_secs(60),
            token: None,
            seed: 0,
        }
    }
}

impl Settings {
    fn check(&self) -> Result<()> {
        let ask = |ok: bool, setting: &'static str, expected: &'static str, found: String| {
            if ok { Ok(()) } else { Err(Error::Setting { setting, expected, found }) }
        };
        ask((1..=1024).contains(&self.max_batch), "max-batch", "1 to 1024", self.max_batch.to_string())?;
        let clients = self.max_clients;
        ask((1..=4096).contains(&clients), "max-clients", "1 to 4096", clients.to_string())?;
        let message = self.max_message;
        ask((1024..=1 << 30).contains(&message), "max-message", "1 KiB to 1 GiB", message.to_string())?;
        ask(!self.idle.is_zero(), "idle time-out", "more than 0 s", format!("{:?}", self.idle))?;
        let inference = format!("{:?}", self.inference);
        ask(!self.inference.is_zero(), "inference time-out", "more than 0 s", inference)?;
        if !self.listen.ip().is_loopback() && self.token.is_none() {
            return Err(Error::Open { address: self.listen });
        }
        Ok(())
    }
}

/// What all connections share.
pub(crate) struct Shared {
    pub(crate) settings: Settings,
    pub(crate) inputs: Inputs,
    pub(crate) metadata: Vec<u8>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) jobs: mpsc::Sender<Job>,
    pub(crate) stop: watch::Receiver<bool>,
    clients: Arc<Semaphore>,
    connections: std::sync::atomic::AtomicU64,
}

/// A server that runs, until [`Server::stop`] or until it is dropped.
pub struct Server {
    address: SocketAddr,
    inputs: Inputs,
    stop: watch::Sender<bool>,
    threads: Vec<JoinHandle<()>>,
}

impl Server {
    /// Listens, and answers from then on.
    ///
    /// # Errors
    /// When a setting cannot work, an address that others reach comes without a token, or it cannot be listened at.
    pub fn start(policy: Box<dyn Servable>, settings: Settings) -> Result<Self> {
        settings.check()?;
        let failed = |doing: &str| {
            let doing = doing.to_owned();
            move |source| Error::Io { doing, source }
        };
        let listening = format!("listening at {}", settings.listen);
        let listener = TcpListener::bind(settings.listen).map_err(failed(&listening))?;
        listener.set_nonblocking(true).map_err(failed(&listening))?;
        let address = listener.local_addr().map_err(failed(&listening))?;
        let runtime = tokio::runtime::Builder::new_current_thread()
            .enable_io()
            .enable_time()
            .build()
            .map_err(failed("starting the server"))?;
        let inputs = policy.inputs();
        let metrics = Arc::new(Metrics::new()?);
        let (jobs, waiting) = mpsc::channel(settings.max_clients);
        let (stop, stopped) = watch::channel(false);
        let shared = Arc::new(Shared {
            metadata: inputs.metadata().encode(),
            inputs: inputs.clone(),
            metrics: metrics.clone(),
            jobs,
            stop: stopped,
            clients: Arc::new(Semaphore::new(settings.max_clients)),
            connections: std::sync::atomic::AtomicU64::new(0),
            settings,
        });
        let max_batch = shared.settings.max_batch;
        let network = std::thread::Builder::new()
            .name("inference".to_owned())
            .spawn(move || answer(&*policy, waiting, max_batch, &metrics))
            .map_err(failed("starting the server"))?;
        let sockets = std::thread::Builder::new()
            .name("sockets".to_owned())
            .spawn(move || runtime.block_on(listen(listener, shared)))
            .map_err(failed("starting the server"))?;
        Ok(Self { address, inputs, stop, threads: vec![sockets, network] })
    }

    /// Where it listens: the port too, where 0 was asked for.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// What it asks for.
    #[must_use]
    pub fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    /// Takes no new client, answers what was asked, says goodbye to every client, and ends.
    pub fn stop(self) {}
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.stop.send(true);
        for thread in self.threads.drain(..) {
            // A thread that panicked has nothing left to be waited for.
            let _ = thread.join();
        }
    }
}

async fn listen(listener: TcpListener, shared: Arc<Shared>) {
    let Ok(listener) = tokio::net::TcpListener::from_std(listener) else { return };
    let router = Router::new()
        .route("/healthz", get(|| async { "OK\n" }))
        .route("/metrics", get(metrics))
        .fallback(connect)
        .with_state(shared.clone());
    let open = Arc::new(Semaphore::new(shared.settings.max_clients + OTHERS));
    let mut stop = shared.stop.clone();
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            _ = stop.wait_for(|stop| *stop) => break,
        };
        let Ok((stream, _)) = accepted else {
            // Such as too many open files: others may be closed meanwhile.
            tokio::time::sleep(Duration::from_millis(50)).await;
            continue;
        };
        let Ok(permit) = open.clone().try_acquire_owned() else {
            shared.metrics.refused.inc();
            continue;
        };
        let _ = stream.set_nodelay(true);
        let service = TowerToHyperService::new(router.clone());
        tokio::spawn(async move {
            let mut http = hyper::server::conn::http1::Builder::new();
            http.timer(TokioTimer::new()).header_read_timeout(HEADERS);
            // What breaks here is a client's connection before it is one of the protocol.
            let served = http.serve_connection(TokioIo::new(stream), service).with_upgrades();
            let _ = tokio::time::timeout(HEADERS * 2, served).await;
            drop(permit);
        });
    }
    drop(listener);
    // Every client has given its place back when its session has ended.
    let all = u32::try_from(shared.settings.max_clients).unwrap_or(u32::MAX);
    let limit = shared.settings.inference + Duration::from_secs(5);
    let _ = tokio::time::timeout(limit, shared.clients.acquire_many(all)).await;
}

fn refuse(shared: &Shared, status: StatusCode, words: &'static str) -> Response {
    shared.metrics.refused.inc();
    (status, words).into_response()
}

const NO_TOKEN: &str = "expected `Authorization: Bearer TOKEN` or `Api-Key TOKEN` with the server's token\n";

async fn metrics(State(shared): State<Arc<Shared>>, headers: HeaderMap) -> Response {
    if shared.settings.token.as_ref().is_some_and(|token| !token.is_in(&headers)) {
        return refuse(&shared, StatusCode::UNAUTHORIZED, NO_TOKEN);
    }
    let kind = [("content-type", "text/plain; version=0.0.4")];
    match shared.metrics.text() {
        Ok(text) => (kind, text).into_response(),
        Err(error) => (StatusCode::INTERNAL_SERVER_ERROR, error.to_string()).into_response(),
    }
}

async fn connect(
    State(shared): State<Arc<Shared>>,
    headers: HeaderMap,
    upgrade: std::result::Result<WebSocketUpgrade, WebSocketUpgradeRejection>,
) -> Response {
    if shared.settings.token.as_ref().is_some_and(|token| !token.is_in(&headers)) {
        return refuse(&shared, StatusCode::UNAUTHORIZED, NO_TOKEN);
    }
    let upgrade = match upgrade {
        Ok(upgrade) => upgrade,
        Err(rejection) => return rejection.into_response(),
    };
    let Ok(place) = shared.clients.clone().try_acquire_owned() else {
        return refuse(&shared, StatusCode::SERVICE_UNAVAILABLE, "as many clients as --max-clients allows\n");
    };
    if *shared.stop.borrow() {
        return refuse(&shared, StatusCode::SERVICE_UNAVAILABLE, "the server is stopping\n");
    }
    let number = shared.connections.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    let most = shared.settings.max_message;
    upgrade.max_message_size(most).max_frame_size(most).on_upgrade(async move |socket| {
        shared.metrics.clients.inc();
        session(socket, &shared, number).await;
        shared.metrics.clients.dec();
        drop(place);
    })
}
