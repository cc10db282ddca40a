//! Insert a rod that the hand holds throughout into a hole; pull it out.

use crate::expert::{draw, scatter};
use crate::mjcf::Ring;
use crate::pick_place::{GENTLE, Symmetry, carry, down, from_above, upright};
use crate::tabletop::{Region, in_disk, lean, tilt, turn};
use crate::tasks::{Choice, Clearance, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Phase, Result, Script, Sim, TableCamera, Task, compose, finer};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::sync::Arc;

/// Radius and half the length of the rod, m.
const ROD: (f64, f64) = (0.008, 0.05);
/// Height of the tool centre point over the rod's middle, m.
const GRIP: f64 = 0.03;
const HOLE: [f64; 2] = [0.62, 0.0];
/// Rim and floor of the hole, m over the table.
const RIM: f64 = 0.05;
const FLOOR: f64 = 0.01;
/// How far below the rim the tip has to be, m; the demonstrator goes deeper.
const INSERTED: f64 = 0.02;
const DEPTH: f64 = 0.03;
/// Depths at which starts of the easy task have the rod, m.
const DEPTHS: [f64; 2] = [0.021, 0.037];
/// Largest tilt of an inserted rod, rad.
const STRAIGHT: f64 = 10.0 * std::f64::consts::PI / 180.0;
/// How far over the rim the tip comes and goes, m.
const OVER: f64 = 0.02;
/// Where the rod's middle is when it is out of the hole.
const START: Region = Region { x: [0.46, 0.56], y: [-0.12, 0.12] };
const START_Z: [f64; 2] = [0.15, 0.21];
/// Largest tilt and yaw of the hand there, rad.
const START_TILT: f64 = 0.12;
const START_YAW: f64 = 0.4;

/// The pair `rod_insertion`. Hard: a rod goes into a hole. Easy: it comes out, to a random pose of the start region. The hand
/// holds it throughout: a dropped rod ends the episode.
///
/// The rod's ends are round, which stands for the chamfer that such pegs have. Default clearance 2 mm per side.
///
/// # Source
/// The paper's Isaac pair; sizes are ours (Factory's peg has 0.06 mm per side, which a position-controlled arm cannot meet).
#[derive(Debug, Clone)]
pub struct RodInsertion {
    clearance: f64,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "rod_insertion",
    config: include_str!("../../../../configs/tasks/rod_insertion.toml"),
    variants: &STANDARD,
    clearance: Some(Clearance { default: 0.002, range: [0.0005, 0.01] }),
    build: |Choice { clearance, demonstrator, .. }| Arc::new(RodInsertion { clearance, demonstrator }),
};

/// The end of the rod that goes into the hole.
fn tip(rod: &Pose) -> Vector3<f64> {
    rod.position - rod.orientation * Vector3::z() * ROD.1
}

/// The rod upright over the hole with its tip at a height.
fn over_hole(tip: f64) -> Vector3<f64> {
    Vector3::new(HOLE[0], HOLE[1], tip + ROD.1)
}

/// A pose out of the hole.
fn start(rng: &mut Rng) -> Pose {
    let height = draw(rng, START_Z);
    let position = START.draw(rng, height);
    let yaw = turn(draw(rng, [-START_YAW, START_YAW]));
    Pose::new(position, lean(rng, START_TILT) * yaw)
}

impl Task for RodInsertion {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let (radius, half) = ROD;
        let hole = Ring {
            look: r#"class="holder" rgba=".25 .42 .66 1""#,
            sides: 12,
            apothem: radius + self.clearance,
            thickness: 0.03,
            half_height: (RIM - FLOOR) / 2.0,
            z: (RIM + FLOOR) / 2.0,
        };
        let bodies = format!(
            r#"<body name="rod" pos="{} {} .2"><freejoint/>
              <geom class="item" type="capsule" size="{radius} {}" density="5000" rgba=".95 .55 .10 1"/>
              <geom class="scenery" type="cylinder" size="{} .004" pos="0 0 -.028" mass="0" rgba=".85 .12 .12 1"/>
            </body>
            <body name="hole" pos="{} {} 0">{}
              <geom class="holder" type="cylinder" size="{} {}" pos="0 0 {}" rgba=".10 .12 .18 1"/>
            </body>"#,
            START.x[0],
            START.y[0],
            half - radius,
            radius * 1.04,
            HOLE[0],
            HOLE[1],
            hole.geoms(),
            radius + self.clearance + 0.02,
            FLOOR / 2.0,
            FLOOR / 2.0,
        );
        finer(&compose(&bodies, &TableCamera::default()))
    }

    fn object(&self) -> &str {
        "rod"
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.54, 0.0, 0.22), down(0.0))
    }

    fn homes(&self) -> bool {
        false
    }

    fn horizon(&self, _: Direction) -> usize {
        200
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let rod = match direction {
            Direction::Hard => start(rng),
            Direction::Easy => {
                let tip = RIM - draw(rng, DEPTHS);
                let yaw = turn(draw(rng, [-START_YAW, START_YAW]));
                Pose::new(over_hole(tip) + in_disk(rng, 0.5 * self.clearance), yaw)
            }
        };
        sim.set_holding(&from_above(&rod, GRIP, Symmetry::Two), &rod, 2.0 * ROD.0)
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let rod = sim.object();
        match direction {
            Direction::Hard => {
                let tip = tip(&rod);
                let inside = (tip.xy() - over_hole(0.0).xy()).norm() < ROD.0 + self.clearance;
                sim.touching() && inside && tip.z < RIM - INSERTED && tilt(&rod) < STRAIGHT
            }
            Direction::Easy => {
                sim.touching() && START.contains(&rod.position) && rod.position.z > START_Z[0] - 0.02
            }
        }
    }

    fn holds(&self) -> bool {
        true
    }

    fn room(&self, sim: &Sim) -> f64 {
        let tip = tip(&sim.object());
        (tip.z - RIM).max((tip.xy() - over_hole(0.0).xy()).norm() - 4.0 * ROD.0)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let out = start(rng);
        let aside = scatter(rng, 0.15 * self.clearance.min(config.waypoint_noise_m));
        Box::new(Script::new(config, rng, move |index, sim, _| {
            let straight = upright(sim.object().orientation);
            let above = carry(sim, over_hole(RIM + OVER) + aside, straight);
            let inserted = carry(sim, over_hole(RIM - DEPTH) + aside, straight);
            let extracted = carry(sim, out.position, out.orientation);
            Some(match (index, direction) {
                (0, _) => Phase::Move { to: above, pace: 1.0, free: false },
                (1, Direction::Hard) => Phase::Move { to: inserted, pace: GENTLE, free: false },
                (1, Direction::Easy) => Phase::Move { to: extracted, pace: 1.0, free: true },
                _ => return None,
            })
        }))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
