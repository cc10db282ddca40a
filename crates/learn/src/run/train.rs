//! The training stages of a run.

use super::stage::PolicyStage;
use super::{Accepted, Demonstrations, Run, folder, now};
use crate::Result;
use crate::config::UpdateFrom;
use crate::directory::TRAINING;
use crate::method::Tools;
use crate::policy_class::{Job, Trained};
use crate::tensorboard::Events;
use e2h_core::{Direction, Episode};
use e2h_data::{Normaliser, Source};
use std::sync::Arc;
use std::time::Instant;

/// One training stage of a run.
struct Stage<'a> {
    /// Folder, below the run's.
    place: String,
    /// What the progress bar says.
    name: String,
    direction: Direction,
    iteration: u32,
    steps: usize,
    sources: Vec<Source>,
    start: Option<&'a dyn Trained>,
}

impl Run {
    /// Trains the easy policy, once.
    ///
    /// # Errors
    /// When training diverges or the folder cannot be written.
    pub fn train_easy(&self, demonstrations: &Demonstrations) -> Result<Box<dyn Trained>> {
        let stage = Stage {
            place: "policy_easy".to_owned(),
            name: "train easy".to_owned(),
            direction: Direction::Easy,
            iteration: 0,
            steps: self.config().train.easy_steps,
            sources: vec![Source::whole(demonstrations.easy_training.clone())],
            start: None,
        };
        self.train(stage, &demonstrations.normaliser)
    }

    /// Trains the initial hard policy on what the method begins with: `D_h^(0)`.
    ///
    /// # Errors
    /// As [`Run::train_easy`].
    pub fn train_initial(&self, demonstrations: &Demonstrations) -> Result<Box<dyn Trained>> {
        let stage = Stage {
            place: folder(0, "policy"),
            name: "train hard 0".to_owned(),
            direction: Direction::Hard,
            iteration: 0,
            steps: self.config().train.initial_steps,
            sources: self.method.initial(demonstrations, self.config(), &Tools::new(self))?,
            start: None,
        };
        self.train(stage, &demonstrations.normaliser)
    }

    /// Trains the hard policy on what the method makes of the rounds so far, from where it is or from fresh weights as
    /// `train.update_from` says; after a round that brought nothing it stays as it is.
    ///
    /// # Errors
    /// As [`Run::train_easy`].
    pub fn update(
        &self,
        iteration: u32,
        policy: &dyn Trained,
        demonstrations: &Demonstrations,
        rounds: &[Accepted],
    ) -> Result<Box<dyn Trained>> {
        let c = self.config();
        let segments: Vec<&[Arc<Episode>]> = rounds.iter().map(|r| &r.segments[..]).collect();
        let learned = if c.closed_loop.accumulate {
            &segments[..]
        } else {
            &segments[segments.len().saturating_sub(1)..]
        };
        let steps = if learned.iter().all(|s| s.is_empty()) { 0 } else { c.train.update_steps };
        let fresh = steps > 0 && c.train.update_from == UpdateFrom::Scratch;
        let stage = Stage {
            place: folder(iteration, "policy"),
            name: format!("train hard {iteration}"),
            direction: Direction::Hard,
            iteration,
            steps,
            sources: self.method.sources(demonstrations, &segments, c),
            start: (!fresh).then_some(policy),
        };
        self.train(stage, &demonstrations.normaliser)
    }

    /// Continues the easy policy on `D_e^(0)` and what it has done well in the loop so far, exploration included; where
    /// `train.easy_update_steps` is 0, and after the last round, it stays as it is.
    ///
    /// # Errors
    /// As [`Run::train_easy`].
    pub fn update_easy(
        &self,
        iteration: u32,
        easy: Box<dyn Trained>,
        demonstrations: &Demonstrations,
        rounds: &[Accepted],
    ) -> Result<Box<dyn Trained>> {
        let own: Vec<_> = rounds.iter().flat_map(|r| r.easy.iter().cloned()).collect();
        let steps = self.config().train.easy_update_steps;
        if own.is_empty() || steps == 0 || iteration >= self.iterations() {
            return Ok(easy);
        }
        let share = self.config().closed_loop.base_share;
        let stage = Stage {
            place: folder(iteration, "policy_easy"),
            name: format!("train easy {iteration}"),
            direction: Direction::Easy,
            iteration,
            steps,
            sources: vec![
                Source::new(demonstrations.easy_training.clone(), share),
                Source::new(own, 1.0 - share),
            ],
            start: Some(&*easy),
        };
        self.train(stage, &demonstrations.normaliser)
    }

    fn train(&self, stage: Stage<'_>, normaliser: &Normaliser) -> Result<Box<dyn Trained>> {
        let Stage { place, name, direction, iteration, steps, sources, start } = stage;
        let provenance = self.provenance(direction, iteration)?;
        let done = self.stage_of_all(&place, || {
            let clock = Instant::now();
            let spent = self.spent(&place)?;
            let c = self.config();
            let bar = self.progress.bar(&name, steps as u64);
            let weights = start.map(Trained::weights).transpose()?;
            let purpose = format!("train/{direction}/{iteration}");
            let mut training = self.class.train(Job {
                config: c,
                sources: &sources,
                normaliser,
                steps,
                start: weights.as_ref(),
                seed: self.options.seed,
                purpose: &purpose,
                compute: &self.compute,
                team: self.team(),
            })?;
            let state = [format!("{place}/{TRAINING}")];
            let saved = self.dir.join(&state[0]);
            if self.lead(|| Ok(saved.exists()))? {
                self.send(&state)?;
                training.restore(&saved)?;
                self.forget(&state)?;
            }
            let mut events = match training.step_count() {
                done if done < steps => {
                    self.events(&format!("train_{direction}_{iteration:02}"), done as u64)?
                }
                _ => None,
            };
            while training.step_count() < steps {
                let stopped = self.lead(|| self.progress.check());
                let done = training.step_count();
                let due = done % c.train.save_every == 0 && done > 0;
                if stopped.is_err() || due {
                    self.compare_ranks(&*training, &name)?;
                    self.lead(|| {
                        let folder = self.dir.join(&place);
                        std::fs::create_dir_all(&folder)
                            .map_err(crate::directory::io("creating", &folder))?;
                        training.save(&saved)?;
                        self.spend(&place, spent + clock.elapsed().as_secs_f64() / 60.0)
                    })?;
                }
                stopped?;
                let loss = training.step()?;
                let done = training.step_count();
                if let Some(events) = &mut events {
                    events.scalar("train/loss", done as u64, now(), loss.into())?;
                }
                if done % 10 == 0 {
                    events.as_mut().map_or(Ok(()), Events::flush)?;
                    bar.set(done as u64, &format!("loss {:.4}", training.mean_loss()));
                }
            }
            events.map(Events::finish).transpose()?;
            if steps > 0 {
                self.compare_ranks(&*training, &name)?;
            }
            let loss = training.mean_loss();
            bar.finish(&format!("{steps} steps, loss {loss:.4}"));
            Ok(Some(PolicyStage { policy: training.policy()?, loss, steps, provenance }))
        })?;
        Ok(done.policy)
    }
}
