//! Put a computer mouse on its pad, straight; take it off.

use crate::expert::{draw, gauss, scatter};
use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place, yaw_of};
use crate::tabletop::{Region, beside, left_alone, near_middle, near_straight, tilt, turn};
use crate::tasks::{Choice, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::f64::consts::PI;
use std::sync::Arc;

/// Half the length, width and height of the mouse, m.
const HALF: [f64; 3] = [0.055, 0.030, 0.0175];
const START: Region = Region { x: [0.48, 0.56], y: [-0.15, -0.08] };
/// Largest yaw at the start, rad.
const START_YAW: f64 = 0.6;
/// Middle of the pad; its front points away from the robot.
const PAD: [f64; 2] = [0.57, 0.10];
/// Largest distance from the pad's middle, m, and largest yaw, rad.
const ON_PAD: (f64, f64) = (0.02, 10.0 * PI / 180.0);
/// How far from lying on the table the mouse's height may be, m, and its tilt, rad.
const FLAT: (f64, f64) = (0.005, 0.05);
/// Height of the tool centre point over the mouse's middle in a grasp, m.
const GRASP: f64 = 0.004;

/// The pair `mouse`. Hard: a mouse goes onto its pad, turned to the front. Easy: it comes off and lies anyhow.
///
/// The pad is a mark on the table, too thin to matter.
///
/// # Source
/// A twin of the paper's real pair; sizes are ours.
#[derive(Debug, Clone)]
pub struct Mouse {
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "mouse",
    config: include_str!("../../../../configs/tasks/mouse.toml"),
    variants: &STANDARD,
    clearance: None,
    build: |Choice { demonstrator, .. }| Arc::new(Mouse { demonstrator }),
};

fn seat() -> Vector3<f64> {
    Vector3::new(PAD[0], PAD[1], HALF[2])
}

impl Task for Mouse {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let [a, b, c] = HALF;
        let [x, y] = PAD;
        let bodies = format!(
            r#"<body name="mouse" pos="{} {} {c}"><freejoint/>
              <geom class="item" type="box" size="{a} {b} {c}" density="430" rgba=".20 .21 .25 1"/>
              <geom class="scenery" type="box" size=".022 .013 .001" pos=".031 .0145 {c}" mass="0" rgba=".95 .75 .15 1"/>
              <geom class="scenery" type="box" size=".022 .013 .001" pos=".031 -.0145 {c}" mass="0" rgba=".95 .75 .15 1"/>
              <geom class="scenery" type="ellipsoid" size=".030 .022 .004" pos="-.022 0 {c}" mass="0" rgba=".45 .47 .55 1"/>
            </body>
            <body name="pad" pos="{x} {y} 0">
              <geom class="scenery" type="box" size=".085 .065 .0005" pos="0 0 .0005" rgba=".10 .45 .50 1"/>
              <geom class="scenery" type="box" size="{a} {b} .0007" pos="0 0 .0007" rgba=".55 .85 .85 1"/>
              <geom class="scenery" type="box" size=".008 {b} .0009" pos=".070 0 .0009" rgba=".95 .75 .15 1"/>
            </body>"#,
            START.x[0], START.y[0]
        );
        compose(&bodies, &TableCamera::default())
    }

    fn object(&self) -> &str {
        "mouse"
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.52, 0.0, 0.21), down(0.0))
    }

    fn horizon(&self, _: Direction) -> usize {
        300
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let (position, yaw) = match direction {
            Direction::Hard => (START.draw(rng, HALF[2]), draw(rng, [-START_YAW, START_YAW])),
            Direction::Easy => {
                (seat() + near_middle(rng, 0.95 * ON_PAD.0), near_straight(rng, 0.95 * ON_PAD.1))
            }
        };
        sim.set_object(&Pose::new(position, turn(yaw)))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let mouse = sim.object();
        let p = mouse.position;
        let flat = (p.z - HALF[2]).abs() < FLAT.0 && tilt(&mouse) < FLAT.1;
        match direction {
            Direction::Hard => {
                sim.released()
                    && flat
                    && beside(&p, &seat()) < ON_PAD.0
                    && yaw_of(&mouse.orientation).abs() < ON_PAD.1
            }
            Direction::Easy => left_alone(sim) && flat && START.contains(&p),
        }
    }

    fn put_down_turn(&self) -> f64 {
        START_YAW
    }

    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        START.nearest(p)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let yaw = Turn::Object(draw(rng, [-START_YAW, START_YAW]));
        let table = Stand::open(START.draw(rng, HALF[2]), yaw);
        let straight = Turn::Object(gauss(rng, 0.5 * config.waypoint_noise_rad));
        let pad = Stand::open(seat() + scatter(rng, 0.7 * config.waypoint_noise_m), straight);
        let grasp = |mouse: &Pose| from_above(mouse, GRASP, Symmetry::Two);
        Box::new(pick_place(move |_| ordered(direction, table, pad), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
