//! Measures a published policy.
//!
//! ```text
//! cargo run --release --example evaluate -- --checkpoint checkpoints/nut_assembly --trials 50 --seed 7
//! cargo run --release --example evaluate -- --checkpoint checkpoints/cube_stack --video rollouts.png
//! ```

use anyhow::{Context as _, ensure};
use auto_e2h::core::say;
use auto_e2h::learn::{Filmed, Filming, Progress, Published, evaluate, hub, report};
use auto_e2h::nn::Compute;
use clap::Parser;
use std::path::{Path, PathBuf};

/// Runs a policy from fresh resets and counts successes.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example evaluate -- --checkpoint checkpoints/nut_assembly --trials 50 --seed 7\n  cargo run --release --example evaluate -- --checkpoint checkpoints/cube_stack --video rollouts.png"
)]
struct Arguments {
    /// Folder with policy.json and model.safetensors, or hf://OWNER/NAME[@revision] (feature `hub`).
    #[arg(long, value_name = "DIR")]
    checkpoint: String,
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
    let published = Published::open(&hub::resolve(&a.checkpoint, &hub::Settings::from_env())?)?;
    let compute = Compute::open(&a.device, published.config.device)?;
    let published = published.into_device(&compute)?;
    let parallel = published.config.evaluation.parallel.min(a.trials);
    let progress = Progress::new(a.json);
    let (policy, direction) = (published.policy(), published.direction);
    let filming = Filming { trials: Filmed::FailuresFirst(a.filmed), camera: "table".to_owned(), size: 200 };
    let filming = a.video.is_some().then_some(&filming);
    let envs = published.envs(parallel)?;
    let done = evaluate(envs, policy, direction, 0..a.trials, a.seed, filming, &progress)?;
    let result = &done.evaluation;
    if let Some(path) = &a.video {
        let (outcomes, frames): (Vec<_>, Vec<_>) = done.films.into_iter().unzip();
        report::animation::write_apng(path, &report::animation::tile(&frames, &outcomes, 3), 10)?;
    }

    let task = &published.provenance.task;
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
