use crate::KinematicConfig;
use crate::motion::{motion, slip, turn};
use crate::series::runs;
use e2h_core::Pose;
use nalgebra::Vector3;

/// One row of a path in the making.
#[derive(Clone, Copy)]
pub(crate) struct Node {
    /// Input row that images, object and gripper come from.
    pub(crate) row: usize,
    /// Pose of the tool centre point.
    pub(crate) pose: Pose,
    /// True when the pose lies between input rows.
    pub(crate) between: bool,
}

/// Slow runs of `nodes` re-timed by arc length to steps of `resample_step`; all else as it was. Rows of the result are
/// strictly increasing, its first and last node are those of `nodes`.
///
/// # Source
/// Section "Kinematic Prior Filtering", speed filter.
pub(crate) fn retime(
    nodes: &[Node],
    objects: &[Vector3<f64>],
    guard: &[bool],
    config: &KinematicConfig,
) -> Vec<Node> {
    let poses: Vec<Pose> = nodes.iter().map(|n| n.pose).collect();
    let speed = motion(&poses, config.speed_window).speed;
    let slow = |t: usize| {
        let v = speed[t];
        !guard[nodes[t].row] && (config.retime_all || (config.static_speed <= v && v < config.slow_speed))
    };
    let mask: Vec<bool> = (0..nodes.len()).map(slow).collect();
    let mut out = Vec::with_capacity(nodes.len());
    let mut next = 0;
    for run in runs(&mask, true) {
        // The speed of a row is that of the step that leaves it: the run ends at the row after its last.
        let end = run.end.min(nodes.len() - 1);
        if run.len() < config.slow_min_frames || end <= run.start {
            continue;
        }
        out.extend_from_slice(&nodes[next..run.start]);
        stretch(&nodes[run.start..=end], objects, config, &mut out);
        next = end;
    }
    out.extend_from_slice(&nodes[next..]);
    out
}

/// Appends `nodes` re-timed, all but the last.
fn stretch(nodes: &[Node], objects: &[Vector3<f64>], config: &KinematicConfig, out: &mut Vec<Node>) {
    let steps = nodes.len() - 1;
    let mut clock = Vec::with_capacity(nodes.len());
    clock.push(0.0);
    for pair in nodes.windows(2) {
        clock.push(clock[clock.len() - 1] + duration(&pair[0], &pair[1], objects, config));
    }
    let total = clock[steps];
    // 0 <= total <= steps.
    let fewer = (total.round() as usize).max(1);
    if fewer >= steps {
        out.extend_from_slice(&nodes[..steps]);
        return;
    }
    out.push(nodes[0]);
    let (mut i, mut nearest) = (0, 0);
    for j in 1..fewer {
        let time = total * j as f64 / fewer as f64;
        while i + 1 < steps && clock[i + 1] < time {
            i += 1;
        }
        let f = ((time - clock[i]) / (clock[i + 1] - clock[i]).max(1e-12)).clamp(0.0, 1.0);
        // Every image is used once: there are enough for that, because steps only become fewer.
        nearest = (i + usize::from(f > 0.5)).clamp(nearest + 1, steps - (fewer - j));
        let pose = nodes[i].pose.interpolate(&nodes[i + 1].pose, f);
        out.push(Node { row: nodes[nearest].row, pose, between: true });
    }
}

/// Control steps that the way from `a` to `b` should take; at most the one that it took, so nothing is slowed down.
///
/// # Source
/// Steps of `resample_step` along the arc.
// Differs: by arc length alone, turning in place or an object that falls would happen in no time. They take time too;
// `resample_rotation = 0` and `object_drift = 0` are the literal rule.
fn duration(a: &Node, b: &Node, objects: &[Vector3<f64>], config: &KinematicConfig) -> f64 {
    let hand = b.pose.position - a.pose.position;
    let mut time = hand.norm() / config.resample_step;
    if config.resample_rotation > 0.0 {
        time = time.max(turn(&a.pose, &b.pose) / config.resample_rotation);
    }
    if config.object_drift > 0.0 {
        time = time.max(slip(hand, objects[b.row] - objects[a.row]) / config.resample_step);
    }
    time.min(1.0)
}
