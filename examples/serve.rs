//! Serves a policy to openpi's clients over a websocket.
//!
//! ```text
//! cargo run --release --example serve -- --checkpoint checkpoints/nut_assembly --listen 127.0.0.1:8000
//! cargo run --release --example serve -- --checkpoint downloaded --listen 0.0.0.0:8000 --token-file token
//! ```
//!
//! `GET /healthz` says whether it is well, `GET /metrics` what it has done. SIGINT and SIGTERM end it when everything that was
//! asked is answered, with status 130 and 143.

use auto_e2h::core::{Failure, mention, say};
use auto_e2h::learn::{Error, Stop, hub};
use auto_e2h::nn::{Compute, Precision};
use auto_e2h::serve::{Inputs, Server, Settings, Token, open_on};
use clap::Parser;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

/// Answers observations with actions, in openpi's protocol.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example serve -- --checkpoint checkpoints/nut_assembly --listen 127.0.0.1:8000\n  cargo run --release --example serve -- --checkpoint downloaded --listen 0.0.0.0:8000 --token-file token"
)]
struct Arguments {
    /// A checkpoint of ours (policy.json) or of LeRobot's (config.json), or hf://OWNER/NAME[@revision] (feature `hub`).
    #[arg(long, value_name = "DIR")]
    checkpoint: String,
    /// Address and port; port 0 takes a free one. Other addresses than loopback want a token.
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1:8000")]
    listen: SocketAddr,
    /// File with the token that clients have to send; without it the environment's E2H_TOKEN, if there is one.
    #[arg(long, value_name = "FILE")]
    token_file: Option<PathBuf>,
    /// Requests that one call of the network answers at most.
    #[arg(long, default_value_t = 16)]
    max_batch: usize,
    /// Clients at once.
    #[arg(long, default_value_t = 64)]
    max_clients: usize,
    /// Largest message, MiB.
    #[arg(long, default_value_t = 64)]
    max_message: usize,
    /// Seconds that a client may be silent.
    #[arg(long, default_value_t = 600)]
    idle: u64,
    /// Seconds that an answer may take.
    #[arg(long, default_value_t = 60)]
    patience: u64,
    /// Seed of the clients that send none.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Where the policy is computed: cpu, cuda or cuda:N.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Threads of the network (by default one per core); never changes an answer.
    #[arg(long)]
    threads: Option<usize>,
}

fn main() -> ExitCode {
    match program() {
        Ok(signal) => ExitCode::from(u8::try_from(128 + signal).unwrap_or(1)),
        Err(error) => {
            mention(format_args!("Error: {:?}", Failure::from(error)));
            ExitCode::FAILURE
        }
    }
}

/// Serves until a signal comes, and says which.
fn program() -> anyhow::Result<i32> {
    let a = Arguments::parse();
    if let Some(n) = a.threads {
        auto_e2h::learn::set_threads(n)?;
    }
    let token = match (&a.token_file, std::env::var("E2H_TOKEN")) {
        (Some(file), _) => Some(Token::read(file)?),
        (None, Ok(text)) => Some(Token::new(&text)?),
        (None, Err(_)) => None,
    };
    let settings = Settings {
        listen: a.listen,
        max_batch: a.max_batch,
        max_clients: a.max_clients,
        max_message: a.max_message.saturating_mul(1 << 20),
        idle: Duration::from_secs(a.idle),
        inference: Duration::from_secs(a.patience),
        token,
        seed: a.seed,
    };
    let stop = Stop::on_signals()?;
    let compute = Compute::open(&a.device, Precision::default())?;
    let policy = open_on(&hub::resolve(&a.checkpoint, &hub::Settings::from_env())?, &compute)?;
    let server = Server::start(policy, settings)?;
    say(format_args!("ws://{}: {}", server.address(), words(server.inputs())))?;
    loop {
        match stop.check() {
            Ok(()) => std::thread::sleep(Duration::from_millis(50)),
            Err(Error::Stopped { signal }) => {
                server.stop();
                return Ok(signal);
            }
            Err(error) => return Err(error.into()),
        }
    }
}

/// What a policy takes and gives, on one line.
fn words(i: &Inputs) -> String {
    let task = i.provenance.as_ref().map(|p| p.task.as_str()).filter(|t| !t.is_empty()).unwrap_or("a policy");
    let mut takes = vec![format!("{} numbers of state", i.state)];
    if i.environment > 0 {
        takes.push(format!("{} of the environment", i.environment));
    }
    takes.extend(i.cameras.iter().map(|c| format!("{} ({} x {})", c.name, c.height, c.width)));
    let (steps, takes) = (i.n_obs_steps, takes.join(", "));
    format!("{task}, {steps} step(s) of {takes}; {} actions of {} numbers", i.n_action_steps, i.action)
}
