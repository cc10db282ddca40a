//! How far along a task a state is, learned from successes.

use super::network::{Learner, matrix, numbers};
use super::{Replay, SacConfig};
use crate::{Error, Result};
use e2h_core::Rng;
use e2h_nn::{Compute, Weights, no_grad};

/// A function of a state, from 0 at the beginning of a task to 1 at its end.
///
/// # Source
/// `jyp9961/TR-DRL e56d60e robosuite/sac_agentenv.py`.
pub struct Potential {
    learner: Learner,
    /// States, each with its share of the way in the last entry.
    examples: Replay,
    inputs: usize,
    compute: Compute,
}

impl Potential {
    /// A potential of `inputs` numbers that has seen nothing.
    ///
    /// # Errors
    /// When a size is zero or the device fails.
    pub fn new(
        inputs: usize,
        capacity: usize,
        config: &SacConfig,
        compute: &Compute,
        rng: &mut Rng,
    ) -> Result<Self> {
        let learner = Learner::new(inputs, 1, config, compute, rng)?;
        Ok(Self { learner, examples: Replay::new(inputs + 1, capacity), inputs, compute: compute.clone() })
    }

    /// Whether there is nothing to learn from, so that its values mean nothing.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.examples.is_empty()
    }

    /// Adds a state, and its share of the way in [0, 1].
    pub fn push(&mut self, state: &[f32], share: f32) {
        let mut row = state.to_vec();
        row.push(share);
        self.examples.push(&row);
    }

    /// Learns for so many steps; nothing happens without examples. Returns the last loss.
    ///
    /// # Errors
    /// [`Error::Data`] when the loss is not finite.
    pub fn learn(&mut self, steps: usize, batch: usize, rng: &mut Rng) -> Result<Option<f32>> {
        let mut last = None;
        if self.examples.is_empty() {
            return Ok(last);
        }
        for _ in 0..steps {
            let (mut x, mut y) = (vec![], vec![]);
            for row in self.examples.draw(batch, rng) {
                x.extend_from_slice(&row[..self.inputs]);
                y.push(row[self.inputs]);
            }
            let y = matrix(&y, 1, &self.compute)?;
            let loss = (self.forward(&x)? - y)?.sqr()?.mean_all()?;
            let loss = self.learner.step(&loss)?;
            if !loss.is_finite() {
                return Err(Error::Data(format!("potential: expected a finite loss, got {loss}")));
            }
            last = Some(loss);
        }
        Ok(last)
    }

    fn forward(&self, states: &[f32]) -> Result<candle_core::Tensor> {
        let x = self.learner.forward(&matrix(states, self.inputs, &self.compute)?)?;
        // The logistic function, by way of a tanh that cannot overflow.
        Ok(((x * 0.5)?.tanh()? * 0.5)?.affine(1.0, 0.5)?)
    }

    /// Values of rows of states.
    ///
    /// # Errors
    /// When the numbers are no whole rows.
    pub fn values(&self, states: &[f32]) -> Result<Vec<f32>> {
        numbers(&no_grad(|| self.forward(states))?)
    }

    /// Adds weights and optimiser below `prefix`; examples are the caller's to give again.
    ///
    /// # Errors
    /// When the device fails.
    pub fn state(&self, prefix: &str, all: &mut Weights) -> Result<()> {
        self.learner.state(prefix, all)
    }

    /// Takes over what [`Potential::state`] added.
    ///
    /// # Errors
    /// When names or shapes differ.
    pub fn load(&mut self, prefix: &str, all: &Weights) -> Result<()> {
        self.learner.load(prefix, all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_learns_how_far_along_a_state_is() {
        let config = SacConfig { hidden: vec![32, 32], lr: 1e-3, ..SacConfig::default() };
        let mut rng = e2h_core::stream(0, "potential", 0, 0);
        let mut p = Potential::new(2, 1000, &config, &Compute::cpu(), &mut rng).unwrap();
        assert!(p.learn(5, 8, &mut rng).unwrap().is_none());
        for i in 0..=50 {
            let share = i as f32 / 50.0;
            p.push(&[share - 0.5, 0.3], share);
        }
        let loss = p.learn(800, 64, &mut rng).unwrap().unwrap();
        assert!(loss < 2e-3, "{loss}");
        let v = p.values(&[-0.4, 0.3, 0.0, 0.3, 0.4, 0.3]).unwrap();
        assert!(v[0] < v[1] && v[1] < v[2] && (v[1] - 0.5).abs() < 0.1, "{v:?}");
    }
}
