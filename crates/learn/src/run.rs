//! A run: its directory, its stages, and how it goes on after a kill.
//!
//! Every stage is a function of the configuration, the seed and what earlier stages left, and its result is written whole or
//! not at all ([`Run::stage`]). Resuming is calling the same stages again: a stage whose result is there reads it.

mod measure;
mod stage;

use crate::collect::{Collected, collect};
use crate::config::{Resolved, RunConfig, UpdateFrom};
use crate::directory::{Directory, TRAINING, write_atomic};
use crate::method::{Lesson, Method, Round, Tools};
use crate::methods;
use crate::picture;
use crate::policy_class::{Diffusion, Job, PolicyClass, Trained};
use crate::record::{Collection, Reversal, RunResults};
use crate::tensorboard::Events;
use crate::{Error, Progress, Result, Stop};
use e2h_core::{Direction, Episode, Kind, Origin, Policy, stream};
use e2h_data::{Normaliser, NormaliserConfig, Source};
use e2h_env::{Env, Task, TaskOptions, demonstrate};
use e2h_nn::Compute;
use e2h_policy::{Critic, CriticReport, CriticTraining, Provenance, train_critic};
use e2h_refine::{kinematic_filter, reverse};
use stage::PolicyStage;
use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

pub use stage::{Json, Stored};

/// What a run is started with.
#[derive(Debug, Clone)]
pub struct RunOptions {
    /// Task pair.
    pub task: String,
    /// Preset name.
    pub preset: String,
    /// Method name ([`methods::registry`]).
    pub method: String,
    /// Seed of everything random.
    pub seed: u64,
    /// `key.path=value` overrides.
    pub set: Vec<String>,
    /// The run directory; by default `runs/<task>-<preset>-<seed>`, with the method before the seed if it is not `auto-e2h`.
    pub out: Option<PathBuf>,
    /// Go on with a run directory that exists.
    pub resume: bool,
    /// Where networks are computed: `cpu`, `cuda` or `cuda:N`. Not part of a run: it may go on elsewhere, and its results may
    /// then differ in the last bits.
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

impl RunOptions {
    /// The defaults of the command line: preset `laptop`, method `auto-e2h`, seed 0.
    #[must_use]
    pub fn new(task: &str) -> Self {
        Self {
            task: task.to_owned(),
            preset: "laptop".to_owned(),
            method: methods::DEFAULT.to_owned(),
            seed: 0,
            set: vec![],
            out: None,
            resume: false,
            device: "cpu".to_owned(),
            threads: None,
            quiet: false,
            tensorboard: false,
            stop: Stop::default(),
        }
    }
}

/// Builds a task of the variant, clearance and demonstrator that a configuration says.
pub type BuildTask = Arc<dyn Fn(&TaskOptions) -> e2h_env::Result<Arc<dyn Task>> + Send + Sync>;

/// Parts of a run that are one's own; what is none comes from the registries.
#[derive(Default, Clone)]
pub struct Parts {
    /// A task pair: the text of its configuration file, which names it and is laid over the preset, and what builds it.
    pub task: Option<(String, BuildTask)>,
    /// A method. The values of the method that [`RunOptions::method`] names are laid over the task file all the same.
    pub method: Option<Arc<dyn Method>>,
    /// A class of policies.
    pub policy: Option<Arc<dyn PolicyClass>>,
}

/// A run in progress.
pub struct Run {
    options: RunOptions,
    resolved: Resolved,
    dir: Directory,
    progress: Progress,
    compute: Compute,
    task: Arc<dyn Task>,
    method: Arc<dyn Method>,
    class: Arc<dyn PolicyClass>,
    env: Env,
}

/// Demonstrations and what is fitted on them.
pub struct Demonstrations {
    /// Easy demonstrations as recorded.
    pub easy: Vec<Episode>,
    /// `D_e^(0)`: what the easy policy learns from.
    pub easy_training: Vec<Arc<Episode>>,
    /// `D_h^(0)`: the reversed demonstrations.
    pub hard: Vec<Arc<Episode>>,
    /// Scaling, fitted on `D_h^(0)`.
    pub normaliser: Normaliser,
}

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
    fn demonstrate(&self, direction: Direction) -> Result<Vec<Episode>>;
}

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
    /// Checks everything that can be checked before any work, then makes or opens the run directory.
    ///
    /// # Errors
    /// A configuration that cannot work, an unknown task, a device that is not there, a run directory that exists (without `resume`) or is another
    /// run's.
    pub fn open(options: &RunOptions) -> Result<Self> {
        Self::open_with(options, &Parts::default())
    }

    /// The same with a task pair, a method or a class of policies of one's own.
    ///
    /// # Errors
    /// As [`Run::open`].
    pub fn open_with(options: &RunOptions, parts: &Parts) -> Result<Self> {
        e2h_nn::tune_allocator();
        let entry = methods::find(&options.method)?;
        let (code, values) = entry.read()?;
        let own = parts.task.as_ref();
        let text = own.map(|(text, _)| text.as_str());
        let mut resolved =
            RunConfig::resolve_with(&options.preset, &options.task, text, &values, &options.set)?;
        if let Some(n) = options.threads {
            set_threads(n)?;
        }
        let task_options = resolved.config.task.options();
        let task = match own {
            Some((_, build)) => build(&task_options)?,
            None => e2h_env::task(&options.task, &task_options)?,
        };
        if task.name() != options.task {
            let (expected, found) = (&options.task, e2h_core::one_line(task.name()));
            return Err(Error::Config(format!("task: expected one named `{expected}`, got `{found}`")));
        }
        resolved.config.know(&*task);
        let config = &resolved.config;
        let compute = Compute::open(&options.device, config.device)?;
        let mut env = Env::new(task.clone(), &config.env)?;
        if !config.policy.cameras.is_empty() {
            env.select_cameras(&config.policy.cameras)?;
        }
        let path = options.out.clone().unwrap_or_else(|| {
            let method = match options.method.as_str() {
                methods::DEFAULT => String::new(),
                other => format!("{other}-"),
            };
            PathBuf::from(format!("runs/{}-{}-{method}{}", options.task, options.preset, options.seed))
        });
        let dir = Directory::open(&path, options, &resolved, &*task)?;
        let progress = Progress::new(options.quiet).stopping(options.stop.clone());
        Ok(Self {
            options: options.clone(),
            resolved,
            dir,
            progress,
            compute,
            task,
            method: parts.method.clone().unwrap_or(code),
            class: parts.policy.clone().unwrap_or_else(|| Arc::new(Diffusion)),
            env,
        })
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

    /// The task pair of the run.
    #[must_use]
    pub fn task(&self) -> &Arc<dyn Task> {
        &self.task
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

    /// All of algorithm 1, as `examples/nut_assembly.rs` spells it out; returns the results and the report's path.
    ///
    /// # Errors
    /// Those of the stages.
    pub fn learn(&self) -> Result<(RunResults, PathBuf)> {
        let demonstrations = self.demonstrations()?;
        let mut easy = self.train_easy(&demonstrations)?;
        let mut hard = self.train_initial(&demonstrations)?;
        let mut records = vec![self.evaluate(0, &*hard, None)?];
        let mut rounds = vec![];
        for n in 1..=self.iterations() {
            rounds.push(self.lesson(n, &demonstrations, &*hard, || self.collect(n, &*hard, &*easy))?);
            hard = self.update(n, &*hard, &demonstrations, &rounds)?;
            easy = self.update_easy(n, easy, &demonstrations, &rounds)?;
            records.push(self.evaluate(n, &*hard, rounds.last())?);
        }
        self.report(&demonstrations, records)
    }

    /// Records the easy demonstrations and reverses them into `D_h^(0)`.
    ///
    /// # Errors
    /// When the demonstrator fails more often than it succeeds, or the folder cannot be written.
    pub fn demonstrations(&self) -> Result<Demonstrations> {
        let c = self.config();
        let easy = self.demonstrate(Direction::Easy)?;
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
        let easy_training = easy.iter().flat_map(|e| self.easy_lessons(e.clone()));
        let config = NormaliserConfig { margin: c.train.normaliser_margin, ..NormaliserConfig::default() };
        let normaliser = Normaliser::fit(&hard, &config)?;
        Ok(Demonstrations {
            easy_training: easy_training.map(Arc::new).collect(),
            hard: hard.into_iter().map(Arc::new).collect(),
            easy,
            normaliser,
        })
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
        self.stage(&folder(iteration, "segments"), || {
            let clock = Instant::now();
            let rollouts = make()?;
            let collect = clock.elapsed();
            let round =
                Round { config: self.config(), iteration, demonstrations, rollouts: &rollouts, policy };
            let clock = Instant::now();
            let lesson = self.method.lesson(&round, &Tools::new(self))?;
            let refine = clock.elapsed().saturating_sub(lesson.critic_time);
            let minutes = [("collect", collect), ("refine", refine), ("critic", lesson.critic_time)];
            let minutes = minutes.map(|(stage, t)| (stage.to_owned(), t.as_secs_f64() / 60.0));
            self.account(iteration, rollouts, lesson, BTreeMap::from(minutes))
        })
    }

    /// Closed-loop collection with both policies.
    ///
    /// # Errors
    /// When the simulation fails, or rollouts are to be kept and cannot be written.
    pub fn collect(&self, iteration: u32, hard: &dyn Policy, easy: &dyn Policy) -> Result<Collected> {
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
        let easy: Vec<Arc<Episode>> = if c.train.easy_update_steps > 0 {
            rollouts.easy.into_iter().flat_map(|e| self.easy_lessons(e)).map(Arc::new).collect()
        } else {
            vec![]
        };
        let segments: Vec<Arc<Episode>> =
            refined.into_iter().flat_map(|r| r.segments).filter(|s| !s.is_empty()).map(Arc::new).collect();
        let collection = Collection {
            cycles: c.closed_loop.cycles,
            hard_successes,
            easy_successes: rollouts.easy_successes,
            easy_rollouts: rollouts.easy_rollouts,
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
                Source { episodes: demonstrations.easy_training.clone(), share },
                Source { episodes: own, share: 1.0 - share },
            ],
            start: Some(&*easy),
        };
        self.train(stage, &demonstrations.normaliser)
    }

    fn train(&self, stage: Stage<'_>, normaliser: &Normaliser) -> Result<Box<dyn Trained>> {
        let Stage { place, name, direction, iteration, steps, sources, start } = stage;
        let provenance = self.provenance(direction, iteration)?;
        let done = self.stage(&place, || {
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
            })?;
            let saved = self.dir.join(format!("{place}/{TRAINING}"));
            if saved.exists() {
                training.restore(&saved)?;
            }
            let mut events = match training.step_count() {
                done if done < steps => {
                    self.events(&format!("train_{direction}_{iteration:02}"), done as u64)?
                }
                _ => None,
            };
            while training.step_count() < steps {
                let stopped = self.progress.check();
                let done = training.step_count();
                let due = done % c.train.save_every == 0 && done > 0;
                if stopped.is_err() || due {
                    let folder = self.dir.join(&place);
                    std::fs::create_dir_all(&folder).map_err(crate::directory::io("creating", &folder))?;
                    training.save(&saved)?;
                    self.spend(&place, spent + clock.elapsed().as_secs_f64() / 60.0)?;
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
            let loss = training.mean_loss();
            bar.finish(&format!("{steps} steps, loss {loss:.4}"));
            Ok(PolicyStage { policy: training.policy()?, loss, provenance })
        })?;
        Ok(done.policy)
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

    fn demonstrate(&self, direction: Direction) -> Result<Vec<Episode>> {
        let c = self.config();
        let (place, purpose) = match direction {
            Direction::Easy => ("demonstrations", "demonstrate"),
            Direction::Hard => ("demonstrations_hard", "demonstrate/hard"),
        };
        self.stage(place, || {
            let wanted = c.closed_loop.demonstrations;
            let bar = self.progress.bar(&format!("{direction} demonstrations"), wanted as u64);
            let mut env = self.env.clone_shared()?;
            let mut episodes = Vec::with_capacity(wanted);
            let mut failed = 0;
            let mut index = 0;
            while episodes.len() < wanted {
                self.progress.check()?;
                let origin = Origin::demonstration(&self.options.task, direction, index, self.options.seed);
                let mut rng = stream(self.options.seed, purpose, 0, u64::from(index));
                let episode = match demonstrate(&mut env, direction, &c.task.demonstrator, origin, &mut rng) {
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
            bar.finish(&format!("{wanted} recorded, {failed} failed"));
            Ok(episodes)
        })
    }
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
