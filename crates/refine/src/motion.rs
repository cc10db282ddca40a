use crate::gripper::open_states;
use crate::{KinematicConfig, ReverseConfig};
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
    episode.state.iter().map(|s| Vector3::new(f64::from(s[7]), f64::from(s[8]), f64::from(s[9]))).collect()
}

/// Speed at every row without any window, m/s, as stored.
pub(crate) fn episode_speeds(episode: &Episode) -> Vec<f32> {
    let poses: Vec<Pose> = (0..episode.len()).map(|t| episode.eef(t)).collect();
    narrow(&motion(&poses, 1).speed)
}

#[allow(clippy::cast_possible_truncation, reason = "diagnostics for pictures")]
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
