//! Put a nut with a handle over a peg; take it off.

mod plan;
mod variant;

use crate::expert::draw;
use crate::pick_place::down;
use crate::tabletop::Region;
use crate::tasks::{Choice, Entry};
use crate::{DemonstratorConfig, Expert, PosturePull, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector2, Vector3};
use rand::Rng as _;
use std::f64::consts::{FRAC_PI_2, PI, TAU};
use std::sync::Arc;
use variant::{NUT_HALF_HEIGHT, PEG_TOP, VARIANTS, Variant, Yaw};

/// Largest tilt of a nut that lies flat, as the cosine of its axis with the vertical (2.6 degrees).
const FLAT: f64 = 0.999;
/// How far above the nut the tool centre point has to be for the arm to count as away, m.
const AWAY: f64 = 0.10;
/// Height above the table of TR-DRL's reference point on the peg, and its tolerance, m.
const SEAT: (f64, f64) = (0.03, 0.05);

/// The pair `nut_assembly`. Hard: the nut goes from the table over the peg. Easy: it comes off and back to the table.
///
/// Variants: `loose` (the round nut of the released TR-DRL scene, about 47 mm per side), `round` and `square` (robosuite's
/// own, 16 and 7 mm per side).
///
/// # Source
/// TR-DRL (arXiv 2505.13925) and robosuite's pegs arena: shapes, start boxes and predicates.
/// Differs: the frame is the robot's base with the table top at z = 0, so robosuite's (x, y, z) is (x + 0.56, y, z - 0.82);
/// `loose` lies 0.10 m further from the robot, because a Panda cannot reach under itself for the handle of the nearest
/// starts (TR-DRL's arm is a Kinova). Contacts are stiffer than robosuite's, whose default softness lets a nut sink into
/// its peg.
#[derive(Debug, Clone)]
pub struct NutAssembly {
    variant: &'static Variant,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "nut_assembly",
    config: include_str!("../../../../configs/tasks/nut_assembly.toml"),
    variants: &VARIANTS,
    clearance: None,
    build: |c| Arc::new(NutAssembly::new(c)),
};

impl NutAssembly {
    fn new(choice: Choice) -> Self {
        Self { variant: Variant::named(choice.variant), demonstrator: choice.demonstrator }
    }

    /// Where the hard task starts, and where a nut that was put down counts as taken off.
    ///
    /// Differs: TR-DRL's easy task ends with the nut held in the air; ours ends where the hard task starts, so that the
    /// reversed data show the grasp from the table.
    fn start(&self) -> Region {
        Region { x: self.variant.start_x, y: self.variant.start_y }
    }
}

impl Task for NutAssembly {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn variant(&self) -> &str {
        self.variant.name
    }

    fn scene(&self) -> String {
        // From the side on which the peg stands, so that the arm does not hide it.
        let [x, y] = self.variant.peg;
        let camera = TableCamera {
            position: [x + 0.46, y + 0.52 * y.signum(), 0.60],
            target: [x - 0.17, y - 0.02 * y.signum(), 0.06],
            fovy: 37.0,
        };
        compose(&self.variant.bodies(), &camera)
    }

    fn object(&self) -> &str {
        "nut"
    }

    fn object_reference(&self) -> [f64; 4] {
        [0.0, 0.0, 0.0, 1.0] // handle towards the robot
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::from(self.variant.home), down(0.0))
    }

    fn posture_pull(&self) -> PosturePull {
        PosturePull::Repeated // what the published policy was trained and measured with
    }

    fn horizon(&self, _: Direction) -> usize {
        500
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let v = self.variant;
        let (position, yaw) = match direction {
            Direction::Hard => ([draw(rng, v.start_x), draw(rng, v.start_y)], v.start_yaw(rng)),
            Direction::Easy => {
                let yaw = match v.yaw {
                    Yaw::Fixed => PI + draw(rng, [-v.peg_yaw, v.peg_yaw]),
                    Yaw::Uniform => TAU * rng.random::<f64>(),
                    Yaw::Quarters => {
                        f64::from(rng.random_range(0..4)) * (PI / 2.0) + draw(rng, [-v.peg_yaw, v.peg_yaw])
                    }
                };
                let [dx, dy] = v.offset(yaw, rng);
                ([v.peg[0] + dx, v.peg[1] + dy], yaw)
            }
        };
        let orientation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw);
        sim.set_object(&Pose::new(Vector3::new(position[0], position[1], NUT_HALF_HEIGHT), orientation))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let nut = sim.object();
        let p = nut.position;
        let released = sim.released();
        match direction {
            Direction::Hard => {
                let beside =
                    ((p.x - self.variant.peg[0]).powi(2) + (p.y - self.variant.peg[1]).powi(2)).sqrt();
                released && beside < self.variant.seat_xy && (p.z - SEAT.0).abs() < SEAT.1 && p.z < PEG_TOP
            }
            Direction::Easy => {
                let flat = (nut.orientation * Vector3::z()).z > FLAT && p.z < 2.0 * NUT_HALF_HEIGHT;
                released && flat && self.start().contains(&p) && sim.tcp().position.z - p.z > AWAY
            }
        }
    }

    fn room(&self, sim: &Sim) -> f64 {
        let p = sim.object().position;
        let over = p.z - NUT_HALF_HEIGHT - PEG_TOP;
        over.max((p.xy() - Vector2::from(self.variant.peg)).norm() - self.variant.reach())
    }

    fn put_down_turn(&self) -> f64 {
        match self.variant.yaw {
            Yaw::Fixed => 0.0,
            Yaw::Uniform | Yaw::Quarters => FRAC_PI_2,
        }
    }

    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.start().nearest(p)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        Box::new(plan::script(self.variant, direction, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
