//! The noise schedule and its samplers.
//!
//! # Source
//! Song et al., "Denoising Diffusion Implicit Models" (arXiv 2010.02502), equation 12 with eta = 0; schedule of Nichol and
//! Dhariwal (arXiv 2102.09672), equation 17; conventions of diffusers 0.35.2 `scheduling_ddim.py` with `clip_sample`,
//! `set_alpha_to_one`, `steps_offset = 0`, "leading" spacing. Checked against it in `tests/golden.rs`.

use crate::{Error, Prediction, Result};

/// Squared-cosine schedule and a fixed sub-sequence of its steps.
#[derive(Debug, Clone)]
pub struct Ddim {
    betas: Vec<f64>,
    alphas_cumprod: Vec<f64>,
    timesteps: Vec<usize>,
    stride: usize,
    prediction: Prediction,
}

/// The numbers of one sampling step: the noise levels before and after it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DdimStep {
    /// Diffusion step k that the network is asked at.
    pub timestep: usize,
    /// Share of signal at that step (alpha bar).
    pub alpha: f64,
    /// Share of signal after it; 1 at the end.
    pub alpha_previous: f64,
}

impl Ddim {
    /// Schedule of `train_timesteps` steps, sampled in `inference_steps`.
    ///
    /// # Errors
    /// When there are no steps or more inference than training steps.
    pub fn new(train_timesteps: usize, inference_steps: usize, prediction: Prediction) -> Result<Self> {
        if inference_steps == 0 || inference_steps > train_timesteps {
            return Err(Error::Config(format!(
                "inference_steps: expected 1 to train_timesteps ({train_timesteps}), got {inference_steps}"
            )));
        }
        let n = train_timesteps as f64;
        let bar = |t: f64| ((t / n + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2);
        // The cap keeps the last step from being pure noise with no way back.
        let betas: Vec<f64> =
            (0..train_timesteps).map(|t| (1.0 - bar(t as f64 + 1.0) / bar(t as f64)).min(0.999)).collect();
        let alphas_cumprod = betas
            .iter()
            .scan(1.0, |product, beta| {
                *product *= 1.0 - beta;
                Some(*product)
            })
            .collect();
        let stride = train_timesteps / inference_steps;
        let timesteps = (0..inference_steps).rev().map(|i| i * stride).collect();
        Ok(Self { betas, alphas_cumprod, timesteps, stride, prediction })
    }

    /// Noise added at each step. Shapes: (train steps).
    #[must_use]
    pub fn betas(&self) -> &[f64] {
        &self.betas
    }

    /// Share of signal left at each step. Shapes: (train steps).
    #[must_use]
    pub fn alphas_cumprod(&self) -> &[f64] {
        &self.alphas_cumprod
    }

    /// Steps of the schedule.
    #[must_use]
    pub fn train_timesteps(&self) -> usize {
        self.betas.len()
    }

    /// The sampling steps, noisiest first.
    pub fn steps(&self) -> impl Iterator<Item = DdimStep> + '_ {
        self.timesteps.iter().map(|&timestep| DdimStep {
            timestep,
            alpha: self.alphas_cumprod[timestep],
            alpha_previous: timestep.checked_sub(self.stride).map_or(1.0, |t| self.alphas_cumprod[t]),
        })
    }

    /// `sqrt(alpha) clean + sqrt(1 - alpha) noise`, written over `clean`. A step past the schedule counts as its last.
    pub fn add_noise(&self, clean: &mut [f32], noise: &[f32], timestep: usize) {
        let alpha = self.alphas_cumprod[timestep.min(self.betas.len() - 1)];
        let (signal, sigma) = (alpha.sqrt() as f32, (1.0 - alpha).sqrt() as f32);
        for (x, e) in clean.iter_mut().zip(noise) {
            *x = signal * *x + sigma * e;
        }
    }

    /// One sampling step on `sample`, given the network's `output` at `step`. The clean estimate is clipped to [-1, 1]; the
    /// noise estimate is not recomputed from the clipped one where the network predicts noise, as in the reference.
    pub fn step(&self, step: DdimStep, output: &[f32], sample: &mut [f32]) {
        let (signal, sigma) = (step.alpha.sqrt() as f32, (1.0 - step.alpha).sqrt() as f32);
        let (signal_previous, sigma_previous) =
            (step.alpha_previous.sqrt() as f32, (1.0 - step.alpha_previous).sqrt() as f32);
        for (x, &out) in sample.iter_mut().zip(output) {
            let (clean, noise) = match self.prediction {
                Prediction::Epsilon => ((*x - sigma * out) / signal, out),
                Prediction::Sample => (out, (*x - signal * out) / sigma),
            };
            *x = signal_previous * clean.clamp(-1.0, 1.0) + sigma_previous * noise;
        }
    }
}

impl Ddim {
    /// One step of the stochastic sampler over the same sub-sequence: the mean of what the clipped clean estimate and `sample`
    /// say of the step before, and `fresh` noise of the smaller of the two variances (none in the last step).
    ///
    /// # Source
    /// Ho et al., arXiv 2006.11239, equations 6 and 7; diffusers 0.35.2 `scheduling_ddpm.py` with `fixed_small` variance and
    /// `clip_sample`. Checked against it in `tests/lerobot.rs`.
    pub fn stochastic_step(&self, step: DdimStep, output: &[f32], fresh: &[f32], sample: &mut [f32]) {
        let (signal, sigma) = (step.alpha.sqrt() as f32, (1.0 - step.alpha).sqrt() as f32);
        let alpha = step.alpha / step.alpha_previous;
        let (beta, rest) = (1.0 - alpha, 1.0 - step.alpha);
        let of_clean = (step.alpha_previous.sqrt() * beta / rest) as f32;
        let of_sample = (alpha.sqrt() * (1.0 - step.alpha_previous) / rest) as f32;
        let deviation = if step.timestep == 0 {
            0.0
        } else {
            ((1.0 - step.alpha_previous) / rest * beta).max(1e-20).sqrt() as f32
        };
        for ((x, &out), &noise) in sample.iter_mut().zip(output).zip(fresh) {
            let clean = match self.prediction {
                Prediction::Epsilon => (*x - sigma * out) / signal,
                Prediction::Sample => out,
            };
            *x = of_clean * clean.clamp(-1.0, 1.0) + of_sample * *x + deviation * noise;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_predictions_walk_the_same_path_for_a_perfect_network() {
        let clean = [0.3, -0.8, 0.0];
        for prediction in [Prediction::Epsilon, Prediction::Sample] {
            let ddim = Ddim::new(100, 10, prediction).unwrap();
            let noise = [0.5, 1.5, -0.7];
            let mut x = clean;
            ddim.add_noise(&mut x, &noise, 90);
            for step in ddim.steps() {
                let out = match prediction {
                    Prediction::Epsilon => noise,
                    Prediction::Sample => clean,
                };
                ddim.step(step, &out, &mut x);
            }
            for (a, b) in x.iter().zip(clean) {
                assert!((a - b).abs() < 1e-3, "{prediction:?} {x:?}");
            }
        }
    }

    #[test]
    fn the_stochastic_sampler_ends_at_what_a_perfect_network_says() {
        let clean = [0.3, -0.8, 0.0];
        let ddim = Ddim::new(100, 100, Prediction::Sample).unwrap();
        let mut x = [2.0, -1.0, 0.5];
        for (k, step) in ddim.steps().enumerate() {
            let fresh = [0.9, -1.1, 0.2].map(|v| if k % 2 == 0 { v } else { -v });
            ddim.stochastic_step(step, &clean, &fresh, &mut x);
        }
        assert!(x.iter().zip(clean).all(|(a, b)| (a - b).abs() < 1e-5), "{x:?}");
    }

    #[test]
    fn refuses_more_inference_steps_than_training_steps() {
        assert!(Ddim::new(10, 11, Prediction::Sample).is_err());
        assert!(Ddim::new(10, 0, Prediction::Sample).is_err());
    }
}
