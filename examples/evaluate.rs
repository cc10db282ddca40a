//! Measures a published policy, or one behind a socket.
//!
//! ```text
//! cargo run --release --example evaluate -- --checkpoint checkpoints/nut_assembly --trials 50 --video rollouts.png
//! cargo run --release --example evaluate -- --policy ws://127.0.0.1:8000 --task cube_stack --direction hard
//! ```
//!
//! With `--policy` it is any server of openpi's protocol. One of ours says what its policy was trained on, and gives the same
//! result as its checkpoint, to the last trial: the trials' random streams travel with the requests.

use anyhow::{Context as _, bail, ensure};
use auto_e2h::core::{Direction, Policy, say};
use auto_e2h::env::{Env, registry, task};
use auto_e2h::learn::{Evaluated, Filmed, Filming, Progress, Published, RunConfig, evaluate, hub, report};
use auto_e2h::nn::Compute;
use auto_e2h::serve::{Metadata, RemotePolicy, RemoteSettings, Token};
use clap::{Parser, ValueEnum};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Runs a policy from fresh resets and counts successes.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example evaluate -- --checkpoint checkpoints/nut_assembly --trials 50 --video rollouts.png\n  cargo run --release --example evaluate -- --policy ws://127.0.0.1:8000 --task cube_stack --direction hard"
)]
struct Arguments {
    /// Folder with policy.json and model.safetensors, or hf://OWNER/NAME[@revision] (feature `hub`).
    #[arg(long, value_name = "DIR", required_unless_present = "policy", conflicts_with = "policy")]
    checkpoint: Option<String>,
    #[command(flatten)]
    served: Served,
    /// Trials.
    #[arg(long, default_value_t = 50)]
    trials: usize,
    /// Seed of the trials; training never sees 100000 and up.
    #[arg(long, default_value_t = 100_001)]
    seed: u64,
    /// Print one JSON line and nothing else.
    #[arg(long)]
    json: bool,
    /// Write an animation (a .png or .apng that plays) of trials, failures first.
    #[arg(long, value_name = "FILE")]
    video: Option<PathBuf>,
    /// Trials in the animation.
    #[arg(long, default_value_t = 6)]
    filmed: usize,
    /// Where the policy is computed: cpu, cuda or cuda:N.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Threads (by default one per core); never changes a result.
    #[arg(long)]
    threads: Option<usize>,
}

/// What concerns a policy behind a socket.
#[derive(clap::Args)]
struct Served {
    /// A server of openpi's protocol in the place of --checkpoint: ws://HOST:PORT.
    #[arg(long, value_name = "URL")]
    policy: Option<String>,
    /// The task pair (by default what the server says that its policy was trained on).
    #[arg(long, requires = "policy", conflicts_with = "checkpoint")]
    task: Option<String>,
    /// The task of the pair (by default the server's, or hard).
    #[arg(long, value_enum, requires = "policy")]
    direction: Option<Side>,
    /// Preset that simulation and horizons come from, with --task.
    #[arg(long, requires = "task", default_value = "laptop")]
    preset: String,
    /// Override a value of the configuration, for example task.variant=square, with --task (may be repeated).
    #[arg(long, value_name = "KEY=VALUE", requires = "task")]
    set: Vec<String>,
    /// What the server wants to be told (by default the environment's E2H_TOKEN, if there is one).
    #[arg(long, requires = "policy")]
    token: Option<String>,
    /// Side of the images that a server gets which does not say its own, pixels.
    #[arg(long, requires = "policy", default_value_t = 224)]
    image_size: usize,
    /// Actions of an answer that are executed at most before the server is asked again (by default all).
    #[arg(long, requires = "policy")]
    actions: Option<usize>,
    /// Connections to the server (by default one a simulation).
    #[arg(long, requires = "policy")]
    connections: Option<usize>,
}

#[derive(Clone, Copy, ValueEnum)]
enum Side {
    Hard,
    Easy,
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    if let Some(path) = &a.video {
        ensure!(a.filmed > 0, "--filmed: expected at least 1 trial for --video, got 0");
        check_video(path).with_context(|| format!("--video {}", path.display()))?;
    }
    if let Some(n) = a.threads {
        auto_e2h::learn::set_threads(n)?;
    }
    let (task, direction, done) = match (&a.checkpoint, &a.served.policy) {
        (Some(checkpoint), _) => published(&a, checkpoint)?,
        (None, Some(url)) => served(&a, url)?,
        (None, None) => bail!("expected --checkpoint DIR or --policy URL"),
    };
    let result = &done.evaluation;
    if let Some(path) = &a.video {
        let (outcomes, frames): (Vec<_>, Vec<_>) = done.films.into_iter().unzip();
        report::animation::write_apng(path, &report::animation::tile(&frames, &outcomes, 3), 10)?;
    }

    if a.json {
        let line = serde_json::json!({
            "task": task,
            "trials": result.trials,
            "outcomes": result.outcomes,
            "successes": result.successes,
            "wilson95": result.wilson95,
            "seconds": result.seconds,
        });
        say(line)?;
    } else {
        let [lo, hi] = result.wilson95;
        say(format_args!(
            "{task} ({direction}): {} of {} trials succeeded, 95 % Wilson interval {:.0} to {:.0} %, {:.0} s",
            result.successes,
            result.trials,
            lo * 100.0,
            hi * 100.0,
            result.seconds
        ))?;
    }
    Ok(())
}

/// What was measured, and what came of it.
type Measured = (String, Direction, Evaluated);

fn published(a: &Arguments, checkpoint: &str) -> anyhow::Result<Measured> {
    let published = Published::open(&hub::resolve(checkpoint, &hub::Settings::from_env())?)?;
    let compute = Compute::open(&a.device, published.config.device)?;
    let published = published.into_device(&compute)?;
    let envs = published.envs(published.config.evaluation.parallel.min(a.trials))?;
    let done = measure(a, envs, published.policy(), published.direction)?;
    Ok((published.provenance.task.clone(), published.direction, done))
}

fn served(a: &Arguments, url: &str) -> anyhow::Result<Measured> {
    let token = a.served.token.clone().or_else(|| std::env::var("E2H_TOKEN").ok());
    let prompt = |task: &str| task.replace('_', " ");
    let settings = RemoteSettings {
        url: url.to_owned(),
        token: token.map(|t| Token::new(&t)).transpose()?,
        connections: 1,
        patience: Duration::from_secs(120),
        prompt: a.served.task.as_deref().map(prompt).unwrap_or_default(),
        cameras: vec![],
        most_actions: a.served.actions,
    };
    let policy = RemotePolicy::connect(settings)?;
    let direction = match (a.served.direction, policy.metadata().direction.as_deref()) {
        (Some(Side::Easy), _) | (None, Some("easy")) => Direction::Easy,
        _ => Direction::Hard,
    };
    let mut config = configuration(&a.served, policy.metadata())?;
    let cameras = policy.metadata().cameras.clone();
    match &cameras {
        Some(cameras) => {
            let sizes: Vec<usize> = cameras.iter().flat_map(|c| [c.height, c.width]).collect();
            let alike = sizes.windows(2).all(|w| w[0] == w[1]);
            ensure!(alike, "the server's cameras: expected squares of one size, found {cameras:?}");
            config.env.cameras = !cameras.is_empty();
            config.env.image_size = sizes.first().copied().unwrap_or(config.env.image_size);
        }
        None => (config.env.cameras, config.env.image_size) = (true, a.served.image_size),
    }
    let problems = config.env.validate();
    ensure!(problems.is_empty(), "{}", problems.join("; "));
    let mut env = Env::new(task(&config.task.name, &config.task.options())?, &config.env)?;
    if let Some(cameras) = cameras {
        env.select_cameras(&cameras.into_iter().map(|c| c.name).collect::<Vec<_>>())?;
    }
    let parallel = config.evaluation.parallel.min(a.trials).max(1);
    let policy = policy.prepare(env.cameras(), a.served.connections.unwrap_or(parallel))?;
    let envs = (0..parallel).map(|_| env.clone_shared()).collect::<Result<Vec<_>, _>>()?;
    let done = measure(a, envs, &policy, direction)?;
    Ok((config.task.name, direction, done))
}

/// The configuration whose simulation is run: that of `--task`, or the one that the server's policy was trained with.
fn configuration(a: &Served, server: &Metadata) -> anyhow::Result<RunConfig> {
    match (&a.task, &server.run) {
        (Some(task), _) => Ok(RunConfig::resolve(&a.preset, task, &a.set)?.config),
        (None, Some(run)) => {
            let config: RunConfig = serde_json::from_str(run)
                .context("the run that the server's policy is of; --task names another")?;
            config.validate().context("the run that the server's policy is of; --task names another")?;
            Ok(config)
        }
        (None, None) => {
            bail!("--task: the server does not say its own, expected one of {}", registry().join(", "))
        }
    }
}

fn measure(
    a: &Arguments,
    envs: Vec<Env>,
    policy: &dyn Policy,
    direction: Direction,
) -> anyhow::Result<Evaluated> {
    let filming = Filming { trials: Filmed::FailuresFirst(a.filmed), camera: "table".to_owned(), size: 200 };
    let filming = a.video.is_some().then_some(&filming);
    Ok(evaluate(envs, policy, direction, 0..a.trials, a.seed, filming, &Progress::new(a.json))?)
}

/// Refuses, before any trial, a place that no animation can be written to.
fn check_video(path: &Path) -> anyhow::Result<()> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    ensure!(
        ["png", "apng"].iter().any(|known| extension.eq_ignore_ascii_case(known)),
        "expected a name that ends in .png or .apng, which is what an animation is written as, found `.{extension}`"
    );
    let there = path.exists();
    std::fs::OpenOptions::new().append(true).create(true).open(path)?;
    if !there {
        std::fs::remove_file(path)?;
    }
    Ok(())
}
