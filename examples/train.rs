//! Trains a diffusion policy on LeRobotDatasets of any robot.
//!
//! ```text
//! cargo run --release --example train -- --dataset refined/plug_in --out runs/plug_in
//! cargo run --release --example train -- --dataset a --dataset b:0.5 --set data.resize=[72,96] --out runs/both
//! ```

use anyhow::Context as _;
use auto_e2h::core::{Failure, mention, say};
use auto_e2h::learn::imitation::{DatasetShare, Imitated, ImitationOptions, imitate};
use auto_e2h::learn::{Error, Stop};
use clap::Parser;
use std::path::PathBuf;
use std::process::ExitCode;

/// Trains a policy on LeRobotDatasets v3.0: state and action of any width, any cameras, any rate. The policy opens in LeRobot too.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example train -- --dataset refined/plug_in --out runs/plug_in\n  cargo run --release --example train -- --dataset a --dataset b:0.5 --set data.resize=[72,96] --out runs/both"
)]
struct Arguments {
    /// Folder of a dataset, and its share of every batch relative to the others' (may be repeated).
    #[arg(long, value_name = "DIR[:SHARE]", required = true)]
    dataset: Vec<String>,
    /// Sizes and step counts to run with: a file of configs/train. smoke shows in seconds that everything runs, paper is LeRobot's.
    #[arg(long, value_parser = ["smoke", "laptop", "paper"], default_value = "laptop")]
    preset: String,
    /// Folder of the training.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Go on with a training that was stopped: the same command with this.
    #[arg(long)]
    resume: bool,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Override a value of the configuration, for example train.steps=10000 (may be repeated).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Where networks are computed: cpu, cuda or cuda:N.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Threads (by default one per core); never changes a result.
    #[arg(long)]
    threads: Option<usize>,
    /// Show no progress.
    #[arg(long)]
    quiet: bool,
    /// Write TensorBoard event files into the folder's tensorboard/.
    #[arg(long)]
    tensorboard: bool,
}

fn main() -> ExitCode {
    let told = match program(Arguments::parse()) {
        Ok(done) => tell(&done).map_err(Failure::from),
        Err(error) => match error.downcast_ref() {
            Some(&Error::Stopped { signal }) => {
                mention(&error);
                return ExitCode::from(u8::try_from(128 + signal).unwrap_or(1));
            }
            _ => Err(Failure::from(error)),
        },
    };
    let Err(failure) = told else { return ExitCode::SUCCESS };
    mention(format_args!("Error: {failure:?}"));
    ExitCode::FAILURE
}

fn program(a: Arguments) -> anyhow::Result<Imitated> {
    let datasets = a.dataset.iter().map(|d| d.parse::<DatasetShare>()).collect::<Result<_, _>>()?;
    let options = ImitationOptions {
        datasets,
        preset: a.preset,
        set: a.set,
        seed: a.seed,
        out: a.out,
        resume: a.resume,
        device: a.device,
        threads: a.threads,
        quiet: a.quiet,
        tensorboard: a.tensorboard,
        stop: Stop::on_signals().context("handling signals")?,
    };
    Ok(imitate(&options)?)
}

fn tell(done: &Imitated) -> anyhow::Result<()> {
    let held = done.validation_loss.map_or(String::new(), |v| format!(", {v:.4} on held-out episodes"));
    say(format_args!("{} steps, loss {:.4}{held}", done.steps, done.loss))?;
    say(format_args!("last: {}", done.last.display()))?;
    Ok(say(format_args!("best: {}", done.best.display()))?)
}
