//! LeRobot's normalisations: ranges and moments, per entry.

use super::EPS;
use crate::{Error, ImageScaling, Result};
use e2h_data::{Normaliser, Recording};
use std::borrow::Borrow;

/// How the entries of a feature are scaled; statistics repeat over rows.
#[derive(Debug, Clone, PartialEq)]
pub enum Scaling {
    /// Not at all.
    None,
    /// From [min, max] to [-1, 1].
    Range {
        /// Lower ends.
        min: Vec<f32>,
        /// Upper ends.
        max: Vec<f32>,
        /// Width of a range that has none.
        eps: f32,
    },
    /// From mean and standard deviation.
    Moments {
        /// Means.
        mean: Vec<f32>,
        /// Standard deviations.
        std: Vec<f32>,
        /// Added to the deviation on the way in, but not on the way out.
        eps: f32,
    },
}

impl Scaling {
    /// Ranges of the entries of rows. An entry that hardly changes is shifted to 0 and not scaled, or its noise would be blown
    /// up to the size of everything else.
    fn fit<'a>(rows: impl Iterator<Item = &'a [f32]>, width: usize) -> Self {
        let (mut min, mut max) = (vec![f32::INFINITY; width], vec![f32::NEG_INFINITY; width]);
        for row in rows {
            for (i, &v) in row.iter().enumerate() {
                (min[i], max[i]) = (min[i].min(v), max[i].max(v));
            }
        }
        for (low, high) in min.iter_mut().zip(&mut max) {
            if *high - *low <= LEAST_RANGE * low.abs().max(high.abs()) {
                let middle = f32::midpoint(*low, *high);
                (*low, *high) = (middle - 1.0, middle + 1.0);
            }
        }
        // Statistics are 32 bits.
        Self::Range { min, max, eps: EPS as f32 }
    }

    /// Name of the mode in `config.json`.
    pub(super) fn mode(&self) -> &'static str {
        match self {
            Self::None => "IDENTITY",
            Self::Range { .. } => "MIN_MAX",
            Self::Moments { .. } => "MEAN_STD",
        }
    }

    /// Scales rows of this feature.
    pub(super) fn normalise(&self, values: &mut [f32]) {
        match self {
            Self::None => {}
            Self::Range { min, max, eps } => {
                each(values, min, max, |v, min, max| 2.0 * (v - min) / width(min, max, *eps) - 1.0)
            }
            Self::Moments { mean, std, eps } => {
                each(values, mean, std, |v, mean, std| (v - mean) / (std + eps));
            }
        }
    }

    /// Undoes it.
    pub(super) fn invert(&self, values: &mut [f32]) {
        match self {
            Self::None => {}
            Self::Range { min, max, eps } => {
                each(values, min, max, |v, min, max| (v + 1.0) / 2.0 * width(min, max, *eps) + min)
            }
            Self::Moments { mean, std, .. } => each(values, mean, std, |v, mean, std| v * std + mean),
        }
    }

    /// The range that [`e2h_data::Normaliser`] maps as this does, for entry `i`. A range without width becomes one in which
    /// its only value is mapped, and comes back, as in LeRobot.
    pub(super) fn range(&self, i: usize, output: bool) -> (f32, f32) {
        match self {
            Self::None => (-1.0, 1.0),
            Self::Range { min, max, .. } if min[i] == max[i] => {
                (min[i], if output { min[i].next_up() } else { min[i] + 2.0 })
            }
            Self::Range { min, max, .. } => (min[i], max[i]),
            Self::Moments { mean, std, eps } => {
                let half = if output { std[i] } else { std[i] + eps };
                (mean[i] - half, mean[i] + half)
            }
        }
    }

    /// Mean and deviation of entry `i` that scale as this does on the way in.
    pub(super) fn moments(&self, i: usize) -> (f32, f32) {
        match self {
            Self::None => (0.0, 1.0),
            Self::Range { min, max, eps } => {
                let half = 0.5 * width(min[i], max[i], *eps);
                (min[i] + half, half)
            }
            Self::Moments { mean, std, eps } => (mean[i], std[i] + eps),
        }
    }
}

/// Ranges below this part of the numbers themselves are noise of 32 bits.
const LEAST_RANGE: f32 = 1e-6;
/// Mean and deviation of the channels of ImageNet's images, which LeRobot scales all images by unless it is told otherwise.
pub const IMAGENET: ImageScaling = ImageScaling { mean: [0.485, 0.456, 0.406], std: [0.229, 0.224, 0.225] };

/// How everything that goes into a policy and comes out is scaled.
#[derive(Debug, Clone, PartialEq)]
pub struct Scalings {
    /// `observation.state`.
    pub state: Scaling,
    /// `observation.environment_state`.
    pub environment: Scaling,
    /// Actions.
    pub action: Scaling,
    /// Images, one entry a camera; none leaves them in [0, 1].
    pub images: Vec<ImageScaling>,
}

impl Scalings {
    /// Ranges of states and actions over all rows of `recordings`, which have one layout; `images` as given.
    ///
    /// # Errors
    /// Without rows.
    pub fn fit<R: Borrow<Recording>>(recordings: &[R], images: Vec<ImageScaling>) -> Result<Self> {
        let all = || recordings.iter().map(Borrow::borrow).flat_map(|r| (0..r.len()).map(move |t| (r, t)));
        let Some((first, _)) = all().next() else { return Err(Error::Dataset(e2h_data::Error::NoRows)) };
        let (s, e) = (first.layout().state.len(), first.layout().environment.len());
        Ok(Self {
            state: Scaling::fit(all().map(|(r, t)| &r.state(t)[..s]), s),
            environment: if e == 0 {
                Scaling::None
            } else {
                Scaling::fit(all().map(|(r, t)| &r.state(t)[s..]), e)
            },
            action: Scaling::fit(all().map(|(r, t)| r.action(t)), first.layout().action_width()),
            images,
        })
    }

    /// Those of a policy of this project's tasks.
    pub(super) fn of(n: &Normaliser, images: &[ImageScaling]) -> Self {
        let range = |min: &[f32], max: &[f32]| Scaling::Range {
            min: min.to_vec(),
            max: max.to_vec(),
            eps: EPS as f32,
        };
        Self {
            state: range(&n.state_min, &n.state_max),
            environment: Scaling::None,
            action: range(&n.action_min, &n.action_max),
            images: images.to_vec(),
        }
    }

    /// Appends a row's state, scaled.
    pub(crate) fn push_state(&self, recording: &Recording, row: usize, out: &mut Vec<f32>) {
        let start = out.len();
        out.extend_from_slice(recording.state(row));
        let (state, environment) = out[start..].split_at_mut(recording.layout().state.len());
        self.state.normalise(state);
        self.environment.normalise(environment);
    }

    /// Appends a row's action, scaled.
    pub(crate) fn push_action(&self, recording: &Recording, row: usize, out: &mut Vec<f32>) {
        let start = out.len();
        out.extend_from_slice(recording.action(row));
        self.action.normalise(&mut out[start..]);
    }
}

fn width(min: f32, max: f32, eps: f32) -> f32 {
    if min == max { eps } else { max - min }
}

fn each(values: &mut [f32], a: &[f32], b: &[f32], f: impl Fn(f32, f32, f32) -> f32) {
    for row in values.chunks_exact_mut(a.len()) {
        for (v, (a, b)) in row.iter_mut().zip(a.iter().zip(b)) {
            *v = f(*v, *a, *b);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_those_of_all_rows_and_what_hardly_changes_is_not_scaled() {
        let rows = [[1.0, 5.0, 1000.0], [3.0, 5.0, 1000.0005], [2.0, 5.0, 1000.0]];
        let fitted = Scaling::fit(rows.iter().map(|r| &r[..]), 3);
        let mut v = vec![1.0, 5.0, 1000.0, 3.0, 5.5, 1001.0];
        fitted.normalise(&mut v);
        let want = [-1.0, 0.0, 0.0, 1.0, 0.5, 1.0];
        assert!(v.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-3), "{v:?}");
    }

    #[test]
    fn there_and_back_is_the_same() {
        let (a, b) = (vec![-2.0, 0.5], vec![3.0, 0.75]);
        for scaling in [
            Scaling::None,
            Scaling::Range { min: a.clone(), max: b.clone(), eps: 1e-8 },
            Scaling::Moments { mean: a, std: b, eps: 1e-8 },
        ] {
            let values = [1.0, 0.6, -1.5, 0.7];
            let mut v = values;
            scaling.normalise(&mut v);
            scaling.invert(&mut v);
            assert!(v.iter().zip(values).all(|(x, y)| (x - y).abs() < 1e-6), "{scaling:?} {v:?}");
        }
    }

    #[test]
    fn ranges_and_moments_say_the_same_in_other_words() {
        let (a, b) = (vec![-2.0, 0.5, 7.0], vec![3.0, 0.75, 7.0]);
        for scaling in [
            Scaling::None,
            Scaling::Range { min: a.clone(), max: b.clone(), eps: 1e-8 },
            Scaling::Moments { mean: a, std: b, eps: 1e-8 },
        ] {
            // The last entry has a range without width, and then its only value.
            let values = [1.0, 0.6, 7.0];
            let mut want = values;
            scaling.normalise(&mut want);
            for i in 0..3 {
                let (min, max) = scaling.range(i, false);
                let got = 2.0 * ((values[i] - min) / (max - min)) - 1.0;
                assert!((got - want[i]).abs() < 1e-5, "{scaling:?} entry {i}: {got}, expected {}", want[i]);
                let (min, max) = scaling.range(i, true);
                let back = min + 0.5 * (want[i] + 1.0) * (max - min);
                assert!((back - values[i]).abs() < 1e-5, "{scaling:?} entry {i}: {back}");
                if i < 2 {
                    let (mean, std) = scaling.moments(i);
                    assert!(((values[i] - mean) / std - want[i]).abs() < 1e-5, "{scaling:?} entry {i}");
                }
            }
        }
    }
}
