use crate::gripper::open_states;
use crate::limits;
use e2h_core::state::{EEF_QUATERNION, OBJECT_QUATERNION};
use e2h_core::{Action, Episode, Excursion, Pose, continue_signs};
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// What the actions of a path that exploration displaced lead to.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Labels {
    /// The poses that were reached: the way back is the way that was come.
    #[default]
    Travelled,
    /// Those poses less the excursion, which leads straight back to the policy's own way (as in DART, arXiv 1703.09327). Where
    /// the gripper works the excursion stays in: the object is where the hand is.
    Undisturbed,
}

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
    /// The same for the object; the task's reference, which the program says. Without one the first row of a path stays as it
    /// is.
    #[serde(skip)]
    pub object_reference: Option<[f64; 4]>,
    /// What the actions of a path that exploration displaced lead to.
    pub labels: Labels,
    /// With [`Labels::Undisturbed`]: nearer than this to a switch of the gripper the excursion stays in, control steps; over as
    /// many more it goes out.
    pub labels_fade: usize,
}

impl Default for ReverseConfig {
    fn default() -> Self {
        Self {
            lookahead: 1,
            open_width_m: 0.08,
            open_at: 0.95,
            close_at: 0.85,
            reference_quaternion: [0.0, 1.0, 0.0, 0.0],
            object_reference: None,
            labels: Labels::Travelled,
            labels_fade: 8,
        }
    }
}

impl ReverseConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        problems.extend(limits::frames("lookahead", self.lookahead, 1));
        problems.extend(limits::frames("labels_fade", self.labels_fade, 0));
        problems.extend(limits::amount("open_width_m", self.open_width_m, false));
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
    continue_path(&mut reversed, &config.reference_quaternion, config.object_reference);
    rebuild_actions(&mut reversed, config);
    reversed
}

/// Continues the signs of the quaternions of hand and object along the states, each from its reference on; the object's from
/// its own first row where it has none.
pub(crate) fn continue_path(episode: &mut Episode, reference: &[f64; 4], object: Option<[f64; 4]>) {
    continue_signs(&mut episode.state, EEF_QUATERNION, reference);
    let first = |s: &e2h_core::State| std::array::from_fn(|i| f64::from(s[OBJECT_QUATERNION.start + i]));
    if let Some(first) = episode.state.first().map(first) {
        continue_signs(&mut episode.state, OBJECT_QUATERNION, &object.unwrap_or(first));
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
    episode.action = goals(&poses, &open_states(episode, config), &episode.excursion, config);
}

/// One action a pose. Shapes: `open` and `excursions` have the length of `poses`.
pub(crate) fn goals(
    poses: &[Pose],
    open: &[bool],
    excursions: &[Excursion],
    config: &ReverseConfig,
) -> Vec<Action> {
    let last = poses.len().saturating_sub(1);
    let undisturbed: Vec<Pose>;
    let poses = match config.labels {
        Labels::Travelled => poses,
        Labels::Undisturbed => {
            undisturbed = without(poses, open, excursions, config.labels_fade);
            &undisturbed
        }
    };
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

/// The poses less their excursions, which stay in near a switch of the gripper.
fn without(poses: &[Pose], open: &[bool], excursions: &[Excursion], fade: usize) -> Vec<Pose> {
    let switches: Vec<usize> = (1..open.len()).filter(|&t| open[t] != open[t - 1]).collect();
    let share = |t: usize| {
        let near = switches.iter().map(|&s| t.abs_diff(s)).min().unwrap_or(usize::MAX);
        (near.saturating_sub(fade) as f64 / fade.max(1) as f64).min(1.0)
    };
    let less = |(t, (pose, e)): (usize, (&Pose, &Excursion))| {
        let [x, y, z, yaw] = e.map(|v| f64::from(v) * share(t));
        let back = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), -yaw);
        Pose::new(pose.position - Vector3::new(x, y, z), back * pose.orientation)
    };
    poses.iter().zip(excursions).enumerate().map(less).collect()
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
        assert_eq!(*hard.frames[0].image(0).unwrap(), [4, 4, 4]);
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
    fn labels_lead_along_the_way_that_was_come_or_straight_back() {
        let mut easy = along(&[0.0, 0.01, 0.02, 0.03]);
        easy.excursion = vec![[0.0; 4], [0.001, 0.0, 0.0, 0.1], [0.002, -0.003, 0.0, 0.2], [0.0; 4]];
        let travelled = reverse(&easy, &reversal());
        assert_eq!(travelled.action.iter().map(|a| a[0]).collect::<Vec<_>>(), [0.02, 0.01, 0.0, 0.0]);
        assert_eq!(travelled.excursion[1], [0.002, -0.003, 0.0, 0.2]);
        let straight = reverse(&easy, &ReverseConfig { labels: Labels::Undisturbed, ..reversal() });
        assert_eq!(straight.state, travelled.state);
        let goal = Pose::from_row(&straight.action[0][..7]);
        assert!((goal.position - Vector3::new(0.018, 0.003, 0.0)).norm() < 1e-6);
        assert!((goal.orientation.angle_to(&easy.eef(2).orientation) - 0.2).abs() < 1e-6);
        assert_eq!(straight.action[3], travelled.action[3]);
    }

    #[test]
    fn excursions_stay_in_labels_where_the_gripper_works() {
        let poses = vec![Pose::from_row(&[0.0; 7]); 12];
        let open: Vec<bool> = (0..12).map(|t| t < 6).collect();
        let config = ReverseConfig { labels: Labels::Undisturbed, labels_fade: 2, ..reversal() };
        let goals = goals(&poses, &open, &[[0.01, 0.0, 0.0, 0.0]; 12], &config);
        let x: Vec<f32> = goals.iter().map(|a| a[0]).collect();
        // Row t leads to pose t + 1; the switch is at row 6.
        assert_eq!(x, [-0.01, -0.01, -0.005, 0.0, 0.0, 0.0, 0.0, 0.0, -0.005, -0.01, -0.01, -0.01]);
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
