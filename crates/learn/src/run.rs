//! A run: its directory, its stages, and how it goes on after a kill.
//!
//! Every stage is a function of the configuration, the seed and what earlier stages left, and its result is written whole or
//! not at all. Resuming is calling the same stages again: a stage whose result is there reads it.

mod measure;

use crate::collect::{Collected, collect};
use crate::config::{Resolved, RunConfig, UpdateFrom};
use crate::directory::{Directory, TRAINING, write_atomic};
use crate::picture;
use crate::record::{Collection, Reversal};
use crate::tensorboard::Events;
use crate::{Error, Progress, Result, Stop};
use e2h_core::{Direction, Episode, Kind, Origin, stream};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_env::{Env, Task, demonstrate};
use e2h_nn::Compute;
use e2h_policy::{CriticTraining, DiffusionPolicy, Provenance, Trainer, TrainingData, train_critic};
use e2h_refine::{Goal, Refined, critic_filter, gate, kinematic_filter, reverse};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// What a run is started with.
#[derive(Debug, Clone)]
pub struct RunOptions {
    /// Task pair.
    pub task: String,
    /// Preset name.
    pub preset: String,
    /// Seed of everything random.
    pub seed: u64,
    /// `key.path=value` overrides.
    pub set: Vec<String>,
    /// The run directory; by default `runs/<task>-<preset>-<seed>`.
    pub out: Option<PathBuf>,
    /// Go on with a run directory that exists.
    pub resume: bool,
    /// Where networks are computed: `cpu`, `cuda` or `cuda:N`. Not part of a run: it may go on elsewhere, and then ends
    /// with other last digits.
    pub device: String,
    /// Threads; by default as many as there are cores. Never changes a result.
    pub threads: Option<usize>,
    /// Show no progress.
    pub quiet: bool,
    /// Write TensorBoard event files into the run directory's `tensorboard/`. Never changes a result.
    pub tensorboard: bool,
    /// Ends a stage early, its state saved, when it is asked to.
    pub stop: Stop,
}

/// A run in progress.
pub struct Run {
    options: RunOptions,
    resolved: Resolved,
    dir: Directory,
    progress: Progress,
    compute: Compute,
    task: Arc<dyn Task>,
    env: Env,
}

/// Demonstrations and what is fitted on them.
pub struct Base {
    /// Easy demonstrations as recorded.
    pub easy: Vec<Episode>,
    /// `D_e^(0)`: what the easy policy learns from.
    pub easy_training: Vec<Arc<Episode>>,
    /// `D_h^(0)`: the reversed demonstrations.
    pub hard_training: Vec<Arc<Episode>>,
    /// Scaling, fitted on `D_h^(0)`.
    pub normaliser: Normaliser,
}

/// Easy rollouts of one iteration, refined.
pub struct Accepted {
    /// Segments for training.
    pub segments: Vec<Arc<Episode>>,
    /// What collection brought and what refinement made of it.
    pub collection: Collection,
}

#[derive(Serialize, Deserialize)]
struct AcceptedNotes {
    collection: Collection,
    stage_minutes: BTreeMap<String, f64>,
}

#[derive(Serialize, Deserialize)]
struct TrainNotes {
    minutes: f64,
    loss: f64,
    /// Of `policy.json`, which has that of the weights. Runs of version 0.1 have none.
    #[serde(default)]
    policy_sha256: Option<String>,
}

impl Run {
    /// Checks everything that can be checked before any work, then makes or opens the run directory.
    ///
    /// # Errors
    /// A configuration that cannot work, an unknown task, a device that is not there, a run directory that exists (without `resume`) or is another
    /// run's.
    pub fn open(options: &RunOptions) -> Result<Self> {
        e2h_nn::tune_allocator();
        let mut resolved = RunConfig::resolve(&options.preset, &options.task, &options.set)?;
        if let Some(n) = options.threads {
            set_threads(n)?;
        }
        let config = &resolved.config;
        let compute = Compute::open(&options.device, config.device)?;
        let task = e2h_env::task(&config.task.name, &config.task.options())?;
        let mut env = Env::new(task.clone(), &config.env)?;
        if !config.policy.cameras.is_empty() {
            env.select_cameras(&config.policy.cameras)?;
        }
        let path = options.out.clone().unwrap_or_else(|| {
            PathBuf::from(format!("runs/{}-{}-{}", options.task, options.preset, options.seed))
        });
        let dir = Directory::open(&path, options.resume, &options.task, options.seed, &resolved)?;
        let progress = Progress::new(options.quiet).stopping(options.stop.clone());
        // Known to the task, not to be chosen.
        resolved.config.refine.reverse.object_reference = Some(task.object_reference());
        Ok(Self { options: options.clone(), resolved, dir, progress, compute, task, env })
    }

    /// The resolved configuration.
    #[must_use]
    pub fn config(&self) -> &RunConfig {
        &self.resolved.config
    }

    /// The run directory.
    #[must_use]
    pub fn path(&self) -> &Path {
        self.dir.path()
    }

    /// Updates of the hard policy.
    #[must_use]
    pub fn iterations(&self) -> u32 {
        self.config().closed_loop.iterations
    }

    fn envs(&self, n: usize) -> Result<Vec<Env>> {
        (0..n).map(|_| Ok(self.env.clone_shared()?)).collect()
    }

    fn origin(&self, iteration: u32) -> Origin {
        Origin {
            task: self.options.task.clone(),
            direction: Direction::Easy,
            kind: Kind::Rollout,
            iteration,
            episode: 0,
            seed: self.options.seed,
            reversed: false,
        }
    }

    /// Records the easy demonstrations and reverses them into `D_h^(0)`.
    ///
    /// # Errors
    /// When the demonstrator fails more often than it succeeds, or the folder cannot be written.
    pub fn demonstrations(&self) -> Result<Base> {
        let c = self.config();
        let easy = match self.dir.get_episodes::<BTreeMap<String, f64>>("demonstrations")? {
            Some((episodes, _)) => episodes,
            None => {
                let start = Instant::now();
                let wanted = c.closed_loop.demonstrations;
                let bar = self.progress.bar("easy demonstrations", wanted as u64);
                let mut env = self.env.clone_shared()?;
                let mut episodes = Vec::with_capacity(wanted);
                let mut failed = 0;
                let mut index = 0;
                while episodes.len() < wanted {
                    self.progress.check()?;
                    let origin =
                        Origin::demonstration(&self.options.task, Direction::Easy, index, self.options.seed);
                    let mut rng = stream(self.options.seed, "demonstrate", 0, u64::from(index));
                    let episode = match demonstrate(
                        &mut env,
                        Direction::Easy,
                        &c.task.demonstrator,
                        origin,
                        &mut rng,
                    ) {
                        Err(e2h_env::Error::Diverged(_)) => None,
                        recorded => Some(recorded?).filter(|e| e.outcome.is_success()),
                    };
                    index += 1;
                    if let Some(episode) = episode {
                        episodes.push(episode);
                    } else {
                        failed += 1;
                        if failed > wanted {
                            return Err(Error::Demonstrations(format!(
                                "the scripted demonstrator failed {failed} times for {} successes",
                                episodes.len()
                            )));
                        }
                    }
                    bar.set(episodes.len() as u64, &format!("{failed} failed"));
                }
                let minutes = start.elapsed().as_secs_f64() / 60.0;
                let notes = BTreeMap::from([("minutes".to_owned(), minutes)]);
                self.dir.put_episodes("demonstrations", &episodes, &notes)?;
                bar.finish(&format!("{wanted} recorded, {failed} failed"));
                episodes
            }
        };
        let r = &c.refine;
        let reversed = |e: &Episode| -> Vec<Episode> {
            let hard = reverse(e, &r.reverse);
            if c.closed_loop.refine_demonstrations {
                kinematic_filter(&hard, &r.kinematic, &r.reverse).segments
            } else {
                vec![hard]
            }
        };
        let hard: Vec<Episode> = easy.iter().flat_map(reversed).collect();
        let easy_training: Vec<Episode> = easy.iter().flat_map(|e| self.easy_lessons(e.clone())).collect();
        let config = NormaliserConfig { margin: c.train.normaliser_margin, ..NormaliserConfig::default() };
        let normaliser = Normaliser::fit(&hard, &config)?;
        Ok(Base {
            easy_training: easy_training.into_iter().map(Arc::new).collect(),
            hard_training: hard.into_iter().map(Arc::new).collect(),
            easy,
            normaliser,
        })
    }

    /// Trains the easy policy, once.
    ///
    /// # Errors
    /// When training diverges or the folder cannot be written.
    pub fn train_easy(&self, base: &Base) -> Result<DiffusionPolicy> {
        let steps = self.config().train.easy_steps;
        let data = (&base.easy_training[..], &[][..]);
        self.train("policy_easy", "train easy", Direction::Easy, 0, steps, base, data, None)
    }

    /// Trains the initial hard policy on `D_h^(0)`.
    ///
    /// # Errors
    /// As [`Run::train_easy`].
    pub fn train_initial(&self, base: &Base) -> Result<DiffusionPolicy> {
        let steps = self.config().train.initial_steps;
        let data = (&base.hard_training[..], &[][..]);
        self.train(&folder(0, "policy"), "train hard 0", Direction::Hard, 0, steps, base, data, None)
    }

    /// Trains the hard policy on `D_h^(0)` and the accepted segments, from where it is or from fresh weights as
    /// `train.update_from` says; with no segments it stays as it is.
    ///
    /// # Errors
    /// As [`Run::train_easy`].
    pub fn update(
        &self,
        iteration: u32,
        policy: &DiffusionPolicy,
        base: &Base,
        accepted: &[Arc<Episode>],
    ) -> Result<DiffusionPolicy> {
        let steps = if accepted.is_empty() { 0 } else { self.config().train.update_steps };
        let fresh = steps > 0 && self.config().train.update_from == UpdateFrom::Scratch;
        let data = (&base.hard_training[..], accepted);
        let name = format!("train hard {iteration}");
        self.train(
            &folder(iteration, "policy"),
            &name,
            Direction::Hard,
            iteration,
            steps,
            base,
            data,
            (!fresh).then_some(policy),
        )
    }

    /// Continues the easy policy on `D_e^(0)` and what it has done well in the loop so far, exploration included; where
    /// `train.easy_update_steps` is 0 it stays as it is.
    ///
    /// # Errors
    /// As [`Run::train_easy`].
    pub fn update_easy(&self, iteration: u32, easy: DiffusionPolicy, base: &Base) -> Result<DiffusionPolicy> {
        let mut own = vec![];
        if self.config().train.easy_update_steps > 0 && iteration < self.iterations() {
            for n in 1..=iteration {
                let found = self.dir.get_episodes::<usize>(&folder(n, "easy_segments"))?;
                own.extend(found.into_iter().flat_map(|(segments, _)| segments).map(Arc::new));
            }
        }
        if own.is_empty() {
            return Ok(easy);
        }
        let steps = self.config().train.easy_update_steps;
        let place = folder(iteration, "policy_easy");
        let name = format!("train easy {iteration}");
        let data = (&base.easy_training[..], &own[..]);
        self.train(&place, &name, Direction::Easy, iteration, steps, base, data, Some(&easy))
    }

    /// What the easy policy learns of an episode of its own task.
    fn easy_lessons(&self, episode: Episode) -> Vec<Episode> {
        let r = &self.config().refine;
        if self.config().closed_loop.refine_easy_demonstrations {
            kinematic_filter(&episode, &r.kinematic, &r.reverse).segments
        } else {
            vec![episode]
        }
    }

    #[allow(
        clippy::too_many_arguments,
        reason = "one private place where all that differs between stages meets"
    )]
    fn train(
        &self,
        place: &str,
        name: &str,
        direction: Direction,
        iteration: u32,
        steps: usize,
        base: &Base,
        data: (&[Arc<Episode>], &[Arc<Episode>]),
        start: Option<&DiffusionPolicy>,
    ) -> Result<DiffusionPolicy> {
        let c = self.config();
        let notes_file = format!("{place}/notes.json");
        let description = format!("{place}/policy.json");
        if let Some(notes) = self.dir.get::<TrainNotes>(&notes_file)? {
            self.dir.verify(&description, notes.policy_sha256.as_deref())?;
            return Ok(DiffusionPolicy::load(&self.dir.join(place))?.0.on(&self.compute)?);
        }
        let clock = Instant::now();
        let share = c.closed_loop.base_share;
        let data = TrainingData::new(data.0, data.1, share, &c.policy, &base.normaliser)?;
        let weights = start.map(DiffusionPolicy::weights).transpose()?;
        let purpose = format!("train/{direction}/{iteration}");
        let mut trainer =
            Trainer::new(&c.policy, &c.train.step, steps, weights.as_ref(), self.options.seed, &purpose)?
                .on(&self.compute)?;
        let saved = self.dir.join(format!("{place}/{TRAINING}"));
        if saved.exists() {
            trainer.restore(&saved)?;
        }
        let mut events = match trainer.step_count() {
            done if done < steps => self.events(&format!("train_{direction}_{iteration:02}"), done as u64)?,
            _ => None,
        };
        let bar = self.progress.bar(name, steps as u64);
        let save = |trainer: &Trainer| {
            let folder = self.dir.join(place);
            std::fs::create_dir_all(&folder).map_err(crate::directory::io("creating", &folder))?;
            Ok::<(), Error>(trainer.save(&saved)?)
        };
        while trainer.step_count() < steps {
            if let Err(stopped) = self.progress.check() {
                save(&trainer)?;
                return Err(stopped);
            }
            let loss = trainer.step(&data)?;
            let done = trainer.step_count();
            if let Some(events) = &mut events {
                events.scalar("train/loss", done as u64, now(), loss.into())?;
            }
            if done % 10 == 0 {
                events.as_mut().map_or(Ok(()), Events::flush)?;
                bar.set(done as u64, &format!("loss {:.4}", trainer.mean_loss()));
            }
            if done % c.train.save_every == 0 && done < steps {
                save(&trainer)?;
            }
        }
        events.map(Events::finish).transpose()?;
        let loss = trainer.mean_loss();
        let weights = match (steps, weights) {
            (0, Some(weights)) => weights,
            _ => trainer.weights()?,
        };
        let policy =
            DiffusionPolicy::with_weights(&c.policy, &base.normaliser, &weights)?.on(&self.compute)?;
        policy.save(&self.dir.join(place), &self.provenance(direction, iteration)?)?;
        let minutes = clock.elapsed().as_secs_f64() / 60.0;
        self.dir.put_sealed(
            &notes_file,
            &TrainNotes { minutes, loss, policy_sha256: Some(self.dir.sha256(&description)?) },
        )?;
        if saved.exists() {
            std::fs::remove_file(&saved).map_err(crate::directory::io("removing", &saved))?;
        }
        bar.finish(&format!("{steps} steps, loss {loss:.4}"));
        Ok(policy)
    }

    /// An event file of one stage, which starts or goes on at `step`; none when nobody asked for them. Each stage has a folder:
    /// TensorBoard draws folders as curves of one chart, and a stage that goes on voids only its own later steps.
    fn events(&self, stage: &str, step: u64) -> Result<Option<Events>> {
        let folder = self.dir.join("tensorboard").join(stage);
        Ok(self.options.tensorboard.then(|| Events::create(&folder, now(), step)).transpose()?)
    }

    fn provenance(&self, direction: Direction, iteration: u32) -> Result<Provenance> {
        let run = serde_json::to_value(self.config()).map_err(|e| Error::Config(e.to_string()))?;
        Ok(Provenance {
            task: self.options.task.clone(),
            direction: Some(direction),
            preset: self.options.preset.clone(),
            seed: self.options.seed,
            iteration,
            version: env!("CARGO_PKG_VERSION").to_owned(),
            run,
        })
    }

    /// What an earlier process of this run accepted in `iteration`, if it got that far.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn stored(&self, iteration: u32) -> Result<Option<Accepted>> {
        let found = self.dir.get_episodes::<AcceptedNotes>(&folder(iteration, "segments"))?;
        Ok(found.map(|(segments, notes)| Accepted {
            segments: segments.into_iter().map(Arc::new).collect(),
            collection: notes.collection,
        }))
    }

    /// What the update of `iteration` learns from besides `D_h^(0)`: this iteration's segments, with all earlier ones where
    /// the configuration accumulates.
    ///
    /// # Errors
    /// When an earlier iteration's folder cannot be read.
    pub fn training_set(&self, iteration: u32, accepted: &Accepted) -> Result<Vec<Arc<Episode>>> {
        let mut all = vec![];
        if self.config().closed_loop.accumulate {
            for earlier in 1..iteration {
                all.extend(self.stored(earlier)?.map(|a| a.segments).unwrap_or_default());
            }
        }
        all.extend(accepted.segments.iter().cloned());
        Ok(all)
    }

    /// Closed-loop collection with both policies.
    ///
    /// # Errors
    /// When the simulation fails, or rollouts are to be kept and cannot be written.
    pub fn collect(
        &self,
        iteration: u32,
        hard: &DiffusionPolicy,
        easy: &DiffusionPolicy,
    ) -> Result<Collected> {
        let c = &self.config().closed_loop;
        let collected = collect(self.envs(c.loops)?, hard, easy, c, &self.origin(iteration), &self.progress)?;
        let place = folder(iteration, "rollouts");
        if c.keep_rollouts && !self.dir.join(&place).exists() {
            let mut all: Vec<&Episode> =
                collected.hard.iter().chain(&collected.easy).chain(&collected.rejected).collect();
            // As they happened: of a cycle the hard rollout, then the easy one.
            all.sort_by_key(|e| (e.origin.episode, e.origin.direction == Direction::Easy));
            self.dir.put_episodes(&place, &all, &collected.resets)?;
        }
        Ok(collected)
    }

    /// Reverses and refines the easy rollouts of one iteration, with a critic trained on its hard rollouts.
    ///
    /// # Errors
    /// When the critic's training diverges or the folder cannot be written.
    pub fn refine(
        &self,
        iteration: u32,
        collected: Collected,
        collect_time: Duration,
        base: &Base,
        policy: &DiffusionPolicy,
    ) -> Result<Accepted> {
        let c = self.config();
        let r = &c.refine;
        let clock = Instant::now();
        let mut notes = vec![];
        let reversed: Vec<Episode> = collected.easy.iter().map(|e| reverse(e, &r.reverse)).collect();
        let mut candidates: Vec<Episode> =
            reversed.into_iter().filter(|e| gate(e, &r.gate, &r.reverse)).collect();
        if let Some(goal) = Goal::fit(&base.hard_training, &r.goal) {
            let before = candidates.len();
            if r.goal.enabled {
                candidates.retain(|e| goal.accepts(e));
            }
            notes.push(goal_note(&goal, &collected.hard, candidates.len(), before));
        }
        let kinematic: Vec<Refined> = candidates
            .iter()
            .map(|e| {
                if r.kinematic_enabled {
                    kinematic_filter(e, &r.kinematic, &r.reverse)
                } else {
                    Refined::untouched(e)
                }
            })
            .collect();
        let refine_minutes = clock.elapsed().as_secs_f64() / 60.0;

        let clock = Instant::now();
        let successes = collected.hard.iter().filter(|e| e.outcome.is_success()).count();
        let mut critic_loss = None;
        let refined = if !c.critic.enabled {
            notes.push("critic: switched off".to_owned());
            kinematic
        } else if successes == 0 {
            notes.push("critic: skipped, no hard rollout succeeded".to_owned());
            kinematic
        } else if candidates.is_empty() {
            notes.push("critic: skipped, nothing to filter".to_owned());
            kinematic
        } else {
            let name = format!("critic {iteration}");
            let network = &c.critic.network;
            let bar = self.progress.bar(&name, network.steps as u64);
            let training = CriticTraining {
                policy: &c.policy,
                critic: network,
                compute: &self.compute,
                normaliser: &base.normaliser,
                policy_weights: &policy.weights()?,
                rollouts: &collected.hard,
                horizon: c.env.horizon_hard,
                seed: self.options.seed,
                purpose: &format!("critic/{iteration}"),
            };
            let trained = train_critic(&training, |step, loss| {
                bar.set(step as u64, &format!("loss {loss:.4}"));
                if self.progress.check().is_ok() { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
            });
            let (critic, report) = match trained {
                Err(e2h_policy::Error::Stopped { .. }) => {
                    return Err(self.progress.check().err().unwrap_or(Error::Stopped { signal: 0 }));
                }
                done => done?,
            };
            bar.finish(&format!(
                "loss {:.4}, held out {:.4}",
                report.train_loss,
                report.validation_loss.unwrap_or(f64::NAN)
            ));
            if let Some(mut events) = self.events(&format!("critic_{iteration:02}"), 0)? {
                for (step, &loss) in report.losses.iter().enumerate() {
                    events.scalar("critic/loss", step as u64 + 1, now(), loss.into())?;
                }
                events.finish()?;
            }
            critic_loss = report.validation_loss.or(Some(report.train_loss));
            let values = kinematic
                .iter()
                .flat_map(|k| &k.segments)
                .map(|segment| critic.evaluate(segment))
                .collect::<std::result::Result<Vec<_>, _>>()?;
            let suffix = r.suffix.trusting(successes);
            if suffix.enabled != r.suffix.enabled {
                let needed = r.suffix.min_successes;
                notes.push(format!("suffix: not cut, the critic has seen {successes} successes of {needed}"));
            }
            critic_filter(kinematic, &values, &suffix, &r.advantage)?
        };
        let critic_minutes = clock.elapsed().as_secs_f64() / 60.0;

        let mut fates = BTreeMap::new();
        for fate in refined.iter().flat_map(|r| &r.fates) {
            *fates.entry(*fate).or_default() += 1;
        }
        if let Some((episode, refined)) = candidates.iter().zip(&refined).next() {
            let svg = picture::filter(episode, refined, &r.kinematic)?;
            write_atomic(&self.dir.join(folder(iteration, "filter.svg")), svg.as_bytes())?;
        }
        let reversals: Vec<Reversal> =
            candidates.iter().zip(&refined).map(|(e, r)| Reversal::new(e, r)).collect();
        self.dir.put_compact(&folder(iteration, "reversals.json"), &reversals)?;
        if c.train.easy_update_steps > 0 {
            let own: Vec<Episode> =
                collected.easy.iter().flat_map(|e| self.easy_lessons(e.clone())).collect();
            self.dir.put_episodes(&folder(iteration, "easy_segments"), &own, &own.len())?;
        }
        let segments: Vec<Episode> =
            refined.into_iter().flat_map(|r| r.segments).filter(|s| !s.is_empty()).collect();
        let collection = Collection {
            cycles: c.closed_loop.cycles,
            hard_successes: successes,
            easy_successes: collected.easy_successes,
            easy_rollouts: collected.easy_rollouts,
            resets: collected.resets,
            explored: collected.explored,
            plain: collected.plain,
            accepted: candidates.len(),
            fates,
            segments: segments.len(),
            frames_kept: segments.iter().map(Episode::len).sum(),
            critic_loss,
            notes,
        };
        let stage_minutes = BTreeMap::from([
            ("collect".to_owned(), collect_time.as_secs_f64() / 60.0),
            ("refine".to_owned(), refine_minutes),
            ("critic".to_owned(), critic_minutes),
        ]);
        let stored = AcceptedNotes { collection, stage_minutes };
        self.dir.put_episodes(&folder(iteration, "segments"), &segments, &stored)?;
        Ok(Accepted { segments: segments.into_iter().map(Arc::new).collect(), collection: stored.collection })
    }

    /// The task pair of the run.
    #[must_use]
    pub fn task(&self) -> &Arc<dyn Task> {
        &self.task
    }
}

/// Where successes leave the object: what tells a loop that walks to the edge of its goal from one that does not.
fn goal_note(goal: &Goal, hard: &[Episode], kept: usize, of: usize) -> String {
    let successes = hard.iter().filter(|e| e.outcome.is_success());
    let mut ends: Vec<f64> = successes.filter_map(|e| goal.distance(e)).collect();
    ends.sort_by(f64::total_cmp);
    let median = ends.get(ends.len() / 2).map_or_else(|| "no".to_owned(), |d| format!("{:.1}", 1000.0 * d));
    format!(
        "goals: successes end {median} mm from the mean demonstrated goal (median), the gate is at {:.1} mm; {kept} of {of} \
         reversals kept",
        1000.0 * goal.radius
    )
}

/// More threads than that no machine has cores for.
const MOST_THREADS: usize = 1024;

/// Sets how many threads compute; never changes a result. A pool that is already running stays as it is.
///
/// # Errors
/// When asked for none, or for more than any machine has.
pub fn set_threads(threads: usize) -> Result<()> {
    if !(1..=MOST_THREADS).contains(&threads) {
        return Err(Error::Config(format!(
            "threads: expected at least 1 and at most {MOST_THREADS}, got {threads}"
        )));
    }
    drop(rayon::ThreadPoolBuilder::new().num_threads(threads).build_global());
    Ok(())
}

/// Seconds since 1970, for logs alone.
fn now() -> f64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

fn folder(iteration: u32, name: &str) -> String {
    format!("iteration_{iteration:02}/{name}")
}
