//! Put a disk with a hole on an upright rod; take it off.

use crate::expert::{draw, scatter};
use crate::mjcf::{Ring, feet};
use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place};
use crate::tabletop::{Region, beside, in_disk, left_alone, tilt, turn};
use crate::tasks::{Choice, Clearance, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::sync::Arc;

/// Radius of the disk and half its thickness, m.
const RADIUS: f64 = 0.04;
const HALF: f64 = 0.006;
/// Outer radius of the hub and its top over the disk's middle, m.
const HUB: (f64, f64) = (0.02, 0.034);
/// Radius and top of the rod, m: low enough to stay clear of the hand that holds the hub.
const ROD: (f64, f64) = (0.008, 0.06);
const ROD_AT: [f64; 2] = [0.60, 0.08];
const START: Region = Region { x: [0.48, 0.57], y: [-0.15, -0.07] };
/// How far from lying on the table the disk's height may be, m, and its tilt, rad.
const FLAT: (f64, f64) = (0.005, 0.05);
/// Height of the tool centre point over the disk's middle in a grasp, m.
const GRASP: f64 = 0.022;
/// Largest yaw at the start, rad.
const YAW: f64 = 0.4;
/// Sides of disk and hub: a multiple of four, so that the fingers meet flat sides of the hub.
const SIDES: u32 = 12;

/// The pair `disk`. Hard: a disk goes from the table over a rod and down. Easy: it comes off and back to the table.
///
/// The hole is the rod's radius and the clearance (default 4 mm per side) wide. The disk is as wide as the hand opens, so it
/// has a hub round its hole to be held by.
///
/// # Source
/// A twin of the paper's real pair; sizes are ours.
#[derive(Debug, Clone)]
pub struct Disk {
    clearance: f64,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "disk",
    config: include_str!("../../../../configs/tasks/disk.toml"),
    variants: &STANDARD,
    clearance: Some(Clearance { default: 0.004, range: [0.001, 0.006] }),
    build: |Choice { clearance, demonstrator, .. }| Arc::new(Disk { clearance, demonstrator }),
};

fn seat() -> Vector3<f64> {
    Vector3::new(ROD_AT[0], ROD_AT[1], HALF)
}

impl Disk {
    fn ring(&self, look: &str, outer: f64, z: [f64; 2]) -> String {
        let apothem = ROD.0 + self.clearance;
        let [low, high] = z;
        Ring {
            look,
            sides: SIDES,
            apothem,
            thickness: outer - apothem,
            half_height: (high - low) / 2.0,
            z: (high + low) / 2.0,
        }
        .geoms()
    }
}

impl Task for Disk {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        // The plate lies on its feet; the hub meets the table when the disk is upside down.
        let plate = r#"class="item" contype="2" density="1200" rgba=".55 .25 .65 1""#;
        let hub = r#"class="item" density="1200" rgba=".90 .80 .30 1""#;
        let (radius, top) = ROD;
        // The mat shows where the rod is when the disk hides it from the wrist camera.
        let bodies = format!(
            r#"<body name="disk" pos="{} {} {HALF}"><freejoint/>{}{}{}</body>
            <body name="rod" pos="{} {} 0">
              <geom class="holder" type="capsule" size="{radius}" fromto="0 0 0 0 0 {}" rgba=".12 .45 .25 1"/>
              <geom class="scenery" type="cylinder" size=".07 .0006" pos="0 0 .0006" rgba=".45 .80 .55 1"/></body>"#,
            START.x[0],
            START.y[0],
            self.ring(plate, RADIUS, [-HALF, HALF]),
            self.ring(hub, HUB.0, [HALF, HUB.1]),
            feet(8, RADIUS - HALF, HALF, -HALF),
            ROD_AT[0],
            ROD_AT[1],
            top - radius,
        );
        compose(&bodies, &TableCamera::default())
    }

    fn object(&self) -> &str {
        "disk"
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
            Direction::Easy => seat() + in_disk(rng, 0.95 * self.clearance),
        };
        sim.set_object(&Pose::new(position, turn(draw(rng, [-YAW, YAW]))))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let disk = sim.object();
        let p = disk.position;
        let flat = (p.z - HALF).abs() < FLAT.0 && tilt(&disk) < FLAT.1;
        match direction {
            // The hole's corners are further out than its sides.
            Direction::Hard => sim.released() && flat && beside(&p, &seat()) < 1.1 * self.clearance + 0.001,
            Direction::Easy => left_alone(sim) && flat && START.contains(&p),
        }
    }

    fn room(&self, sim: &Sim) -> f64 {
        let p = sim.object().position;
        (p.z - HALF - ROD.1).max(beside(&p, &seat()) - RADIUS - ROD.0)
    }

    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        START.nearest(p)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let noise = config.waypoint_noise_m;
        let table = Stand::open(START.draw(rng, HALF), Turn::Keep);
        let rod = Stand {
            at: seat() + scatter(rng, 0.15 * self.clearance.min(noise)),
            lift: ROD.1 + 0.02,
            tight: true,
            ..table
        };
        let grasp = |disk: &Pose| from_above(disk, GRASP, Symmetry::Two);
        Box::new(pick_place(move |_| ordered(direction, table, rod), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
