use crate::{assert_success, example, text};
use auto_e2h::core::{Direction, Episode};
use auto_e2h::data::HandRecording;
use auto_e2h::data::lerobot::Dataset;
use auto_e2h::env::{Env, EnvConfig, TaskOptions, demonstration_stream, replay, task};
use auto_e2h::teleop::{Control, Event, Phase, Session, Settings, Sticks};
use nalgebra::Vector3;
use std::f64::consts::{FRAC_PI_2, PI};
use std::path::Path;

const PAIR: &str = "nut_assembly";

/// What the smoke preset's cameras see.
fn config() -> EnvConfig {
    EnvConfig { image_size: 32, ..EnvConfig::default() }
}

fn open(pair: &str, variant: &str, out: &Path) -> auto_e2h::teleop::Result<Session> {
    let options = TaskOptions { variant: variant.to_owned(), ..TaskOptions::default() };
    Session::open(task(pair, &options).unwrap(), &config(), Settings::new(Direction::Easy, out.to_owned()))
}

/// A person: holds keys or pushes sticks until the hand is where it should be.
struct Hand {
    session: Session,
    held: Vec<Control>,
    clock: f64,
}

fn yaw(pose: &auto_e2h::core::Pose) -> f64 {
    let x = pose.orientation * Vector3::x();
    x.y.atan2(x.x)
}

impl Hand {
    fn new(session: Session) -> Self {
        Self { session, held: vec![], clock: 100.0 }
    }

    /// A control step with these keys down.
    fn hold(&mut self, keys: &[Control]) {
        let mut events: Vec<Event> =
            self.held.iter().filter(|k| !keys.contains(k)).map(|k| Event::Release(*k)).collect();
        events.extend(keys.iter().map(|k| Event::Press(*k)));
        self.held = keys.to_vec();
        self.step(&events);
    }

    fn step(&mut self, events: &[Event]) {
        self.session.step(events, self.clock).unwrap();
        self.clock += 0.05;
    }

    fn tap(&mut self, key: Control) {
        self.hold(&[key]);
        self.hold(&[]);
    }

    fn wait(&mut self, steps: usize) {
        (0..steps).for_each(|_| self.hold(&[]));
    }

    fn error(&self, to: Vector3<f64>, turned: f64) -> (Vector3<f64>, f64) {
        let goal = self.session.env().sim().goal();
        (to - goal.position, turned - yaw(&goal))
    }

    /// With keys: fast while it is far, slowly when it is near.
    fn go(&mut self, to: Vector3<f64>, turned: f64) {
        for _ in 0..400 {
            let (way, turn) = self.error(to, turned);
            let far = way.abs().max() > 0.04 || turn.abs() > 0.2;
            let (least, least_turn) = if far { (0.03, 0.15) } else { (0.0025, 0.02) };
            let pairs = [
                (way.x, least, Control::Forward, Control::Back),
                (way.y, least, Control::Left, Control::Right),
                (way.z, least, Control::Up, Control::Down),
                (turn, least_turn, Control::TurnLeft, Control::TurnRight),
            ];
            let mut keys: Vec<Control> = pairs
                .into_iter()
                .filter(|(error, least, ..)| error.abs() > *least)
                .map(|(error, _, plus, minus)| if error > 0.0 { plus } else { minus })
                .collect();
            if keys.is_empty() {
                return self.wait(3);
            }
            keys.extend((!far).then_some(Control::Slow));
            self.hold(&keys);
        }
        panic!("the hand does not come to {to}: {:?}", self.session.status());
    }

    /// The same with the sticks of a gamepad.
    fn push(&mut self, to: Vector3<f64>, turned: f64) {
        for _ in 0..400 {
            let (way, turn) = self.error(to, turned);
            if way.abs().max() < 0.006 && turn.abs() < 0.04 {
                self.step(&[Event::Sticks(Sticks::default())]);
                return self.wait(3);
            }
            let stick = |error: f64| (error * 10.0).clamp(-1.0, 1.0);
            // Sticks near their middle are at rest.
            let stick =
                |error: f64| if error.abs() < 0.003 { 0.0 } else { stick(error) + 0.13 * error.signum() };
            let sticks = Sticks {
                forward: stick(way.x),
                left: stick(way.y),
                up: stick(way.z),
                turn: stick(turn * 0.5),
            };
            self.step(&[Event::Sticks(sticks)]);
        }
        panic!("the hand does not come to {to}: {:?}", self.session.status());
    }

    fn object(&self) -> auto_e2h::core::Pose {
        self.session.env().sim().object()
    }

    /// Takes the loose nut off its peg by the handle and puts it down where the hard task starts.
    fn take_the_nut_off(&mut self) {
        let nut = self.object();
        let along = yaw(&nut);
        let turned = along - PI * (along / PI).round();
        let handle = nut.position + Vector3::new(along.cos(), along.sin(), 0.0) * 0.14;
        self.go(Vector3::new(handle.x, handle.y, 0.15), turned);
        self.go(Vector3::new(handle.x, handle.y, 0.016), turned);
        self.tap(Control::Gripper);
        self.wait(8);
        self.go(Vector3::new(handle.x, handle.y, 0.19), turned);
        let handle = Vector3::new(0.51 - 0.14, -0.15, 0.19);
        self.go(handle, 0.0);
        self.go(Vector3::new(handle.x, handle.y, 0.018), 0.0);
        self.tap(Control::Gripper);
        self.wait(8);
        for _ in 0..100 {
            self.hold(&[Control::Home]);
        }
        self.wait(2);
    }
}

fn read(out: &Path) -> Vec<Episode> {
    let dataset = Dataset::open(out).unwrap();
    (0..dataset.len()).map(|i| dataset.read_episode(i).unwrap()).collect()
}

#[test]
fn keys_take_the_nut_off_the_peg_and_a_run_learns_from_it() {
    let dir = tempfile::tempdir().unwrap();
    let (out, run) = (dir.path().join("by_hand"), dir.path().join("run"));
    let mut hand = Hand::new(open(PAIR, "loose", &out).unwrap());
    // Practice leaves nothing, and what is not recorded cannot be saved.
    hand.go(Vector3::new(0.45, -0.1, 0.2), 0.3);
    hand.tap(Control::Save);
    assert_eq!((hand.session.status().phase, hand.session.status().rows), (Phase::Practice, 0));
    hand.tap(Control::Record);
    assert!(hand.session.status().from_home < 1e-3, "a take begins at home");
    // Not done is not saved.
    hand.wait(10);
    hand.tap(Control::Save);
    let status = hand.session.status();
    assert!(status.phase == Phase::Recording && status.note.contains("not done"), "{status:?}");
    hand.tap(Control::Discard);
    assert!(!out.join("meta").exists(), "a discarded take left something");

    hand.tap(Control::Record);
    hand.take_the_nut_off();
    let status = hand.session.status();
    assert!(status.success && status.from_home < 2e-3, "{status:?}");
    hand.tap(Control::Save);
    let status = hand.session.status();
    assert_eq!((status.phase, status.saved), (Phase::Practice, 1), "{status:?}");

    // It is whole at once, and says how long it took.
    let [episode] = &read(&out)[..] else { panic!("one episode") };
    assert!(episode.outcome.is_success() && episode.terminal && episode.origin.episode == 1);
    let recording = HandRecording::read(&out).unwrap().unwrap();
    let [take] = &recording.takes[..] else { panic!("one take") };
    assert_eq!((&*recording.variant, take.episode, take.discarded), ("loose", 0, 1));
    assert!((take.seconds - 0.05 * (episode.len() as f64)).abs() < 0.06, "{take:?}");
    assert!(take.cost_seconds > take.seconds + 1.0, "{take:?}");
    // Goals are absolute, near the hand, and no faster than they may be.
    for t in 1..episode.len() {
        let (a, b, s) = (&episode.action[t - 1], &episode.action[t], &episode.state[t]);
        let apart = |p: &[f32], q: &[f32]| p.iter().zip(q).map(|(x, y)| (x - y).powi(2)).sum::<f32>().sqrt();
        assert!(apart(&a[..3], &b[..3]) < 0.0101 && apart(&b[..3], &s[..3]) < 0.035, "row {t}");
        assert!(apart(&a[3..7], &b[3..7]) < 0.05, "row {t}: a quaternion jumps");
    }
    // The recorded actions do it again from the start that seed and number say.
    let mut env = Env::new(task(PAIR, &TaskOptions::default()).unwrap(), &EnvConfig::blind()).unwrap();
    let origin = &episode.origin;
    env.reset(Direction::Easy, &mut demonstration_stream(origin.seed, Direction::Easy, origin.episode))
        .unwrap();
    assert_eq!(env.state(), episode.state[0]);
    let again = replay(&mut env, &episode.action).unwrap().unwrap();
    assert!(again.is_success(), "{again:?}");

    // A second session goes on with the dataset, as a third whose process was killed in a take.
    drop(hand);
    let mut hand = Hand::new(open(PAIR, "loose", &out).unwrap());
    hand.tap(Control::Record);
    hand.wait(5);
    std::fs::write(out.join("data/chunk-000/.new-123"), "half a file").unwrap();
    drop(hand);
    let mut hand = Hand::new(open(PAIR, "loose", &out).unwrap());
    hand.tap(Control::Record);
    hand.take_the_nut_off();
    hand.tap(Control::Save);
    assert_eq!(hand.session.status().saved, 2, "{:?}", hand.session.status());
    assert_eq!(read(&out).iter().map(|e| e.origin.episode).collect::<Vec<_>>(), [1, 2]);

    let output = example(PAIR)
        .args(["--preset", "smoke", "--quiet", "--set=loop.iterations=0", "--demonstrations"])
        .arg(&out)
        .arg("--out")
        .arg(&run)
        .args(crate::SMALL)
        .output()
        .unwrap();
    assert_success(&output);
    let (given, mine) = (read(&run.join("demonstrations")), read(&out));
    assert!(given.len() == 2 && given[1].state == mine[1].state && given[1].action == mine[1].action);
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(
        page.contains("2 of 2 episodes of") && page.contains("s each by the clock"),
        "the page says nothing"
    );
    // The square nut is another task.
    let output = example(PAIR)
        .args(["--preset", "smoke", "--set=task.variant=square", "--demonstrations"])
        .arg(&out)
        .arg("--out")
        .arg(dir.path().join("square"))
        .output()
        .unwrap();
    assert!(!output.status.success());
    assert!(text(&output.stderr).contains("recorded variant: expected square, found loose"));
}

#[test]
fn sticks_take_the_cube_out_of_the_tray() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("by_hand");
    let mut hand = Hand::new(open("cube_pick_place", "", &out).unwrap());
    hand.tap(Control::Record);
    let cube = hand.object();
    let turned = yaw(&cube) - FRAC_PI_2 * (yaw(&cube) / FRAC_PI_2).round();
    let above = Vector3::new(cube.position.x, cube.position.y, 0.14);
    hand.push(above, turned);
    hand.push(cube.position + Vector3::new(0.0, 0.0, 0.004), turned);
    hand.tap(Control::Gripper);
    hand.wait(8);
    hand.push(above, turned);
    let lifted = hand.object().position.z - cube.position.z;
    assert!(lifted > 0.08, "the cube was lifted by {lifted} m");
    // To where hard episodes start.
    let pair = task("cube_pick_place", &TaskOptions::default()).unwrap();
    let place = pair.put_down(&above);
    let middle = place + (Vector3::new(0.5, -0.12, 0.0) - place) * 0.5;
    let target = pair.put_down(&middle);
    hand.push(Vector3::new(target.x, target.y, 0.14), 0.0);
    hand.push(Vector3::new(target.x, target.y, 0.029), 0.0);
    hand.tap(Control::Gripper);
    hand.wait(8);
    for _ in 0..100 {
        hand.hold(&[Control::Home]);
    }
    assert!(
        hand.session.status().success,
        "{:?}, the cube is at {}",
        hand.session.status(),
        hand.object().position
    );
    hand.tap(Control::Save);
    assert_eq!(read(&out).len(), 1);
}

#[test]
fn a_disk_that_refuses_loses_nothing_and_a_folder_of_something_else_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("by_hand");
    let mut hand = Hand::new(open(PAIR, "loose", &out).unwrap());
    // Nobody else may record into it meanwhile.
    let busy = open(PAIR, "loose", &out).err().unwrap().to_string();
    assert!(busy.contains("by another process"), "{busy}");
    hand.tap(Control::Record);
    hand.take_the_nut_off();
    hand.tap(Control::Save);
    hand.tap(Control::Record);
    hand.take_the_nut_off();
    // In the way of the next file, so that it cannot be put there.
    let block = out.join("data/chunk-000/file-001.parquet");
    std::fs::create_dir_all(block.join("full")).unwrap();
    hand.tap(Control::Save);
    let status = hand.session.status();
    assert!(status.phase == Phase::Unsaved && status.note.starts_with("not saved:"), "{status:?}");
    let rows = status.rows;
    assert_eq!(read(&out).len(), 1);
    // Whatever is touched, it is kept.
    for key in [Control::Record, Control::Reset, Control::Gripper, Control::Save] {
        hand.tap(key);
    }
    hand.wait(20);
    assert_eq!((hand.session.status().phase, hand.session.status().rows), (Phase::Unsaved, rows));
    std::fs::remove_dir_all(&block).unwrap();
    // And half way through: the rows are there, and are not counted.
    let block = out.join("meta/episodes/chunk-000/file-001.parquet");
    std::fs::create_dir_all(block.join("full")).unwrap();
    hand.tap(Control::Save);
    assert_eq!((hand.session.status().phase, read(&out).len()), (Phase::Unsaved, 1));
    std::fs::remove_dir_all(&block).unwrap();
    hand.tap(Control::Save);
    assert_eq!(hand.session.status().saved, 2, "{:?}", hand.session.status());
    let episodes = read(&out);
    assert!(episodes.len() == 2 && episodes[1].len() == rows && episodes[1].outcome.is_success());
    drop(hand);

    let refused = |result: auto_e2h::teleop::Result<Session>, words: &[&str]| {
        let message = result.err().expect("a refusal").to_string();
        assert!(words.iter().all(|w| message.contains(w)), "{words:?} in {message}");
    };
    let before = std::fs::read(out.join("recording.json")).unwrap();
    refused(open("disk", "", &out), &["task: expected disk, found nut_assembly", "--out"]);
    refused(open(PAIR, "square", &out), &["variant: expected square, found loose"]);
    let pair = task(PAIR, &TaskOptions::default()).unwrap();
    let hard = Settings::new(Direction::Hard, out.clone());
    refused(Session::open(pair.clone(), &config(), hard), &["direction: expected hard, found easy"]);
    let sharper = EnvConfig { image_size: 48, ..config() };
    let settings = Settings::new(Direction::Easy, out.clone());
    refused(Session::open(pair, &sharper, settings), &["images of 48 x 48, found 32 x 32", "wrist"]);
    assert_eq!(std::fs::read(out.join("recording.json")).unwrap(), before);
    let holiday = dir.path().join("holiday");
    std::fs::create_dir(&holiday).unwrap();
    std::fs::write(holiday.join("photo.jpg"), "mine").unwrap();
    refused(open(PAIR, "loose", &holiday), &["photo.jpg"]);
    assert_eq!(std::fs::read_dir(&holiday).unwrap().count(), 1);
}
