//! What every benchmark example has: a command line, a way to end, and words.

use auto_e2h::core::{Failure, Team, mention, say};
pub(crate) use auto_e2h::learn::Run;
use auto_e2h::learn::record::RunResults;
use auto_e2h::learn::{Error, Parts, Result, RunOptions, Stop, report};
use clap::{CommandFactory as _, FromArgMatches as _, Parser, ValueEnum};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

/// What a run ends with: its results, and where its page is.
pub(crate) type Learned = (RunResults, PathBuf);

/// Learns a pair with what the command line asks for, and tells how it went. SIGINT and SIGTERM end it with its state saved, and
/// with status 130 and 143. Started several times by `mpirun` or `srun`, all processes learn together.
pub(crate) fn main(task: &str, parts: Parts, learn: fn(&Run) -> Result<Learned>) -> ExitCode {
    let options = options(task);
    let team = match auto_e2h::mpi::team() {
        Ok(team) => team,
        Err(error) => {
            if speaks() {
                mention(format_args!("Error: {error}"));
            }
            return ExitCode::FAILURE;
        }
    };
    let done = options
        .and_then(|o| Run::open_team(&o, &parts, team.clone()))
        .and_then(|run| run.learn_alone().unwrap_or_else(|| learn(&run)));
    let told = match done {
        // The first rank has said it, and ends all; if it cannot, this one does.
        Err(Error::Led(_)) => {
            std::thread::sleep(Duration::from_secs(5));
            team.abort("", 1);
        }
        Ok(_) if team.rank() > 0 => return ExitCode::SUCCESS,
        Ok((results, page)) => say(report::table::iterations(&results))
            .and_then(|()| say(format_args!("report: {}", page.display())))
            .map_err(Failure::from),
        Err(Error::Stopped { signal }) => {
            mention(Error::Stopped { signal });
            return ended(&*team, u8::try_from(128 + signal).unwrap_or(1));
        }
        Err(error) => Err(Failure::from(error)),
    };
    let Err(failure) = told else { return ExitCode::SUCCESS };
    mention(format_args!("Error: {failure:?}"));
    ended(&*team, 1)
}

/// Ends this process; with others, ends them too, which would wait for it.
fn ended(team: &dyn Team, status: u8) -> ExitCode {
    if team.size() > 1 { team.abort("", status) } else { ExitCode::from(status) }
}

/// Whether this process tells what is wrong; the others leave it the time to, as the end of one ends all.
fn speaks() -> bool {
    let speaks = auto_e2h::mpi::speaks();
    if !speaks {
        std::thread::sleep(Duration::from_secs(1));
    }
    speaks
}

#[derive(Clone, Copy, ValueEnum)]
enum Preset {
    /// Under a minute; shows that everything runs.
    Smoke,
    /// Two CPU cores, images and state; the default.
    Laptop,
    /// The paper's values.
    Paper,
}

/// Learns the hard task of a pair from reversed demonstrations of the easy one.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Sizes and step counts to run with.
    #[arg(long, value_enum, default_value = "laptop")]
    preset: Preset,
    /// What the loop teaches, by its name in configs/methods.
    #[arg(long, default_value = "auto-e2h")]
    method: String,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Updates of the hard policy (by default the preset's).
    #[arg(long)]
    iterations: Option<u32>,
    /// Run directory (by default runs/<task>-<preset>-<seed>).
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Easy demonstrations of one's own in place of scripted ones: a LeRobot dataset as runs and `teleop` record it.
    #[arg(long, value_name = "DIR")]
    demonstrations: Option<PathBuf>,
    /// Go on with a run directory that exists.
    #[arg(long)]
    resume: bool,
    /// Where networks are computed: cpu, cuda or cuda:N.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Override a value of the configuration, for example loop.cycles=20 (may be repeated).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Threads (by default one per core); never changes a result.
    #[arg(long)]
    threads: Option<usize>,
    /// Show no progress.
    #[arg(long)]
    quiet: bool,
    /// Write TensorBoard event files into the run directory's tensorboard/.
    #[arg(long)]
    tensorboard: bool,
}

/// What the command line asks for.
fn options(task: &str) -> Result<RunOptions> {
    let example = env!("CARGO_BIN_NAME");
    let command = Arguments::command().after_help(format!(
        "Examples:\n  cargo run --release --example {example} -- --preset smoke\n  cargo run --release --example {example} -- \
         --seed 1 --set loop.cycles=20"
    ));
    let a = command
        .try_get_matches()
        .and_then(|m| Arguments::from_arg_matches(&m))
        .unwrap_or_else(|e| if speaks() { e.exit() } else { std::process::exit(e.exit_code()) });
    let preset = match a.preset {
        Preset::Smoke => "smoke",
        Preset::Laptop => "laptop",
        Preset::Paper => "paper",
    };
    let mut set = a.set;
    set.extend(a.iterations.map(|n| format!("loop.iterations={n}")));
    Ok(RunOptions {
        task: task.to_owned(),
        preset: preset.to_owned(),
        method: a.method,
        seed: a.seed,
        set,
        out: a.out,
        demonstrations: a.demonstrations,
        resume: a.resume,
        initial_from: None,
        device: a.device,
        threads: a.threads,
        quiet: a.quiet,
        tensorboard: a.tensorboard,
        stop: Stop::on_signals()?,
    })
}
