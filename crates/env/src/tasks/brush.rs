//! Stand a brush in its holder; lay it back into its cradle.

use crate::expert::{draw, scatter};
use crate::mjcf::{Ring, feet};
use crate::pick_place::{Stand, Turn, down, ordered, pick_place};
use crate::tabletop::{beside, in_disk, lean, left_alone, turn};
use crate::tasks::{Choice, Clearance, Entry, STANDARD};
use crate::{DemonstratorConfig, Expert, Result, Sim, TableCamera, Task, compose, finer};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use std::f64::consts::{FRAC_PI_2, PI};
use std::sync::Arc;

/// Radius of the handle, m.
const RADIUS: f64 = 0.009;
/// The brush's frame is where it is gripped, z towards the head: how far below the handle ends, and where the head begins
/// and ends, m.
const HANDLE_END: f64 = 0.09;
const HEAD: [f64; 2] = [0.030, 0.075];
/// Half the width and thickness of the head, m.
const HEAD_HALF: [f64; 2] = [0.013, 0.008];
/// The holder: place, rim and floor, m.
const HOLDER: [f64; 2] = [0.62, 0.08];
const RIM: f64 = 0.07;
const FLOOR: f64 = 0.01;
/// How far below the rim the handle's end has to be, m.
const INSERTED: f64 = 0.04;
/// Where the gripped point of a brush in the cradle is; the handle points to the robot.
const CRADLE: [f64; 3] = [0.53, -0.08, 0.035];
/// How far from there a brush starts, m to each side, and its yaw, rad.
const START: ([f64; 2], f64) = ([0.015, 0.003], 0.04);
/// How far from there, in any direction, a brush may be that was laid back, m; and how far its axis from level, rad.
const LAID: (f64, f64) = (0.025, 15.0 * PI / 180.0);
/// How far the hand leans back against the brush's axis, rad: it points 45 degrees back when the brush lies and 45 degrees
/// forward when it stands. Further forward the wrist meets its limit, further back the palm the head.
const LEAN_BACK: f64 = PI / 4.0;

/// The pair `brush`. Hard: a brush goes from its cradle, where it lies, into its holder, where it stands. Easy: it goes back.
/// On the way the hand turns by a quarter. Default clearance 3 mm per side.
///
/// # Source
/// A twin of the paper's real pair; sizes are ours.
#[derive(Debug, Clone)]
pub struct Brush {
    clearance: f64,
    demonstrator: DemonstratorConfig,
}

/// The registry's line.
pub(crate) const ENTRY: Entry = Entry {
    name: "brush",
    config: include_str!("../../../../configs/tasks/brush.toml"),
    variants: &STANDARD,
    clearance: Some(Clearance { default: 0.003, range: [0.001, 0.006] }),
    build: |Choice { clearance, demonstrator, .. }| Arc::new(Brush { clearance, demonstrator }),
};

fn pitch(angle: f64) -> UnitQuaternion<f64> {
    UnitQuaternion::from_axis_angle(&Vector3::y_axis(), angle)
}

/// How a brush in the cradle is turned: its head away from the robot.
fn lying() -> UnitQuaternion<f64> {
    pitch(FRAC_PI_2)
}

fn seat() -> Vector3<f64> {
    Vector3::new(HOLDER[0], HOLDER[1], FLOOR + HANDLE_END)
}

fn axis(brush: &Pose) -> Vector3<f64> {
    brush.orientation * Vector3::z()
}

/// The hand that grips a brush.
fn grasp(brush: &Pose) -> Pose {
    Pose::new(brush.position, brush.orientation * pitch(-LEAN_BACK) * down(0.0))
}

impl Task for Brush {
    fn name(&self) -> &str {
        ENTRY.name
    }

    fn scene(&self) -> String {
        let holder = Ring {
            look: r#"class="holder" rgba=".20 .42 .70 1""#,
            sides: 12,
            apothem: RADIUS + self.clearance,
            thickness: 0.014,
            half_height: (RIM - FLOOR) / 2.0,
            z: (RIM + FLOOR) / 2.0,
        };
        let [x, y, z] = CRADLE;
        let [wide, thick] = HEAD_HALF;
        let middle = (HEAD[0] + HEAD[1]) / 2.0;
        let under_head = z - thick;
        let under_handle = z - RADIUS;
        let wood = r#"class="holder" type="box" rgba=".50 .34 .20 1""#;
        // The mat shows where the holder is when the head hides it from the wrist camera.
        let bodies = format!(
            r#"<body name="brush" pos="{x} {y} {z}" euler="0 {FRAC_PI_2} 0"><freejoint/>
              <geom class="item" type="capsule" size="{RADIUS}" fromto="0 0 {} 0 0 {}" density="2000" rgba=".85 .18 .16 1"/>
              <geom class="item" type="box" size="{thick} {wide} {}" pos="0 0 {middle}" density="600" rgba=".96 .90 .70 1"/>
              <geom class="scenery" type="box" size="{} {} .005" pos="0 0 {}" mass="0" rgba=".75 .75 .78 1"/>
              {}</body>
            <body name="holder" pos="{} {} 0">{}
              <geom class="holder" type="cylinder" size="{} {}" pos="0 0 {}" rgba=".10 .12 .16 1"/>
              <geom class="scenery" type="cylinder" size=".085 .0006" pos="0 0 .0006" rgba=".55 .78 .92 1"/></body>
            <body name="cradle" pos="{x} {y} 0">
              <geom {wood} size=".012 .03 {}" pos="{middle} 0 {}"/>
              <geom {wood} size=".008 .025 {}" pos="-.07 0 {}"/>
              <geom {wood} size=".008 .004 .024" pos="-.07 {} .024"/>
              <geom {wood} size=".008 .004 .024" pos="-.07 -{} .024"/>
            </body>"#,
            // A little short of the feet, which it stands on.
            RADIUS - HANDLE_END + 0.001,
            HEAD[0] - RADIUS,
            (HEAD[1] - HEAD[0]) / 2.0,
            thick + 0.0005,
            wide + 0.0005,
            HEAD[0] + 0.006,
            feet(6, RADIUS - 0.002, 0.002, -HANDLE_END),
            HOLDER[0],
            HOLDER[1],
            holder.geoms(),
            RADIUS + self.clearance + 0.012,
            FLOOR / 2.0,
            FLOOR / 2.0,
            under_head / 2.0,
            under_head / 2.0,
            under_handle / 2.0,
            under_handle / 2.0,
            RADIUS + 0.008,
            RADIUS + 0.008,
        );
        finer(&compose(&bodies, &TableCamera::default()))
    }

    fn object(&self) -> &str {
        "brush"
    }

    fn object_reference(&self) -> [f64; 4] {
        // Half way between lying and standing.
        let half = FRAC_PI_2 / 4.0;
        [half.cos(), 0.0, half.sin(), 0.0]
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.54, 0.0, 0.22), down(0.0))
    }

    fn horizon(&self, _: Direction) -> usize {
        300
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()> {
        let pose = match direction {
            Direction::Hard => {
                let ([dx, dy], yaw) = START;
                let offset = Vector3::new(draw(rng, [-dx, dx]), draw(rng, [-dy, dy]), 0.0);
                Pose::new(Vector3::from(CRADLE) + offset, turn(draw(rng, [-yaw, yaw])) * lying())
            }
            Direction::Easy => {
                let most = 0.5 * self.clearance / (RIM - FLOOR);
                Pose::new(seat() + in_disk(rng, 0.3 * self.clearance), lean(rng, most))
            }
        };
        sim.set_object(&pose)?;
        sim.settle_object(40)
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let brush = sim.object();
        let end = brush.position - axis(&brush) * HANDLE_END;
        match direction {
            Direction::Hard => {
                sim.released()
                    && end.z < RIM - INSERTED
                    && beside(&end, &seat()) < RADIUS + self.clearance
                    && axis(&brush).z > 0.9
            }
            Direction::Easy => {
                left_alone(sim)
                    && (brush.position - Vector3::from(CRADLE)).norm() < LAID.0
                    && axis(&brush).z.asin().abs() < LAID.1
            }
        }
    }

    fn room(&self, sim: &Sim) -> f64 {
        let brush = sim.object();
        let end = brush.position - axis(&brush) * HANDLE_END;
        let out = (end.z - RIM).max(beside(&end, &seat()) - 4.0 * RADIUS);
        out.min((brush.position - Vector3::from(CRADLE)).norm() - LAID.0)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let noise = config.waypoint_noise_m;
        let along = Vector3::new(draw(rng, [-START.0[0], START.0[0]]), 0.0, 0.0);
        let cradle = Stand {
            at: Vector3::from(CRADLE) + along,
            turn: Turn::To(lying()),
            retreat: 0.05,
            lift: 0.05,
            tight: false,
        };
        let holder = Stand {
            at: seat() + scatter(rng, 0.15 * self.clearance.min(noise)),
            turn: Turn::To(UnitQuaternion::identity()),
            lift: RIM - FLOOR + 0.012,
            tight: true,
            ..cradle
        };
        Box::new(pick_place(move |_| ordered(direction, cradle, holder), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.demonstrator
    }
}
