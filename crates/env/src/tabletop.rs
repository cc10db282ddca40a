//! What the pairs at one table share: start regions and the pieces of their predicates.

use crate::Sim;
use crate::expert::{draw, gauss};
use e2h_core::{Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng as _;
use std::f64::consts::TAU;

/// How far above the object the tool centre point has to be for the arm to count as away, m.
pub(crate) const AWAY: f64 = 0.10;
/// Widening of a start region in which an object that was put down counts as back, m: forgives what a hand does when it
/// lets go.
pub(crate) const MARGIN: f64 = 0.02;

/// A rectangle on the table, m in the frame of the robot's base.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// Range of x.
    pub x: [f64; 2],
    /// Range of y.
    pub y: [f64; 2],
}

impl Region {
    /// A point of the region at a height.
    pub fn draw(&self, rng: &mut Rng, height: f64) -> Vector3<f64> {
        Vector3::new(draw(rng, self.x), draw(rng, self.y), height)
    }

    /// The point nearest to `p`, on the level, that is over the region or within three quarters of 2 cm: what is put
    /// down there still counts when the hand pushes it a little as it lets go.
    #[must_use]
    pub fn nearest(&self, p: &Vector3<f64>) -> Vector3<f64> {
        let nearest = |v: f64, [low, high]: [f64; 2]| v.clamp(low - 0.75 * MARGIN, high + 0.75 * MARGIN);
        Vector3::new(nearest(p.x, self.x), nearest(p.y, self.y), p.z)
    }

    /// Whether a point is over the region or within 2 cm of it.
    #[must_use]
    pub fn contains(&self, p: &Vector3<f64>) -> bool {
        let within = |v: f64, [low, high]: [f64; 2]| (low - MARGIN..=high + MARGIN).contains(&v);
        within(p.x, self.x) && within(p.y, self.y)
    }
}

/// A point uniform in a disk.
pub(crate) fn in_disk(rng: &mut Rng, radius: f64) -> Vector3<f64> {
    let (r, angle) = (radius * rng.random::<f64>().sqrt(), TAU * rng.random::<f64>());
    Vector3::new(r * angle.cos(), r * angle.sin(), 0.0)
}

/// A number of the range -1 to 1, as somebody hits it who aims at 0: normal with a third as its deviation.
fn aimed(rng: &mut Rng) -> f64 {
    loop {
        let x = gauss(rng, 1.0 / 3.0);
        if x.abs() <= 1.0 {
            return x;
        }
    }
}

/// An angle within `most` of 0, rad, that was aimed at 0.
pub(crate) fn near_straight(rng: &mut Rng, most: f64) -> f64 {
    most * aimed(rng)
}

/// A point of a disk at whose middle was aimed: all of the disk is covered, its edge seldom.
pub fn near_middle(rng: &mut Rng, radius: f64) -> Vector3<f64> {
    loop {
        let p = Vector3::new(aimed(rng), aimed(rng), 0.0);
        if p.norm() <= 1.0 {
            return p * radius;
        }
    }
}

/// A rotation about the vertical.
#[must_use]
pub fn turn(yaw: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw)
}

/// A tilt by at most `most`, rad, in any direction.
pub(crate) fn lean(rng: &mut Rng, most: f64) -> UnitQuaternion<f64> {
    let towards = in_disk(rng, most);
    UnitQuaternion::new(Vector3::new(-towards.y, towards.x, 0.0))
}

/// Angle between a body's z axis and the vertical, rad.
#[must_use]
pub fn tilt(pose: &Pose) -> f64 {
    (pose.orientation * Vector3::z()).z.clamp(-1.0, 1.0).acos()
}

/// Distance of two points seen from above, m.
#[must_use]
pub fn beside(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    (a.xy() - b.xy()).norm()
}

/// Whether the gripper let go of the object and the hand is well above it.
#[must_use]
pub fn left_alone(sim: &Sim) -> bool {
    sim.released() && sim.tcp().position.z - sim.object().position.z > AWAY
}
