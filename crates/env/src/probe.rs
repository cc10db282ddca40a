//! Policies that know nothing: a sound task is never solved by them, and its scene survives them.

use crate::{Env, Result};
use e2h_core::{Action, Direction, Outcome, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng as _;
use std::ops::Range;

/// What a policy does that does not look.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Blind {
    /// Asks for what the controller does anyway.
    Still,
    /// Asks for a random pose and a random gripper, and for others after this many control steps: 1 makes the arm tremble, many
    /// sweep it over the table.
    Random {
        /// Control steps for which a goal is kept.
        hold: usize,
    },
}

/// What became of a scene under a [`Blind`] policy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Probed {
    /// How the episode ended.
    pub outcome: Outcome,
    /// Deepest contact of the episode, m.
    pub deepest: f64,
    /// Whether the object was ever inside the table or below it.
    pub through_table: bool,
}

/// Where random goals lie, m in the frame of the robot's base: the reach of the arm over the table, down to it.
const GOALS: [Range<f64>; 3] = [0.3..0.75, -0.3..0.3, 0.02..0.4];
/// Largest yaw and largest tilt of random goals against the home pose, rad.
const TURNS: [f64; 2] = [0.8, 0.3];
/// The table's top, m, as far as an object can lie on it.
const TABLE: [Range<f64>; 2] = [0.05..1.0, -0.45..0.45];

/// Runs `policy` in an episode of `direction` from an external reset until it ends.
///
/// # Errors
/// When the simulation cannot be set up or stepped.
pub fn probe(env: &mut Env, direction: Direction, policy: Blind, rng: &mut Rng) -> Result<Probed> {
    env.reset(direction, rng)?;
    let reference = env.task().eef_reference();
    let action = |pose: &Pose, open: bool| -> Action {
        let p = pose.to_row(&reference);
        [p[0], p[1], p[2], p[3], p[4], p[5], p[6], if open { 1.0 } else { 0.0 }]
    };
    let (mut deepest, mut through_table) = (0.0_f64, false);
    let mut asked = action(&env.sim().goal(), env.sim().opens());
    let mut step = 0;
    loop {
        match policy {
            Blind::Still => asked = action(&env.sim().goal(), env.sim().opens()),
            Blind::Random { hold } if step % hold.max(1) == 0 => {
                asked = action(&anywhere(&env.sim().home(), rng), rng.random_bool(0.5));
            }
            Blind::Random { .. } => {}
        }
        let outcome = env.step(&asked)?;
        deepest = deepest.max(env.sim().penetration());
        let object = env.sim().object().position;
        through_table |= object.z < 0.0 && TABLE[0].contains(&object.x) && TABLE[1].contains(&object.y);
        if let Some(outcome) = outcome {
            return Ok(Probed { outcome, deepest, through_table });
        }
        step += 1;
    }
}

fn anywhere(home: &Pose, rng: &mut Rng) -> Pose {
    let [x, y, z] = GOALS.map(|range| rng.random_range(range));
    let [yaw, tilt] = TURNS.map(|most| rng.random_range(-most..most));
    let towards = rng.random_range(0.0..std::f64::consts::TAU);
    let lean = UnitQuaternion::new(Vector3::new(towards.cos(), towards.sin(), 0.0) * tilt);
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
    Pose::new(Vector3::new(x, y, z), lean * turn * home.orientation)
}
