//! Insert a peg into the plate that a second arm holds; pull it out.

use crate::expert::{draw, gauss};
use crate::pick_place::{GENTLE, down};
use crate::scene::{compose_two_arms, finer};
use crate::tabletop::{in_disk, lean};
use crate::tasks::{Choice, Clearance, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Phase, Result, Script, Sim, TableCamera, Task};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use std::f64::consts::FRAC_PI_4;
use std::sync::Arc;

/// Radius and half the length of the peg, m. It sticks straight out of the flange, and its middle is the tool centre point.
const PEG: (f64, f64) = (0.02, 0.13);
/// Half the outer sizes of the plate along its x and y and half its thickness, m.
const PLATE: [f64; 3] = [0.17, 0.17, 0.01];
/// Distance of the hole's middle from the second flange, m.
const REACH: f64 = 0.17;
/// Base of the second arm, m.
const SECOND: [f64; 3] = [0.0, 0.5, 0.0];
/// Where the second arm holds the hole, m. Its axis lies half way between level (away from the first arm) and down.
const HOLE: [f64; 3] = [0.50, 0.24, 0.32];
/// Middle of the peg at home, m.
const HOME: [f64; 3] = [0.48, -0.08, 0.36];
/// Deviation of the second arm's joints at a reset, rad.
const NOISE: f64 = 0.02;
/// Furthest that the peg's axis passes by the hole's middle, m; range of the hole's middle along the axis, m from the peg's
/// middle; and least cosine of the angle between peg and hole.
const INSERTED: (f64, [f64; 2], f64) = (0.06, [-0.12, 0.14], 0.95);
/// Furthest that the peg's middle is from home when it is back, m.
const BACK: f64 = 0.05;
/// Furthest that the hole may have been pushed since the episode began, m.
const PUSHED: f64 = 0.02;
/// Distance of the peg's tip before the plate at which it comes and goes, m.
const BEFORE: f64 = 0.03;
/// Range of the hole along an inserted peg in starts of the easy task, m, and the largest tilt there, rad.
const START: ([f64; 2], f64) = ([-0.04, 0.04], 0.04);

/// The pair `peg_insertion`. Hard: the peg on one arm goes into the hole of a plate on the other. Easy: it comes out and back
/// home. There are no grippers; the second arm only holds the plate, and what the state calls the object is the hole.
///
/// # Source
/// robosuite's `TwoArmPegInHole` and TR-DRL's `TwoArmPegRemoval`: sizes (default clearance 30 mm per side) and predicates.
/// Differs: the peg's radius is fixed; the hole's middle is that of its opening (robosuite's is 10 mm off); the peg starts 45
/// degrees off the hole's axis (there 90), within reach of two Pandas side by side; starts are spread by 40 mm, over the
/// states in which the easy task ends.
#[derive(Debug, Clone)]
pub struct PegInsertion {
    clearance: f64,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "peg_insertion",
    config: include_str!("../../../../configs/tasks/peg_insertion.toml"),
    variants: &STANDARD,
    clearance: Some(Clearance { default: 0.03, range: [0.005, 0.06] }),
    build: |Choice { clearance, demonstrator, .. }| Arc::new(PegInsertion { clearance, demonstrator }),
};

/// A rotation about x: what tilts the peg from straight down to the second arm, or that one's hand to the first.
fn roll(angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::x_axis(), angle)
}

fn axis(pose: &Pose) -> Vector3<f64> {
    pose.orientation * Vector3::z()
}

/// The peg with its middle `along` metres before the hole's, in line with the hole.
fn in_line(hole: &Pose, along: f64) -> Pose {
    // The plate's z axis points to the first arm.
    let into = -axis(hole);
    let tilt = UnitQuaternion::rotation_between(&-Vector3::z(), &into);
    let orientation = tilt.unwrap_or_else(UnitQuaternion::identity) * down(0.0);
    Pose::new(hole.position - into * along, orientation)
}

/// The peg at home, give or take.
fn near_home(rng: &mut Rng, radius: f64, most: f64) -> Pose {
    let aside = in_disk(rng, radius) + Vector3::new(0.0, 0.0, draw(rng, [-0.5 * radius, 0.5 * radius]));
    Pose::new(Vector3::from(HOME) + aside, lean(rng, most) * down(0.0))
}

impl Task for PegInsertion {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let (radius, half) = PEG;
        let peg = format!(
            r#"<body name="peg" pos="0 0 {half}" gravcomp="1"><site name="tcp" size=".004" group="4"/>
              <geom class="item" type="cylinder" size="{radius} {half}" mass=".2" rgba=".90 .55 .12 1"/>
              <geom class="scenery" type="cylinder" size="{} .01" pos="0 0 {}" mass="0" rgba=".80 .10 .10 1"/></body>"#,
            radius * 1.02,
            half - 0.01,
        );
        // Around the opening: two long bars along y, two short ones between them.
        let open = radius + self.clearance;
        let [x, y, thick] = PLATE;
        let (bar, beam) = ((x - open) / 2.0, (y - open) / 2.0);
        let look = r#"class="holder" type="box" density="500""#;
        let plate = format!(
            r#"<body name="hole" pos="0 0 {REACH}" quat="0 0 .70710678 .70710678" gravcomp="1">
              <geom {look} size="{bar} {y} {thick}" pos="{} 0 0" rgba=".16 .42 .62 1"/>
              <geom {look} size="{bar} {y} {thick}" pos="-{} 0 0" rgba=".16 .42 .62 1"/>
              <geom {look} size="{open} {beam} {thick}" pos="0 {} 0" rgba=".25 .60 .70 1"/>
              <geom {look} size="{open} {beam} {thick}" pos="0 -{} 0" rgba=".25 .60 .70 1"/></body>"#,
            open + bar,
            open + bar,
            open + beam,
            open + beam,
        );
        let camera = TableCamera { position: [1.45, -0.35, 0.85], target: [0.42, 0.13, 0.30], fovy: 34.0 };
        let table = r#"<geom class="scenery" type="box" size=".52 .25 .025" pos=".54 .75 -.025" rgba=".70 .60 .48 1"/>"#;
        finer(&compose_two_arms([&peg, &plate], SECOND, table, &camera))
    }

    fn object(&self) -> &str {
        "hole"
    }

    fn object_reference(&self) -> [f64; 4] {
        // The plate on a hand that points down and 45 degrees to the first arm.
        [0.38, 0.92, 0.0, 0.0]
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::from(HOME), down(0.0))
    }

    fn homes(&self) -> bool {
        false
    }

    fn horizon(&self, _: Direction) -> usize {
        500
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        // The second arm's hand, whose middle of the hole is further out than the first one's tool centre point.
        let hand = roll(-FRAC_PI_4) * down(0.0);
        let back = hand * Vector3::z() * (REACH - PEG.1);
        let position = Vector3::from(HOLE) - Vector3::from(SECOND) - back;
        let joints = sim.joints_for(&Pose::new(position, hand))?;
        sim.set_second_arm(&joints.map(|q| q + gauss(rng, NOISE)))?;
        let peg = match direction {
            Direction::Hard => near_home(rng, 0.8 * BACK, 0.1),
            Direction::Easy => {
                let (along, most) = START;
                let mut peg = in_line(&sim.object(), draw(rng, along));
                peg.position += peg.orientation * in_disk(rng, 0.3 * self.clearance);
                peg.orientation = lean(rng, most.min(0.3 * self.clearance / PEG.1)) * peg.orientation;
                peg
            }
        };
        sim.set_tcp(&peg)
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let (peg, hole) = (sim.tcp(), sim.object());
        let pushed = (hole.position - sim.object_start().position).norm();
        if pushed > PUSHED || sim.touching() {
            return false;
        }
        match direction {
            Direction::Hard => {
                let (by, along, cosine) = INSERTED;
                let (v, to_hole) = (axis(&peg), hole.position - peg.position);
                v.cross(&to_hole).norm() < by
                    && (along[0]..=along[1]).contains(&v.dot(&to_hole))
                    && v.dot(&axis(&hole)).abs() > cosine
            }
            Direction::Easy => (peg.position - Vector3::from(HOME)).norm() < BACK,
        }
    }

    fn room(&self, sim: &Sim) -> f64 {
        let (peg, hole) = (sim.tcp(), sim.object());
        axis(&peg).dot(&(hole.position - peg.position)) - PEG.1
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let home = near_home(rng, 0.3 * BACK, 0.05);
        Box::new(Script::new(config, rng, move |index, sim, _| {
            let before = in_line(&sim.object(), PEG.1 + BEFORE);
            let inserted = in_line(&sim.object(), 0.0);
            Some(match (index, direction) {
                (0, Direction::Hard) => Phase::Move { to: before, pace: 1.0, free: true },
                (1, Direction::Hard) => Phase::Move { to: inserted, pace: GENTLE, free: false },
                (0, Direction::Easy) => Phase::Move { to: before, pace: 1.0, free: false },
                (1, Direction::Easy) => Phase::Move { to: home, pace: 1.0, free: true },
                _ => return None,
            })
        }))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
