//! A round of the loop: collection, the method's lesson, and the account of both.

use super::{Demonstrations, Run, folder, now};
use crate::collect::{Collected, collect_lanes};
use crate::directory::write_atomic;
use crate::method::{Lesson, Round, Tools};
use crate::picture;
use crate::policy_class::Trained;
use crate::record::{Collection, Reversal};
use crate::{Error, Result};
use e2h_core::{Direction, Episode, ImageStore, Policy};
use e2h_policy::{
    Critic, CriticReport, CriticTraining, Dynamics, DynamicsReport, DynamicsTraining, train_critic,
    train_dynamics,
};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::sync::Arc;
use std::time::Instant;

/// What a round brought.
pub struct Accepted {
    /// Segments for training the hard policy.
    pub segments: Vec<Arc<Episode>>,
    /// What the easy policy has done well, for training it; none where it stays as it is.
    pub easy: Vec<Arc<Episode>>,
    /// What collection brought and what refinement made of it.
    pub collection: Collection,
    /// Minutes of collection, refinement and critic.
    pub stage_minutes: BTreeMap<String, f64>,
}

/// What [`Tools`] of a method call.
pub(crate) trait Toolbox {
    fn critic(&self, round: &Round<'_>) -> Result<(Critic, CriticReport)>;
    fn dynamics(&self, round: &Round<'_>) -> Result<(Dynamics, DynamicsReport)>;
    fn demonstrate(&self, direction: Direction) -> Result<Vec<Episode>>;
}

impl Run {
    /// What the rounds teach: `make` collects, the method makes a lesson of it, and its segments are stored. Where an earlier
    /// process did so, nothing is collected.
    ///
    /// # Errors
    /// When collection fails, the critic's training diverges, or the folder cannot be written.
    pub fn lesson(
        &self,
        iteration: u32,
        demonstrations: &Demonstrations,
        policy: &dyn Trained,
        make: impl FnOnce() -> Result<Collected>,
    ) -> Result<Accepted> {
        self.stage_of_all(&folder(iteration, "segments"), || {
            let clock = Instant::now();
            let rollouts = make()?;
            let collect = clock.elapsed();
            // Only rank 0 has all rollouts.
            self.lead_alone(|| {
                let round =
                    Round { config: self.config(), iteration, demonstrations, rollouts: &rollouts, policy };
                let clock = Instant::now();
                let lesson = self.method.lesson(&round, &Tools::new(self))?;
                let refine = clock.elapsed().saturating_sub(lesson.critic_time);
                let minutes = [("collect", collect), ("refine", refine), ("critic", lesson.critic_time)];
                let minutes = minutes.map(|(stage, t)| (stage.to_owned(), t.as_secs_f64() / 60.0));
                self.account(iteration, rollouts, lesson, BTreeMap::from(minutes))
            })
        })
    }

    /// Closed-loop collection with both policies, whose loops are spread over the ranks: rank 0 gets what all brought, the others
    /// nothing.
    ///
    /// # Errors
    /// When the simulation fails, or rollouts are to be kept and cannot be written.
    pub fn collect(&self, iteration: u32, hard: &dyn Policy, easy: &dyn Policy) -> Result<Collected> {
        let c = &self.config().closed_loop;
        // A store of its own, which goes with the rollouts: few of them become segments.
        let images = ImageStore::create(self.path())?;
        let origin = self.origin(iteration);
        let lanes = self.lanes(c.loops)?;
        let collected = collect_lanes(lanes, hard, easy, c, &origin, Some(&images), &self.progress)?;
        self.lead(|| {
            let place = folder(iteration, "rollouts");
            if c.keep_rollouts && !self.dir.join(&place).exists() {
                let mut all: Vec<&Episode> =
                    collected.hard.iter().chain(&collected.easy).chain(&collected.rejected).collect();
                // As they happened: of a cycle the hard rollout, then the easy one.
                all.sort_by_key(|e| (e.origin.episode, e.origin.direction == Direction::Easy));
                self.dir.put_episodes(&place, &all, &collected.resets)?;
            }
            Ok(())
        })?;
        Ok(collected)
    }

    /// Whether a training in a round goes on.
    fn flow(&self) -> ControlFlow<()> {
        if self.progress.check().is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    }

    /// A training that [`Run::flow`] broke off was stopped by what asked for it.
    fn unless_stopped<T>(&self, trained: e2h_policy::Result<T>) -> Result<T> {
        match trained {
            Err(e2h_policy::Error::Stopped { .. }) => {
                Err(self.progress.check().err().unwrap_or(Error::Stopped { signal: 0 }))
            }
            done => Ok(done?),
        }
    }

    /// Pictures and record of a round.
    fn account(
        &self,
        iteration: u32,
        rollouts: Collected,
        lesson: Lesson,
        stage_minutes: BTreeMap<String, f64>,
    ) -> Result<Accepted> {
        let c = self.config();
        let Lesson { candidates, refined, critic, notes, .. } = lesson;
        let mut fates = BTreeMap::new();
        for fate in refined.iter().flat_map(|r| &r.fates) {
            *fates.entry(*fate).or_default() += 1;
        }
        if let Some((episode, refined)) = candidates.iter().zip(&refined).next() {
            let svg = picture::filter(episode, refined, &c.refine.kinematic)?;
            write_atomic(&self.dir.join(folder(iteration, "filter.svg")), svg.as_bytes())?;
        }
        let reversals: Vec<Reversal> =
            candidates.iter().zip(&refined).map(|(e, r)| Reversal::new(e, r)).collect();
        self.dir.put_compact(&folder(iteration, "reversals.json"), &reversals)?;
        let hard_successes = rollouts.hard.iter().filter(|e| e.outcome.is_success()).count();
        let keep = |mut episode: Episode| -> Result<Arc<Episode>> {
            episode.store_images(self.dir.images())?;
            Ok(Arc::new(episode))
        };
        let easy: Vec<Arc<Episode>> = if c.train.easy_update_steps > 0 {
            rollouts.easy.into_iter().flat_map(|e| self.easy_lessons(e)).map(keep).collect::<Result<_>>()?
        } else {
            vec![]
        };
        let segments = refined.into_iter().flat_map(|r| r.segments).filter(|s| !s.is_empty());
        let segments: Vec<Arc<Episode>> = segments.map(keep).collect::<Result<_>>()?;
        let collection = Collection {
            cycles: c.closed_loop.cycles,
            hard_successes,
            easy_successes: rollouts.easy_successes,
            easy_rollouts: rollouts.easy_rollouts,
            steps: rollouts.steps,
            resets: rollouts.resets,
            explored: rollouts.explored,
            plain: rollouts.plain,
            accepted: candidates.len(),
            fates,
            segments: segments.len(),
            frames_kept: segments.iter().map(|e| e.len()).sum(),
            critic_loss: critic.map(|report| report.validation_loss.unwrap_or(report.train_loss)),
            notes,
        };
        Ok(Accepted { segments, easy, collection, stage_minutes })
    }
}

impl Toolbox for Run {
    fn critic(&self, round: &Round<'_>) -> Result<(Critic, CriticReport)> {
        let (c, iteration) = (self.config(), round.iteration);
        let network = &c.critic.network;
        let bar = self.progress.bar(&format!("critic {iteration}"), network.steps as u64);
        let training = CriticTraining {
            policy: &c.policy,
            critic: network,
            compute: &self.compute,
            normaliser: &round.demonstrations.normaliser,
            policy_weights: &round.policy.weights()?,
            rollouts: &round.rollouts.hard,
            horizon: c.env.horizon_hard,
            seed: self.options.seed,
            purpose: &format!("critic/{iteration}"),
        };
        let (critic, report) = self.unless_stopped(train_critic(&training, |step, loss| {
            bar.set(step as u64, &format!("loss {loss:.4}"));
            self.flow()
        }))?;
        let held_out = report.validation_loss.unwrap_or(f64::NAN);
        bar.finish(&format!("loss {:.4}, held out {held_out:.4}", report.train_loss));
        if let Some(mut events) = self.events(&format!("critic_{iteration:02}"), 0)? {
            for (step, &loss) in report.losses.iter().enumerate() {
                events.scalar("critic/loss", step as u64 + 1, now(), loss.into())?;
            }
            events.finish()?;
        }
        Ok((critic, report))
    }

    fn dynamics(&self, round: &Round<'_>) -> Result<(Dynamics, DynamicsReport)> {
        let (c, iteration) = (self.config(), round.iteration);
        let network = &c.dynamics.network;
        let bar = self.progress.bar(&format!("dynamics {iteration}"), 2 * network.steps as u64);
        let training = DynamicsTraining {
            policy: &c.policy,
            policy_weights: &round.policy.weights()?,
            dynamics: network,
            compute: &self.compute,
            normaliser: &round.demonstrations.normaliser,
            rollouts: &round.rollouts.hard,
            seed: self.options.seed,
            purpose: &format!("dynamics/{iteration}"),
        };
        let (dynamics, report) = self.unless_stopped(train_dynamics(&training, |step, loss| {
            bar.set(step as u64, &format!("loss {loss:.4}"));
            self.flow()
        }))?;
        let held_out = |v: Option<f64>| v.unwrap_or(f64::NAN);
        bar.finish(&format!(
            "held out: forward {:.4}, inverse {:.4}",
            held_out(report.forward_held_out),
            held_out(report.inverse_held_out)
        ));
        Ok((dynamics, report))
    }

    fn demonstrate(&self, direction: Direction) -> Result<Vec<Episode>> {
        Run::demonstrate(self, direction)
    }
}
