//! Closed-loop collection: the hard policy, then the easy policy from where it ended, and so on.

use crate::config::{AfterFailure, LoopConfig};
use crate::explore::Wander;
use crate::gather::{self, Lanes};
use crate::record::{Automatic, ResetCause};
use crate::rollout::{self, Finished, Lane, Rollout, drive};
use crate::{Error, Progress, Result};
use e2h_core::{Direction, Episode, ImageStore, Kind, Origin, Outcome, Policy, stream};
use e2h_env::Env;
use std::collections::{BTreeMap, VecDeque};

/// What one round of the closed loop brought. Source: the paper's equation 2.
#[derive(Debug, Default)]
pub struct Collected {
    /// All hard rollouts, in cycle order: the critic learns from successes and failures.
    pub hard: Vec<Episode>,
    /// Easy rollouts that succeeded and began at the hard goal, so that their reversal ends there; in cycle order.
    pub easy: Vec<Episode>,
    /// The other easy rollouts, in cycle order; none unless [`LoopConfig::keep_rollouts`].
    pub rejected: Vec<Episode>,
    /// Easy rollouts started.
    pub easy_rollouts: usize,
    /// Easy rollouts that succeeded.
    pub easy_successes: usize,
    /// Control steps of all rollouts.
    pub steps: usize,
    /// External resets by cause.
    pub resets: BTreeMap<ResetCause, usize>,
    /// Cycles with exploration.
    pub explored: Automatic,
    /// Cycles without.
    pub plain: Automatic,
}

impl Collected {
    /// The account of the kind of cycle that `cycle` is.
    fn kind(&mut self, config: &LoopConfig, cycle: usize) -> &mut Automatic {
        if config.explore.explores(cycle) { &mut self.explored } else { &mut self.plain }
    }
}

/// One loop's own state.
struct Loop {
    cycles: VecDeque<usize>,
    /// The easy rollout in progress began with the object at the hard goal.
    at_goal: bool,
    collected: Collected,
}

/// Runs `config.cycles` cycles, spread over `envs` (one loop each). Images of rollouts that have ended go to `images`, where there
/// is one: in memory they are megabytes a rollout.
///
/// # Errors
/// When the observations do not fit the policies, the simulation fails or images cannot be written.
pub fn collect(
    envs: Vec<Env>,
    hard: &dyn Policy,
    easy: &dyn Policy,
    config: &LoopConfig,
    origin: &Origin,
    images: Option<&ImageStore>,
    progress: &Progress,
) -> Result<Collected> {
    collect_lanes(Lanes::alone(envs), hard, easy, config, origin, images, progress)
}

/// The same over the lanes of a team: at rank 0 what all brought, at the others nothing.
pub(crate) fn collect_lanes(
    lanes: Lanes<'_>,
    hard: &dyn Policy,
    easy: &dyn Policy,
    config: &LoopConfig,
    origin: &Origin,
    images: Option<&ImageStore>,
    progress: &Progress,
) -> Result<Collected> {
    let Lanes { envs, all: n, team } = lanes;
    if n == 0 {
        return Err(Error::Config("collection needs at least one simulation".to_owned()));
    }
    let (seed, iteration) = (origin.seed, u64::from(origin.iteration));
    let origin_of = |direction: Direction, cycle: usize| Origin {
        direction,
        kind: Kind::Rollout,
        episode: u32::try_from(cycle).unwrap_or(u32::MAX),
        reversed: false,
        ..origin.clone()
    };
    let begin = |lane: &mut Lane<Loop>, direction: Direction| -> Result<()> {
        let Some(&cycle) = lane.state.cycles.front() else { return Ok(()) };
        let (policy, purpose) = match direction {
            Direction::Hard => (hard, "collect/act/hard"),
            Direction::Easy => (easy, "collect/act/easy"),
        };
        let rng = stream(seed, purpose, iteration, cycle as u64);
        let record = Some(origin_of(direction, cycle));
        let rollout = Rollout::begin(&mut lane.env, direction, policy.n_obs_steps(), rng, record)?;
        let explores = direction == Direction::Easy && config.explore.explores(cycle);
        let wander = explores.then(|| {
            let mut rng = stream(seed, "collect/explore", iteration, cycle as u64);
            Wander::new(&config.explore, origin.iteration, lane.env.task().put_down_turn(), &mut rng)
        });
        lane.rollout = Some(rollout.wandering(wander));
        Ok(())
    };
    let reset = |lane: &mut Lane<Loop>, direction: Direction, cause: ResetCause| -> Result<()> {
        let Some(&cycle) = lane.state.cycles.front() else { return Ok(()) };
        let purpose = if direction == Direction::Hard { "collect/reset/hard" } else { "collect/reset/easy" };
        let mut count = |cause: ResetCause, n| {
            if n > 0 {
                *lane.state.collected.resets.entry(cause).or_default() += n;
            }
        };
        count(cause, 1);
        count(
            ResetCause::ResetDiverged,
            rollout::reset(&mut lane.env, direction, seed, purpose, iteration, cycle as u64)?,
        );
        Ok(())
    };
    // Home without a reset; false: the way there diverged, which a reset has repaired.
    let home = |lane: &mut Lane<Loop>, direction: Direction| -> Result<bool> {
        match lane.env.home() {
            Err(e2h_env::Error::Diverged(_)) => {
                reset(lane, direction, ResetCause::HomingDiverged).map(|()| false)
            }
            done => Ok(done.map(|()| true)?),
        }
    };
    let next = |lane: &mut Lane<Loop>, finished: Finished, direction: Direction| -> Result<()> {
        let Some(mut episode) = finished.episode else { return Ok(()) };
        if let Some(store) = images {
            episode.store_images(store)?;
        }
        lane.state.collected.steps += finished.steps;
        let success = finished.outcome.is_success();
        // What only an external reset repairs.
        let accident = match finished.outcome {
            Outcome::Diverged => Some(ResetCause::Diverged),
            Outcome::Dropped => Some(ResetCause::Dropped),
            Outcome::Success { .. } | Outcome::Timeout => None,
        };
        match direction {
            Direction::Hard => {
                lane.state.collected.hard.push(episode);
                let Some(&cycle) = lane.state.cycles.front() else { return Ok(()) };
                let cause = match (success, accident, config.after_failure) {
                    (_, Some(cause), _) => Some(cause),
                    (false, _, AfterFailure::Assembled) => Some(ResetCause::HardFailed),
                    _ => None,
                };
                let by_itself = match cause {
                    Some(cause) => reset(lane, Direction::Easy, cause).map(|()| false)?,
                    None => !config.homing || home(lane, Direction::Easy)?,
                };
                // After a reset to the start of the easy task it is.
                lane.state.at_goal = success || !by_itself;
                let kind = lane.state.collected.kind(config, cycle);
                kind.cycles += 1;
                kind.resets += usize::from(!by_itself);
                lane.state.collected.easy_rollouts += 1;
                begin(lane, Direction::Easy)
            }
            Direction::Easy => {
                let collected = &mut lane.state.collected;
                collected.easy_successes += usize::from(success);
                let done = lane.state.cycles.pop_front();
                if let Some(cycle) = done {
                    let kind = collected.kind(config, cycle);
                    kind.easy_successes += usize::from(success);
                    kind.resets += usize::from(!success);
                }
                if success && lane.state.at_goal {
                    collected.easy.push(episode);
                } else if config.keep_rollouts {
                    collected.rejected.push(episode);
                }
                if lane.state.cycles.is_empty() {
                    return Ok(());
                }
                let by_itself = match (success, accident) {
                    (_, Some(cause)) => reset(lane, Direction::Hard, cause).map(|()| false)?,
                    (false, _) => reset(lane, Direction::Hard, ResetCause::EasyFailed).map(|()| false)?,
                    (true, _) => !config.homing || home(lane, Direction::Hard)?,
                };
                if let Some(cycle) = done.filter(|_| success && !by_itself) {
                    lane.state.collected.kind(config, cycle).resets += 1;
                }
                begin(lane, Direction::Hard)
            }
        }
    };

    let mut lanes: Vec<Lane<Loop>> = envs
        .into_iter()
        .map(|(i, env)| Lane {
            env,
            rollout: None,
            state: Loop {
                cycles: (i..config.cycles).step_by(n).collect(),
                at_goal: false,
                collected: Collected::default(),
            },
        })
        .collect();
    for lane in &mut lanes {
        if !lane.state.cycles.is_empty() {
            reset(lane, Direction::Hard, ResetCause::Start)?;
            begin(lane, Direction::Hard)?;
        }
    }
    let cycles = lanes.iter().map(|l| l.state.cycles.len()).sum::<usize>();
    let bar = progress.bar("collect", cycles as u64);
    let summary = |lanes: &[Lane<Loop>]| {
        let sum = |f: fn(&Collected) -> usize| lanes.iter().map(|l| f(&l.state.collected)).sum::<usize>();
        let hard = sum(|c| c.hard.iter().filter(|e| e.outcome.is_success()).count());
        let text = format!(
            "hard {hard}/{} easy {}/{} succeeded",
            sum(|c| c.hard.len()),
            sum(|c| c.easy_successes),
            sum(|c| c.easy_rollouts)
        );
        let left: usize = lanes.iter().map(|l| l.state.cycles.len()).sum();
        (cycles - left, text)
    };
    drive(&mut lanes, hard, easy, &|lane, finished, direction| next(lane, finished, direction), |lanes| {
        let (done, text) = summary(lanes);
        bar.set(done as u64, &text);
        progress.check()
    })?;
    bar.finish(&summary(&lanes).1);

    let mut all = Collected::default();
    for lane in lanes {
        let c = lane.state.collected;
        all.hard.extend(c.hard);
        all.easy.extend(c.easy);
        all.rejected.extend(c.rejected);
        all.easy_rollouts += c.easy_rollouts;
        all.easy_successes += c.easy_successes;
        all.steps += c.steps;
        all.explored += c.explored;
        all.plain += c.plain;
        for (cause, n) in c.resets {
            *all.resets.entry(cause).or_default() += n;
        }
    }
    all.hard.sort_by_key(|e| e.origin.episode);
    all.easy.sort_by_key(|e| e.origin.episode);
    all.rejected.sort_by_key(|e| e.origin.episode);
    gather::collected(team, all, images)
}
