use crate::gripper::open_states;
use crate::motion::{motion, narrow, objects, protected};
use crate::retime::{Node, retime};
use crate::reverse::{continue_path, goals};
use crate::smooth::smooth;
use crate::still::still_runs;
use crate::{Fate, Refined, ReverseConfig, limits};
use e2h_core::state::EEF;
use e2h_core::{CONTROL_HZ, Episode, Pose};
use serde::{Deserialize, Serialize};

/// What the kinematic filter cuts and re-times. Speeds are those of the tool centre point at 20 Hz.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct KinematicConfig {
    /// Slower counts as standing still, m/s. Paper: 0.04.
    pub static_speed: f64,
    /// Runs of more frames than this are cut. Paper: 16; 4 learns better at laptop scale, where a pause of 5 stalls a policy.
    pub static_frames: usize,
    /// Runs that drift further are split, m. Paper: 0.05.
    pub static_drift: f64,
    /// Turning faster counts as motion, rad a frame; 0 ignores turning (the paper).
    pub rotation_speed: f64,
    /// Frames near a gripper that switches or moves are left alone; false is the paper's literal rule, under which a grasp
    /// of more than 0.8 s vanishes.
    pub protect_gripper: bool,
    /// How near, frames on either side.
    pub protect_frames: usize,
    /// The gripper moves when its opening changes by more than this, m per frame.
    pub gripper_motion: f64,
    /// A run is split where the object moved further than this on its own, neither at rest nor with the hand, m; 0 does not
    /// look at the object (the paper).
    pub object_drift: f64,
    /// Below this and above `static_speed` motion is re-timed, m/s. Paper: 0.06.
    pub slow_speed: f64,
    /// Shorter slow runs are left alone, frames. The paper gives none.
    pub slow_min_frames: usize,
    /// Step that slow runs are re-timed to, m per frame. Paper: 0.005, that is 0.1 m/s.
    pub resample_step: f64,
    /// Re-timed runs turn at least at this rate where turning takes longer than moving, rad a frame; 0 lets them turn as
    /// fast as the arc length says (the paper).
    pub resample_rotation: f64,
    /// Speed is measured over this many frames on either side; 0 or 1: one step ahead (the paper). 3 sees through the
    /// jitter of a policy that hovers.
    pub speed_window: usize,
    /// Re-time all motion outside protected frames, not only what is slow; nothing is slowed down. False in the paper.
    pub retime_all: bool,
    /// Poses averaged before anything else, frames in the window; 0 is none (the paper). Goals become smooth, observed
    /// states stay as recorded.
    pub smooth_frames: usize,
}

impl Default for KinematicConfig {
    fn default() -> Self {
        Self {
            static_speed: 0.04,
            static_frames: 16,
            static_drift: 0.05,
            rotation_speed: 0.02,
            protect_gripper: true,
            protect_frames: 5,
            gripper_motion: 5e-4,
            object_drift: 0.01,
            slow_speed: 0.06,
            slow_min_frames: 3,
            resample_step: 0.005,
            resample_rotation: 0.05,
            speed_window: 0,
            retime_all: false,
            smooth_frames: 0,
        }
    }
}

impl KinematicConfig {
    /// The paper's rules to the letter.
    #[must_use]
    pub fn literal() -> Self {
        Self {
            rotation_speed: 0.0,
            protect_gripper: false,
            object_drift: 0.0,
            resample_rotation: 0.0,
            ..Self::default()
        }
    }

    /// The same thresholds for episodes at `hz` rows a second. The entries of this struct are meant at [`CONTROL_HZ`], at
    /// which the filter counts; at another rate frames and metres a frame stand for other times and speeds.
    #[must_use]
    pub fn at_rate(&self, hz: f64) -> Self {
        let longer = CONTROL_HZ / hz;
        // Small and not negative.
        let frames = |n: usize| (n as f64 / longer).round() as usize;
        Self {
            static_speed: self.static_speed * longer,
            slow_speed: self.slow_speed * longer,
            rotation_speed: self.rotation_speed * longer,
            gripper_motion: self.gripper_motion * longer,
            resample_step: self.resample_step * longer,
            resample_rotation: self.resample_rotation * longer,
            static_frames: frames(self.static_frames),
            protect_frames: frames(self.protect_frames),
            slow_min_frames: frames(self.slow_min_frames),
            speed_window: frames(self.speed_window),
            smooth_frames: frames(self.smooth_frames),
            ..self.clone()
        }
    }

    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        for (name, value, zero) in [
            ("static_speed", self.static_speed, true),
            ("static_drift", self.static_drift, true),
            ("rotation_speed", self.rotation_speed, true),
            ("gripper_motion", self.gripper_motion, false),
            ("object_drift", self.object_drift, true),
            ("slow_speed", self.slow_speed, true),
            ("resample_step", self.resample_step, false),
            ("resample_rotation", self.resample_rotation, true),
        ] {
            problems.extend(limits::amount(name, value, zero));
        }
        for (name, value, least) in [
            ("static_frames", self.static_frames, 1),
            ("protect_frames", self.protect_frames, 0),
            ("slow_min_frames", self.slow_min_frames, 0),
            ("speed_window", self.speed_window, 0),
            ("smooth_frames", self.smooth_frames, 0),
        ] {
            problems.extend(limits::frames(name, value, least));
        }
        if self.slow_speed < self.static_speed {
            problems.push(format!(
                "slow_speed: expected at least static_speed = {}, got {}",
                self.static_speed, self.slow_speed
            ));
        }
        problems
    }
}

/// Cuts what stands still, re-times what is slow, and then rebuilds the actions. The first and the last frame stay.
///
/// Frames that a re-timed path passes nearest to are [`Fate::Kept`] (their images, object and gripper are its rows), the
/// others [`Fate::Resampled`].
///
/// # Source
/// Eq. 7: the speed filter works on what the static filter leaves. Actions (Eq. 4) are rebuilt once at the end; made before,
/// they would lead to poses that are no longer there.
#[must_use]
pub fn kinematic_filter(episode: &Episode, config: &KinematicConfig, reverse: &ReverseConfig) -> Refined {
    let rows = episode.len();
    if rows == 0 {
        return Refined::untouched(episode);
    }
    let recorded: Vec<Pose> = (0..rows).map(|t| episode.eef(t)).collect();
    let guard = protected(episode, config, reverse);
    let objects = objects(episode);
    let path = smooth(&recorded, &guard, config.smooth_frames);
    let motion = motion(&path, config.speed_window);

    let mut fates = vec![Fate::Kept; rows];
    for run in still_runs(&path, &objects, &motion, &guard, config) {
        fates[run.start + 1..run.end - 1].fill(Fate::Static);
    }
    let kept = (0..rows).filter(|&t| fates[t] == Fate::Kept);
    let nodes: Vec<Node> = kept.map(|row| Node { row, pose: path[row], between: false }).collect();
    let nodes = retime(&nodes, &objects, &guard, config);
    for fate in &mut fates {
        if *fate == Fate::Kept {
            *fate = Fate::Resampled;
        }
    }
    for node in &nodes {
        fates[node.row] = Fate::Kept;
    }
    Refined::new(vec![assemble(episode, &nodes, reverse)], fates, narrow(&motion.speed))
}

/// The episode along `nodes`. Rows between input rows get their own pose, the others keep the observed one.
fn assemble(episode: &Episode, nodes: &[Node], reverse: &ReverseConfig) -> Episode {
    let rows: Vec<usize> = nodes.iter().map(|n| n.row).collect();
    let mut out = episode.select(&rows);
    for (state, node) in out.state.iter_mut().zip(nodes).filter(|(_, n)| n.between) {
        state[EEF].copy_from_slice(&node.pose.to_row(&reverse.reference_quaternion));
    }
    continue_path(&mut out, &reverse.reference_quaternion, reverse.object_reference);
    let poses: Vec<Pose> = nodes.iter().map(|n| n.pose).collect();
    out.action = goals(&poses, &open_states(&out, reverse), &out.excursion, reverse);
    out
}

#[cfg(test)]
mod tests;
