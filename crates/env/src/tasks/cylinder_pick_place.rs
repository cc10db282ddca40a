//! Stand a cylinder in a ring holder; take it out.

use crate::expert::{draw, scatter};
use crate::mjcf::{Ring, feet};
use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place};
use crate::tabletop::{Region, beside, in_disk, left_alone, tilt, turn};
use crate::tasks::{Choice, Clearance, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::f64::consts::PI;
use std::sync::Arc;

/// Radius and half the height of the cylinder, m.
const RADIUS: f64 = 0.022;
const HALF: f64 = 0.045;
const START: Region = Region { x: [0.47, 0.57], y: [-0.16, -0.06] };
const HOLDER: [f64; 2] = [0.60, 0.09];
/// Rim of the holder, m: the cylinder stands on the table inside it.
const RIM: f64 = 0.03;
/// Largest tilt of a standing cylinder, rad.
const STANDING: f64 = 10.0 * PI / 180.0;
/// How far from standing on the table its height may be, m.
const DOWN: f64 = 0.005;
/// Height of the tool centre point over the cylinder's middle in a grasp, m.
const GRASP: f64 = 0.022;
/// Largest yaw at the start, rad.
const YAW: f64 = 0.5;

/// The pair `cylinder_pick_place`. Hard: a cylinder goes from the table into a ring that it stands in. Easy: it comes out
/// and back. Default clearance 4 mm per side.
///
/// # Source
/// The paper's Isaac pair; sizes are ours.
#[derive(Debug, Clone)]
pub struct CylinderPickPlace {
    clearance: f64,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "cylinder_pick_place",
    config: include_str!("../../../../configs/tasks/cylinder_pick_place.toml"),
    variants: &STANDARD,
    clearance: Some(Clearance { default: 0.004, range: [0.001, 0.012] }),
    build: |Choice { clearance, demonstrator, .. }| Arc::new(CylinderPickPlace { clearance, demonstrator }),
};

fn seat() -> Vector3<f64> {
    Vector3::new(HOLDER[0], HOLDER[1], HALF)
}

impl Task for CylinderPickPlace {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let holder = Ring {
            look: r#"class="holder" rgba=".93 .60 .12 1""#,
            sides: 16,
            apothem: RADIUS + self.clearance,
            thickness: 0.012,
            half_height: RIM / 2.0,
            z: RIM / 2.0,
        };
        // Balls inside take the grip and feet the weight: a cylinder meets a box in a single point.
        let ball = |z: f64| {
            format!(r#"<geom class="item" contype="0" size="{RADIUS}" pos="0 0 {z}" mass="0" group="3"/>"#)
        };
        let bodies = format!(
            r#"<body name="cylinder" pos="{} {} {HALF}"><freejoint/>
              <geom class="item" conaffinity="0" type="cylinder" size="{RADIUS} {}" pos="0 0 .0005" density="700" rgba=".20 .50 .85 1"/>
              <geom class="scenery" type="cylinder" size="{} .0005" pos="0 0 {HALF}" mass="0" rgba=".90 .93 .97 1"/>
              {}{}</body>
            <body name="holder" pos="{} {} 0">{}
              <geom class="scenery" type="cylinder" size="{} .0006" pos="0 0 .0006" rgba=".25 .12 .05 1"/></body>"#,
            START.x[0],
            START.y[0],
            HALF - 0.0005,
            RADIUS - 0.006,
            [-0.02, 0.0, 0.012, 0.022].map(ball).concat(),
            feet(8, RADIUS - 0.003, 0.003, -HALF),
            HOLDER[0],
            HOLDER[1],
            holder.geoms(),
            RADIUS + self.clearance,
        );
        compose(&bodies, &TableCamera::default())
    }

    fn object(&self) -> &str {
        "cylinder"
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.52, 0.0, 0.23), down(0.0))
    }

    fn horizon(&self, _: Direction) -> usize {
        300
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let position = match direction {
            Direction::Hard => START.draw(rng, HALF),
            Direction::Easy => seat() + in_disk(rng, 0.95 * self.clearance),
        };
        sim.set_object(&Pose::new(position, turn(draw(rng, [-YAW, YAW]))))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let cylinder = sim.object();
        let p = cylinder.position;
        let stands = tilt(&cylinder) < STANDING && (p.z - HALF).abs() < DOWN;
        match direction {
            Direction::Hard => {
                // The ring's corners are further out than its sides.
                sim.released() && stands && beside(&p, &seat()) < 1.1 * self.clearance + 0.001
            }
            Direction::Easy => left_alone(sim) && stands && START.contains(&p),
        }
    }

    fn room(&self, sim: &Sim) -> f64 {
        let p = sim.object().position;
        (p.z - HALF - RIM).max(beside(&p, &seat()) - 2.0 * RADIUS)
    }

    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        START.nearest(p)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let noise = config.waypoint_noise_m;
        let table = Stand::open(START.draw(rng, HALF), Turn::Keep);
        let holder = Stand {
            at: seat() + scatter(rng, 0.15 * self.clearance.min(noise)),
            lift: RIM + 0.025,
            tight: true,
            ..table
        };
        let grasp = |cylinder: &Pose| from_above(cylinder, GRASP, Symmetry::Two);
        Box::new(pick_place(move |_| ordered(direction, table, holder), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
