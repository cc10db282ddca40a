//! LeRobot's normalisations: ranges and moments, per entry.

/// How the entries of a feature are scaled; statistics repeat over rows.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Scaling {
    /// Not at all.
    None,
    /// From [min, max] to [-1, 1].
    Range {
        min: Vec<f32>,
        max: Vec<f32>,
        /// Width of a range that has none.
        eps: f32,
    },
    /// From mean and standard deviation.
    Moments {
        mean: Vec<f32>,
        std: Vec<f32>,
        /// Added to the deviation on the way in, but not on the way out.
        eps: f32,
    },
}

impl Scaling {
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
