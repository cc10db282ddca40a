//! A checkpoint and the environment that it was trained in.

use crate::config::RunConfig;
use crate::{Error, Result};
use e2h_core::Direction;
use e2h_env::Env;
use e2h_policy::{Checkpoint, DiffusionPolicy};
use std::path::Path;

/// A policy with everything that an evaluation needs.
pub struct Published {
    /// The policy.
    pub policy: DiffusionPolicy,
    /// Its configuration, normaliser and provenance.
    pub checkpoint: Checkpoint,
    /// Configuration of the run that trained it.
    pub config: RunConfig,
    /// Which task of the pair it does.
    pub direction: Direction,
    env: Env,
}

impl Published {
    /// Reads a checkpoint folder and builds its environment.
    ///
    /// # Errors
    /// When a file is missing, foreign, or of another version; names what was expected and found.
    pub fn open(dir: &Path) -> Result<Self> {
        let (policy, checkpoint) = DiffusionPolicy::load(dir)?;
        let foreign = |quantity: &str, expected: &str, found: String| Error::Foreign {
            path: dir.join("policy.json"),
            quantity: quantity.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let config: RunConfig = serde_json::from_value(checkpoint.provenance.run.clone())
            .map_err(|e| foreign("run configuration", "one of this version", e.to_string()))?;
        // Settings are as foreign as weights: what builds the environment is looked at like a configuration of one's own.
        config.validate().map_err(|e| foreign("run configuration", "values that work", e.to_string()))?;
        let direction = checkpoint.provenance.direction;
        let direction = direction.ok_or_else(|| foreign("direction", "hard or easy", "none".to_owned()))?;
        let task = e2h_env::task(&config.task.name, &config.task.options())?;
        let mut env = Env::new(task, &config.env)?;
        let p = &checkpoint.config;
        if !p.cameras.is_empty() && (!config.env.cameras || p.image_size != config.env.image_size) {
            let found = format!("{} (images: {})", config.env.image_size, config.env.cameras);
            return Err(foreign(
                "env.image_size of its run",
                &format!("{} as the policy's", p.image_size),
                found,
            ));
        }
        if !p.cameras.is_empty() {
            env.select_cameras(&p.cameras)?;
        }
        Ok(Self { policy, checkpoint, config, direction, env })
    }

    /// `n` simulations of its task.
    ///
    /// # Errors
    /// When the simulation cannot be set up.
    pub fn envs(&self, n: usize) -> Result<Vec<Env>> {
        (0..n).map(|_| Ok(self.env.clone_shared()?)).collect()
    }
}
