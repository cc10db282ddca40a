//! A run: its directory, its stages, and how it goes on after a kill.
//!
//! Every stage is a function of the configuration, the seed and what earlier stages left, and its result is written whole or
//! not at all ([`Run::stage`]). Resuming is calling the same stages again: a stage whose result is there reads it.

mod given;
mod measure;
mod options;
mod round;
mod share;
mod stage;
mod team;
mod tr_drl;
mod train;

use crate::config::{Resolved, RunConfig};
use crate::directory::Directory;
use crate::method::Method;
use crate::methods;
use crate::policy_class::{Diffusion, PolicyClass};
use crate::record::RunResults;
use crate::tensorboard::Events;
use crate::{Error, Progress, Result};
use e2h_core::{Direction, Episode, Kind, Origin, Solo, Team};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_env::{Env, Task, demonstrate, demonstration_stream};
use e2h_nn::Compute;
use e2h_policy::Provenance;
use e2h_refine::{kinematic_filter, reverse};
use e2h_report::folder::{Given, Identity, LAYOUT};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::sync::Arc;

use given::GivenDataset;
pub use options::{BuildTask, Parts, RunOptions, set_threads};
pub use round::Accepted;
pub(crate) use round::Toolbox;
pub use stage::{Json, Stored};
use team::{Ranks, lead, lead_alone};

/// Where demonstrations of the hard direction lie, for methods that ask for them.
const HARD_DEMONSTRATIONS: &str = "demonstrations_hard";

/// A run in progress.
pub struct Run {
    options: RunOptions,
    identity: Identity,
    resolved: Resolved,
    dir: Directory,
    progress: Progress,
    compute: Compute,
    task: Arc<dyn Task>,
    method: Arc<dyn Method>,
    class: Arc<dyn PolicyClass>,
    env: Env,
    ranks: Ranks,
    /// Demonstrations that the run was given; none where it records its own, or has its copy already.
    given: Option<GivenDataset>,
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
        Self::open_team(options, parts, Rc::new(Solo))
    }

    /// The same on every rank of a team, each with the same options and parts. Rank 0 alone reads and writes the run directory and
    /// speaks; the others keep what they need for a moment in the system's folder for such files, which need not be shared.
    ///
    /// # Errors
    /// As [`Run::open`], and when the ranks cannot share a step evenly. An error of rank 0 is [`Error::Led`] at the others.
    pub fn open_team(options: &RunOptions, parts: &Parts, team: Rc<dyn Team>) -> Result<Self> {
        let opened = lead_alone(&*team, || Self::open_as(options, parts, team.clone(), None))?;
        let identity = || opened.as_ref().map(|run| run.identity.clone());
        let identity = lead(&*team, || identity().ok_or_else(|| Error::Team("no run".to_owned())))?;
        if let Some(run) = opened {
            return Ok(run);
        }
        let folder = tempfile::tempdir().map_err(crate::directory::io("creating", &std::env::temp_dir()))?;
        let options = RunOptions {
            out: Some(folder.path().to_owned()),
            demonstrations: None,
            resume: false,
            initial_from: None,
            quiet: true,
            tensorboard: false,
            stop: crate::Stop::default(),
            ..options.clone()
        };
        Self::open_as(&options, parts, team, Some((identity, folder)))
    }

    /// `follows`: rank 0's run, and the folder of another rank.
    fn open_as(
        options: &RunOptions,
        parts: &Parts,
        team: Rc<dyn Team>,
        follows: Option<(Identity, tempfile::TempDir)>,
    ) -> Result<Self> {
        e2h_nn::tune_allocator();
        let entry = methods::find(&options.method)?;
        let (code, values) = entry.read()?;
        let method = parts.method.clone().unwrap_or(code);
        let own = parts.task.as_ref();
        let text = own.map(|(text, _)| text.as_str());
        let mut options = options.clone();
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
        let (shards, ranks) = (config.train.step.shards, team.size());
        if !shards.is_multiple_of(ranks) {
            return Err(Error::Config(format!(
                "train.step.shards: expected a multiple of the {ranks} ranks, got {shards}: start as many ranks as divide it, or \
                 give --set train.step.shards=N, the same for all tries of a run"
            )));
        }
        let compute = Compute::open(&options.device, config.device)?;
        let mut env = Env::new(task.clone(), &config.env)?;
        if !config.policy.cameras.is_empty() {
            env.select_cameras(&config.policy.cameras)?;
        }
        let class = method.policies().or_else(|| parts.policy.clone()).unwrap_or_else(|| Arc::new(Diffusion));
        let mut identity = Identity {
            format: LAYOUT,
            task: options.task.clone(),
            preset: options.preset.clone(),
            seed: options.seed,
            method: parts.method.as_ref().map_or(&*options.method, |m| m.name()).to_owned(),
            policy: class.name().to_owned(),
            given: None,
        };
        let path = options.out.clone().unwrap_or_else(|| default_folder(&identity));
        let asked = crate::config::sets(&options.set, "loop", "demonstrations")
            .then_some(config.closed_loop.demonstrations);
        let given = options
            .demonstrations
            .as_ref()
            .map(|root| GivenDataset::open(root, config, &*task, env.cameras(), asked))
            .transpose()?;
        identity.given = match (&given, &follows) {
            (Some(given), _) => Some(given.given.clone()),
            (None, Some((leader, _))) => leader.given.clone(),
            // A run that has its copy goes on without the original.
            (None, None) if options.resume => Directory::given(&path)?,
            (None, None) => None,
        };
        if let (Some(given), None) = (&identity.given, asked) {
            options.set.push(format!("loop.demonstrations={}", given.episodes));
            resolved = RunConfig::resolve_with(&options.preset, &options.task, text, &values, &options.set)?;
            resolved.config.know(&*task);
        }
        method.check(&resolved.config)?;
        let dir = Directory::open(&path, options.resume, &identity, &resolved, &*task)?;
        let progress = Progress::new(options.quiet).stopping(options.stop.clone());
        let ranks = Ranks::new(team, follows.map(|(_, folder)| folder));
        let run = Self {
            options,
            resolved,
            dir,
            progress,
            compute,
            task,
            method,
            class,
            identity,
            env,
            ranks,
            given,
        };
        if let Some(other) = &run.options.initial_from {
            run.take_over(other)?;
        }
        Ok(run)
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
        if let Some(done) = self.learn_alone() {
            return done;
        }
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

    /// All of it, where the method has a loop of its own ([`Method::learn`]), which runs on rank 0 while the others wait.
    #[must_use]
    pub fn learn_alone(&self) -> Option<Result<(RunResults, PathBuf)>> {
        self.lead(|| self.method.learn(self).transpose()).transpose()
    }

    /// Records the easy demonstrations, or copies those that the run was given, and reverses them into `D_h^(0)`.
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

    /// Successful demonstrations, scripted and recorded once; of the easy task those that the run was given, if it was.
    fn demonstrate(&self, direction: Direction) -> Result<Vec<Episode>> {
        let c = self.config();
        if let (Direction::Easy, Some(given)) = (direction, &self.identity.given) {
            return self.stage("demonstrations", || self.copy_given(given));
        }
        let place = match direction {
            Direction::Easy => "demonstrations",
            Direction::Hard => HARD_DEMONSTRATIONS,
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
                let mut rng = demonstration_stream(self.options.seed, direction, index);
                let episode = match demonstrate(&mut env, direction, &c.task.demonstrator, origin, &mut rng) {
                    Err(e2h_env::Error::Diverged(_)) => None,
                    recorded => Some(recorded?).filter(|e| e.outcome.is_success()),
                };
                index += 1;
                if let Some(mut episode) = episode {
                    episode.store_images(self.dir.images())?;
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

    fn copy_given(&self, given: &Given) -> Result<Vec<Episode>> {
        let Some(dataset) = &self.given else {
            let problem = "the run was stopped before it had copied them: give --demonstrations again";
            return Err(Error::Given {
                path: PathBuf::from(&given.from),
                problems: vec![problem.to_owned()],
            });
        };
        let episodes = dataset.read(self.dir.images())?;
        self.progress.say(&format!("easy demonstrations: {}", given.words()));
        Ok(episodes)
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

/// Where a run lies that says no place: the parts that are not the usual ones are in its name.
fn default_folder(run: &Identity) -> PathBuf {
    let usual = [methods::DEFAULT, Diffusion.name()];
    let parts = [&run.method, &run.policy];
    let unusual: String = parts
        .into_iter()
        .zip(usual)
        .filter(|(part, usual)| part != usual)
        .map(|(part, _)| format!("{part}-"))
        .collect();
    PathBuf::from(format!("runs/{}-{}-{unusual}{}", run.task, run.preset, run.seed))
}

/// Seconds since 1970, for logs alone.
pub(crate) fn now() -> f64 {
    std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}

fn folder(iteration: u32, name: &str) -> String {
    format!("iteration_{iteration:02}/{name}")
}
