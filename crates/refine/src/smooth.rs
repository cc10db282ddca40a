use crate::series::runs;
use e2h_core::Pose;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// The path with every pose replaced by the mean of `width` poses around it; rows in `guard` stay as they are.
///
/// Near the end of a free stretch the window shrinks on both sides alike, so that its ends stay where they are and the path
/// has no step there.
pub(crate) fn smooth(path: &[Pose], guard: &[bool], width: usize) -> Vec<Pose> {
    let mut smoothed = path.to_vec();
    if width < 2 {
        return smoothed;
    }
    for stretch in runs(guard, false) {
        for t in stretch.clone() {
            let half = (width / 2).min(t - stretch.start).min(stretch.end - 1 - t);
            smoothed[t] = mean(&path[t - half..=t + half]);
        }
    }
    smoothed
}

/// Mean position, and the orientation nearest to all in the least-squares sense of quaternions of one hemisphere.
fn mean(poses: &[Pose]) -> Pose {
    let middle = poses[poses.len() / 2];
    let mut position = Vector3::zeros();
    let mut orientation = Quaternion::from([0.0; 4]);
    for pose in poses {
        position += pose.position / poses.len() as f64;
        let q = pose.orientation.quaternion();
        let same = q.coords.dot(&middle.orientation.coords) >= 0.0;
        orientation.coords += if same { q.coords } else { -q.coords };
    }
    Pose::new(position, UnitQuaternion::try_new(orientation, 1e-9).unwrap_or(middle.orientation))
}
