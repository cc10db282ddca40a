//! Is every task pair sound? Scripted demonstrators in both directions, reversed demonstrations replayed, policies that do
//! not look, starts, contacts and speed.
//!
//! ```text
//! cargo run --release --example experts -- --all --trials 100
//! ```
//!
//! Successes, hard and easy: `experts`; `replay` of reversed easy demonstrations; `starts` in which both predicates are as they should
//! be; policies that hold `still` or draw `random` goal poses. Then the deepest contact of anything with anything while goals are
//! drawn every step (trembling) and every 20 steps (sweeping, with all the force that the arm has), and control steps a second
//! with both cameras. About a minute per pair on two cores. `--json` prints one line per variant and nothing else.

use anyhow::Result;
use clap::Parser;
use e2h_core::{Direction, Episode, Origin, Outcome, say, stream};
use e2h_env::{
    Blind, Env, EnvConfig, Task, TaskOptions, demonstrate, probe, registry, replay, task, variants,
};
use e2h_refine::{ReverseConfig, reverse};
use std::sync::Arc;
use std::time::Instant;

#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release --example experts -- --all --trials 100")]
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
    /// Trials of each figure.
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

const BOTH: [Direction; 2] = [Direction::Hard, Direction::Easy];
/// Control steps for which a random goal is kept: half of the trials tremble, half sweep with all the force that the arm has.
const HOLDS: [usize; 2] = [1, 20];
/// Side of the images for which the speed is measured, pixels, and the control steps.
const SPEED: (usize, usize) = (72, 400);

/// Counts over the trials; pairs are of the hard and the easy direction.
#[derive(Default)]
struct Count {
    experts: [u32; 2],
    replay: u32,
    /// Starts that are no goal of theirs and one of the other direction's.
    starts: [u32; 2],
    still: [u32; 2],
    random: [u32; 2],
    diverged: u32,
    through_table: u32,
    /// Under trembling (and still) and under sweeping policies, m.
    deepest: [f64; 2],
    rows: [usize; 2],
}

impl Count {
    fn add(&mut self, other: &Self) {
        for d in 0..2 {
            self.experts[d] += other.experts[d];
            self.starts[d] += other.starts[d];
            self.still[d] += other.still[d];
            self.random[d] += other.random[d];
            self.rows[d] += other.rows[d];
            self.deepest[d] = self.deepest[d].max(other.deepest[d]);
        }
        self.replay += other.replay;
        self.diverged += other.diverged;
        self.through_table += other.through_table;
    }
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> Result<()> {
    let arguments = Arguments::parse();
    let names: Vec<String> = match (arguments.all, arguments.variants) {
        (false, _) => vec![arguments.task.clone()],
        (true, false) => registry().iter().map(|&t| t.to_owned()).collect(),
        (true, true) => {
            registry().iter().flat_map(|t| variants(t).iter().map(move |v| format!("{t}:{v}"))).collect()
        }
    };
    let n = arguments.trials;
    if !arguments.json {
        say(format_args!(
            "of {n} trials, hard/easy     experts  replay   starts  still  random  trembling/sweeping, mm  steps/s"
        ))?;
    }
    for name in &names {
        let (c, speed) = measure(name, &arguments)?;
        if arguments.json {
            let line = serde_json::json!({
                "task": name, "trials": n, "seed": arguments.seed,
                "hard_expert": c.experts[0], "easy_expert": c.experts[1], "reversed_replay": c.replay,
                "hard_starts": c.starts[0], "easy_starts": c.starts[1],
                "still_hard": c.still[0], "still_easy": c.still[1],
                "random_hard": c.random[0], "random_easy": c.random[1],
                "deepest_contact_mm": c.deepest.map(|m| (m * 1e5).round() / 100.0),
                "diverged": c.diverged, "through_table": c.through_table,
                "steps_per_second": speed.round(), "image_size": SPEED.0,
                "mean_rows_hard": c.rows[0] / n.max(1) as usize, "mean_rows_easy": c.rows[1] / n.max(1) as usize,
            });
            say(line)?;
        } else {
            let two = |[hard, easy]: [u32; 2]| format!("{hard}/{easy}");
            say(format_args!(
                "{name:<26} {:>9} {:>7} {:>8} {:>6} {:>7} {:>12.2}/{:<8.2} {speed:>10.0}",
                two(c.experts),
                c.replay,
                two(c.starts),
                two(c.still),
                two(c.random),
                c.deepest[0] * 1e3,
                c.deepest[1] * 1e3,
            ))?;
            if c.diverged + c.through_table > 0 {
                say(format_args!(
                    "{:<26} {} diverged, {} fell through the table",
                    "", c.diverged, c.through_table
                ))?;
            }
        }
    }
    Ok(())
}

/// All counts of one variant, and its control steps a second on one thread.
fn measure(name: &str, arguments: &Arguments) -> Result<(Count, f64)> {
    let (name, variant) = name.split_once(':').unwrap_or((name, ""));
    let mut options = TaskOptions { variant: variant.to_owned(), ..TaskOptions::default() };
    if arguments.clean {
        options.demonstrator = e2h_env::DemonstratorConfig::clean();
    }
    let task = task(name, &options)?;
    let speed = speed(&task)?;
    let first = Env::new(task.clone(), &EnvConfig::physics(&*task))?;
    let workers = std::thread::available_parallelism().map_or(1, |n| n.get() as u32);
    // Trials are split by worker, but what one does depends on its index alone.
    let parts: Vec<Result<Count>> = std::thread::scope(|scope| {
        let spawned: Vec<_> = (0..workers)
            .map(|worker| {
                let env = first.clone_shared();
                let trials = (worker..arguments.trials).step_by(workers as usize);
                scope.spawn(move || run(&mut env?, trials, arguments.seed))
            })
            .collect();
        spawned
            .into_iter()
            .map(|s| s.join().unwrap_or_else(|_| Err(anyhow::anyhow!("a worker panicked"))))
            .collect()
    });
    let mut total = Count::default();
    for part in parts {
        total.add(&part?);
    }
    Ok((total, speed))
}

fn run(env: &mut Env, trials: impl Iterator<Item = u32>, seed: u64) -> Result<Count> {
    let task = env.task().clone();
    let config = ReverseConfig { reference_quaternion: task.eef_reference(), ..ReverseConfig::default() };
    let mut count = Count::default();
    for trial in trials {
        for (d, direction) in BOTH.into_iter().enumerate() {
            let episode = record(&task, env, direction, trial, seed)?;
            count.experts[d] += u32::from(episode.outcome.is_success());
            count.rows[d] += episode.len();
            if direction == Direction::Easy {
                // The scene is where the demonstration left it: play that backwards, open loop.
                env.begin(Direction::Hard)?;
                let outcome = replay(env, &reverse(&episode, &config).action)?;
                count.replay += u32::from(outcome.is_some_and(|o| o.is_success()));
            }
        }
        for (d, direction) in BOTH.into_iter().enumerate() {
            let rng = |what: &str| stream(seed, &format!("{what}/{direction}"), 0, u64::from(trial));
            env.reset(direction, &mut rng("start"))?;
            let fresh = !env.success(direction);
            env.home()?;
            count.starts[d] += u32::from(fresh && env.success(direction.reverse()));
            let hold = HOLDS[trial as usize % HOLDS.len()];
            for policy in [Blind::Still, Blind::Random { hold }] {
                let probed = probe(env, direction, policy, &mut rng("blind"))?;
                let solved = u32::from(probed.outcome.is_success());
                match policy {
                    Blind::Still => count.still[d] += solved,
                    Blind::Random { .. } => count.random[d] += solved,
                }
                count.diverged += u32::from(probed.outcome == Outcome::Diverged);
                count.through_table += u32::from(probed.through_table);
                let sweeps = usize::from(policy == Blind::Random { hold: HOLDS[1] });
                count.deepest[sweeps] = count.deepest[sweeps].max(probed.deepest);
            }
        }
    }
    Ok(count)
}

/// Control steps a second with both cameras, on this thread: a demonstration, over and over.
fn speed(task: &Arc<dyn Task>) -> Result<f64> {
    let config = EnvConfig { image_size: SPEED.0, ..EnvConfig::default() };
    let mut env = Env::new(task.clone(), &config)?;
    let actions = record(task, &mut env, Direction::Easy, 0, 0)?.action;
    let (mut steps, start) = (0, Instant::now());
    let mut resets = std::time::Duration::ZERO;
    while steps < SPEED.1 {
        let clock = Instant::now();
        env.reset(Direction::Easy, &mut stream(0, Direction::Easy.name(), 0, 0))?;
        resets += clock.elapsed();
        for action in &actions {
            let end = env.step(action)?;
            env.observe()?;
            steps += 1;
            if end.is_some() {
                break;
            }
        }
    }
    Ok(steps as f64 / (start.elapsed() - resets).as_secs_f64())
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
