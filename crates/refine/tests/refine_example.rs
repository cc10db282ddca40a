//! The refine example on a recording with other names, units and rate than this project's: what it writes, and what it says
//! when it cannot.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_data::lerobot::{Column, Dataset, Dtype, Feature, Table, Writer, check, encode_png};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Rows of a recording at 30 Hz: up, a pause of two seconds, aside, a slow stretch; the jaw opens, and the hand leaves.
fn path() -> Vec<(f32, f32, f32)> {
    let mut rows = vec![];
    let (mut x, mut z, mut jaw) = (0.4_f32, 0.2_f32, 20.0_f32);
    for t in 0..200 {
        rows.push((x, z, jaw));
        match t {
            0..30 | 170.. => z += 0.004,
            90..120 => x += 0.005,
            120..150 => x += 0.0016,
            150..160 => jaw += 6.0,
            _ => {}
        }
    }
    rows
}

fn record(root: &Path, successes: &[bool]) {
    let features = vec![
        ("tcp".to_owned(), Feature::vector(&["x", "y", "z", "qx", "qy", "qz", "qw"])),
        ("jaw".to_owned(), Feature::vector(&["left", "right"])),
        ("joints".to_owned(), Feature { shape: vec![3], ..Feature::scalar(Dtype::Float64) }),
        ("front".to_owned(), Feature::image(4, 6)),
        ("next.success".to_owned(), Feature::scalar(Dtype::Bool)),
    ];
    let mut writer = Writer::create(root, 30.0, Some("other_arm"), features).unwrap();
    for &success in successes {
        let rows = path();
        let n = rows.len();
        let columns = vec![
            // Orientation: half a turn about x, written with the real part last.
            (
                "tcp".to_owned(),
                Column::F32(rows.iter().flat_map(|r| [r.0, 0.0, r.1, 1.0, 0.0, 0.0, 0.0]).collect()),
            ),
            ("jaw".to_owned(), Column::F32(rows.iter().flat_map(|r| [-1.0, r.2]).collect())),
            ("joints".to_owned(), Column::F64((0..3 * n).map(|i| i as f64).collect())),
            (
                "front".to_owned(),
                Column::Png((0..n).map(|t| encode_png(4, 6, &[t as u8; 72]).unwrap()).collect()),
            ),
            ("next.success".to_owned(), Column::Bool((0..n).map(|t| success && t + 1 == n).collect())),
        ];
        writer.push(&Table { rows: n, columns }, "unplug").unwrap();
    }
    writer.finish().unwrap();
}

/// The example that `cargo test` built beside this test.
fn refine(dataset: &Path, out: &Path, arguments: &[&str]) -> Output {
    let mut program: PathBuf = std::env::current_exe().unwrap();
    program.pop();
    program.pop();
    let names = ["--pose", "tcp", "--rotation", "xyzw", "--gripper", "jaw[1]", "--gripper-range", "0,80"];
    Command::new(program.join("examples/refine"))
        .arg("--dataset")
        .arg(dataset)
        .arg("--out")
        .arg(out)
        .args(names)
        .args(arguments)
        .output()
        .unwrap()
}

fn refusal(dataset: &Path, out: &Path, arguments: &[&str]) -> String {
    let output = refine(dataset, out, arguments);
    assert!(!output.status.success());
    String::from_utf8(output.stderr).unwrap()
}

/// A number that is not finite in the first of two recordings, which each have a file of their own; then half a file.
#[test]
fn broken_recordings_stop_the_work_or_are_left_out_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (folder.path().join("unplug"), folder.path().join("plug_in"));
    record(&from, &[true]);
    let dataset = Dataset::open(&from).unwrap();
    let own = ["tcp", "jaw", "joints", "front", "next.success"];
    let mut writer = Writer::append(&from).unwrap();
    writer.push(&dataset.read_columns(0, &own).unwrap(), "unplug").unwrap();
    writer.finish().unwrap();
    let file = from.join("data/chunk-000/file-000.parquet");
    let whole = std::fs::read(&file).unwrap();
    // Distinct numbers lie in a dictionary, each once.
    let (place, mut bad) = (path()[100].0.to_le_bytes(), whole.clone());
    let at = bad.windows(4).position(|w| w == place).unwrap();
    bad[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    for (bytes, says) in [(&bad[..], "finite"), (&whole[..whole.len() / 2], "file-000.parquet")] {
        std::fs::write(&file, bytes).unwrap();
        let stops = refusal(&from, &to, &[]);
        assert!(stops.contains(says), "{stops}");
        let _ = std::fs::remove_dir_all(&to);
        let output = refine(&from, &to, &["--skip-broken"]);
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.success() && said.contains("left out episode 0: "), "{said}");
        left_out_alone(&to, 0, says);
    }
}

/// Of two recordings one was left out, and the report says which, and why.
fn left_out_alone(to: &Path, episode: i64, says: &str) {
    let refined = Dataset::open(to).unwrap();
    assert_eq!((refined.len(), refined.read(0).unwrap().i64("source.episode").unwrap()[0]), (1, 1 - episode));
    let report = std::fs::read(to.join("report/report.json")).unwrap();
    let report: serde_json::Value = serde_json::from_slice(&report).unwrap();
    assert_eq!((&report["episodes_in"], &report["episodes_accepted"]), (&2.into(), &1.into()));
    let broken = &report["left_out"].as_array().unwrap()[..];
    assert_eq!((broken.len(), &broken[0]["episode"]), (1, &episode.into()));
    assert!(broken[0]["reason"].as_str().unwrap().contains(says), "{broken:?}");
    let page = std::fs::read_to_string(to.join("report/report.html")).unwrap();
    assert!(page.contains("1 of 2 recordings") && page.contains(&format!("<li>episode {episode}: ")));
    std::fs::remove_dir_all(to).unwrap();
}

/// Images are files in a column: rows may be sound and one of their images not.
#[test]
fn a_recording_with_an_image_that_cannot_be_decoded_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let (whole, from, to) =
        (folder.path().join("whole"), folder.path().join("unplug"), folder.path().join("plug_in"));
    record(&whole, &[true, true]);
    // Its writer looks at images; that of another robot did not.
    record(&from, &[true]);
    let dataset = Dataset::open(&whole).unwrap();
    let own = ["tcp", "jaw", "joints", "front", "next.success"];
    let mut table = dataset.read_columns(0, &own).unwrap();
    let images = table.columns.iter_mut().find(|(n, _)| n == "front").unwrap();
    let Column::Png(files) = &mut images.1 else { panic!("images") };
    // Statistics are of a part of the rows.
    let row = 102;
    let length = files[row].len();
    files[row].truncate(length / 2);
    let mut writer = Writer::append(&from).unwrap();
    writer.push(&table, "unplug").unwrap();
    writer.finish().unwrap();
    let output = refine(&from, &to, &["--skip-broken"]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success() && said.contains("left out episode 1: "), "{said}");
    left_out_alone(&to, 1, "column `front`, row 102");
}

#[test]
fn a_recording_becomes_hard_direction_data() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (folder.path().join("unplug"), folder.path().join("plug_in"));
    record(&from, &[true, false]);
    let output = refine(&from, &to, &["--state", "joints[1:3]", "--task", "plug it in", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&report["episodes_in"], &report["episodes_accepted"]), (&2.into(), &1.into()));
    assert_eq!(report["episodes"][1]["verdict"], "failed");
    assert_eq!(report["recorded"]["frames"], 400);

    let dataset = Dataset::open(&to).unwrap();
    assert!(check(&to).unwrap().is_sound());
    assert_eq!((dataset.len(), dataset.tasks()), (1, &["plug it in".to_owned()][..]));
    assert_eq!((dataset.info().fps, dataset.info().robot_type.as_deref()), (20.0, Some("other_arm")));
    let state = dataset.info().feature("observation.state").unwrap();
    assert_eq!(state.entry_names().unwrap()[7..], ["gripper", "joints.1", "joints.2"]);

    let table = dataset.read(0).unwrap();
    let frames = table.i64("source.frame").unwrap();
    assert_eq!(
        (frames[0], *frames.last().unwrap()),
        (198, 0),
        "the first row at 20 Hz nearest to the last at 30 Hz"
    );
    assert!(frames.windows(2).all(|w| w[1] < w[0]), "backwards");
    let states: Vec<&[f32]> = table.f32("observation.state").unwrap().chunks_exact(10).collect();
    let actions: Vec<&[f32]> = table.f32("action").unwrap().chunks_exact(8).collect();
    for (t, &frame) in frames.iter().enumerate() {
        let (x, z, jaw) = path()[frame as usize];
        // Poses lie between rows, at most half a step of a frame of the slow stretch's re-timing away.
        assert!((states[t][0] - x).abs() < 0.003 && (states[t][2] - z).abs() < 0.003, "row {t}");
        assert!((states[t][7] - jaw / 1000.0).abs() < 0.0031, "row {t}");
        let turned = states[t][3..7].iter().zip([0.0, 1.0, 0.0, 0.0]).all(|(a, b)| (a - b).abs() < 1e-6);
        assert!(turned, "row {t}: the hemisphere of the first frame");
        assert_eq!(states[t][8..], [(3 * frame + 1) as f32, (3 * frame + 2) as f32]);
        assert_eq!(table.png("front").unwrap()[t], encode_png(4, 6, &[frame as u8; 72]).unwrap(), "row {t}");
        let next = states.get(t + 1).unwrap_or(&states[t]);
        assert!(actions[t][..7].iter().zip(&next[..7]).all(|(a, b)| (a - b).abs() < 1e-6), "row {t}");
    }
    // Open at first, closed on the object in the end.
    assert_eq!((actions[0][7], actions.last().unwrap()[7]), (1.0, 0.0));
    let success = table.bool("next.success").unwrap();
    assert!(success.iter().rev().skip(1).all(|s| !s) && success.last() == Some(&true));

    let fates = &report["fates"];
    let count = |name: &str| fates[name].as_u64().unwrap() as usize;
    assert_eq!(count("frames"), count("kept") + count("still") + count("resampled"));
    assert_eq!(count("kept"), table.rows);
    // The pause of 60 rows at 30 Hz is 40 at 20 Hz.
    assert!((35..45).contains(&count("still")), "{fates}");
    assert!(count("resampled") > 4, "{fates}");
    let page = std::fs::read_to_string(to.join("report/report.html")).unwrap();
    assert_eq!(page.matches("<svg").count(), 2);
    assert!(!page.contains("NaN") && page.contains("rejected: the recording did not succeed"));
    let csv = std::fs::read_to_string(to.join("report/frames.csv")).unwrap();
    assert_eq!(csv.matches(",static\n").count(), count("still"));
    assert_eq!(csv.lines().count(), 1 + 2 * count("frames"));
}

#[test]
fn what_cannot_be_done_is_said_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let (from, to) = (folder.path().join("unplug"), folder.path().join("plug_in"));
    record(&from, &[true]);
    for (arguments, expected) in [
        (&["--state", "joint"][..], "perhaps `joints`"),
        (&["--camera", "fronte"], "perhaps `front`"),
        (&["--set", "kinematic.static_frame=3"], "did you mean `kinematic.static_frames`?"),
        (&["--set", "kinematic.static_frames=many"], "expected a number"),
        (&["--set", "gate.enabled=true"], "the gripper closes 1 and opens 0 times"),
        (&["--fps", "0"], "--fps: expected a positive rate"),
        (&["--object", "jaw"], "`jaw`: expected 7 numbers"),
    ] {
        let message = refusal(&from, &to, arguments);
        assert!(message.contains(expected), "{arguments:?}: {message}");
        assert!(!to.exists(), "{arguments:?}");
    }
    assert!(refusal(folder.path(), &to, &[]).contains("info.json"));
    assert!(refine(&from, &to, &[]).status.success());
    assert!(refusal(&from, &to, &[]).contains("expected none: a new dataset"), "never over another one");
}
