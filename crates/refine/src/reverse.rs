use crate::gripper::open_states;
use e2h_core::{Action, Episode, Pose, continue_signs};
use serde::{Deserialize, Serialize};

/// How actions are rebuilt from a path.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ReverseConfig {
    /// The goal of step t is the pose at t + `lookahead`; control steps. 1 is the paper's (Eq. 4); more makes up for a
    /// controller that lags.
    pub lookahead: usize,
    /// Opening of the fully open gripper, m. The hand's own figure: 0.08 for the Panda.
    pub open_width_m: f64,
    /// The gripper counts as open above this fraction of `open_width_m`.
    pub open_at: f64,
    /// The gripper counts as closed below this fraction of `open_width_m`.
    pub close_at: f64,
    /// The first quaternion of a path is written in the hemisphere of this one (wxyz), the task's reference; the others go on
    /// from there without a jump.
    pub reference_quaternion: [f64; 4],
}

impl Default for ReverseConfig {
    fn default() -> Self {
        Self {
            lookahead: 1,
            open_width_m: 0.08,
            open_at: 0.95,
            close_at: 0.85,
            reference_quaternion: [0.0, 1.0, 0.0, 0.0],
        }
    }
}

impl ReverseConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        if self.lookahead == 0 {
            problems.push("lookahead: expected at least 1 control step, got 0".to_owned());
        }
        if !(self.open_width_m > 0.0 && self.open_width_m.is_finite()) {
            problems.push(format!("open_width_m: expected a positive opening, m, got {}", self.open_width_m));
        }
        if !(0.0 < self.close_at && self.close_at <= self.open_at && self.open_at < 1.0) {
            problems.push(format!(
                "close_at, open_at: expected 0 < close_at <= open_at < 1, got {} and {}",
                self.close_at, self.open_at
            ));
        }
        let norm = self.reference_quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(0.999..=1.001).contains(&norm) {
            problems.push(format!("reference_quaternion: expected norm 1, got {norm}"));
        }
        problems
    }
}

/// The episode backwards, as a candidate for the other task: states and images in reversed order, actions rebuilt.
///
/// `source` goes on naming rows of the recording, and `outcome` stays the recording's, its row included. `terminal` stays
/// too: the end of the reversed path is where the recording began.
///
/// # Source
/// Eq. 3 and 4.
#[must_use]
pub fn reverse(episode: &Episode, config: &ReverseConfig) -> Episode {
    let rows: Vec<usize> = (0..episode.len()).rev().collect();
    let mut reversed = episode.select(&rows);
    reversed.terminal = episode.terminal;
    reversed.origin.reversed = !episode.origin.reversed;
    continue_path(&mut reversed, &config.reference_quaternion);
    rebuild_actions(&mut reversed, config);
    reversed
}

/// Continues the signs of the quaternions of hand and object along the states: the hand's from `reference` on (wxyz), the
/// object's from its own first row.
pub(crate) fn continue_path(episode: &mut Episode, reference: &[f64; 4]) {
    continue_signs(&mut episode.state, 3..7, reference);
    if let Some(first) = episode.state.first().map(|s| [10, 11, 12, 13].map(|i| f64::from(s[i]))) {
        continue_signs(&mut episode.state, 10..14, &first);
    }
}

/// Replaces the actions by the poses and openings that follow: the goal of step t is the pose at t + `lookahead` (the last
/// pose where the path ends before), the gripper command that of the next row's opening.
///
/// # Source
/// Eq. 4. The command follows the observed opening and not the recorded command, which runs ahead of it; and it is never
/// the width itself, because a gripper told to close to the width of the object does not squeeze it.
pub fn rebuild_actions(episode: &mut Episode, config: &ReverseConfig) {
    let poses: Vec<Pose> = (0..episode.len()).map(|t| episode.eef(t)).collect();
    episode.action = goals(&poses, &open_states(episode, config), config);
}

/// One action a pose. Shapes: `open` has the length of `poses`.
pub(crate) fn goals(poses: &[Pose], open: &[bool], config: &ReverseConfig) -> Vec<Action> {
    let last = poses.len().saturating_sub(1);
    // Several steps have the same goal only at the end, so rows are made once and looked up.
    let reference = &config.reference_quaternion;
    let mut rows: Vec<[f32; 7]> = poses.iter().map(|p| p.to_row(reference)).collect();
    continue_signs(&mut rows, 3..7, reference);
    let goal = |t: usize| {
        let mut action = [0.0; 8];
        action[..7].copy_from_slice(&rows[(t + config.lookahead).min(last)]);
        action[7] = f32::from(u8::from(open[(t + 1).min(last)]));
        action
    };
    (0..poses.len()).map(goal).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{along, reversal, walk};

    #[test]
    fn states_images_and_sources_run_backwards() {
        let easy = along(&walk(&[(4, 0.01)]));
        let hard = reverse(&easy, &reversal());
        assert_eq!(hard.source, [4, 3, 2, 1, 0]);
        assert_eq!(hard.state[0], easy.state[4]);
        assert_eq!(hard.frames[0].image(0), [4, 4, 4]);
        assert!(hard.origin.reversed && hard.terminal);
        let again = reverse(&hard, &reversal());
        assert_eq!((&again.state, &again.frames, &again.source), (&easy.state, &easy.frames, &easy.source));
        assert!(!again.origin.reversed);
    }

    #[test]
    fn goals_are_the_poses_ahead_and_the_last_one_repeats() {
        for (lookahead, expected) in [(1, [0.02, 0.01, 0.0, 0.0]), (2, [0.01, 0.0, 0.0, 0.0])] {
            let hard = reverse(&along(&[0.0, 0.01, 0.02, 0.03]), &ReverseConfig { lookahead, ..reversal() });
            assert_eq!(hard.action.iter().map(|a| a[0]).collect::<Vec<_>>(), expected);
        }
    }

    #[test]
    fn goals_lie_in_the_hemisphere_of_the_reference() {
        let mut e = along(&[0.0, 0.01]);
        e.state[1][4] = -1.0;
        rebuild_actions(&mut e, &reversal());
        assert_eq!(e.action[0][3..7], [0.0, 1.0, 0.0, 0.0]);
    }

    /// A hand that turns about the vertical from 100 to 260 degrees passes the equator of the reference on its way.
    #[test]
    fn signs_go_on_where_the_hand_turns_past_half_a_turn() {
        let mut e = along(&walk(&[(16, 0.01)]));
        let reference = [1.0, 0.0, 0.0, 0.0];
        for (t, s) in e.state.iter_mut().enumerate() {
            let half = (50.0 + 5.0 * t as f32).to_radians();
            // In one hemisphere, as a driver writes them: the sign jumps in the middle.
            let sign = half.cos().signum();
            s[3..7].copy_from_slice(&[sign * half.cos(), 0.0, 0.0, sign * half.sin()]);
            s[10..14].copy_from_slice(&[sign * half.cos(), 0.0, 0.0, sign * half.sin()]);
        }
        let hard = reverse(&e, &ReverseConfig { reference_quaternion: reference, ..reversal() });
        let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
        for t in 0..16 {
            assert!(dot(&hard.state[t][3..7], &hard.state[t + 1][3..7]) > 0.99, "state {t}");
            assert!(dot(&hard.state[t][10..14], &hard.state[t + 1][10..14]) > 0.99, "object {t}");
            assert!(dot(&hard.action[t][3..7], &hard.state[t + 1][3..7]) > 0.99, "action {t}");
        }
        assert!(hard.state[0][3] > 0.0, "the first row lies in the reference's hemisphere");
    }

    #[test]
    fn the_command_follows_the_next_opening_with_hysteresis() {
        let mut e = along(&[0.0; 8]);
        // 0.0760 is the upper, 0.0680 the lower threshold.
        for (s, w) in e.state.iter_mut().zip([0.080, 0.074, 0.070, 0.060, 0.070, 0.075, 0.077, 0.070]) {
            s[14] = w;
        }
        rebuild_actions(&mut e, &reversal());
        assert_eq!(
            e.action.iter().map(|a| a[7]).collect::<Vec<_>>(),
            [1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
        );
    }

    #[test]
    fn an_empty_episode_stays_empty() {
        assert!(reverse(&along(&[]), &reversal()).is_empty());
    }

    #[test]
    fn all_problems_are_listed() {
        let config = ReverseConfig { lookahead: 0, open_width_m: f64::NAN, open_at: 0.1, ..reversal() };
        assert_eq!(config.validate().len(), 3);
        assert!(reversal().validate().is_empty());
    }
}
