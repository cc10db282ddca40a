//! The robot's side of serving: what its driver does with a policy server.

use crate::record::place;
use crate::robot::{HZ, OPEN, Robot};
use anyhow::{Context as _, ensure};
use auto_e2h::core::{Image, Outcome, say, stream};
use auto_e2h::report::animation;
use auto_e2h::report::record::wilson95;
use auto_e2h::serve::wire::{Array, Value};
use auto_e2h::serve::{Client, ClientSettings};
use std::collections::VecDeque;
use std::path::Path;

/// Rate of the policy, Hz: what `refine --fps` brought the recordings to. The robot's own is twice that.
const POLICY_HZ: f64 = 15.0;
/// Opening that `refine` scales a fully open gripper to, m.
const OPEN_M: f64 = 0.08;
/// Numbers of a state: pose and opening as `refine` writes them, then the robot's own six.
const STATE: usize = 14;
/// Longest trial, s, and how long the plug has to stay in, control steps.
const LONGEST_S: f64 = 40.0;
const HOLD: usize = 10;
/// Trials in an animation.
const FILMED: usize = 6;

/// What the policy sees of the robot: the state in the units that it was trained in, and the picture.
#[derive(Clone)]
struct Seen {
    state: [f32; STATE],
    image: Image,
}

fn look(robot: &Robot) -> Seen {
    let metres = robot.hand.map(|v| v / 1000.0);
    // `--rotation none`: the hand does not turn.
    let pose = metres.into_iter().chain([1.0, 0.0, 0.0, 0.0, OPEN_M * robot.jaw / OPEN]);
    let mut state = [0.0; STATE];
    // Networks compute in 32 bits.
    let all = pose.map(|v| v as f32).chain(robot.state());
    state.iter_mut().zip(all).for_each(|(slot, v)| *slot = v);
    Seen { state, image: robot.image() }
}

/// Runs `trials` and says how many succeeded.
pub(crate) fn run(server: &str, trials: usize, seed: u64, video: Option<&Path>) -> anyhow::Result<()> {
    ensure!(trials > 0, "--trials: expected at least 1, got 0");
    let mut client = Client::connect(&ClientSettings::new(server)).context("is the server running?")?;
    let history = client.metadata().get("n_obs_steps").and_then(Value::as_usize).unwrap_or(1);
    let width = client.metadata().get("state_width").and_then(Value::as_usize);
    ensure!(
        width.is_none_or(|w| w == STATE),
        "the server's policy: expected {STATE} numbers of state (pose, opening, the robot's six), found {}",
        width.unwrap_or_default()
    );
    let (mut done, mut films) = (0, vec![]);
    for trial in 0..trials {
        let mut robot = Robot::new(place(&mut stream(seed, "trial", 0, trial as u64)));
        let mut film = (video.is_some() && trial < FILMED).then(Vec::new);
        let success = one(&mut client, &mut robot, history, seed + trial as u64, film.as_mut())?;
        done += usize::from(success);
        let outcome = if success { Outcome::Success { at: 0 } } else { Outcome::Timeout };
        films.extend(film.map(|frames| (outcome, frames)));
        say(format_args!("trial {trial}: {}", if success { "the plug is in" } else { "failed" }))?;
    }
    if let Some(path) = video {
        let (outcomes, frames): (Vec<_>, Vec<_>) = films.into_iter().unzip();
        animation::write_apng(path, &animation::tile(&frames, &outcomes, 3), 10)?;
    }
    let [lo, hi] = wilson95(done, trials);
    Ok(say(format_args!(
        "{done} of {trials} trials succeeded, 95 % Wilson interval {:.0} to {:.0} %",
        100.0 * lo,
        100.0 * hi
    ))?)
}

fn one(
    client: &mut Client,
    robot: &mut Robot,
    history: usize,
    seed: u64,
    mut film: Option<&mut Vec<Image>>,
) -> anyhow::Result<bool> {
    // Control steps of the robot to one of the policy.
    let ticks = (HZ / POLICY_HZ).round() as usize;
    let mut seen: VecDeque<Seen> = std::iter::repeat_n(look(robot), history).collect();
    let (mut held, mut steps, mut chunk) = (0, 0, VecDeque::new());
    while (steps as f64) < LONGEST_S * POLICY_HZ {
        if chunk.is_empty() {
            chunk = ask(client, &seen, seed.wrapping_mul(1_000_003) + steps as u64)?;
        }
        let Some([x, y, z, jaw]) = chunk.pop_front() else { break };
        if let Some(film) = film.as_mut().filter(|_| steps % 3 == 0) {
            film.push(enlarged(&robot.image()));
        }
        for _ in 0..ticks {
            robot.step([x, y, z], jaw);
            held = if robot.plugged_in() { held + 1 } else { 0 };
        }
        if held >= HOLD {
            return Ok(true);
        }
        seen.pop_front();
        seen.push_back(look(robot));
        steps += 1;
    }
    Ok(false)
}

/// The picture three times as large, for people.
fn enlarged(image: &Image) -> Image {
    let (height, width) = (3 * image.height, 3 * image.width);
    let pixel = |i: usize| &image.data[(i / width / 3 * image.width + i % width / 3) * 3..][..3];
    let data = (0..height * width).flat_map(|i| pixel(i).iter().copied()).collect();
    Image { height, width, data }
}

/// The next goals, in the robot's own units: x, y, z and jaws, mm.
fn ask(client: &mut Client, seen: &VecDeque<Seen>, seed: u64) -> anyhow::Result<VecDeque<[f64; 4]>> {
    let states: Vec<f32> = seen.iter().flat_map(|s| s.state).collect();
    let images: Vec<Array> = seen.iter().map(|s| Array::image(&s.image)).collect();
    let images = Array::stack(&images).context("no picture")?;
    let request = Value::map([
        ("observation/state", Array::f32(&[seen.len(), STATE], &states).into()),
        ("observation/images/above", images.into()),
        ("prompt", "plug it in".into()),
        ("seed", seed.into()),
    ]);
    let reply = client.infer(&request)?;
    let Some(Value::Array(actions)) = reply.get("actions") else {
        anyhow::bail!("the server's answer: expected `actions`, found none");
    };
    let (rows, width) = match *actions.shape() {
        [rows, width] if rows > 0 && width == 8 => (actions.to_f32(), width),
        _ => anyhow::bail!("the server's answer: expected `actions` of shape [T, 8], found {actions}"),
    };
    let goal = |row: &[f32]| {
        let [x, y, z] = [0, 1, 2].map(|i| 1000.0 * f64::from(row[i]));
        [x, y, z, if row[7] > 0.5 { OPEN } else { 0.0 }]
    };
    Ok(rows.chunks_exact(width).map(goal).collect())
}
