//! Records demonstrations by hand: keys or a gamepad steer the arm in MuJoCo's window, and what succeeds goes into a dataset.
//!
//! ```text
//! cargo run --release --features viewer --example teleop -- --task nut_assembly --direction easy --out recordings/nut
//! cargo run --release --example nut_assembly -- --demonstrations recordings/nut
//! ```
//!
//! The same command goes on with the same folder. The window lists keys and buttons.

use auto_e2h::core::Direction;
use clap::{Parser, ValueEnum};
use std::path::PathBuf;

#[derive(Clone, Copy, ValueEnum)]
enum Side {
    /// The task that runs learn from.
    Easy,
    /// The task that undoes it.
    Hard,
}

/// Records demonstrations by hand.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --features viewer --example teleop -- --task nut_assembly --direction easy --out recordings/nut\n  \
                  cargo run --release --example nut_assembly -- --demonstrations recordings/nut"
)]
struct Arguments {
    /// Task pair.
    #[arg(long)]
    task: String,
    /// Which task of the pair.
    #[arg(long, value_enum, default_value = "easy")]
    direction: Side,
    /// Folder of the dataset; one of the same task is gone on with.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The preset whose image size and scene are recorded: what the run will have.
    #[arg(long, default_value = "laptop")]
    preset: String,
    /// Override a value of the configuration, for example task.variant=square (may be repeated).
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Seed of the starts.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Largest speed of the hand, m/s.
    #[arg(long, default_value_t = 0.2)]
    speed: f64,
    /// Print a line of JSON every control step: where goal and object are, and what is recorded.
    #[arg(long)]
    trace: bool,
}

/// Control steps from one picture to the next, at most.
#[cfg(feature = "viewer")]
const MOST_STEPS: usize = 8;

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program(&Arguments::parse())?)
}

fn program(a: &Arguments) -> anyhow::Result<()> {
    let direction = match a.direction {
        Side::Easy => Direction::Easy,
        Side::Hard => Direction::Hard,
    };
    record(a, direction)
}

#[cfg(not(feature = "viewer"))]
fn record(_: &Arguments, _: Direction) -> anyhow::Result<()> {
    anyhow::bail!("this program was built without a window: build it with --features viewer")
}

#[cfg(feature = "viewer")]
fn record(a: &Arguments, direction: Direction) -> anyhow::Result<()> {
    use auto_e2h::core::{CONTROL_HZ, say};
    use auto_e2h::env::{Key, Window};
    use auto_e2h::learn::RunConfig;
    use auto_e2h::teleop::{Event, Gamepads, Limits, Session, Settings, key};
    use std::time::{Duration, Instant};

    let config = RunConfig::resolve(&a.preset, &a.task, &a.set)?.config;
    let task = auto_e2h::env::task(&a.task, &config.task.options())?;
    let settings = Settings {
        seed: a.seed,
        clearance: config.task.clearance,
        limits: Limits { speed: a.speed, ..Limits::default() },
        ..Settings::new(direction, a.out.clone())
    };
    let mut session = Session::open(task, &config.env, settings)?;
    let title = format!("{} ({direction}), {}", a.task, a.out.display());
    let mut window = Window::open(session.env().sim(), &title)?;
    let mut gamepads = Gamepads::new();
    for name in gamepads.names() {
        say(format_args!("gamepad: {name}"))?;
    }
    say(format_args!("{} demonstrations in {}", session.status().saved, a.out.display()))?;

    let clock = Instant::now();
    let step = Duration::from_secs_f64(1.0 / CONTROL_HZ);
    let (mut due, mut events, mut note) = (clock + step, vec![], String::new());
    while window.is_open() {
        for touched in window.show(session.env().sim(), panel(&session.status(), direction))? {
            events.extend(match touched {
                Key::Is(name, true) => key(name).map(Event::Press),
                Key::Is(name, false) => key(name).map(Event::Release),
                Key::None => Some(Event::ReleaseAll),
            });
        }
        events.extend(gamepads.poll());
        // Where a picture takes longer than a control step, several steps follow it: the arm is as fast as ever.
        for _ in 0..MOST_STEPS {
            if Instant::now() < due {
                break;
            }
            session.step(&events, clock.elapsed().as_secs_f64())?;
            events.clear();
            due += step;
            let status = session.status();
            if a.trace {
                say(trace(&session))?;
            }
            if status.note != note {
                say(&status.note)?;
                note = status.note;
            }
        }
        // A machine that is too slow even so does not hurry afterwards.
        due = due.max(Instant::now().checked_sub(step).unwrap_or(due));
        std::thread::sleep(due.saturating_duration_since(Instant::now()).min(Duration::from_millis(8)));
    }
    say(format_args!("{} demonstrations in {}", session.status().saved, a.out.display()))?;
    Ok(())
}

/// A control step for a program that watches.
#[cfg(feature = "viewer")]
fn trace(session: &auto_e2h::teleop::Session) -> serde_json::Value {
    let (status, sim) = (session.status(), session.env().sim());
    let yaw = |pose: &auto_e2h::core::Pose| {
        let x = pose.orientation * nalgebra::Vector3::x();
        x.y.atan2(x.x)
    };
    let (goal, object) = (sim.goal(), sim.object());
    let [g, o] = [goal.position, object.position];
    serde_json::json!({
        "goal": [g.x, g.y, g.z],
        "yaw": yaw(&goal),
        "object": [o.x, o.y, o.z, yaw(&object)],
        "phase": format!("{:?}", status.phase),
        "success": status.success,
        "open": status.open,
        "saved": status.saved,
        "rows": status.rows,
        "from_home": status.from_home,
    })
}

/// What the window says.
#[cfg(feature = "viewer")]
fn panel(status: &auto_e2h::teleop::Status, direction: Direction) -> auto_e2h::env::Panel {
    use auto_e2h::teleop::{BINDINGS, Phase};
    let phase = match status.phase {
        Phase::Practice => "practice".to_owned(),
        Phase::Recording => format!("RECORDING {:.1} s, {} steps", status.seconds, status.rows),
        Phase::Unsaved => "NOT SAVED".to_owned(),
    };
    let done = match (status.success, status.from_home > 0.01) {
        (false, _) => format!("{direction} task: not done"),
        (true, true) => "SUCCESS: now home".to_owned(),
        (true, false) => "SUCCESS".to_owned(),
    };
    let gripper = if status.open { "open" } else { "closed" };
    let state =
        format!("{} saved, gripper {gripper}, {:.0} cm from home", status.saved, 100.0 * status.from_home);
    let bindings =
        BINDINGS.iter().map(|b| [format!("{:<9}{}", b.keys.join(" "), b.button), b.words.to_owned()]);
    let rows = bindings.chain([["Ctrl+Q".to_owned(), "quit".to_owned()]]).collect();
    auto_e2h::env::Panel {
        head: vec![phase, done, state],
        good: status.success,
        note: status.note.clone(),
        rows,
    }
}
