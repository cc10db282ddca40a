//! A checkpoint and the environment that it was trained in.

use crate::config::RunConfig;
use crate::{Error, Result};
use e2h_core::{Direction, Policy};
use e2h_env::Env;
use e2h_nn::Compute;
use e2h_policy::sac::{self, StatePolicy};
use e2h_policy::{DiffusionPolicy, PolicyConfig, Provenance};
use e2h_report::folder::read_json;
use serde::Deserialize;
use std::path::Path;

/// A policy with everything that an evaluation needs.
pub struct Published {
    policy: Loaded,
    /// Where it comes from.
    pub provenance: Provenance,
    /// Configuration of the run that trained it.
    pub config: RunConfig,
    /// Which task of the pair it does.
    pub direction: Direction,
    env: Env,
}

/// A policy of a class that checkpoints can be of.
enum Loaded {
    Diffusion(Box<DiffusionPolicy>),
    States(Box<StatePolicy>),
}

impl Loaded {
    /// Reads the class that `policy.json` names; the images that it wants with it.
    fn read(dir: &Path) -> Result<(Self, Option<PolicyConfig>, Provenance)> {
        // A file that is no description of any is the diffusion policy's to complain of.
        let kind: Option<Kind> = read_json(&dir.join("policy.json")).ok().flatten();
        if kind.is_some_and(|k| k.kind.as_deref() == Some(sac::KIND)) {
            let (policy, provenance) = StatePolicy::load(dir)?;
            return Ok((Self::States(Box::new(policy)), None, provenance));
        }
        let (policy, checkpoint) = DiffusionPolicy::load(dir)?;
        Ok((Self::Diffusion(Box::new(policy)), Some(checkpoint.config), checkpoint.provenance))
    }
}

/// What `policy.json` says of its class, whatever else is in it.
#[derive(Deserialize)]
struct Kind {
    kind: Option<String>,
}

impl Published {
    /// Reads a checkpoint folder, of a diffusion policy or of an agent of `tr-drl`, and builds its environment.
    ///
    /// # Errors
    /// When a file is missing, foreign, or of another version; names what was expected and found.
    pub fn open(dir: &Path) -> Result<Self> {
        let (policy, images, provenance) = Loaded::read(dir)?;
        let foreign = |quantity: &str, expected: &str, found: String| Error::Foreign {
            path: dir.join("policy.json"),
            quantity: quantity.to_owned(),
            expected: expected.to_owned(),
            found,
        };
        let config: RunConfig = serde_json::from_value(provenance.run.clone())
            .map_err(|e| foreign("run configuration", "one of this version", e.to_string()))?;
        // Settings are as foreign as weights: what builds the environment is looked at like a configuration of one's own.
        config.validate().map_err(|e| foreign("run configuration", "values that work", e.to_string()))?;
        let direction = provenance.direction;
        let direction = direction.ok_or_else(|| foreign("direction", "hard or easy", "none".to_owned()))?;
        let task = e2h_env::task(&config.task.name, &config.task.options())?;
        let mut env = Env::new(task, &config.env)?;
        if let Some(p) = images.filter(|p| !p.cameras.is_empty()) {
            if !config.env.cameras || p.image_size != config.env.image_size {
                let found = format!("{} (images: {})", config.env.image_size, config.env.cameras);
                let expected = format!("{} as the policy's", p.image_size);
                return Err(foreign("env.image_size of its run", &expected, found));
            }
            env.select_cameras(&p.cameras)?;
        }
        Ok(Self { policy, provenance, config, direction, env })
    }

    /// The policy.
    #[must_use]
    pub fn policy(&self) -> &dyn Policy {
        match &self.policy {
            Loaded::Diffusion(policy) => &**policy,
            Loaded::States(policy) => &**policy,
        }
    }

    /// The same, with its network on a device; an agent from states stays on the CPU, where its few numbers are fastest.
    ///
    /// # Errors
    /// When the device fails.
    pub fn into_device(self, compute: &Compute) -> Result<Self> {
        let policy = match self.policy {
            Loaded::Diffusion(policy) => Loaded::Diffusion(Box::new(policy.into_device(compute)?)),
            states @ Loaded::States(_) => states,
        };
        Ok(Self { policy, ..self })
    }

    /// `n` simulations of its task.
    ///
    /// # Errors
    /// When the simulation cannot be set up.
    pub fn envs(&self, n: usize) -> Result<Vec<Env>> {
        (0..n).map(|_| Ok(self.env.clone_shared()?)).collect()
    }
}
