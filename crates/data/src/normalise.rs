use crate::{Error, Result};
use e2h_core::{ACTION_DIM, Action, Episode, Pose, STATE_DIM, State};
use serde::{Deserialize, Serialize};
use std::borrow::Borrow;

/// Entries of a state row that are scaled: both positions and the gripper opening. Quaternions are not.
const STATE_SCALED: [usize; 7] = [0, 1, 2, 7, 8, 9, 14];
/// Entries of an action row that are scaled by the data: the position. The gripper command is, by its definition.
const ACTION_SCALED: [usize; 3] = [0, 1, 2];
const GRIPPER: usize = ACTION_DIM - 1;

/// How ranges are taken from data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct NormaliserConfig {
    /// Part of a range by which it is widened in all, half on either side. 0: the paper's min-max. More leaves a policy
    /// with clipped samples room beyond its demonstrations.
    pub margin: f32,
    /// Smaller ranges, m, count as constant: such entries are shifted to 0 and not scaled. Diffusion Policy: 1e-7.
    // Differs: below 0.1 mm a range is noise of the physics, which scaling would blow up to the size of everything else.
    pub min_range: f32,
}

impl Default for NormaliserConfig {
    fn default() -> Self {
        Self { margin: 0.0, min_range: 1e-4 }
    }
}

impl NormaliserConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let check = |name: &str, value: f32| {
            let bad = !(value >= 0.0 && value.is_finite());
            bad.then(|| format!("{name}: expected at least 0, got {value}"))
        };
        [check("margin", self.margin), check("min_range", self.min_range)].into_iter().flatten().collect()
    }
}

/// Scales rows to [-1, 1] and back.
///
/// Every entry is mapped from its [min, max]; entries that pass unscaled have [-1, 1], constant ones [c - 1, c + 1].
///
/// # Units
/// In: as [`State`] and [`Action`]. Out: none.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Normaliser {
    /// Lower ends, state.
    pub state_min: State,
    /// Upper ends, state.
    pub state_max: State,
    /// Lower ends, action.
    pub action_min: Action,
    /// Upper ends, action.
    pub action_max: Action,
}

impl Normaliser {
    /// Numbers in [`Normaliser::to_vec`].
    pub const LEN: usize = 2 * (STATE_DIM + ACTION_DIM);

    /// Ranges of all rows of `episodes`.
    ///
    /// # Errors
    /// Without rows, or when a number is not finite.
    pub fn fit<E: Borrow<Episode>>(episodes: &[E], config: &NormaliserConfig) -> Result<Self> {
        if episodes.iter().all(|e| e.borrow().is_empty()) {
            return Err(Error::NoRows);
        }
        let rows = || episodes.iter().map(Borrow::borrow);
        let mut fitted = Self {
            state_min: [-1.0; STATE_DIM],
            state_max: [1.0; STATE_DIM],
            action_min: [-1.0; ACTION_DIM],
            action_max: [1.0; ACTION_DIM],
        };
        for i in STATE_SCALED {
            (fitted.state_min[i], fitted.state_max[i]) =
                range(rows().flat_map(|e| &e.state).map(|s| s[i]), config);
        }
        for i in ACTION_SCALED {
            (fitted.action_min[i], fitted.action_max[i]) =
                range(rows().flat_map(|e| &e.action).map(|a| a[i]), config);
        }
        (fitted.action_min[GRIPPER], fitted.action_max[GRIPPER]) = (0.0, 1.0);
        fitted.check()
    }

    /// A state row, scaled.
    #[must_use]
    pub fn normalise_state(&self, state: &State) -> State {
        std::array::from_fn(|i| scale(state[i], self.state_min[i], self.state_max[i]))
    }

    /// An action row, scaled.
    #[must_use]
    pub fn normalise_action(&self, action: &Action) -> Action {
        std::array::from_fn(|i| scale(action[i], self.action_min[i], self.action_max[i]))
    }

    /// A scaled state row, back in units.
    #[must_use]
    pub fn unnormalise_state(&self, state: &State) -> State {
        std::array::from_fn(|i| unscale(state[i], self.state_min[i], self.state_max[i]))
    }

    /// A scaled action row, back in units; its quaternion is made a unit one again, since a policy predicts four free
    /// numbers. The gripper entry stays a number between the commands 0 and 1.
    #[must_use]
    pub fn unnormalise_action(&self, action: &Action) -> Action {
        let mut row = self.unscale_action(action);
        // The prediction's own hemisphere, so that no sign flips.
        let own = [3, 4, 5, 6].map(|i| f64::from(row[i]));
        let pose = Pose::from_row(&row).to_row(&own);
        row[3..7].copy_from_slice(&pose[3..]);
        row
    }

    /// A scaled action row, back in units, with the quaternion as long as it was predicted.
    #[must_use]
    pub fn unscale_action(&self, action: &Action) -> Action {
        std::array::from_fn(|i| unscale(action[i], self.action_min[i], self.action_max[i]))
    }

    /// All ranges in one list, for a weight file: state min, state max, action min, action max.
    #[must_use]
    pub fn to_vec(&self) -> Vec<f32> {
        let Self { state_min, state_max, action_min, action_max } = self;
        [&state_min[..], &state_max[..], &action_min[..], &action_max[..]].concat()
    }

    /// From the list of [`Normaliser::to_vec`].
    ///
    /// # Errors
    /// When the length is not [`Normaliser::LEN`] or a range is not one.
    pub fn from_slice(numbers: &[f32]) -> Result<Self> {
        if numbers.len() != Self::LEN {
            return Err(Error::Length { expected: Self::LEN, found: numbers.len() });
        }
        let s = STATE_DIM;
        let action = 2 * s;
        Self {
            state_min: std::array::from_fn(|i| numbers[i]),
            state_max: std::array::from_fn(|i| numbers[s + i]),
            action_min: std::array::from_fn(|i| numbers[action + i]),
            action_max: std::array::from_fn(|i| numbers[action + ACTION_DIM + i]),
        }
        .check()
    }

    /// The same ranges, when each is one.
    ///
    /// # Errors
    /// Names the first range that is empty or not finite.
    pub fn check(self) -> Result<Self> {
        let state = self.state_min.iter().zip(&self.state_max).enumerate().map(|r| ("state", r));
        let action = self.action_min.iter().zip(&self.action_max).enumerate().map(|r| ("action", r));
        for (column, (index, (&min, &max))) in state.chain(action) {
            if !(min < max && min.is_finite() && max.is_finite()) {
                return Err(Error::Range { column, index, min, max });
            }
        }
        Ok(self)
    }
}

/// Ends of the range of `values`, by the rules of `config`.
fn range(values: impl Iterator<Item = f32>, config: &NormaliserConfig) -> (f32, f32) {
    // `min` and `max` of floats pass over a NaN; adding it up does not.
    let (mut low, mut high, mut sum) = (f32::INFINITY, f32::NEG_INFINITY, 0.0);
    for v in values {
        (low, high, sum) = (low.min(v), high.max(v), sum + v * 0.0);
    }
    let (low, high) = (low + sum, high + sum);
    if high - low <= config.min_range {
        let middle = f32::midpoint(low, high);
        return (middle - 1.0, middle + 1.0);
    }
    let more = 0.5 * config.margin * (high - low);
    (low - more, high + more)
}

fn scale(v: f32, min: f32, max: f32) -> f32 {
    2.0 * ((v - min) / (max - min)) - 1.0
}

fn unscale(v: f32, min: f32, max: f32) -> f32 {
    min + 0.5 * (v + 1.0) * (max - min)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::episode;
    use proptest::prelude::*;

    fn fit(rows: usize, margin: f32) -> Normaliser {
        Normaliser::fit(&[episode(rows)], &NormaliserConfig { margin, ..NormaliserConfig::default() })
            .unwrap()
    }

    #[test]
    fn positions_span_minus_one_to_one_and_quaternions_pass() {
        let (e, n) = (episode(11), fit(11, 0.0));
        let (first, last) = (n.normalise_state(&e.state[0]), n.normalise_state(&e.state[10]));
        for i in 0..STATE_DIM {
            let (low, high) =
                if STATE_SCALED.contains(&i) { (-1.0, 1.0) } else { (e.state[0][i], e.state[10][i]) };
            assert!((first[i] - low).abs() < 1e-5 && (last[i] - high).abs() < 1e-5, "entry {i}");
        }
        assert!((fit(11, 0.1).normalise_state(&e.state[10])[0] - 1.0 / 1.1).abs() < 1e-6);
    }

    #[test]
    fn the_gripper_command_is_scaled_by_what_it_means() {
        let n = fit(5, 0.1);
        let command = |g| n.normalise_action(&[0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, g])[7];
        assert_eq!((command(0.0), command(1.0)), (-1.0, 1.0));
    }

    #[test]
    fn constant_entries_are_shifted_and_not_scaled() {
        let n = fit(1, 0.0);
        let mut state = episode(1).state[0];
        assert_eq!(n.normalise_state(&state)[7], 0.0);
        state[7] += 0.5;
        assert!((n.normalise_state(&state)[7] - 0.5).abs() < 1e-6);
    }

    #[test]
    fn ranges_pass_through_lists_and_bad_ones_are_refused() {
        let n = fit(7, 0.0);
        let mut list = n.to_vec();
        assert_eq!(Normaliser::from_slice(&list).unwrap(), n);
        assert_eq!(serde_json::from_str::<Normaliser>(&serde_json::to_string(&n).unwrap()).unwrap(), n);
        assert!(matches!(Normaliser::from_slice(&list[1..]), Err(Error::Length { expected: 46, found: 45 })));
        list[15] = f32::NAN;
        assert!(matches!(Normaliser::from_slice(&list), Err(Error::Range { column: "state", index: 0, .. })));
    }

    #[test]
    fn nothing_and_not_a_number_are_refused() {
        let config = NormaliserConfig::default();
        assert!(matches!(Normaliser::fit::<Episode>(&[], &config), Err(Error::NoRows)));
        let mut e = episode(4);
        e.action[2][1] = f32::NAN;
        assert!(matches!(
            Normaliser::fit(&[e], &config),
            Err(Error::Range { column: "action", index: 1, .. })
        ));
        assert_eq!(NormaliserConfig { margin: -1.0, min_range: f32::NAN }.validate().len(), 2);
    }

    proptest! {
        #[test]
        fn there_and_back_is_the_same(
            rows in prop::collection::vec(prop::array::uniform15(-1.0_f32..1.0), 1..20), margin in 0.0_f32..0.3,
            p in prop::array::uniform3(-2.0_f32..2.0), q in prop::array::uniform4(-1.0_f32..1.0), g in 0.0_f32..1.0,
        ) {
            prop_assume!(q.iter().map(|v| v * v).sum::<f32>() > 0.01);
            let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
            let mut e = episode(rows.len());
            for (t, row) in rows.iter().enumerate() {
                e.state[t] = *row;
                e.action[t][..3].copy_from_slice(&row[..3]);
            }
            let n = Normaliser::fit(&[e], &NormaliserConfig { margin, ..NormaliserConfig::default() }).unwrap();
            let action = [p[0], p[1], p[2], q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm, g];
            let back = n.unnormalise_action(&n.normalise_action(&action));
            prop_assert!(back.iter().zip(&action).all(|(a, b)| (a - b).abs() < 1e-5), "{back:?} of {action:?}");
            for row in &rows {
                let scaled = n.normalise_state(row);
                prop_assert!(scaled.iter().all(|v| v.abs() <= 1.0 + 1e-5));
                let back = n.unnormalise_state(&scaled);
                prop_assert!(back.iter().zip(row).all(|(a, b)| (a - b).abs() < 1e-5));
            }
        }
    }
}
