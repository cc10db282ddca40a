//! Success of a policy over trials at fixed seeds.

use crate::record::{Evaluation, wilson95};
use crate::rollout::{Lane, Rollout, drive};
use crate::{Error, Progress, Result};
use e2h_core::{Direction, Image, Outcome, Policy, stream};
use e2h_env::Env;
use std::time::Instant;

/// How one trial went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Trial {
    /// How it ended.
    pub outcome: Outcome,
    /// Control steps it took.
    pub steps: usize,
}

struct Queue {
    /// Trials still to do, in reverse.
    trials: Vec<usize>,
    current: usize,
    done: Vec<(usize, Trial)>,
}

/// Runs `trials` trials of `direction` from external resets drawn from `seed`, several simulations side by side.
/// `envs` are fresh simulations of the same task, one a lane.
///
/// # Errors
/// When the observations do not fit the policy or the simulation fails.
pub fn evaluate(
    envs: Vec<Env>,
    policy: &dyn Policy,
    direction: Direction,
    trials: usize,
    seed: u64,
    progress: &Progress,
) -> Result<(Evaluation, Vec<Trial>)> {
    let start = Instant::now();
    let n = envs.len();
    if n == 0 || trials == 0 {
        return Err(Error::Config("evaluation needs at least one simulation and one trial".to_owned()));
    }
    let begin = |lane: &mut Lane<Queue>| -> Result<()> {
        let Some(trial) = lane.state.trials.pop() else { return Ok(()) };
        lane.state.current = trial;
        lane.env.reset(direction, &mut stream(seed, "evaluate/reset", 0, trial as u64))?;
        let rng = stream(seed, "evaluate/act", 0, trial as u64);
        lane.rollout = Some(Rollout::begin(&mut lane.env, direction, policy.n_obs_steps(), rng, None)?);
        Ok(())
    };
    let mut lanes: Vec<Lane<Queue>> = envs
        .into_iter()
        .enumerate()
        .map(|(i, env)| {
            let queue = Queue { trials: (i..trials).step_by(n).rev().collect(), current: 0, done: vec![] };
            Lane { env, rollout: None, state: queue }
        })
        .collect();
    for lane in &mut lanes {
        begin(lane)?;
    }
    let bar = progress.bar("evaluate", trials as u64);
    drive(
        &mut lanes,
        policy,
        policy,
        &|lane, finished, _| {
            let trial = Trial { outcome: finished.outcome, steps: finished.steps };
            lane.state.done.push((lane.state.current, trial));
            begin(lane)
        },
        |lanes| {
            let done = || lanes.iter().flat_map(|l| &l.state.done);
            let k = done().filter(|(_, t)| t.outcome.is_success()).count();
            bar.set(done().count() as u64, &format!("{k} succeeded"));
        },
    )?;
    let mut done: Vec<(usize, Trial)> = lanes.into_iter().flat_map(|l| l.state.done).collect();
    done.sort_by_key(|(i, _)| *i);
    let results: Vec<Trial> = done.into_iter().map(|(_, t)| t).collect();
    let successes: Vec<usize> = results.iter().filter(|t| t.outcome.is_success()).map(|t| t.steps).collect();
    let k = successes.len();
    bar.finish(&format!("{k} of {trials} succeeded"));
    let evaluation = Evaluation {
        successes: k,
        trials,
        wilson95: wilson95(k, trials),
        mean_steps: if k == 0 { 0.0 } else { successes.iter().sum::<usize>() as f64 / k as f64 },
        seconds: start.elapsed().as_secs_f64(),
    };
    Ok((evaluation, results))
}

/// Films the given trials of an evaluation again, from `camera` at `size` pixels, every second control step.
///
/// # Errors
/// As [`evaluate`].
pub fn film(
    env: &mut Env,
    policy: &dyn Policy,
    direction: Direction,
    trials: &[usize],
    seed: u64,
    camera: &str,
    size: usize,
) -> Result<Vec<(Outcome, Vec<Image>)>> {
    let mut films = Vec::with_capacity(trials.len());
    for &trial in trials {
        env.reset(direction, &mut stream(seed, "evaluate/reset", 0, trial as u64))?;
        let mut rng = [stream(seed, "evaluate/act", 0, trial as u64)];
        env.begin(direction)?;
        let mut history = vec![env.observe()?; policy.n_obs_steps()];
        let mut frames = vec![env.render(camera, size, size)?];
        let mut steps = 0;
        let outcome = 'episode: loop {
            let chunk = policy.act(&[history.iter().collect()], &mut rng)?.swap_remove(0);
            for action in &chunk {
                let end = env.step(action)?;
                steps += 1;
                if steps % 2 == 0 || end.is_some() {
                    frames.push(env.render(camera, size, size)?);
                }
                if let Some(outcome) = end {
                    break 'episode outcome;
                }
                history.remove(0);
                history.push(env.observe()?);
            }
        };
        films.push((outcome, frames));
    }
    Ok(films)
}
