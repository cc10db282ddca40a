//! A task pair of one's own, outside the library: a block goes onto a pedestal (hard) and comes down again (easy).
//!
//! ```text
//! cargo run --release --example own_task -- --preset smoke
//! cargo run --release --example own_task -- --seed 1 --set loop.cycles=20
//! ```
//!
//! A pair is a scene, a start and a goal for each direction, a scripted demonstrator, and a few lines of configuration.

mod common;

use auto_e2h::core::{Direction, Pose, Rng};
use auto_e2h::env::toolkit::{
    Region, Stand, Symmetry, Turn, beside, down, draw, from_above, left_alone, near_middle, ordered,
    pick_place, scatter, turn,
};
use auto_e2h::env::{self, DemonstratorConfig, Expert, Sim, TableCamera, Task, compose};
use auto_e2h::learn::Parts;
use common::Run;
use nalgebra::Vector3;
use std::process::ExitCode;
use std::sync::Arc;

/// Laid over the preset, as files in configs/tasks are.
const CONFIG: &str = r#"
    [task]
    name = "block_on_pedestal"

    [loop]
    demonstrations = 6
"#;

/// Half an edge of the block, m.
const HALF: f64 = 0.02;
/// Where it starts on the table, m.
const START: Region = Region { x: [0.46, 0.54], y: [-0.14, -0.06] };
/// Middle of the pedestal, m, its height, and how far from the middle the block may stand.
const PEDESTAL: [f64; 2] = [0.56, 0.10];
const HEIGHT: f64 = 0.03;
const NEAR: f64 = 0.025;

struct BlockOnPedestal(DemonstratorConfig);

fn seat() -> Vector3<f64> {
    Vector3::new(PEDESTAL[0], PEDESTAL[1], HEIGHT + HALF)
}

impl Task for BlockOnPedestal {
    fn name(&self) -> &str {
        "block_on_pedestal"
    }

    fn scene(&self) -> String {
        let ([x, y], half) = (PEDESTAL, HEIGHT / 2.0);
        let bodies = format!(
            r#"<body name="block" pos=".5 -.1 {HALF}"><freejoint/>
              <geom class="item" type="box" size="{HALF} {HALF} {HALF}" density="900" rgba=".95 .65 .10 1"/>
            </body>
            <body name="pedestal" pos="{x} {y} {half}">
              <geom class="holder" type="box" size=".05 .05 {half}" rgba=".35 .40 .45 1"/>
            </body>"#
        );
        compose(&bodies, &TableCamera::default())
    }

    fn object(&self) -> &str {
        "block"
    }

    fn home(&self) -> Pose {
        Pose::new(Vector3::new(0.52, 0.0, 0.21), down(0.0))
    }

    fn horizon(&self, _: Direction) -> usize {
        300
    }

    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> env::Result<()> {
        let position = match direction {
            Direction::Hard => START.draw(rng, HALF),
            Direction::Easy => seat() + near_middle(rng, 0.8 * NEAR),
        };
        sim.set_object(&Pose::new(position, turn(draw(rng, [-0.5, 0.5]))))
    }

    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        let p = sim.object().position;
        match direction {
            Direction::Hard => sim.released() && beside(&p, &seat()) < NEAR && (p.z - seat().z).abs() < 0.005,
            Direction::Easy => left_alone(sim) && START.contains(&p) && p.z < HALF + 0.005,
        }
    }

    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        START.nearest(p)
    }

    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        let yaw = draw(rng, [-0.5, 0.5]);
        let table = Stand::open(START.draw(rng, HALF), Turn::Hand(yaw));
        let pedestal = Stand::open(seat() + scatter(rng, config.waypoint_noise_m), Turn::Hand(yaw));
        let grasp = |block: &Pose| from_above(block, 0.0, Symmetry::Four);
        Box::new(pick_place(move |_| ordered(direction, table, pedestal), grasp, config, rng))
    }

    fn demonstrator(&self) -> &DemonstratorConfig {
        &self.0
    }
}

fn main() -> ExitCode {
    let build = Arc::new(|options: &env::TaskOptions| -> env::Result<Arc<dyn Task>> {
        Ok(Arc::new(BlockOnPedestal(options.demonstrator.clone())))
    });
    let parts = Parts { task: Some((CONFIG.to_owned(), build)), ..Parts::default() };
    common::main("block_on_pedestal", parts, Run::learn)
}
