//! What a run is started with.

use crate::config::{Resolved, RunConfig};
use crate::method::Method;
use crate::methods;
use crate::policy_class::PolicyClass;
use crate::{Error, Result, Stop};
use e2h_env::{Task, TaskOptions};
use std::path::PathBuf;
use std::sync::Arc;

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
    /// The run directory; by default `runs/<task>-<preset>-<seed>`, with the method and the class of policies before the seed where
    /// they are not the usual ones.
    pub out: Option<PathBuf>,
    /// A LeRobot dataset of the easy task, in the layout that runs record, in place of the scripted demonstrator. All of its successful
    /// episodes are used, or the first `loop.demonstrations` where [`RunOptions::set`] says how many.
    pub demonstrations: Option<PathBuf>,
    /// Go on with a run directory that exists.
    pub resume: bool,
    /// Another run's directory, whose finished stages before the loop are copied where they are what this run would make, byte for byte
    /// but for the provenance of its policies: several methods may share them.
    pub initial_from: Option<PathBuf>,
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
            demonstrations: None,
            resume: false,
            initial_from: None,
            device: "cpu".to_owned(),
            threads: None,
            quiet: false,
            tensorboard: false,
            stop: Stop::default(),
        }
    }

    /// The configuration that a run of a built-in pair has with these options: preset, task file, method and overrides.
    ///
    /// # Errors
    /// An unknown task, preset, method or key (the nearest known one is named), values that do not fit together, a pair that the method
    /// cannot run on.
    pub fn resolve(&self) -> Result<Resolved> {
        let (method, values) = methods::find(&self.method)?.read()?;
        let resolved = RunConfig::resolve_with(&self.preset, &self.task, None, &values, &self.set)?;
        method.check(&resolved.config)?;
        Ok(resolved)
    }
}

/// Builds a task of the variant, clearance and demonstrator that a configuration says.
pub type BuildTask = Arc<dyn Fn(&TaskOptions) -> e2h_env::Result<Arc<dyn Task>> + Send + Sync>;

/// Parts of a run that are one's own; what is none comes from the registries.
#[derive(Default, Clone)]
pub struct Parts {
    /// A task pair: the text of its configuration file, which names it and is laid over the preset, and what builds it.
    pub task: Option<(String, BuildTask)>,
    /// A method. The values of the one that [`RunOptions::method`] names are laid over the task file all the same; the run is told
    /// from others by the name of this one.
    pub method: Option<Arc<dyn Method>>,
    /// A class of policies.
    pub policy: Option<Arc<dyn PolicyClass>>,
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
