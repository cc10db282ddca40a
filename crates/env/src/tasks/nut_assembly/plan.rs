//! What the demonstrators do: grasp the handle, carry, put down gently, let go, go home.

use super::variant::{NUT_HALF_HEIGHT, PEG_TOP, Variant, Yaw};
use crate::expert::{draw, gauss};
use crate::pick_place::{GENTLE, down, fold, raised, yaw_of};
use crate::{DemonstratorConfig, Phase, Script, Sim};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use std::f64::consts::{FRAC_PI_2, PI};

/// Height of the tool centre point over the nut's middle in a grasp, m: keeps the fingertips off the table.
const GRASP_HEIGHT: f64 = 0.004;
/// Height over the nut at which the hand comes and goes, m.
const APPROACH: f64 = 0.09;
/// Height of the nut's middle at which it passes over the peg, m.
const TRANSIT: f64 = PEG_TOP + 0.03;
/// Gap under the nut when it is let go, m.
const RELEASE_GAP: f64 = 0.001;

fn turned(yaw: f64, x: f64) -> Vector3<f64> {
    Vector3::new(x * yaw.cos(), x * yaw.sin(), 0.0)
}

/// The tool's pose that brings the held nut to a position and yaw, from how it lies in the hand now.
fn carry(sim: &Sim, position: Vector3<f64>, yaw: f64) -> Pose {
    let (nut, tcp) = (sim.object(), sim.tcp());
    let turn = yaw - yaw_of(&nut.orientation);
    // The shorter way round.
    let turn = turn - 2.0 * PI * (turn / (2.0 * PI)).round();
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
    let arm = turn * (tcp.position - nut.position);
    let upright = down(yaw_of(&(turn * tcp.orientation)));
    Pose::new(position + arm, upright)
}

/// The demonstration of one direction.
pub(super) fn script(
    v: &'static Variant,
    direction: Direction,
    config: &DemonstratorConfig,
    rng: &mut Rng,
) -> Script {
    // Where the nut goes is decided once, at the start.
    let target = match direction {
        Direction::Hard => {
            let spread = if config.waypoint_noise_m > 0.0 { v.entry } else { 0.0 };
            [v.peg[0] + gauss(rng, spread), v.peg[1] + gauss(rng, spread)]
        }
        Direction::Easy => [draw(rng, v.start_x), draw(rng, v.start_y)],
    };
    let gripper_yaw = draw(rng, [-FRAC_PI_2, FRAC_PI_2]);
    let entry = [gauss(rng, v.entry), gauss(rng, v.entry)];
    Script::new(config, rng, move |index, sim, _| {
        let nut = sim.object();
        let nut_yaw = yaw_of(&nut.orientation);
        let grasp = Pose::new(
            nut.position + turned(nut_yaw, v.grip_at) + Vector3::new(0.0, 0.0, GRASP_HEIGHT),
            down(fold(nut_yaw)),
        );
        let free = |to, pace| Phase::Move { to, pace, free: true };
        let exact = |to, pace| Phase::Move { to, pace, free: false };
        let goal_yaw = match (direction, v.yaw) {
            (_, Yaw::Fixed) => PI,
            // On the peg the nearest quarter turn (which stays within a quarter of straight ahead), or just as it is.
            (Direction::Hard, Yaw::Quarters) => FRAC_PI_2 * (nut_yaw / FRAC_PI_2).round(),
            (Direction::Hard, Yaw::Uniform) => nut_yaw,
            // In the hand the nut keeps its angle to the gripper, so a gripper angle decides the nut's.
            (Direction::Easy, _) => gripper_yaw + nut_yaw - fold(nut_yaw),
        };
        let [x, y] = target;
        let at = |z: f64| carry(sim, Vector3::new(x, y, z), goal_yaw);
        // What is on the peg is reached and left over the peg's top.
        let over = PEG_TOP + 0.02;
        let (come, leave) = match direction {
            Direction::Hard => (APPROACH, over),
            Direction::Easy => (over, APPROACH),
        };
        Some(match (index, direction) {
            (0, _) => free(raised(grasp, come), 1.0),
            (1, _) => exact(grasp, GENTLE),
            (2, _) => Phase::Grip { open: false },
            (3, Direction::Hard) => free(raised(sim.goal(), TRANSIT - nut.position.z), 1.0),
            // Off the peg by its middle: reversed, the nut comes down over the middle and then drifts to where it lay.
            (3, Direction::Easy) => {
                let over = Vector3::new(v.peg[0] + entry[0], v.peg[1] + entry[1], TRANSIT);
                exact(carry(sim, over, nut_yaw), 1.0)
            }
            (4, _) => {
                let to = at(TRANSIT);
                match direction {
                    Direction::Hard => exact(to, 1.0),
                    Direction::Easy => free(to, 1.0),
                }
            }
            (5, _) => exact(at(NUT_HALF_HEIGHT + RELEASE_GAP), GENTLE),
            (6, _) => Phase::Grip { open: true },
            (7, _) => exact(raised(sim.goal(), leave), GENTLE),
            (8, _) => free(sim.home(), 1.0),
            _ => return None,
        })
    })
}
