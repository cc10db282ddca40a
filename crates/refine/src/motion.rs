use crate::gripper::open_states;
use crate::{KinematicConfig, ReverseConfig};
use e2h_core::state::object_position;
use e2h_core::{CONTROL_HZ, Episode, Pose};
use nalgebra::Vector3;

/// Speed and turning rate at every row.
pub(crate) struct Motion {
    /// m/s.
    pub(crate) speed: Vec<f64>,
    /// rad a frame.
    pub(crate) turn: Vec<f64>,
}

/// Rows t and t' between which row t is measured: the next row, or `window` rows on either side; fewer at the ends.
fn span(t: usize, window: usize, rows: usize) -> (usize, usize) {
    let last = rows.saturating_sub(1);
    match window {
        // The last row has no next one: it gets the speed with which it was reached.
        0 | 1 => (t.min(last.saturating_sub(1)), (t + 1).min(last)),
        k => (t.saturating_sub(k), (t + k).min(last)),
    }
}

/// # Source
/// Eq. 8, times the control rate: the thresholds of the paper's appendix are in m/s.
// Differs: Eq. 8 looks at one step. The jitter of a policy that hovers looks like motion there; the net displacement over a
// few frames tells them apart. `speed_window` 0 or 1 is the literal rule.
pub(crate) fn motion(poses: &[Pose], window: usize) -> Motion {
    let measure = |t| {
        let (a, b) = span(t, window, poses.len());
        let steps = b.saturating_sub(a).max(1) as f64;
        let distance = (poses[b].position - poses[a].position).norm();
        (distance * CONTROL_HZ / steps, turn(&poses[a], &poses[b]) / steps)
    };
    let (speed, turn) = (0..poses.len()).map(measure).unzip();
    Motion { speed, turn }
}

/// Angle between two orientations, rad.
pub(crate) fn turn(a: &Pose, b: &Pose) -> f64 {
    // Half the chord of the quaternions, the nearer of the two signs: exact at small angles, where acos is not.
    let (a, b) = (a.orientation.as_vector(), b.orientation.as_vector());
    let chord = (a - b).norm_squared().min((a + b).norm_squared()).sqrt();
    4.0 * (0.5 * chord).min(1.0).asin()
}

/// How far the object moved other than with the hand, m: nothing when it lies still or goes along.
pub(crate) fn slip(hand: Vector3<f64>, object: Vector3<f64>) -> f64 {
    object.norm().min((object - hand).norm())
}

/// Positions of the object, m.
pub(crate) fn objects(episode: &Episode) -> Vec<Vector3<f64>> {
    episode.state.iter().map(|s| Vector3::from(object_position(s).map(f64::from))).collect()
}

/// Speed at every row without any window, m/s, as stored.
pub(crate) fn episode_speeds(episode: &Episode) -> Vec<f32> {
    let poses: Vec<Pose> = (0..episode.len()).map(|t| episode.eef(t)).collect();
    narrow(&motion(&poses, 1).speed)
}

// Diagnostics for pictures.
pub(crate) fn narrow(values: &[f64]) -> Vec<f32> {
    values.iter().map(|&v| v as f32).collect()
}

/// Rows that no stage may cut, move or re-time: those near a gripper that switches or still moves. None when protection is
/// off.
pub(crate) fn protected(episode: &Episode, config: &KinematicConfig, reverse: &ReverseConfig) -> Vec<bool> {
    let rows = episode.len();
    let mut mask = vec![false; rows];
    if !config.protect_gripper {
        return mask;
    }
    let open = open_states(episode, reverse);
    let mut done = 0;
    for t in 1..rows {
        let moves = f64::from((episode.opening(t) - episode.opening(t - 1)).abs()) > config.gripper_motion;
        if moves || open[t] != open[t - 1] {
            let end = (t + config.protect_frames + 1).min(rows);
            let start = (t - 1).saturating_sub(config.protect_frames).max(done.min(end));
            mask[start..end].fill(true);
            done = end;
        }
    }
    mask
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{along, reversal};

    fn poses(x: &[f64]) -> Vec<Pose> {
        x.iter().map(|&x| Pose::from_row(&[x as f32, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0])).collect()
    }

    fn assert_close(got: &[f64], want: &[f64]) {
        assert_eq!(got.len(), want.len());
        assert!(got.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-6), "{got:?}, expected {want:?}");
    }

    #[test]
    fn speed_is_that_of_the_step_ahead_in_metres_per_second() {
        // 2 mm per frame at 20 Hz are 0.04 m/s; the last row gets the step that reached it.
        assert_close(&motion(&poses(&[0.0, 0.002, 0.005, 0.010]), 0).speed, &[0.04, 0.06, 0.1, 0.1]);
        assert_close(&motion(&poses(&[0.3]), 0).speed, &[0.0]);
        assert_close(&motion(&poses(&[]), 3).speed, &[]);
    }

    #[test]
    fn a_window_sees_through_jitter() {
        let jitter: Vec<f64> = (0..9).map(|t| 0.003 * f64::from(t % 2)).collect();
        assert!(motion(&poses(&jitter), 0).speed.iter().all(|&v| v > 0.05));
        // Row 4 compares rows 1 and 7, both at 3 mm; row 0 only rows 0 and 3.
        let seen = motion(&poses(&jitter), 3).speed;
        assert_close(&[seen[0], seen[4]], &[0.003 * 20.0 / 3.0, 0.0]);
    }

    #[test]
    fn turning_is_measured_either_way_round() {
        let a = Pose::from_row(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
        let (s, c) = (0.15_f64.sin() as f32, 0.15_f64.cos() as f32);
        for sign in [1.0, -1.0] {
            let b = Pose::from_row(&[0.0, 0.0, 0.0, sign * c, 0.0, 0.0, sign * s]);
            assert!((turn(&a, &b) - 0.3).abs() < 1e-6);
        }
    }

    #[test]
    fn protection_covers_switch_and_motion() {
        let mut e = along(&[0.0; 40]);
        for (t, s) in e.state.iter_mut().enumerate().skip(20) {
            // Rows 20 and 21 move, the hysteresis switches at 21.
            s[14] = if t == 20 { 0.07 } else { 0.05 };
        }
        let config = KinematicConfig::default();
        let mask = protected(&e, &config, &reversal());
        let expected: Vec<bool> = (0..40).map(|t| (14..=26).contains(&t)).collect();
        assert_eq!(mask, expected);
        let off = KinematicConfig { protect_gripper: false, ..config };
        assert!(!protected(&e, &off, &reversal()).contains(&true));
    }
}
