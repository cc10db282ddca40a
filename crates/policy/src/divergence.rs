//! When a training no longer learns: weights that are no numbers, gradients too long to be followed.

use crate::{Error, Result};
use e2h_nn::Weights;

/// Steps in a row whose gradient was too long to be a number, after which nothing is learned any more.
const MOST_SKIPPED: usize = 5;

/// Refuses weights that are no numbers, which nobody can act with.
pub(crate) fn sound(weights: &Weights, step: usize, seed: u64) -> Result<()> {
    for (name, tensor) in weights {
        if let Some(found) = tensor.data.iter().find(|v| !v.is_finite()) {
            return Err(Error::Weight { name: name.clone(), found: *found, step, seed });
        }
    }
    Ok(())
}

/// Counts steps in a row that the optimiser left out, and refuses too many.
#[derive(Default)]
pub(crate) struct Skipped(pub(crate) usize);

impl Skipped {
    /// `norm` is what the optimiser said of the step.
    pub(crate) fn after(&mut self, norm: f32, step: usize, seed: u64) -> Result<()> {
        self.0 = if norm.is_finite() { 0 } else { self.0 + 1 };
        if self.0 < MOST_SKIPPED { Ok(()) } else { Err(Error::Skipped { steps: self.0, norm, step, seed }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_skipped_steps_in_a_row_end_a_training() {
        let mut skipped = Skipped::default();
        for step in 1..MOST_SKIPPED {
            skipped.after(f32::INFINITY, step, 7).unwrap();
        }
        // One that counts, and the row begins anew.
        skipped.after(3.0, MOST_SKIPPED, 7).unwrap();
        for step in 1..MOST_SKIPPED {
            skipped.after(f32::NAN, step, 7).unwrap();
        }
        let error = skipped.after(f32::INFINITY, 40, 7).unwrap_err();
        assert!(matches!(error, Error::Skipped { steps: MOST_SKIPPED, step: 40, seed: 7, .. }), "{error}");
    }

    #[test]
    fn weights_that_are_no_numbers_are_refused_by_name() {
        let tensor = |v: f32| e2h_nn::HostTensor { shape: vec![2], data: vec![0.5, v] };
        let weights: Weights =
            [("a".to_owned(), tensor(1.0)), ("b".to_owned(), tensor(f32::INFINITY))].into();
        assert!(matches!(sound(&weights, 3, 7), Err(Error::Weight { name, .. }) if name == "b"));
        let weights: Weights = [("a".to_owned(), tensor(1.0))].into();
        sound(&weights, 3, 7).unwrap();
    }
}
