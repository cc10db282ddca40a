use crate::{assert_success, example, text};
use auto_e2h::data::lerobot::{Column, Feature, Table, Writer, encode_png};
use auto_e2h::policy::lerobot::import;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Recordings of an arm of 3 joints at 30 Hz, driven by 2 numbers, with a wide camera and a small one.
fn record(root: &Path, episodes: usize, fps: f64, action: &[&str]) -> PathBuf {
    let features = vec![
        ("observation.state".to_owned(), Feature::vector(&["base", "elbow", "jaw"])),
        ("action".to_owned(), Feature::vector(action)),
        ("observation.images.front".to_owned(), Feature::image(40, 56)),
        ("observation.images.hand".to_owned(), Feature::image(48, 48)),
    ];
    let mut writer = Writer::create(root, fps, Some("arm"), features).unwrap();
    for e in 0..episodes {
        let rows = 24 + e;
        let angle = |t: usize| e as f32 + t as f32 * 0.1;
        let image = |h: usize, w: usize| {
            let picture =
                |t: usize| (0..h * w * 3).map(|i| if i / 3 % w > t { 220 } else { 30 }).collect::<Vec<u8>>();
            Column::Png((0..rows).map(|t| encode_png(h, w, &picture(t)).unwrap()).collect())
        };
        let state = (0..rows).flat_map(|t| [angle(t).sin(), angle(t).cos(), 0.5]).collect();
        let goal = |t: usize| (0..action.len()).map(move |i| 90.0 * angle(t + 1 + i).sin());
        let columns = vec![
            ("observation.state".to_owned(), Column::F32(state)),
            ("action".to_owned(), Column::F32((0..rows).flat_map(goal).collect())),
            ("observation.images.front".to_owned(), image(40, 56)),
            ("observation.images.hand".to_owned(), image(48, 48)),
        ];
        writer.push(&Table { rows, columns }, "wave").unwrap();
    }
    writer.finish().unwrap();
    root.to_owned()
}

fn train(dataset: &[String], out: &Path) -> Command {
    let mut command = example("train");
    command.args([
        "--preset",
        "smoke",
        "--quiet",
        "--set=data.resize=[40,56]",
        "--set=data.crop=[36,50]",
        "--out",
    ]);
    command.arg(out);
    for d in dataset {
        command.args(["--dataset", d]);
    }
    command
}

/// All files of a training by their names, but for the name of a process.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            let path = entry.path();
            let name = path.strip_prefix(root).unwrap().to_owned();
            if path.is_symlink() {
                found.insert(name, std::fs::read_link(&path).unwrap().into_os_string().into_encoded_bytes());
            } else if path.is_dir() {
                folders.push(path);
            } else if name != Path::new("run.lock") {
                found.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

#[test]
fn train_learns_from_datasets_of_an_unknown_robot_and_resumes_to_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let a = record(&dir.path().join("a"), 4, 30.0, &["base", "elbow"]);
    let b = record(&dir.path().join("b"), 3, 30.0, &["base", "elbow"]);
    let datasets = [a.display().to_string(), format!("{}:0.5", b.display())];
    let whole = dir.path().join("whole");
    let output = train(&datasets, &whole).arg("--tensorboard").output().unwrap();
    assert_success(&output);
    let printed = text(&output.stdout);
    assert!(printed.contains("20 steps") && printed.contains("on held-out episodes"), "{printed}");
    let policy = import(&whole.join("checkpoints/last/pretrained_model")).unwrap();
    assert_eq!((policy.state_dim(), policy.action_dim(), policy.image_size()), (3, 2, [40, 56]));
    assert_eq!(policy.provenance().unwrap().run["fps"], 30.0);
    import(&whole.join("checkpoints/best/pretrained_model")).unwrap();
    let svg = std::fs::read_to_string(whole.join("losses.svg")).unwrap();
    assert!(svg.starts_with("<svg") && svg.contains("held-out episodes"));
    std::fs::remove_dir_all(whole.join("tensorboard")).unwrap();

    // Killed as soon as there is something to go on from, and gone on with on another number of threads.
    let killed = dir.path().join("killed");
    let mut child = train(&datasets, &killed).args(["--threads", "1"]).spawn().unwrap();
    let last = killed.join("checkpoints/last");
    while !last.exists() && child.try_wait().unwrap().is_none() {
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert_success(&train(&datasets, &killed).args(["--resume", "--threads", "2"]).output().unwrap());
    let (a, b) = (files(&whole), files(&killed));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    let differ: Vec<_> = a.iter().filter(|(name, bytes)| b[*name] != **bytes).map(|(name, _)| name).collect();
    assert!(differ.is_empty(), "{differ:?}");

    // The same again has nothing to do, and what differs is named.
    assert_success(&train(&datasets, &whole).arg("--resume").output().unwrap());
    let refused = |command: &mut Command| {
        let output = command.output().unwrap();
        assert!(!output.status.success());
        text(&output.stderr)
    };
    assert!(refused(&mut train(&datasets, &whole)).contains("give --resume"));
    let other = refused(train(&datasets, &whole).args(["--resume", "--seed", "5"]));
    assert!(other.contains("seed") && other.contains("expected 5, found 0"), "{other}");
    let other = refused(train(&datasets, &whole).args(["--resume", "--set", "train.steps=30"]));
    assert!(other.contains("steps = 30"), "{other}");
    assert_eq!(files(&whole), a);
    std::fs::write(dir.path().join("b/meta/note.txt"), "more").unwrap();
    let changed = refused(train(&datasets, &whole).arg("--resume"));
    assert!(changed.contains("which has changed"), "{changed}");
}

#[test]
fn train_lists_all_that_does_not_fit_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let a = record(&dir.path().join("a"), 3, 30.0, &["base", "elbow"]).display().to_string();
    let b = record(&dir.path().join("b"), 1, 20.0, &["base", "elbow", "jaw"]).display().to_string();
    let out = dir.path().join("out");
    let refused = |datasets: &[String], more: &[&str]| {
        let output = train(datasets, &out).args(more).output().unwrap();
        assert!(!output.status.success() && !out.exists(), "{}", text(&output.stdout));
        text(&output.stderr)
    };
    let all = refused(&[a.clone(), b.clone()], &[]);
    for part in ["rows a second: expected 30, found 20", "`action`", "expected at least 2 episodes"] {
        assert!(all.contains(part), "{all}");
    }
    let sizes = refused(std::slice::from_ref(&a), &["--set=data.resize=[]"]);
    assert!(sizes.contains("images of one size") && sizes.contains("data.resize"), "{sizes}");
    let small = refused(std::slice::from_ref(&a), &["--set=data.crop=[30,30]"]);
    assert!(small.contains("map of 1 x 1"), "{small}");
    let unknown =
        refused(std::slice::from_ref(&a), &["--set=data.cameras=[\"wrist\"]", "--set=policy.keypoints=8"]);
    assert!(unknown.contains("camera `wrist`") && unknown.contains("observation.images.front"), "{unknown}");
    let network =
        refused(std::slice::from_ref(&a), &["--set=policy.horizon=15", "--set=policy.down_dims=[30]"]);
    assert!(network.contains("horizon") && network.contains("down_dims"), "{network}");
    assert!(refused(&[format!("{a}:0")], &[]).contains("share above 0"));
    assert!(refused(&["nowhere".to_owned()], &[]).contains("nowhere"));
}

/// The worked example, at a size at which nothing is learned: every step of REAL_ROBOT.md runs, and the trials are counted.
#[test]
fn a_robot_of_ones_own_goes_from_its_recordings_to_a_served_policy() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("all");
    let run = || {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples/real_robot/run.sh");
        let programs = PathBuf::from(example("train").get_program());
        let mut command = Command::new(script);
        command.env("E2H_PROGRAMS", programs.parent().unwrap()).arg(&out);
        command.args(["--preset", "smoke", "--episodes", "3", "--trials", "2"]).output().unwrap()
    };
    let output = run();
    assert_success(&output);
    let printed = text(&output.stdout);
    assert!(printed.contains("3 of 3 recordings accepted"), "{printed}");
    assert!(printed.contains("of 2 trials succeeded, 95 % Wilson interval"), "{printed}");
    assert!(std::fs::read(out.join("trials.png")).unwrap().starts_with(b"\x89PNG"));
    let refined = auto_e2h::data::lerobot::Dataset::open(out.join("refined")).unwrap();
    assert_eq!((refined.len(), refined.info().fps), (3, 15.0));
    // Goals of the last frames are those of a plug in its socket: the hand has gone up over it, the jaws are open.
    let table = refined.read_columns(0, &["action"]).unwrap();
    let last = &table.f32("action").unwrap()[table.rows * 8 - 8..];
    assert!((last[0] - 0.3).abs() < 0.02 && last[1].abs() < 0.02 && last[7] == 1.0, "{last:?}");
    // The same command goes on: what is there is not made again.
    let again = run();
    assert_success(&again);
    assert_eq!(text(&again.stdout).lines().last(), printed.lines().last());
}
