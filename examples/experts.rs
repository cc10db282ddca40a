//! How well do the scripted demonstrators do, and do reversed demonstrations of the easy task replay in the hard one?
//!
//!     cargo run --release --example experts -- --all --trials 100
//!
//! About half a minute a variant on two cores. `--json` prints one line a variant and nothing else.
#![allow(clippy::print_stdout, reason = "what an example is for")]

use anyhow::Result;
use clap::Parser;
use e2h_core::{Direction, Episode, Origin, stream};
use e2h_env::{Env, EnvConfig, Task, TaskOptions, demonstrate, registry, replay, task, variants};
use e2h_refine::{ReverseConfig, reverse};
use std::sync::Arc;

#[derive(Parser)]
struct Arguments {
    /// Task pair, with a variant after a colon if not the default one (nut_assembly:square).
    #[arg(long, default_value = "nut_assembly", conflicts_with = "all")]
    task: String,
    /// Every task pair.
    #[arg(long)]
    all: bool,
    /// With --all: every variant of each pair, not only the default one.
    #[arg(long, requires = "all")]
    variants: bool,
    /// Trials of each of the three figures.
    #[arg(long, default_value_t = 100)]
    trials: u32,
    #[arg(long, default_value_t = 42)]
    seed: u64,
    /// Demonstrators without human-like variation.
    #[arg(long)]
    clean: bool,
    #[arg(long)]
    json: bool,
}

/// Successes, and the lengths of the two kinds of demonstrations.
#[derive(Default)]
struct Count {
    hard: u32,
    easy: u32,
    replay: u32,
    rows: [usize; 2],
}

fn main() -> Result<()> {
    let arguments = Arguments::parse();
    let names: Vec<String> = match (arguments.all, arguments.variants) {
        (false, _) => vec![arguments.task.clone()],
        (true, false) => registry().iter().map(|&t| t.to_owned()).collect(),
        (true, true) => {
            registry().iter().flat_map(|t| variants(t).iter().map(move |v| format!("{t}:{v}"))).collect()
        }
    };
    if !arguments.json {
        println!(
            "{:<22} {:>7} {:>12} {:>12} {:>16}",
            "task", "trials", "hard expert", "easy expert", "reversed replay"
        );
    }
    for name in &names {
        let count = measure(name, &arguments)?;
        let Count { hard, easy, replay, rows } = count;
        let n = arguments.trials;
        if arguments.json {
            let line = serde_json::json!({
                "task": name, "trials": n, "hard_expert": hard, "easy_expert": easy, "reversed_replay": replay,
                "mean_rows_hard": rows[0] / n.max(1) as usize, "mean_rows_easy": rows[1] / n.max(1) as usize,
            });
            println!("{line}");
        } else {
            println!("{name:<22} {n:>7} {hard:>12} {easy:>12} {replay:>16}");
        }
    }
    Ok(())
}

fn measure(name: &str, arguments: &Arguments) -> Result<Count> {
    let (name, variant) = name.split_once(':').unwrap_or((name, ""));
    let mut options = TaskOptions { variant: variant.to_owned(), ..TaskOptions::default() };
    if arguments.clean {
        options.demonstrator = e2h_env::DemonstratorConfig::clean();
    }
    let task = task(name, &options)?;
    let first = Env::new(task.clone(), &EnvConfig::physics(&*task))?;
    let workers = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    // Trials are split by worker, but what one does depends on its index alone.
    let parts: Vec<Result<Count>> = std::thread::scope(|scope| {
        let spawned: Vec<_> = (0..workers)
            .map(|worker| {
                let (task, env) = (&task, first.clone_shared());
                let trials = (worker..arguments.trials).step_by(workers as usize);
                scope.spawn(move || run(task, &mut env?, trials, arguments.seed))
            })
            .collect();
        spawned
            .into_iter()
            .map(|s| s.join().unwrap_or_else(|_| Err(anyhow::anyhow!("a worker panicked"))))
            .collect()
    });
    let mut total = Count::default();
    for part in parts {
        let part = part?;
        total.hard += part.hard;
        total.easy += part.easy;
        total.replay += part.replay;
        total.rows = [total.rows[0] + part.rows[0], total.rows[1] + part.rows[1]];
    }
    Ok(total)
}

fn run(task: &Arc<dyn Task>, env: &mut Env, trials: impl Iterator<Item = u32>, seed: u64) -> Result<Count> {
    let mut count = Count::default();
    for trial in trials {
        let hard = record(task, env, Direction::Hard, trial, seed)?;
        count.hard += u32::from(hard.outcome.is_success());
        let easy = record(task, env, Direction::Easy, trial, seed)?;
        count.easy += u32::from(easy.outcome.is_success());
        count.rows = [count.rows[0] + hard.len(), count.rows[1] + easy.len()];
        // The scene is where the easy demonstration left it: play that backwards, open loop.
        env.begin(Direction::Hard)?;
        let config = ReverseConfig { reference_quaternion: task.eef_reference(), ..ReverseConfig::default() };
        let outcome = replay(env, &reverse(&easy, &config).action)?;
        count.replay += u32::from(outcome.is_some_and(|o| o.is_success()));
    }
    Ok(count)
}

fn record(
    task: &Arc<dyn Task>,
    env: &mut Env,
    direction: Direction,
    trial: u32,
    seed: u64,
) -> Result<Episode> {
    let origin = Origin::demonstration(task.name(), direction, trial, seed);
    let mut rng = stream(seed, direction.name(), 0, u64::from(trial));
    Ok(demonstrate(env, direction, task.demonstrator(), origin, &mut rng)?)
}
