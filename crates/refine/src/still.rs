use crate::KinematicConfig;
use crate::motion::{Motion, slip};
use crate::series::runs;
use e2h_core::Pose;
use nalgebra::Vector3;
use std::ops::Range;

/// Runs of rows that stand still for too long. The first and the last row of each are to be kept, those between cut.
///
/// # Source
/// Section "Kinematic Prior Filtering": displacement below the threshold, drift within `static_drift`, more than
/// `static_frames` rows. A run that drifts further is split greedily where its drift would exceed the limit.
pub(crate) fn still_runs(
    path: &[Pose],
    objects: &[Vector3<f64>],
    motion: &Motion,
    guard: &[bool],
    config: &KinematicConfig,
) -> Vec<Range<usize>> {
    // Differs: the paper looks at positions alone. A hand that turns in place is at work; `rotation_speed = 0` ignores
    // turning, as the paper does.
    let turns = |t: usize| config.rotation_speed > 0.0 && motion.turn[t] > config.rotation_speed;
    let still = |t: usize| motion.speed[t] < config.static_speed && !turns(t) && !guard[t];
    let mask: Vec<bool> = (0..path.len()).map(still).collect();
    // Differs: nor does the paper look at the object. Where it falls or is pushed on its own, a splice would make it jump.
    let slips = |a: usize, b: usize| {
        config.object_drift > 0.0
            && slip(path[b].position - path[a].position, objects[b] - objects[a]) > config.object_drift
    };
    let mut found = vec![];
    for run in runs(&mask, true) {
        let mut start = run.start;
        for t in run.clone() {
            let drift = (path[t].position - path[start].position).norm();
            if drift > config.static_drift || slips(start, t) {
                found.push(start..t);
                start = t;
            }
        }
        found.push(start..run.end);
    }
    // Nothing lies between the ends of a run of two.
    found.retain(|run| run.len() > config.static_frames.max(2));
    found
}
