//! Rollouts of several simulations side by side, with one batched policy call for all of them.
//!
//! Every simulation is a lane. Lanes execute their action chunks in parallel; between chunks the policies answer all lanes
//! that wait for them in lane order. Which lane does what is decided by its own state alone, so neither the number of
//! threads nor their timing can change a result.

use crate::Result;
use crate::explore::Wander;
use e2h_core::{
    ACTION_DIM, Action, Direction, Episode, Excursion, Image, Observation, Origin, Outcome, Policy, Rng,
    stream,
};
use e2h_env::{Env, Snapshot};
use rayon::prelude::*;
use std::collections::VecDeque;

/// A rollout for people to see, every second control step: physical states, which are small, and drawn only if they are wanted.
#[derive(Default)]
pub(crate) struct Film {
    states: Vec<Snapshot>,
}

impl Film {
    fn shoot(&mut self, env: &Env) {
        self.states.push(env.save());
    }

    /// The pictures, drawn by any environment of the same task.
    pub(crate) fn draw(&self, env: &mut Env, camera: &str, size: usize) -> Result<Vec<Image>> {
        let picture = |state: &Snapshot| {
            env.restore(state)?;
            Ok(env.render(camera, size, size)?)
        };
        self.states.iter().map(picture).collect()
    }
}

/// One episode in progress in one simulation.
pub(crate) struct Rollout {
    pub(crate) direction: Direction,
    rng: Rng,
    history: VecDeque<Observation>,
    /// None: frames are rendered only where the policy looks (evaluation).
    episode: Option<Episode>,
    film: Option<Film>,
    wander: Option<Wander>,
    steps: usize,
}

/// What a rollout left.
pub(crate) struct Finished {
    pub(crate) outcome: Outcome,
    pub(crate) steps: usize,
    pub(crate) episode: Option<Episode>,
    pub(crate) film: Option<Film>,
}

impl Rollout {
    /// Starts an episode from the current physical state of `env`; `record` keeps every observation.
    pub(crate) fn begin(
        env: &mut Env,
        direction: Direction,
        n_obs_steps: usize,
        rng: Rng,
        record: Option<Origin>,
    ) -> Result<Self> {
        env.begin(direction)?;
        let first = env.observe()?;
        let history = std::iter::repeat_n(first, n_obs_steps).collect();
        let episode = record.map(|origin| Episode::new(origin, env.cameras()));
        Ok(Self { direction, rng, history, episode, film: None, wander: None, steps: 0 })
    }

    /// Films the rollout from its present state on.
    pub(crate) fn filmed(mut self, env: &Env) -> Self {
        let mut film = Film::default();
        film.shoot(env);
        self.film = Some(film);
        self
    }

    /// Displaces the goals of the rollout.
    pub(crate) fn wandering(mut self, wander: Option<Wander>) -> Self {
        self.wander = wander;
        self
    }

    /// Executes `chunk`, after the goal at hand was held as long as the policy thought; Some when the episode ended in it.
    pub(crate) fn execute(&mut self, env: &mut Env, chunk: &[Action]) -> Result<Option<Finished>> {
        let held = self.held(env);
        let waits = std::iter::repeat_n(None, env.config().latency);
        let steps: Vec<Option<&Action>> = waits.chain(chunk.iter().map(Some)).collect();
        for (i, asked) in steps.iter().enumerate() {
            // Without a recording only the observations that the next policy call gets are worth rendering.
            let seen = self.episode.is_some() || i + self.history.len() >= steps.len();
            let excursion = self.wander.as_ref().map(Wander::now);
            if let Some(asked) = asked {
                while let Some(extra) = self.wander.as_mut().and_then(|w| w.before(env, asked)) {
                    if let Some(done) = self.advance(env, &extra, excursion, true)? {
                        return Ok(Some(done));
                    }
                }
            }
            let action = match (asked, &mut self.wander) {
                (None, _) => held,
                (Some(action), None) => **action,
                (Some(action), Some(wander)) => wander.displace(env, action),
            };
            if let Some(done) = self.advance(env, &action, excursion, seen)? {
                return Ok(Some(done));
            }
        }
        Ok(None)
    }

    /// One control step; Some when the episode ended with it. `seen`: what comes of it is worth rendering.
    fn advance(
        &mut self,
        env: &mut Env,
        action: &Action,
        excursion: Option<Excursion>,
        seen: bool,
    ) -> Result<Option<Finished>> {
        if let (Some(episode), Some(now)) = (&mut self.episode, self.history.back()) {
            episode.push(now, action)?;
            if let (Some(row), Some(excursion)) = (episode.excursion.last_mut(), excursion) {
                *row = excursion;
            }
        }
        let end = env.step(action)?;
        self.steps += 1;
        if let Some(film) = self.film.as_mut().filter(|_| self.steps.is_multiple_of(2) || end.is_some()) {
            film.shoot(env);
        }
        if let Some(outcome) = end {
            let episode = self.episode.take().map(|mut episode| {
                episode.outcome = outcome;
                episode
            });
            return Ok(Some(Finished { outcome, steps: self.steps, episode, film: self.film.take() }));
        }
        if seen {
            self.history.pop_front();
            self.history.push_back(env.observe()?);
        }
        Ok(None)
    }

    /// The goal at hand as an action.
    fn held(&self, env: &Env) -> Action {
        let sim = env.sim();
        // In the hemisphere of what was observed, so that no sign flips.
        let near =
            self.history.back().map_or([1.0, 0.0, 0.0, 0.0], |o| [3, 4, 5, 6].map(|i| f64::from(o.state[i])));
        let mut action = [0.0; ACTION_DIM];
        action[..7].copy_from_slice(&sim.goal().to_row(&near));
        action[7] = f32::from(u8::from(sim.opens()));
        action
    }
}

/// Draws of one start before it is given up: chance does not fail so often.
const MOST_STARTS: u64 = 10;

/// An external reset. A start that diverges is drawn again from a stream of its own; returns how many did.
///
/// # Errors
/// When all do, or none can be made.
pub(crate) fn reset(
    env: &mut Env,
    direction: Direction,
    seed: u64,
    purpose: &str,
    iteration: u64,
    index: u64,
) -> Result<usize> {
    let mut diverged = 0;
    loop {
        let mut rng = match diverged {
            0 => stream(seed, purpose, iteration, index),
            // No other purpose ends so.
            again => stream(seed, &format!("{purpose}/again/{again}"), iteration, index),
        };
        match env.reset(direction, &mut rng) {
            Ok(()) => return Ok(diverged as usize),
            Err(e2h_env::Error::Diverged(_)) if diverged + 1 < MOST_STARTS => diverged += 1,
            Err(e) => return Err(e.into()),
        }
    }
}

/// One simulation and what it is doing.
pub(crate) struct Lane<S> {
    pub(crate) env: Env,
    pub(crate) rollout: Option<Rollout>,
    /// The driver's own bookkeeping.
    pub(crate) state: S,
}

/// What a lane does when its rollout of a task ended.
pub(crate) type Next<'a, S> = dyn Fn(&mut Lane<S>, Finished, Direction) -> Result<()> + Sync + 'a;

/// Runs all lanes until none has a rollout. `next` is called with a lane whose rollout just ended (what it left, and which
/// task it did) and starts its next one, if there is to be one; it runs on the lane's own thread. `tick` sees how far lanes are,
/// and may end all.
pub(crate) fn drive<S: Send>(
    lanes: &mut [Lane<S>],
    hard: &dyn Policy,
    easy: &dyn Policy,
    next: &Next<'_, S>,
    mut tick: impl FnMut(&[Lane<S>]) -> Result<()>,
) -> Result<()> {
    loop {
        let mut waiting: Vec<&mut Lane<S>> = lanes.iter_mut().filter(|l| l.rollout.is_some()).collect();
        if waiting.is_empty() {
            return Ok(());
        }
        let mut chunks: Vec<Vec<Action>> = vec![vec![]; waiting.len()];
        for (direction, policy) in [(Direction::Hard, hard), (Direction::Easy, easy)] {
            let (mut index, mut histories, mut rngs) = (vec![], vec![], vec![]);
            for (i, lane) in waiting.iter().enumerate() {
                if let Some(r) = lane.rollout.as_ref().filter(|r| r.direction == direction) {
                    index.push(i);
                    histories.push(r.history.iter().collect::<Vec<_>>());
                    rngs.push(r.rng.clone());
                }
            }
            if index.is_empty() {
                continue;
            }
            let actions = policy.act(&histories, &mut rngs)?;
            for ((i, chunk), rng) in index.into_iter().zip(actions).zip(rngs) {
                chunks[i] = chunk;
                if let Some(r) = &mut waiting[i].rollout {
                    r.rng = rng;
                }
            }
        }
        waiting.par_iter_mut().zip(chunks).try_for_each(|(lane, chunk)| -> Result<()> {
            let Some(rollout) = &mut lane.rollout else { return Ok(()) };
            if let Some(finished) = rollout.execute(&mut lane.env, &chunk)? {
                let direction = rollout.direction;
                lane.rollout = None;
                next(lane, finished, direction)?;
            }
            Ok(())
        })?;
        tick(lanes)?;
    }
}
