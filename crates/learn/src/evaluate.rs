//! Success of a policy over trials at fixed seeds.

use crate::gather::{self, Lanes};
use crate::record::{Evaluation, Trial};
use crate::rollout::{self, Film, Lane, Rollout, drive};
use crate::{Error, Progress, Result};
use e2h_core::{Direction, Image, Outcome, Policy, stream};
use e2h_env::Env;
use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Instant;

/// Which trials of an evaluation are shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filmed {
    /// So many from the first on.
    First(usize),
    /// So many, those that failed before those that succeeded.
    FailuresFirst(usize),
}

/// Which trials of an evaluation are filmed, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Filming {
    /// The trials.
    pub trials: Filmed,
    /// Camera of the scene.
    pub camera: String,
    /// Side of the pictures, pixels.
    pub size: usize,
}

/// What an evaluation left.
#[derive(Debug, Clone, PartialEq)]
pub struct Evaluated {
    /// Successes, and every trial.
    pub evaluation: Evaluation,
    /// One film a filmed trial, in the order of [`Filmed`].
    pub films: Vec<(Outcome, Vec<Image>)>,
}

/// More trials than that are a slip of the keyboard.
const MOST_TRIALS: usize = 100_000;

struct Queue {
    /// Trials still to do, in reverse.
    trials: Vec<usize>,
    current: usize,
    done: Vec<(usize, Trial, Option<Film>)>,
}

/// Runs the trials of `direction` with these numbers from external resets drawn from `seed`, several simulations side by side: `0..50` are the
/// first fifty, `50..100` go on from there. `envs` are fresh simulations of the same task, one a lane. Filming changes nothing else: a film is of the
/// evaluation itself and shows what was counted.
///
/// # Errors
/// Before any trial when there are none or too many, or the film's camera or size is not one; when the observations do not fit the
/// policy or the simulation fails.
pub fn evaluate(
    envs: Vec<Env>,
    policy: &dyn Policy,
    direction: Direction,
    trials: Range<usize>,
    seed: u64,
    filming: Option<&Filming>,
    progress: &Progress,
) -> Result<Evaluated> {
    evaluate_lanes(Lanes::alone(envs), policy, direction, trials, seed, filming, progress)
}

/// The same over the lanes of a team: every rank has all trials in the end, rank 0 alone the films.
pub(crate) fn evaluate_lanes(
    lanes: Lanes<'_>,
    policy: &dyn Policy,
    direction: Direction,
    trials: Range<usize>,
    seed: u64,
    filming: Option<&Filming>,
    progress: &Progress,
) -> Result<Evaluated> {
    let start = Instant::now();
    let Lanes { mut envs, all: n, team } = lanes;
    if n == 0 || trials.is_empty() {
        return Err(Error::Config("evaluation needs at least one simulation and one trial".to_owned()));
    }
    if trials.end > MOST_TRIALS {
        return Err(Error::Config(format!("trials: expected at most {MOST_TRIALS}, got {}", trials.end)));
    }
    if let (Some(f), Some((_, env))) = (filming, envs.first_mut()) {
        env.render(&f.camera, f.size, f.size)?;
    }
    let films = |trial: usize| {
        filming.is_some_and(|f| match f.trials {
            Filmed::First(n) => trial - trials.start < n,
            Filmed::FailuresFirst(n) => n > 0,
        })
    };
    let begin = |lane: &mut Lane<Queue>| -> Result<()> {
        let Some(trial) = lane.state.trials.pop() else { return Ok(()) };
        lane.state.current = trial;
        rollout::reset(&mut lane.env, direction, seed, "evaluate/reset", 0, trial as u64)?;
        let rng = stream(seed, "evaluate/act", 0, trial as u64);
        let mut rollout = Rollout::begin(&mut lane.env, direction, policy.n_obs_steps(), rng, None)?;
        if films(trial) {
            rollout = rollout.filmed(&lane.env);
        }
        lane.rollout = Some(rollout);
        Ok(())
    };
    let mut lanes: Vec<Lane<Queue>> = envs
        .into_iter()
        .map(|(i, env)| {
            let mine = trials.clone().skip(i).step_by(n);
            let queue = Queue { trials: mine.rev().collect(), current: 0, done: vec![] };
            Lane { env, rollout: None, state: queue }
        })
        .collect();
    for lane in &mut lanes {
        begin(lane)?;
    }
    let own = lanes.iter().map(|l| l.state.trials.len() + usize::from(l.rollout.is_some())).sum::<usize>();
    let bar = progress.bar("evaluate", own as u64);
    drive(
        &mut lanes,
        policy,
        policy,
        &|lane, finished, _| {
            let trial = Trial { outcome: finished.outcome, steps: finished.steps };
            lane.state.done.push((lane.state.current, trial, finished.film));
            begin(lane)
        },
        |lanes| {
            let done = || lanes.iter().flat_map(|l| &l.state.done);
            let k = done().filter(|(_, t, _)| t.outcome.is_success()).count();
            bar.set(done().count() as u64, &format!("{k} succeeded"));
            progress.check()
        },
    )?;
    let (mut mine, mut shot, mut envs) = (vec![], BTreeMap::new(), vec![]);
    for lane in lanes {
        for (i, trial, film) in lane.state.done {
            mine.push((i, trial));
            shot.extend(film.map(|film| (i, film)));
        }
        envs.push(lane.env);
    }
    let mut done = gather::trials(team, &mine)?;
    let results: Vec<Trial> = done.iter().map(|(_, t)| *t).collect();
    let mut films = vec![];
    if let Some(f) = filming {
        let wanted = match f.trials {
            Filmed::First(n) => n,
            Filmed::FailuresFirst(n) => {
                done.sort_by_key(|(i, trial)| (trial.outcome.is_success(), *i));
                n
            }
        };
        for (i, trial) in done.iter().take(wanted) {
            // Drawn by the rank that has seen it.
            let drawn = match (shot.get(i), envs.first_mut()) {
                (Some(film), Some(env)) => Some(film.draw(env, &f.camera, f.size)?),
                _ => None,
            };
            films.extend(gather::film(team, drawn)?.map(|film| (trial.outcome, film)));
        }
    }
    let evaluation = Evaluation::new(results, start.elapsed().as_secs_f64());
    bar.finish(&format!("{} of {} succeeded", evaluation.successes, trials.len()));
    Ok(Evaluated { evaluation, films })
}
