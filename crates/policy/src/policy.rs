//! A trained policy: observations in, action chunks out.

use crate::batch::{BatchBuilder, Rows};
use crate::model::Widths;
use crate::{Checkpoint, Ddim, DiffusionModel, Error, PolicyConfig, Provenance, Result, SamplerKind};
use candle_core::Tensor;
use e2h_core::{ACTION_DIM, Action, ActionChunk, Observation, Policy, Rng, stream};
use e2h_data::Normaliser;
use e2h_nn::{Compute, Mode, Weights};
use rand::Rng as _;
use std::path::Path;

/// A diffusion policy ready to act.
pub struct DiffusionPolicy {
    model: DiffusionModel,
    ddim: Ddim,
    normaliser: Normaliser,
    config: PolicyConfig,
}

impl DiffusionPolicy {
    /// A policy with random weights.
    ///
    /// # Errors
    /// When the configuration does not fit together.
    pub fn untrained(config: &PolicyConfig, normaliser: &Normaliser, seed: u64) -> Result<Self> {
        let model = DiffusionModel::new(config, Mode::Infer, &mut stream(seed, "weights", 0, 0))?;
        let ddim = Ddim::new(config.train_timesteps, config.inference_steps, config.prediction)?;
        Ok(Self { model, ddim, normaliser: normaliser.clone(), config: config.clone() })
    }

    /// A policy with given weights.
    ///
    /// # Errors
    /// When the weights are not those of this configuration; lists every tensor that differs.
    pub fn with_weights(config: &PolicyConfig, normaliser: &Normaliser, weights: &Weights) -> Result<Self> {
        let widths = Widths { state: config.state_features(), action: ACTION_DIM };
        let model = DiffusionModel::with_weights(config, widths, weights)?;
        let ddim = Ddim::new(config.train_timesteps, config.inference_steps, config.prediction)?;
        Ok(Self { model, ddim, normaliser: normaliser.clone(), config: config.clone() })
    }

    /// The same policy on another device.
    ///
    /// # Errors
    /// When the device fails.
    pub fn into_device(self, compute: &Compute) -> Result<Self> {
        let widths = Widths { state: self.config.state_features(), action: ACTION_DIM };
        let model = self.model.into_device(compute, &self.config, widths)?;
        Ok(Self { model, ..self })
    }

    /// Reads a checkpoint folder.
    ///
    /// # Errors
    /// When a file is missing, foreign or does not match; names what was expected and found.
    pub fn load(dir: &Path) -> Result<(Self, Checkpoint)> {
        let (checkpoint, weights) = Checkpoint::read(dir)?;
        let policy = Self::with_weights(&checkpoint.config, &checkpoint.normaliser, &weights)
            .map_err(|e| Error::Checkpoint { path: dir.to_owned(), problem: e.to_string() })?;
        Ok((policy, checkpoint))
    }

    /// Writes a checkpoint folder that stands alone.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn save(&self, dir: &Path, provenance: &Provenance) -> Result<()> {
        Checkpoint {
            config: self.config.clone(),
            normaliser: self.normaliser.clone(),
            provenance: provenance.clone(),
        }
        .write(dir, &self.weights()?)
    }

    /// The weights that it acts with.
    ///
    /// # Errors
    /// When they cannot be read back from the device.
    pub fn weights(&self) -> Result<Weights> {
        Ok(self.model.params.export()?)
    }

    /// Architecture and inference settings.
    #[must_use]
    pub fn config(&self) -> &PolicyConfig {
        &self.config
    }

    /// Scaling of states and actions.
    #[must_use]
    pub fn normaliser(&self) -> &Normaliser {
        &self.normaliser
    }

    /// Number of parameters.
    #[must_use]
    pub fn parameters(&self) -> usize {
        self.model.params.count()
    }

    fn check(&self, histories: &[Vec<&Observation>]) -> Result<()> {
        let c = &self.config;
        let wrong = |quantity: &str, expected: String, found: String| {
            Err(Error::Observation { quantity: quantity.to_owned(), expected, found })
        };
        for history in histories {
            if history.len() != c.n_obs_steps {
                return wrong("steps of history", c.n_obs_steps.to_string(), history.len().to_string());
            }
            for observation in history {
                if observation.frames.len() < c.cameras.len() {
                    return wrong(
                        "cameras",
                        format!("{:?}", c.cameras),
                        observation.frames.len().to_string(),
                    );
                }
                for (image, camera) in observation.frames.iter().zip(&c.cameras) {
                    let n = c.image_size;
                    if (image.height, image.width) != (n, n) || image.data.len() != n * n * 3 {
                        return wrong(
                            &format!("image of camera `{camera}`"),
                            format!("{n} x {n}"),
                            format!("{} x {} ({} bytes)", image.height, image.width, image.data.len()),
                        );
                    }
                }
                if let Some(v) = observation.state.iter().find(|v| !v.is_finite()) {
                    return wrong("state", "finite numbers".to_owned(), v.to_string());
                }
            }
        }
        Ok(())
    }

    /// Actions for each history; see [`Policy::act`].
    ///
    /// # Errors
    /// When the observations do not fit the policy.
    pub fn sample(&self, histories: &[Vec<&Observation>], rngs: &mut [Rng]) -> Result<Vec<ActionChunk>> {
        if histories.len() != rngs.len() {
            return Err(Error::Observation {
                quantity: "random streams".to_owned(),
                expected: histories.len().to_string(),
                found: rngs.len().to_string(),
            });
        }
        let per = self.config.horizon * ACTION_DIM;
        self.sample_with(histories, &mut |noise| {
            for (row, rng) in noise.chunks_exact_mut(per).zip(rngs.iter_mut()) {
                row.fill_with(|| rng.sample(rand_distr::StandardNormal));
            }
        })
    }

    /// Actions for each history from noise of the caller's. `noise` fills the slice that it is given: once for where sampling
    /// begins, and with [`crate::SamplerKind::Ddpm`] once more for every step.
    ///
    /// # Shapes
    /// The slice is (histories, T, 8).
    ///
    /// # Errors
    /// When the observations do not fit the policy.
    pub fn sample_with(
        &self,
        histories: &[Vec<&Observation>],
        noise: &mut dyn FnMut(&mut [f32]),
    ) -> Result<Vec<ActionChunk>> {
        if histories.is_empty() {
            return Ok(vec![]);
        }
        self.check(histories)?;
        let c = &self.config;
        let mut batch = BatchBuilder::new(c);
        for history in histories {
            batch.push_state(Rows::Observations(history), &self.normaliser, None);
            let first_image = c.n_obs_steps - c.n_image_steps;
            for camera in 0..c.cameras.len() {
                for observation in &history[first_image..] {
                    batch.push_image(
                        camera,
                        &observation.frames[camera].data,
                        c.centre_crop(),
                        c.crop_size,
                        None,
                    );
                }
            }
        }
        let device = self.model.device();
        let (state, images) = batch.tensors(c.crop_size, device)?;
        let condition = self.model.condition(&state, &images)?;
        let x = denoise(&self.model, &self.ddim, c, ACTION_DIM, &condition, noise)?;
        let first = if c.lerobot_alignment { c.n_obs_steps - 1 } else { 0 };
        Ok(x.chunks_exact(c.horizon * ACTION_DIM)
            .map(|sample| {
                let rows = sample.as_chunks::<ACTION_DIM>().0;
                rows.iter().skip(first).take(c.n_action_steps).map(|row| self.action(row)).collect()
            })
            .collect())
    }

    /// A predicted row in units.
    fn action(&self, row: &Action) -> Action {
        if self.config.unit_quaternion {
            self.normaliser.unnormalise_action(row)
        } else {
            self.normaliser.unscale_action(row)
        }
    }
}

/// From noise to normalised actions.
///
/// # Shapes
/// `condition` (B, condition), one less with an indicator; result (B, T, `action_dim`) in a row.
pub(crate) fn denoise(
    model: &DiffusionModel,
    ddim: &Ddim,
    c: &PolicyConfig,
    action_dim: usize,
    condition: &Tensor,
    noise: &mut dyn FnMut(&mut [f32]),
) -> Result<Vec<f32>> {
    let b = condition.dim(0)?;
    let mut x = vec![0.0; b * c.horizon * action_dim];
    noise(&mut x);
    let mut fresh = vec![];
    let guided = c.guidance != 1.0;
    let (condition, free) = if c.indicator {
        let indicate = |value: f32| model.indicate(condition, &vec![value; b]);
        (indicate(1.0)?, guided.then(|| indicate(0.0)).transpose()?)
    } else {
        (condition.clone(), guided.then(|| condition.zeros_like()).transpose()?)
    };
    for step in ddim.steps() {
        let timesteps = vec![step.timestep as f32; b];
        let input = Tensor::from_slice(&x, (b, c.horizon, action_dim), model.device())?;
        let mut output = model.forward(&input, &timesteps, &condition)?;
        if let Some(free) = &free {
            // Source: classifier-free guidance, arXiv 2207.12598, equation 6 in the form u + w (c - u).
            let unconditional = model.forward(&input, &timesteps, free)?;
            output = (&unconditional + ((output - &unconditional)? * f64::from(c.guidance))?)?;
        }
        let output = output.flatten_all()?.to_vec1::<f32>()?;
        match c.sampler {
            SamplerKind::Ddim => ddim.step(step, &output, &mut x),
            SamplerKind::Ddpm => {
                fresh.resize(x.len(), 0.0);
                if step.timestep > 0 {
                    noise(&mut fresh);
                }
                ddim.stochastic_step(step, &output, &fresh, &mut x);
            }
        }
    }
    Ok(x)
}

impl Policy for DiffusionPolicy {
    fn n_obs_steps(&self) -> usize {
        self.config.n_obs_steps
    }

    fn act(&self, histories: &[Vec<&Observation>], rngs: &mut [Rng]) -> e2h_core::Result<Vec<ActionChunk>> {
        Ok(self.sample(histories, rngs)?)
    }
}
