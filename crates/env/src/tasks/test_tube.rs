//! Put a test tube into a rack; put it back into a loose stand.

use crate::expert::{draw, scatter};
use crate::mjcf::{Ring, feet};
use crate::pick_place::{Stand, Symmetry, Turn, down, from_above, ordered, pick_place};
use crate::tabletop::{beside, in_disk, lean, left_alone, tilt, turn};
use crate::tasks::{Choice, Clearance, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use rand::Rng as _;
use std::sync::Arc;

/// Radius and half the length of the tube, m.
const TUBE: (f64, f64) = (0.008, 0.05);
/// Height of the tool centre point over the tube's middle in a grasp, m.
const GRASP: f64 = 0.03;
/// An upright hole: its place, rim and floor, m.
struct Hole {
    at: [f64; 2],
    rim: f64,
    floor: f64,
}
const RACK: Hole = Hole { at: [0.62, 0.10], rim: 0.06, floor: 0.01 };
const STAND: Hole = Hole { at: [0.52, -0.12], rim: 0.03, floor: 0.006 };
/// Free space round the tube in the stand, m per side.
const STAND_PLAY: f64 = 0.008;
/// How far below the rack's rim the tube's bottom has to be, m.
const INSERTED: f64 = 0.03;
/// Largest tilt of a tube that is back in its stand, rad: one that leans on the rim cannot be told from one that stands.
const STANDING: f64 = 0.5;
/// Largest yaw of a tube at the start, rad.
const YAW: f64 = 0.5;

/// The pair `test_tube`. Hard: a tube goes from a loose stand into a rack. Easy: it comes out and back into the stand.
///
/// The tube's bottom is flat, so that it can stand by itself where there is room to lean. Default clearance 3 mm per side.
///
/// # Source
/// A twin of the paper's real pair; sizes are ours.
#[derive(Debug, Clone)]
pub struct TestTube {
    clearance: f64,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "test_tube",
    config: include_str!("../../../../configs/tasks/test_tube.toml"),
    variants: &STANDARD,
    clearance: Some(Clearance { default: 0.003, range: [0.001, 0.006] }),
    build: |Choice { clearance, demonstrator, .. }| Arc::new(TestTube { clearance, demonstrator }),
};

impl Hole {
    /// Position of a tube that stands in the middle.
    fn seat(&self) -> Vector3<f64> {
        Vector3::new(self.at[0], self.at[1], self.floor + TUBE.1)
    }

    fn body(&self, name: &str, play: f64, thickness: f64, color: &str) -> String {
        let Self { at: [x, y], rim, floor } = *self;
        let wall = Ring {
            look: &format!(r#"class="holder" rgba="{color}""#),
            sides: 12,
            apothem: TUBE.0 + play,
            thickness,
            half_height: (rim - floor) / 2.0,
            z: (rim + floor) / 2.0,
        };
        let base = TUBE.0 + play + thickness;
        format!(
            r#"<body name="{name}" pos="{x} {y} 0">{}
              <geom class="holder" type="box" size="{base} {base} {}" pos="0 0 {}" rgba=".12 .13 .16 1"/></body>"#,
            wall.geoms(),
            floor / 2.0,
            floor / 2.0
        )
    }
}

fn bottom(tube: &Pose) -> Vector3<f64> {
    tube.position - tube.orientation * Vector3::z() * TUBE.1
}

impl Task for TestTube {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let (r, half) = TUBE;
        let seat = STAND.seat();
        let tube = format!(
            r#"<body name="tube" pos="{} {} {}"><freejoint/>
              <geom class="item" type="capsule" size="{r}" fromto="0 0 {} 0 0 {}" density="2500" rgba=".88 .95 .97 1"/>
              <geom class="scenery" type="cylinder" size="{} .02" pos="0 0 -.026" mass="0" rgba=".80 .10 .45 1"/>
              <geom class="scenery" type="cylinder" size="{} .004" pos="0 0 {}" mass="0" rgba=".80 .10 .45 1"/>
              {}</body>"#,
            seat.x,
            seat.y,
            seat.z,
            // A little short of the feet, which it stands on.
            r - half + 0.001,
            half - r,
            r * 1.03,
            r * 1.03,
            half - 0.006,
            feet(6, r - 0.002, 0.002, -half)
        );
        let bodies = tube
            + &RACK.body("rack", self.clearance, 0.018, ".20 .55 .35 1")
            + &STAND.body("stand", STAND_PLAY, 0.008, ".85 .75 .35 1");
        compose(&bodies, &TableCamera::default())
    }

    fn object(&self) -> &str {
        "tube"
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.52, 0.0, 0.23), down(0.0))
    }

    fn horizon(&self, _: Direction) -> usize {
        300
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let yaw = turn(draw(rng, [-YAW, YAW]));
        let pose = match direction {
            Direction::Hard => Pose::new(STAND.seat() + in_disk(rng, 0.8 * STAND_PLAY), yaw),
            // Half of the tubes lean: they turn about their middle inside the hole, and then lie against its rim.
            Direction::Easy => {
                let most = self.clearance / (RACK.rim - RACK.floor);
                let leaning = if rng.random_bool(0.5) { lean(rng, most) } else { lean(rng, 0.0) };
                Pose::new(RACK.seat() + in_disk(rng, 0.3 * self.clearance), leaning * yaw)
            }
        };
        sim.set_object(&pose)?;
        sim.settle_object(40)
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let tube = sim.object();
        let bottom = bottom(&tube);
        match direction {
            Direction::Hard => {
                sim.released()
                    && bottom.z < RACK.rim - INSERTED
                    && beside(&bottom, &RACK.seat()) < TUBE.0 + self.clearance
            }
            Direction::Easy => {
                left_alone(sim)
                    && bottom.z < 0.5 * (STAND.rim + STAND.floor)
                    && beside(&bottom, &STAND.seat()) < TUBE.0 + STAND_PLAY
                    && tilt(&tube) < STANDING
            }
        }
    }

    fn room(&self, sim: &Sim) -> f64 {
        let bottom = bottom(&sim.object());
        let out = |hole: &Hole| (bottom.z - hole.rim).max(beside(&bottom, &hole.seat()) - 4.0 * TUBE.0);
        out(&RACK).min(out(&STAND))
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let noise = config.waypoint_noise_m;
        let stand = Stand {
            at: STAND.seat() + scatter(rng, 0.4 * noise),
            turn: Turn::Keep,
            retreat: 0.07,
            lift: STAND.rim - STAND.floor + 0.025,
            tight: true,
        };
        let rack = Stand {
            at: RACK.seat() + scatter(rng, 0.15 * self.clearance.min(noise)),
            lift: RACK.rim - RACK.floor + 0.025,
            ..stand
        };
        let grasp = |tube: &Pose| from_above(tube, GRASP, Symmetry::Two);
        Box::new(pick_place(move |_| ordered(direction, stand, rack), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
