use crate::{ReverseConfig, limits};
use e2h_core::{Episode, state};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

/// Whether the gripper counts as open at every row: open above `open_at`, closed below `close_at`, in between as before.
pub(crate) fn open_states(episode: &Episode, config: &ReverseConfig) -> Vec<bool> {
    let fraction = |t| f64::from(episode.opening(t)) / config.open_width_m;
    // Nothing comes before the first row: the middle of the band decides, 0.9 as long as the band is 0.85 to 0.95.
    let mut open = !episode.is_empty() && fraction(0) > 0.5 * (config.open_at + config.close_at);
    let step = |t| {
        let f = fraction(t);
        open = f > config.open_at || (open && f >= config.close_at);
        open
    };
    (0..episode.len()).map(step).collect()
}

/// How often the gripper closes and how often it opens, by its opening with hysteresis: (closings, openings).
#[must_use]
pub fn gripper_switches(episode: &Episode, config: &ReverseConfig) -> (usize, usize) {
    let open = open_states(episode, config);
    let count = |from: bool| open.windows(2).filter(|w| w[0] == from && w[1] != from).count();
    (count(true), count(false))
}

/// Which reversed recordings are accepted at all.
///
/// # Source
/// Not in the paper. In the prototype reversals with exactly one closing and one opening replayed in all of 50 cases,
/// against 58 of 61 of all successful recordings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GateConfig {
    /// False accepts everything, as the paper does.
    pub enabled: bool,
    /// Closings that the reversed recording must show; count.
    pub closings: usize,
    /// Openings that it must show; count.
    pub openings: usize,
    /// A recording whose object moved further than this in the closed hand while it was carried is not accepted, m: backwards,
    /// it would have to slip by itself. 0 does not look.
    pub slip_m: f64,
    /// An object that moved further than this before the hand held it is looked at from where it is held on alone, m: it had been
    /// dropped or pushed, and the grasp of the reversal would be beside it. 0 does not look.
    #[serde(default)]
    pub loose_m: f64,
}

impl Default for GateConfig {
    fn default() -> Self {
        // Differs: the paper has no such gate; `enabled = false` is its rule. A recording that lets go and grasps again
        // replays backwards only by luck.
        Self { enabled: true, closings: 1, openings: 1, slip_m: 0.0, loose_m: 0.0 }
    }
}

impl GateConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let counts = [("closings", self.closings), ("openings", self.openings)];
        let mut problems: Vec<String> =
            counts.into_iter().filter_map(|(name, n)| limits::frames(name, n, 0)).collect();
        problems.extend(limits::amount("slip_m", self.slip_m, true));
        problems.extend(limits::amount("loose_m", self.loose_m, true));
        // Between two closings there is an opening: other counts would accept nothing.
        if self.closings.abs_diff(self.openings) > 1 {
            problems.push(format!(
                "closings, openings: expected counts that differ by at most 1, got {} and {}",
                self.closings, self.openings
            ));
        }
        problems
    }
}

/// Whether the gripper switches as often as a valid reversal of this task does, and held the object still.
#[must_use]
pub fn gate(episode: &Episode, config: &GateConfig, reverse: &ReverseConfig) -> bool {
    let switches = || gripper_switches(episode, reverse) == (config.closings, config.openings);
    let held = || config.slip_m == 0.0 || config.closings == 0 || slip(episode, reverse) <= config.slip_m;
    !config.enabled || (switches() && held())
}

/// Fingers that move less than this in a control step hold what they have, m.
const HELD: f32 = 0.0005;

/// The reversal from where the object is held on, where it moved further than [`GateConfig::loose_m`] before: in the recording it was
/// dropped or pushed as the hand let go, which does not happen backwards. Others stay as they are.
#[must_use]
pub fn held_on(episode: Episode, config: &GateConfig, reverse: &ReverseConfig) -> Episode {
    let open = open_states(&episode, reverse);
    let Some(closes) = open.windows(2).position(|w| w[0] && !w[1]).filter(|_| config.loose_m > 0.0) else {
        return episode;
    };
    let still = |t: &usize| (episode.opening(t + 1) - episode.opening(*t)).abs() < HELD;
    let held = (closes + 1..episode.len().saturating_sub(1)).find(still).unwrap_or(closes + 1);
    let moved = (0..=held).map(|t| (object(&episode, t) - object(&episode, 0)).norm()).fold(0.0, f64::max);
    if moved <= config.loose_m {
        return episode;
    }
    episode.select(&(held..episode.len()).collect::<Vec<_>>())
}

/// Object that moves less than this in a control step is not being carried, m.
const CARRIED: f64 = 0.001;

fn object(episode: &Episode, t: usize) -> Vector3<f64> {
    Vector3::from(state::object_position(&episode.state[t]).map(f64::from))
}

/// How far the object moved in the closed hand while it was carried, m: the largest distance of its position in the frame of the
/// hand from that halfway. 0 where nothing is carried.
#[must_use]
pub fn slip(episode: &Episode, config: &ReverseConfig) -> f64 {
    let open = open_states(episode, config);
    let carried = (1..episode.len()).filter(|&t| {
        let moved = object(episode, t) - object(episode, t - 1);
        !open[t] && !open[t - 1] && moved.norm() > CARRIED
    });
    let in_hand = |t: usize| {
        let hand = episode.eef(t);
        hand.orientation.inverse() * (object(episode, t) - hand.position)
    };
    let places: Vec<_> = carried.map(in_hand).collect();
    let Some(middle) = places.get(places.len() / 2) else { return 0.0 };
    places.iter().map(|p| (p - middle).norm()).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{along, reversal};

    fn with_openings(openings: &[f32]) -> Episode {
        let mut e = along(&vec![0.0; openings.len()]);
        for (s, w) in e.state.iter_mut().zip(openings) {
            s[14] = *w;
        }
        e
    }

    #[test]
    fn switches_are_counted_with_hysteresis() {
        let wobble = with_openings(&[0.08, 0.074, 0.08, 0.05, 0.07, 0.05, 0.08]);
        assert_eq!(gripper_switches(&wobble, &reversal()), (1, 1));
        let twice = with_openings(&[0.08, 0.05, 0.08, 0.05]);
        assert_eq!(gripper_switches(&twice, &reversal()), (2, 1));
        assert_eq!(gripper_switches(&along(&[]), &reversal()), (0, 0));
    }

    /// A hand that carries the object 2 cm a step, and in which it slips by 5 mm on the way.
    #[test]
    fn what_slips_in_the_hand_does_not_pass() {
        let carried = |slip: f32| {
            let mut e = along(&(0..12).map(|t| 0.02 * f64::from(t)).collect::<Vec<_>>());
            for (t, s) in e.state.iter_mut().enumerate() {
                s[14] = if (2..10).contains(&t) { 0.03 } else { 0.08 };
                let hand = s[0].clamp(0.04, 0.18);
                let height = s[2] - 0.02 + if t > 6 { slip } else { 0.0 };
                (s[7], s[8], s[9]) = (hand, s[1], height);
            }
            e
        };
        assert!(slip(&carried(0.0), &reversal()) < 1e-6);
        assert!((slip(&carried(0.005), &reversal()) - 0.005).abs() < 1e-6);
        let config = GateConfig { slip_m: 0.003, ..GateConfig::default() };
        assert!(gate(&carried(0.002), &config, &reversal()) && !gate(&carried(0.005), &config, &reversal()));
        assert!(gate(&carried(0.005), &GateConfig::default(), &reversal()));
        assert_eq!(slip(&along(&[]), &reversal()), 0.0);
    }

    /// A hand that closes at the sixth row round an object that was beside it by `off` m two rows before.
    fn grasped(off: f32) -> Episode {
        let mut e = along(&(0..14).map(|t| 0.01 * f64::from(t)).collect::<Vec<_>>());
        for (t, s) in e.state.iter_mut().enumerate() {
            s[14] = if t < 5 {
                0.08
            } else if t == 5 {
                0.05
            } else {
                0.03
            };
            (s[7], s[8], s[9]) = (0.5 + if t < 4 { off } else { 0.0 }, 0.0, 0.01);
        }
        e
    }

    #[test]
    fn a_reversal_of_a_drop_begins_where_the_object_is_held() {
        let config = GateConfig { loose_m: 0.003, ..GateConfig::default() };
        let cut = |off: f32, config: &GateConfig| held_on(grasped(off), config, &reversal());
        assert_eq!(cut(0.002, &config), grasped(0.002));
        assert_eq!(cut(0.01, &GateConfig::default()), grasped(0.01));
        let held = cut(0.01, &config);
        assert_eq!(held.state, grasped(0.01).state[6..]);
        assert!(held.terminal == grasped(0.01).terminal);
        // Nothing is grasped, or at the very end.
        assert_eq!(held_on(along(&[]), &config, &reversal()), along(&[]));
        let last = grasped(0.01).select(&[0, 1, 2, 3, 4, 5]);
        assert!(held_on(last, &config, &reversal()).len() <= 1);
    }

    #[test]
    fn the_gate_asks_for_one_of_each_unless_it_is_off() {
        let regrasp = with_openings(&[0.08, 0.05, 0.08, 0.05, 0.08]);
        assert!(!gate(&regrasp, &GateConfig::default(), &reversal()));
        assert!(gate(&regrasp, &GateConfig { enabled: false, ..GateConfig::default() }, &reversal()));
        assert!(gate(&with_openings(&[0.08, 0.05, 0.08]), &GateConfig::default(), &reversal()));
    }
}
