//! Put a cube into an open tray; take it out.

use crate::expert::{draw, scatter};
use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place};
use crate::tabletop::{Region, beside, left_alone, near_middle, tilt, turn};
use crate::tasks::{Choice, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::f64::consts::FRAC_PI_4;
use std::sync::Arc;

/// Half an edge of the cube, m.
const HALF: f64 = 0.023;
const START: Region = Region { x: [0.46, 0.57], y: [-0.16, -0.05] };
const TRAY: [f64; 2] = [0.58, 0.11];
/// Thickness of the tray's floor, m.
const FLOOR: f64 = 0.004;
/// Top of its rim, m: low enough for the fingers to reach a cube at the wall.
const RIM: f64 = 0.014;
/// Half its inner width, m.
const INSIDE: f64 = 0.07;
/// Largest distance of the cube from the tray's middle, m, and of its height from lying on the floor.
const SEAT: (f64, f64) = (0.03, 0.005);
/// Largest tilt of a cube that lies flat, rad.
const FLAT: f64 = 0.05;
/// Height of the tool centre point over the cube's middle in a grasp, m: keeps the fingertips clear of the rim.
const GRASP: f64 = 0.008;

/// The pair `cube_pick_place`. Hard: a cube of 46 mm goes from the table into a tray. Easy: it comes out and back.
///
/// # Source
/// Isaac Lab's lift and place tasks: cube, start region and the predicate `object_a_is_into_b` (30 mm). The tray is ours:
/// 140 mm wide inside, with a rim of 14 mm.
#[derive(Debug, Clone)]
pub struct CubePickPlace {
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "cube_pick_place",
    config: include_str!("../../../../configs/tasks/cube_pick_place.toml"),
    variants: &STANDARD,
    clearance: None,
    build: |Choice { demonstrator, .. }| Arc::new(CubePickPlace { demonstrator }),
};

fn seat() -> Vector3<f64> {
    Vector3::new(TRAY[0], TRAY[1], FLOOR + HALF)
}

impl Task for CubePickPlace {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let wall = INSIDE + 0.004;
        let height = RIM / 2.0;
        let look = r#"class="holder" rgba=".16 .38 .62 1""#;
        let bodies = format!(
            r#"<body name="cube" pos="{} {} {HALF}"><freejoint/>
              <geom class="item" type="box" size="{HALF} {HALF} {HALF}" density="1000" rgba=".86 .20 .16 1"/>
            </body>
            <body name="tray" pos="{} {} 0">
              <geom class="holder" type="box" size="{INSIDE} {INSIDE} {}" pos="0 0 {}" rgba=".62 .78 .90 1"/>
              <geom {look} type="box" size="{wall} .004 {height}" pos="0 {wall} {height}"/>
              <geom {look} type="box" size="{wall} .004 {height}" pos="0 -{wall} {height}"/>
              <geom {look} type="box" size=".004 {wall} {height}" pos="{wall} 0 {height}"/>
              <geom {look} type="box" size=".004 {wall} {height}" pos="-{wall} 0 {height}"/>
            </body>"#,
            START.x[0],
            START.y[0],
            TRAY[0],
            TRAY[1],
            FLOOR / 2.0,
            FLOOR / 2.0
        );
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
        let position = match direction {
            Direction::Hard => START.draw(rng, HALF),
            Direction::Easy => seat() + near_middle(rng, 0.95 * SEAT.0),
        };
        sim.set_object(&Pose::new(position, turn(draw(rng, [-FRAC_PI_4, FRAC_PI_4]))))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let cube = sim.object();
        let p = cube.position;
        match direction {
            Direction::Hard => {
                sim.released() && beside(&p, &seat()) < SEAT.0 && (p.z - seat().z).abs() < SEAT.1
            }
            Direction::Easy => {
                left_alone(sim) && START.contains(&p) && p.z < HALF + SEAT.1 && tilt(&cube) < FLAT
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
        let yaw = draw(rng, [-FRAC_PI_4, FRAC_PI_4]);
        let spread = config.waypoint_noise_m;
        let table = Stand::open(START.draw(rng, HALF), Turn::Hand(yaw));
        let tray = Stand::open(seat() + scatter(rng, spread), Turn::Hand(yaw));
        let grasp = |cube: &Pose| from_above(cube, GRASP, Symmetry::Four);
        Box::new(pick_place(move |_| ordered(direction, table, tray), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
