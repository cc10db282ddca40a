use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// A rigid pose. Units: metres; the quaternion is stored as (w, x, y, z) in rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Position, m.
    pub position: Vector3<f64>,
    /// Orientation.
    pub orientation: UnitQuaternion<f64>,
}

impl Pose {
    /// From position and orientation.
    #[must_use]
    pub fn new(position: Vector3<f64>, orientation: UnitQuaternion<f64>) -> Self {
        Self { position, orientation }
    }

    /// From seven numbers: position, quaternion wxyz (normalised here; a zero quaternion gives the identity).
    /// Missing entries count as zero.
    #[must_use]
    pub fn from_row(row: &[f32]) -> Self {
        let v = |i: usize| row.get(i).copied().map_or(0.0, f64::from);
        let q = Quaternion::new(v(3), v(4), v(5), v(6));
        let orientation = UnitQuaternion::try_new(q, 1e-9).unwrap_or_else(UnitQuaternion::identity);
        Self { position: Vector3::new(v(0), v(1), v(2)), orientation }
    }

    /// Seven numbers: position, quaternion wxyz in the hemisphere of `reference` (wxyz).
    #[must_use]
    // Stored episodes are f32; physics is f64: this is the one place.
    pub fn to_row(&self, reference: &[f64; 4]) -> [f32; 7] {
        let q = self.orientation.quaternion();
        let q = align_hemisphere([q.w, q.i, q.j, q.k], reference);
        let p = self.position;
        [p.x, p.y, p.z, q[0], q[1], q[2], q[3]].map(|v| v as f32)
    }

    /// Position linear, orientation slerp; `f` in [0, 1].
    #[must_use]
    pub fn interpolate(&self, other: &Self, f: f64) -> Self {
        let position = self.position + (other.position - self.position) * f;
        let orientation =
            self.orientation.try_slerp(&other.orientation, f, 1e-9).unwrap_or(other.orientation);
        Self { position, orientation }
    }
}

/// Flips the sign of quaternion `q` (wxyz) where that brings it into the hemisphere of `reference`.
/// One sign for every row of a task keeps quaternions continuous, which "w >= 0" does not for a gripper that points down.
#[must_use]
pub fn align_hemisphere(q: [f64; 4], reference: &[f64; 4]) -> [f64; 4] {
    let dot: f64 = q.iter().zip(reference).map(|(a, b)| a * b).sum();
    if dot < 0.0 { q.map(|v| -v) } else { q }
}

/// Continues the sign of quaternions (wxyz) along a path: the first goes into the hemisphere of `reference`, each other into
/// that of the one before it. A fixed reference would make a hand that turns past 180 degrees jump from q to -q.
///
/// # Shapes
/// `rows` are any rows; `entries` says where the four numbers of a quaternion lie in each.
pub fn continue_signs<const N: usize>(
    rows: &mut [[f32; N]],
    entries: std::ops::Range<usize>,
    reference: &[f64; 4],
) {
    let mut before = *reference;
    for row in rows {
        let Some(q) = row.get_mut(entries.clone()) else { return };
        if q.iter().zip(before).map(|(a, b)| f64::from(*a) * b).sum::<f64>() < 0.0 {
            q.iter_mut().for_each(|v| *v = -*v);
        }
        for (slot, v) in before.iter_mut().zip(q) {
            *slot = f64::from(*v);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_round_trip_in_the_reference_hemisphere() {
        let row = [0.1, 0.2, 0.3, 0.0, -1.0, 0.0, 0.0];
        let back = Pose::from_row(&row).to_row(&[0.0, 1.0, 0.0, 0.0]);
        assert_eq!(back, [0.1, 0.2, 0.3, 0.0, 1.0, 0.0, 0.0]);
    }

    #[test]
    fn interpolation_meets_both_ends() {
        let a = Pose::from_row(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]);
        let b = Pose::from_row(&[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert!((a.interpolate(&b, 0.0).orientation.angle_to(&a.orientation)).abs() < 1e-9);
        assert!((a.interpolate(&b, 1.0).orientation.angle_to(&b.orientation)).abs() < 1e-9);
        assert!((a.interpolate(&b, 0.5).position.x - 0.5).abs() < 1e-12);
    }
}
