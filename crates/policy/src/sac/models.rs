//! Forward and inverse dynamics, which say whether a reversed transition could have happened, and by which action.

use super::SacConfig;
use super::network::{Learner, matrix, numbers};
use crate::{Error, Result};
use candle_core::Tensor;
use e2h_core::Rng;
use e2h_nn::{Compute, Weights, no_grad};
use serde::{Deserialize, Serialize};

/// When a transition counts as confirmed. Entries are numbered as in an observation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Confirmation {
    /// Entries that the forward model has to predict.
    pub entries: Vec<usize>,
    /// Largest error of each of them.
    pub tolerance: f32,
    /// Entries that say where the object is: if none changes by more than `still`, the transition counts as it is.
    pub object: Vec<(usize, f32)>,
}

impl Confirmation {
    /// Whether nothing happened to the object between two observations.
    fn still(&self, now: &[f32], next: &[f32]) -> bool {
        self.object.iter().all(|&(i, most)| (next[i] - now[i]).abs() < most)
    }
}

/// s' = s + tanh f(s, a) and a = tanh g(s, s' - s).
///
/// # Source
/// `jyp9961/TR-DRL e56d60e robosuite/sac_agentenv.py`.
pub struct Models {
    forward: Learner,
    inverse: Learner,
    sizes: [usize; 2],
    compute: Compute,
}

impl Models {
    /// Models that know nothing, of observations and actions of these sizes.
    ///
    /// # Errors
    /// When a size is zero or the device fails.
    pub fn new(
        observation: usize,
        action: usize,
        config: &SacConfig,
        compute: &Compute,
        rng: &mut Rng,
    ) -> Result<Self> {
        let forward = Learner::new(observation + action, observation, config, compute, rng)?;
        let inverse = Learner::new(2 * observation, action, config, compute, rng)?;
        Ok(Self { forward, inverse, sizes: [observation, action], compute: compute.clone() })
    }

    fn tensors(&self, now: &[f32], other: &[f32], width: usize) -> Result<(Tensor, Tensor)> {
        let tensors = (matrix(now, self.sizes[0], &self.compute)?, matrix(other, width, &self.compute)?);
        if tensors.0.dims()[0] != tensors.1.dims()[0] {
            let found = format!("{} and {}", now.len(), other.len());
            return Err(Error::Data(format!(
                "dynamics: expected rows of {} and {width}, got {found} numbers",
                self.sizes[0]
            )));
        }
        Ok(tensors)
    }

    fn next(&self, now: &[f32], action: &[f32]) -> Result<Tensor> {
        let (s, a) = self.tensors(now, action, self.sizes[1])?;
        let change = self.forward.forward(&Tensor::cat(&[&s, &a], 1)?)?.tanh()?;
        Ok((s + change)?)
    }

    fn between(&self, now: &[f32], next: &[f32]) -> Result<Tensor> {
        let (s, next) = self.tensors(now, next, self.sizes[0])?;
        let x = Tensor::cat(&[&s, &(next - &s)?], 1)?;
        Ok(self.inverse.forward(&x)?.tanh()?)
    }

    /// One step of both on transitions that happened; returns their mean squared errors, forward and inverse.
    ///
    /// # Errors
    /// [`Error::Data`] when the numbers do not fit or a loss is not finite.
    pub fn learn(&mut self, now: &[f32], action: &[f32], next: &[f32]) -> Result<[f32; 2]> {
        let forward =
            (self.next(now, action)? - matrix(next, self.sizes[0], &self.compute)?)?.sqr()?.mean_all()?;
        let inverse =
            (self.between(now, next)? - matrix(action, self.sizes[1], &self.compute)?)?.sqr()?.mean_all()?;
        let losses = [self.forward.step(&forward)?, self.inverse.step(&inverse)?];
        if losses.iter().all(|l| l.is_finite()) {
            return Ok(losses);
        }
        Err(Error::Data(format!("dynamics: expected finite losses, got {losses:?}")))
    }

    /// Actions that lead from observations to others, and whether the forward model confirms each.
    ///
    /// # Shapes
    /// `now` and `next` (B, O); the results are (B, A), flat, and (B).
    ///
    /// # Errors
    /// [`Error::Data`] when the numbers do not fit.
    pub fn propose(&self, now: &[f32], next: &[f32], c: &Confirmation) -> Result<(Vec<f32>, Vec<bool>)> {
        let o = self.sizes[0];
        let (actions, reached) = no_grad(|| -> Result<_> {
            let actions = numbers(&self.between(now, next)?)?;
            let reached = numbers(&self.next(now, &actions)?)?;
            Ok((actions, reached))
        })?;
        let rows = now.chunks_exact(o).zip(next.chunks_exact(o)).zip(reached.chunks_exact(o));
        let good = rows.map(|((now, next), reached)| {
            let near = |&i: &usize| (reached[i] - next[i]).abs() < c.tolerance;
            c.still(now, next) || c.entries.iter().all(near)
        });
        Ok((actions, good.collect()))
    }

    /// Adds weights and optimisers below `prefix`.
    ///
    /// # Errors
    /// When the device fails.
    pub fn state(&self, prefix: &str, all: &mut Weights) -> Result<()> {
        self.forward.state(&format!("{prefix}forward."), all)?;
        self.inverse.state(&format!("{prefix}inverse."), all)
    }

    /// Takes over what [`Models::state`] added.
    ///
    /// # Errors
    /// When names or shapes differ.
    pub fn load(&mut self, prefix: &str, all: &Weights) -> Result<()> {
        self.forward.load(&format!("{prefix}forward."), all)?;
        self.inverse.load(&format!("{prefix}inverse."), all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng as _;

    #[test]
    fn they_find_the_action_of_a_step_that_can_happen_and_refuse_one_that_cannot() {
        let config = SacConfig { hidden: vec![32, 32], lr: 2e-3, ..SacConfig::default() };
        let mut rng = e2h_core::stream(0, "models", 0, 0);
        let mut models = Models::new(2, 2, &config, &Compute::cpu(), &mut rng).unwrap();
        // A point that moves by a tenth of the action.
        let draw = |n: usize, rng: &mut Rng| {
            let (mut now, mut action, mut next) = (vec![], vec![], vec![]);
            for _ in 0..2 * n {
                let (s, a) = (rng.random_range(-1.0..1.0f32), rng.random_range(-0.9..0.9f32));
                now.push(s);
                action.push(a);
                next.push(s + 0.1 * a);
            }
            (now, action, next)
        };
        for _ in 0..1500 {
            let (now, action, next) = draw(64, &mut rng);
            models.learn(&now, &action, &next).unwrap();
        }
        let c = Confirmation { entries: vec![0, 1], tolerance: 0.02, object: vec![(0, 1e-6), (1, 1e-6)] };
        let (now, action, next) = draw(200, &mut rng);
        let (found, good) = models.propose(&now, &next, &c).unwrap();
        let error = found.iter().zip(&action).map(|(a, b)| (a - b).abs()).sum::<f32>() / found.len() as f32;
        assert!(error < 0.1, "{error}");
        assert!(good.iter().filter(|g| **g).count() > 180);
        // A jump is confirmed by no action; standing still always is.
        let far: Vec<f32> = now.iter().map(|s| s + 0.6).collect();
        assert!(models.propose(&now, &far, &c).unwrap().1.iter().all(|g| !g));
        assert!(models.propose(&now, &now, &c).unwrap().1.iter().all(|g| *g));
        assert!(models.propose(&now, &now[2..], &c).is_err());
    }
}
