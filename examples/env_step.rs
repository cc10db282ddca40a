//! Our side of the comparison with robosuite and Python MuJoCo: control steps a second, with two camera images each.
//!
//! ```text
//! cargo run --release --example env_step -- --px 128 --json
//! ```

use anyhow::bail;
use auto_e2h::core::{Action, Direction, Origin, say, stream};
use auto_e2h::env::{DemonstratorConfig, Env, EnvConfig, TaskOptions, demonstrate, task};
use clap::Parser;
use std::path::PathBuf;
use std::time::Instant;

/// Replays a demonstration over and over and counts control steps.
#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release --example env_step -- --px 128 --json")]
struct Arguments {
    /// Task pair.
    #[arg(long, default_value = "nut_assembly")]
    task: String,
    /// Side of both images, pixels.
    #[arg(long, default_value_t = 128)]
    px: usize,
    /// Control steps of each simulation.
    #[arg(long, default_value_t = 1000)]
    steps: usize,
    /// Simulations side by side, each on a thread of its own.
    #[arg(long, default_value_t = 1)]
    threads: usize,
    /// Write the scene (MJCF), for `env_step.py mujoco`, and stop.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,
    /// Print one JSON line and nothing else.
    #[arg(long)]
    json: bool,
}

/// Steps `env` through `actions`, looking through both cameras at every step.
fn run(env: &mut Env, actions: &[Action], steps: usize) -> anyhow::Result<()> {
    let mut next = actions.iter();
    for _ in 0..steps {
        let action = match next.next() {
            Some(action) => action,
            None => {
                env.reset(Direction::Easy, &mut stream(0, "env_step", 0, 0))?;
                env.begin(Direction::Easy)?;
                next = actions[1..].iter();
                &actions[0]
            }
        };
        if env.step(action)?.is_some() {
            next = [].iter();
        }
        env.observe()?;
    }
    Ok(())
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    if a.steps == 0 || a.threads == 0 {
        bail!("--steps and --threads: expected at least 1, got {} and {}", a.steps, a.threads);
    }
    let task = task(&a.task, &TaskOptions::default())?;
    if let Some(file) = &a.scene {
        std::fs::write(file, task.scene())?;
        return Ok(());
    }
    let config = EnvConfig { image_size: a.px, cameras: true, ..EnvConfig::default() };
    let mut first = Env::new(task, &config)?;
    let origin = Origin::demonstration(&a.task, Direction::Easy, 0, 0);
    let mut rng = stream(0, "demonstrate", 0, 0);
    let actions =
        demonstrate(&mut first, Direction::Easy, &DemonstratorConfig::default(), origin, &mut rng)?.action;
    let mut envs = vec![first];
    while envs.len() < a.threads {
        envs.push(envs[0].clone_shared()?);
    }
    for env in &mut envs {
        env.reset(Direction::Easy, &mut stream(0, "env_step", 0, 0))?;
        env.begin(Direction::Easy)?;
        run(env, &actions, 20)?;
    }
    let start = Instant::now();
    std::thread::scope(|scope| -> anyhow::Result<()> {
        let actions = &actions;
        let running: Vec<_> =
            envs.iter_mut().map(|env| scope.spawn(move || run(env, actions, a.steps))).collect();
        for thread in running {
            thread.join().map_err(|_| anyhow::anyhow!("a simulation panicked"))??;
        }
        Ok(())
    })?;
    let rate = (a.steps * a.threads) as f64 / start.elapsed().as_secs_f64();
    if a.json {
        let rate = (10.0 * rate).round() / 10.0;
        say(serde_json::json!({
            "peer": "auto-e2h", "what": a.task, "px": a.px, "threads": a.threads, "control_steps_per_s": rate
        }))?;
    } else {
        say(format_args!(
            "{}: {rate:.1} control steps a second, two images of {1} x {1} each, {2} thread(s)",
            a.task, a.px, a.threads
        ))?;
    }
    Ok(())
}
