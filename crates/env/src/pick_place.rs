//! Building blocks of scripted pick and place: hand orientations, grasps, and the one script that such pairs share.

use crate::tabletop::turn;
use crate::{DemonstratorConfig, Phase, Script, Sim};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use std::f64::consts::{FRAC_PI_2, PI};

/// Fraction of the drawn speed at which the hand goes down to things.
pub(crate) const GENTLE: f64 = 0.8;
/// Gap under an object when it is let go, m.
const RELEASE_GAP: f64 = 0.001;

/// Gripper pointing down, its fingers closing along y turned by `yaw`.
#[must_use]
pub fn down(yaw: f64) -> UnitQuaternion<f64> {
    turn(yaw) * UnitQuaternion::from_axis_angle(&Vector3::x_axis(), PI)
}

/// Where an x axis points seen from above, rad: an object's front, or the back of a gripper that points down.
pub(crate) fn yaw_of(orientation: &UnitQuaternion<f64>) -> f64 {
    let x = orientation * Vector3::x();
    x.y.atan2(x.x)
}

/// The same direction of a two-fingered gripper, within a quarter turn of straight ahead.
pub(crate) fn fold(yaw: f64) -> f64 {
    yaw - PI * (yaw / PI).round()
}

/// A pose moved straight up.
pub(crate) fn raised(pose: Pose, by: f64) -> Pose {
    Pose::new(pose.position + Vector3::new(0.0, 0.0, by), pose.orientation)
}

/// A hand's pose drawn back along the direction in which it points.
fn drawn_back(hand: Pose, by: f64) -> Pose {
    Pose::new(hand.position - hand.orientation * Vector3::z() * by, hand.orientation)
}

/// The orientation with its z axis put upright, by the shortest way.
pub(crate) fn upright(orientation: UnitQuaternion<f64>) -> UnitQuaternion<f64> {
    let z = orientation * Vector3::z();
    UnitQuaternion::rotation_between(&z, &Vector3::z()).map_or(orientation, |r| r * orientation)
}

/// In which of the directions that an object's shape allows the fingers close.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Symmetry {
    /// Across the object's y axis.
    Two,
    /// Across y or x, whichever is nearer to straight ahead.
    Four,
}

/// The hand that grasps a standing object from above: `along` metres up its z axis from its origin, in line with that axis.
#[must_use]
pub fn from_above(object: &Pose, along: f64, symmetry: Symmetry) -> Pose {
    let axis = object.orientation * Vector3::z();
    let yaw = match symmetry {
        Symmetry::Two => fold(yaw_of(&object.orientation)),
        Symmetry::Four => {
            let yaw = yaw_of(&object.orientation);
            yaw - FRAC_PI_2 * (yaw / FRAC_PI_2).round()
        }
    };
    let lean =
        UnitQuaternion::rotation_between(&Vector3::z(), &axis).unwrap_or_else(UnitQuaternion::identity);
    Pose::new(object.position + axis * along, lean * down(yaw))
}

/// How the object is turned where it is put down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Turn {
    /// Upright, its yaw as it is.
    Keep,
    /// Upright, at the yaw that it has when the hand's is this, rad.
    Hand(f64),
    /// Upright, its own yaw this, rad.
    Object(f64),
    /// Just so.
    To(UnitQuaternion<f64>),
}

impl Turn {
    fn of(self, sim: &Sim) -> UnitQuaternion<f64> {
        let object = sim.object().orientation;
        match self {
            Self::Keep => upright(object),
            Self::Hand(yaw) => turn(yaw - yaw_of(&sim.tcp().orientation)) * upright(object),
            Self::Object(yaw) => turn(yaw - yaw_of(&object)) * upright(object),
            Self::To(orientation) => orientation,
        }
    }
}

/// The two ends of the way in the order in which a direction needs them.
#[must_use]
pub fn ordered(direction: Direction, start: Stand, goal: Stand) -> [Stand; 2] {
    match direction {
        Direction::Hard => [start, goal],
        Direction::Easy => [goal, start],
    }
}

/// One end of the way: where the object stands, and how it and the hand come and go there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stand {
    /// Position of the object's frame when it stands there, m. What the script takes up may stand anywhere near.
    pub at: Vector3<f64>,
    /// How it is turned there.
    pub turn: Turn,
    /// How far the hand draws back from its grasp, m.
    pub retreat: f64,
    /// How far above the stand the object's frame comes and goes, m.
    pub lift: f64,
    /// True where only the way straight up leads out (a hole, a peg): the object then passes right over [`Self::at`].
    pub tight: bool,
}

impl Stand {
    /// A place on the table, or in something flat.
    #[must_use]
    pub fn open(at: Vector3<f64>, turn: Turn) -> Self {
        Self { at, turn, retreat: 0.06, lift: 0.07, tight: false }
    }

    fn over(&self) -> Vector3<f64> {
        self.at + Vector3::new(0.0, 0.0, self.lift)
    }
}

/// The tool's pose that brings the held object to a pose, from how it lies in the hand now.
pub(crate) fn carry(sim: &Sim, position: Vector3<f64>, orientation: UnitQuaternion<f64>) -> Pose {
    let (object, tcp) = (sim.object(), sim.tcp());
    let rotation = orientation * object.orientation.inverse();
    Pose::new(position + rotation * (tcp.position - object.position), rotation * tcp.orientation)
}

/// The demonstration of every pick-and-place pair: come over the object, grasp it, carry it over the other stand, put it
/// down gently, let go, draw back, go home. `stands` gives where from and where to in the scene as it is, `grasp` the hand's
/// pose for an object's.
pub fn pick_place(
    stands: impl Fn(&Sim) -> [Stand; 2] + Send + 'static,
    grasp: impl Fn(&Pose) -> Pose + Send + 'static,
    config: &DemonstratorConfig,
    rng: &mut Rng,
) -> Script {
    Script::new(config, rng, move |index, sim, _| {
        let free = |to, pace| Phase::Move { to, pace, free: true };
        let exact = |to, pace| Phase::Move { to, pace, free: false };
        let [from, to] = stands(sim);
        Some(match index {
            0 => free(drawn_back(grasp(&sim.object()), from.retreat), 1.0),
            1 => exact(grasp(&sim.object()), GENTLE),
            2 => Phase::Grip { open: false },
            // Out of a hole by its middle and upright: reversed, the object comes down over the middle and only then goes to
            // where it stood.
            3 if from.tight => exact(carry(sim, from.over(), from.turn.of(sim)), 1.0),
            3 => free(raised(sim.goal(), from.lift), 1.0),
            4 if to.tight => exact(carry(sim, to.over(), to.turn.of(sim)), 1.0),
            4 => free(carry(sim, to.over(), to.turn.of(sim)), 1.0),
            5 => {
                let gap = Vector3::new(0.0, 0.0, RELEASE_GAP);
                exact(carry(sim, to.at + gap, to.turn.of(sim)), GENTLE)
            }
            6 => Phase::Grip { open: true },
            7 => exact(drawn_back(sim.goal(), to.retreat), GENTLE),
            8 => free(sim.home(), 1.0),
            _ => return None,
        })
    })
}
