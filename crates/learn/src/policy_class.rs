//! What the loop needs of a policy: to train on weighted sources, to act, to be saved and read again.
//!
//! [`Diffusion`] is the built-in class. A class of one's own goes into [`Parts`](crate::Parts);
//! `examples/own_policy.rs` has one.

use crate::{Error, Result, RunConfig};
use e2h_core::{Policy, Team};
use e2h_data::{Normaliser, Source};
use e2h_nn::{Compute, Weights};
use e2h_policy::sac::{self, StatePolicy};
use e2h_policy::{DiffusionPolicy, PolicyConfig, Provenance, Trainer, TrainingData};
use std::path::Path;

/// A policy that a run has trained.
pub trait Trained: Policy {
    /// Its weights by name: an update goes on from them, and the critic's image encoders start from those of the same name and
    /// shape.
    ///
    /// # Errors
    /// When they cannot be read back from the device.
    fn weights(&self) -> Result<Weights>;

    /// Writes a folder that stands alone, with a file `policy.json` that names its class as `kind`.
    ///
    /// # Errors
    /// When a weight is not finite or the folder cannot be written.
    fn save(&self, folder: &Path, provenance: &Provenance) -> Result<()>;
}

/// A stage of training to begin.
pub struct Job<'a> {
    /// The run's configuration.
    pub config: &'a RunConfig,
    /// What is learned from. Labels are for classes that can be told of them; others ignore them.
    pub sources: &'a [Source],
    /// Scaling of states and actions.
    pub normaliser: &'a Normaliser,
    /// Steps of the stage: the length of the learning-rate schedule.
    pub steps: usize,
    /// Weights to go on from; none: fresh ones.
    pub start: Option<&'a Weights>,
    /// The run's seed.
    pub seed: u64,
    /// Names the random streams of the stage, so that no two share one.
    pub purpose: &'a str,
    /// Where networks are computed.
    pub compute: &'a Compute,
    /// The ranks that all begin this stage. A class that does not share its steps among them may ignore it: every rank then trains
    /// the same policy.
    pub team: &'a dyn Team,
}

/// A training in progress, one step at a time.
pub trait Training {
    /// Steps done.
    fn step_count(&self) -> usize;

    /// One step; returns its loss. Draws from a stream named by the step, so that a stage goes on after
    /// [`Training::restore`] as if nothing had happened.
    ///
    /// # Errors
    /// When the data do not fit, or the loss is not finite.
    fn step(&mut self) -> Result<f32>;

    /// Mean loss of the last steps.
    fn mean_loss(&self) -> f64;

    /// Writes all that [`Training::restore`] needs.
    ///
    /// # Errors
    /// When the file cannot be written, or a number is not finite: the file that was there stays.
    fn save(&self, file: &Path) -> Result<()>;

    /// Goes on from a file of [`Training::save`].
    ///
    /// # Errors
    /// When the file is missing, damaged or of another network.
    fn restore(&mut self, file: &Path) -> Result<()>;

    /// Something short that is the same wherever the weights are, and the next gradients would be; none, the default, where ranks
    /// are not to be compared.
    ///
    /// # Errors
    /// When the data do not fit.
    fn fingerprint(&self) -> Result<Option<String>> {
        Ok(None)
    }

    /// The policy to act with.
    ///
    /// # Errors
    /// When a weight is not finite.
    fn policy(&self) -> Result<Box<dyn Trained>>;
}

/// A kind of policy that a run can train.
pub trait PolicyClass: Send + Sync {
    /// Its name, for example `diffusion`.
    fn name(&self) -> &str;

    /// Begins a stage.
    ///
    /// # Errors
    /// When the configuration, the data or the weights to start from do not fit.
    fn train<'a>(&self, job: Job<'a>) -> Result<Box<dyn Training + 'a>>;

    /// Reads a folder that [`Trained::save`] wrote.
    ///
    /// # Errors
    /// When a file is missing, foreign or damaged; names what was expected and found.
    fn load(&self, folder: &Path, compute: &Compute) -> Result<Box<dyn Trained>>;
}

/// The image-conditioned diffusion policy. Where sources have labels, it is a policy with an indicator
/// ([`PolicyConfig::indicator`]), which may go on from one without.
#[derive(Debug, Clone, Copy, Default)]
pub struct Diffusion;

impl Trained for DiffusionPolicy {
    fn weights(&self) -> Result<Weights> {
        Ok(DiffusionPolicy::weights(self)?)
    }

    fn save(&self, folder: &Path, provenance: &Provenance) -> Result<()> {
        Ok(DiffusionPolicy::save(self, folder, provenance)?)
    }
}

struct DiffusionTraining<'a> {
    trainer: Trainer,
    data: TrainingData<'a>,
    policy: PolicyConfig,
    job: Job<'a>,
}

impl Training for DiffusionTraining<'_> {
    fn step_count(&self) -> usize {
        self.trainer.step_count()
    }

    fn step(&mut self) -> Result<f32> {
        Ok(self.trainer.step_with(&self.data, self.job.team)?)
    }

    fn fingerprint(&self) -> Result<Option<String>> {
        Ok(Some(self.trainer.fingerprint(&self.data)?))
    }

    fn mean_loss(&self) -> f64 {
        self.trainer.mean_loss()
    }

    fn save(&self, file: &Path) -> Result<()> {
        Ok(self.trainer.save(file)?)
    }

    fn restore(&mut self, file: &Path) -> Result<()> {
        Ok(self.trainer.restore(file)?)
    }

    fn policy(&self) -> Result<Box<dyn Trained>> {
        let weights = self.trainer.weights()?;
        let policy = DiffusionPolicy::with_weights(&self.policy, self.job.normaliser, &weights)?;
        Ok(Box::new(policy.into_device(self.job.compute)?))
    }
}

/// Actors of the method `tr-drl`: policies from states alone, which that method trains by itself.
#[derive(Debug, Clone, Copy, Default)]
pub struct States;

impl Trained for StatePolicy {
    fn weights(&self) -> Result<Weights> {
        Ok(StatePolicy::weights(self)?)
    }

    fn save(&self, folder: &Path, provenance: &Provenance) -> Result<()> {
        Ok(StatePolicy::save(self, folder, provenance)?)
    }
}

impl PolicyClass for States {
    fn name(&self) -> &str {
        sac::KIND
    }

    fn train<'a>(&self, _: Job<'a>) -> Result<Box<dyn Training + 'a>> {
        Err(Error::Config(format!("policies `{}`: expected the method tr-drl, which trains them", sac::KIND)))
    }

    fn load(&self, folder: &Path, _: &Compute) -> Result<Box<dyn Trained>> {
        Ok(Box::new(StatePolicy::load(folder)?.0))
    }
}

impl PolicyClass for Diffusion {
    fn name(&self) -> &str {
        "diffusion"
    }

    fn train<'a>(&self, job: Job<'a>) -> Result<Box<dyn Training + 'a>> {
        let mut policy = job.config.policy.clone();
        // Whoever labels sources wants a policy that is told of it; without labels it stays the plain one.
        if job.sources.iter().any(|s| s.label.is_some()) {
            policy.indicator = true;
            policy.guidance = job.config.recap.guidance;
        }
        let data = TrainingData::new(job.sources, &policy, job.normaliser)?;
        let step = &job.config.train.step;
        let trainer = Trainer::new(&policy, step, job.steps, job.start, job.seed, job.purpose)?
            .into_device(job.compute)?;
        Ok(Box::new(DiffusionTraining { trainer, data, policy, job }))
    }

    fn load(&self, folder: &Path, compute: &Compute) -> Result<Box<dyn Trained>> {
        let (policy, _) = DiffusionPolicy::load(folder).map_err(Error::from)?;
        Ok(Box::new(policy.into_device(compute)?))
    }
}
