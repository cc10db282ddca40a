//! Stack a cube on another; take it off.

use crate::expert::{draw, scatter};
use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place, yaw_of};
use crate::tabletop::{Region, beside, left_alone, near_middle, tilt, turn};
use crate::tasks::{Choice, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::f64::consts::FRAC_PI_4;
use std::sync::Arc;

/// Half an edge of both cubes, m.
const HALF: f64 = 0.023;
/// Where the upper cube starts, and where the lower one stands: more than [`APART`] from each other.
const START: Region = Region { x: [0.48, 0.58], y: [-0.16, -0.05] };
const BASE: Region = Region { x: [0.56, 0.62], y: [0.075, 0.125] };
/// Largest yaw of the lower cube, rad.
const BASE_YAW: f64 = 0.4;
/// Largest distance of stacked cubes seen from above, m, and of their height step from an edge.
const STACKED: (f64, f64) = (0.04, 0.005);
/// How far off the middle of the lower cube the upper one lies in starts of the easy task, m: further out it falls.
const OFF_MIDDLE: f64 = 0.016;
/// Distance of cubes that are not stacked, m.
const APART: f64 = 0.10;
/// Speed below which a cube is still, m/s.
const STILL: f64 = 0.01;
/// Largest tilt of a cube that lies flat, rad.
const FLAT: f64 = 0.05;
/// Height of the tool centre point over the cube's middle in a grasp, m.
const GRASP: f64 = 0.004;

/// The pair `cube_stack`. Hard: a cube goes from the table onto another one. Easy: it comes off and back to the table.
///
/// # Source
/// Isaac Lab's stack task: cubes of 46 mm, 40 mm and 5 mm tolerances, at least 10 cm between cubes at the start. The lower
/// cube is not in the state: its place (6 cm by 6 cm, 0.4 rad to each side) is to be seen in the images.
#[derive(Debug, Clone)]
pub struct CubeStack {
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "cube_stack",
    config: include_str!("../../../../configs/tasks/cube_stack.toml"),
    variants: &STANDARD,
    clearance: None,
    build: |Choice { demonstrator, .. }| Arc::new(CubeStack { demonstrator }),
};

/// Pose of the lower cube; a scene of this task has it.
fn base(sim: &Sim) -> Option<Pose> {
    sim.body("base").ok()
}

fn still(sim: &Sim) -> bool {
    ["cube", "base"].into_iter().all(|name| sim.speed(name).is_ok_and(|v| v < STILL))
}

impl Task for CubeStack {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        // Each cube is object and fixture to the other.
        let cube = |name: &str, at: [f64; 2], color: &str| {
            format!(
                r#"<body name="{name}" pos="{} {} {HALF}"><freejoint/>
                  <geom class="item" conaffinity="3" type="box" size="{HALF} {HALF} {HALF}" density="1000"
                    rgba="{color}"/></body>"#,
                at[0], at[1]
            )
        };
        let bodies = cube("cube", [START.x[0], START.y[0]], ".86 .20 .16 1")
            + &cube("base", [BASE.x[0], BASE.y[0]], ".13 .45 .75 1");
        compose(&bodies, &TableCamera::default())
    }

    fn object(&self) -> &str {
        "cube"
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.52, 0.0, 0.21), down(0.0))
    }

    fn horizon(&self, _: Direction) -> usize {
        300
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let base = Pose::new(BASE.draw(rng, HALF), turn(draw(rng, [-BASE_YAW, BASE_YAW])));
        sim.set_body("base", &base)?;
        let position = match direction {
            Direction::Hard => START.draw(rng, HALF),
            Direction::Easy => {
                base.position + near_middle(rng, OFF_MIDDLE) + Vector3::new(0.0, 0.0, 2.0 * HALF)
            }
        };
        sim.set_object(&Pose::new(position, turn(draw(rng, [-FRAC_PI_4, FRAC_PI_4]))))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let Some(base) = base(sim) else { return false };
        let cube = sim.object();
        let p = cube.position;
        match direction {
            Direction::Hard => {
                let step = p.z - base.position.z;
                sim.released()
                    && beside(&p, &base.position) < STACKED.0
                    && (step - 2.0 * HALF).abs() < STACKED.1
                    && still(sim)
            }
            Direction::Easy => {
                left_alone(sim)
                    && START.contains(&p)
                    && p.z < HALF + STACKED.1
                    && tilt(&cube) < FLAT
                    && beside(&p, &base.position) > APART
            }
        }
    }

    fn put_down_turn(&self) -> f64 {
        FRAC_PI_4
    }

    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        START.nearest(p)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let table = Stand::open(START.draw(rng, HALF), Turn::Hand(draw(rng, [-FRAC_PI_4, FRAC_PI_4])));
        let off = scatter(rng, 0.5 * config.waypoint_noise_m);
        let stands = move |sim: &Sim| {
            // A scene of this task has the lower cube.
            let base = base(sim).unwrap_or_else(|| sim.home());
            let top = base.position + off + Vector3::new(0.0, 0.0, 2.0 * HALF);
            ordered(direction, table, Stand::open(top, Turn::Hand(yaw_of(&base.orientation))))
        };
        let grasp = |cube: &Pose| from_above(cube, GRASP, Symmetry::Four);
        Box::new(pick_place(stands, grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
