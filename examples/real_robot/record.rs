//! Recording the easy task, as a person at the controls does it: pull the plug out, lay it down somewhere, go home.

use crate::robot::{HOME, HZ, IMAGE, OPEN, Robot, SOCKET};
use anyhow::ensure;
use auto_e2h::core::{Rng, say, stream};
use auto_e2h::data::lerobot::{Column, Dtype, Feature, Features, Table, Writer, encode_png};
use rand::Rng as _;
use std::path::Path;

/// Columns of the recording. The pose is there in metres as well: what turns a recording round has to know lengths.
fn features() -> Features {
    vec![
        (
            "observation.state".to_owned(),
            Feature::vector(&["jaw_mm", "z_mm", "y_mm", "x_mm", "plug_y_mm", "plug_x_mm"]),
        ),
        ("observation.tcp_m".to_owned(), Feature::vector(&["x", "y", "z"])),
        ("action".to_owned(), Feature::vector(&["x_mm", "y_mm", "z_mm", "jaw_mm"])),
        ("observation.images.above".to_owned(), Feature::image(IMAGE.0, IMAGE.1)),
        ("next.success".to_owned(), Feature::scalar(Dtype::Bool)),
    ]
}

/// Where the plug may be put, mm: on the table and clear of the socket.
pub(crate) fn place(rng: &mut Rng) -> [f64; 2] {
    loop {
        let p = [rng.random_range(160.0..440.0), rng.random_range(-200.0..200.0)];
        if (p[0] - SOCKET[0]).hypot(p[1] - SOCKET[1]) > 90.0 {
            return p;
        }
    }
}

/// Records `episodes` into `root`. Each is written as it ends: one that is cut off takes no other with it.
pub(crate) fn record(root: &Path, episodes: usize, seed: u64) -> anyhow::Result<()> {
    let mut writer = Writer::create(root, HZ, Some("gantry"), features())?;
    for episode in 0..episodes {
        let mut rng = stream(seed, "record", 0, episode as u64);
        let (table, done) = demonstration(&mut rng)?;
        ensure!(done, "episode {episode}: the plug is not out");
        let seconds = table.rows as f64 / HZ;
        writer.push(&table, "pull the plug out")?;
        say(format_args!("episode {episode}: {} rows, {seconds:.1} s", table.rows))?;
    }
    writer.finish()?;
    Ok(())
}

fn demonstration(rng: &mut Rng) -> anyhow::Result<(Table, bool)> {
    let mut robot = Robot::new(SOCKET);
    let [x, y] = place(rng);
    let mut shaky = |v: f64, by: f64| v + rng.random_range(-by..by);
    let height = shaky(100.0, 15.0);
    let hold = shaky(10.0, 3.0);
    let (dx, dy) = (shaky(0.0, 3.0), shaky(0.0, 3.0));
    let [sx, sy] = [SOCKET[0] + dx, SOCKET[1] + dy];
    // Goal of the hand, jaws, and how long a person takes to think afterwards, control steps.
    let ways: [([f64; 3], f64, usize); 8] = [
        ([sx, sy, height], OPEN, 4),
        ([sx, sy, hold], OPEN, 6),
        ([sx, sy, hold], 0.0, 14),
        ([sx, sy, height], 0.0, 3),
        ([x, y, height], 0.0, 5),
        ([x, y, hold], 0.0, 5),
        ([x, y, hold], OPEN, 12),
        ([x, y, height], OPEN, 3),
    ];
    let (mut states, mut poses, mut actions, mut images) = (vec![], vec![], vec![], vec![]);
    let mut row = |robot: &mut Robot, goal: [f64; 3], jaw: f64| -> anyhow::Result<()> {
        states.extend(robot.state());
        // Datasets hold 32 bits.
        poses.extend(robot.hand.map(|v| (v / 1000.0) as f32));
        actions.extend([goal[0], goal[1], goal[2], jaw].map(|v| v as f32));
        images.push(encode_png(IMAGE.0, IMAGE.1, &robot.image().data)?);
        robot.step(goal, jaw);
        Ok(())
    };
    for (goal, jaw, pause) in ways.into_iter().chain([(HOME, OPEN, 2)]) {
        // A person pushes the stick no further than it takes.
        let speed = rng.random_range(4.0..7.0);
        loop {
            let from = robot.hand;
            let left = (0..3).map(|i| (goal[i] - from[i]).powi(2)).sum::<f64>().sqrt();
            let share = if left > speed { speed / left } else { 1.0 };
            row(&mut robot, std::array::from_fn(|i| from[i] + (goal[i] - from[i]) * share), jaw)?;
            if left <= speed {
                break;
            }
        }
        // Now and then for more than a second: that is what the kinematic filter is for.
        let thinks =
            if rng.random::<f64>() < 0.3 { rng.random_range(25..50) } else { rng.random_range(0..8) };
        for _ in 0..pause + thinks {
            row(&mut robot, goal, jaw)?;
        }
    }
    let (rows, done) = (images.len(), robot.unplugged());
    let columns = vec![
        ("observation.state".to_owned(), Column::F32(states)),
        ("observation.tcp_m".to_owned(), Column::F32(poses)),
        ("action".to_owned(), Column::F32(actions)),
        ("observation.images.above".to_owned(), Column::Png(images)),
        ("next.success".to_owned(), Column::Bool((0..rows).map(|t| done && t + 1 == rows).collect())),
    ];
    Ok((Table { rows, columns }, done))
}
