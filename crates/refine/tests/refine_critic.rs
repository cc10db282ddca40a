//! The refine example with a critic: trained from hard rollouts, saved, read again, and what it says when it cannot.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_data::lerobot::{Column, Dataset, Dtype, Feature, Table, Writer, encode_png};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// One row per control step at 20 Hz: x and y of the hand, m. The goal of the hard task lies at x = 0.
type Rows = Vec<(f32, f32)>;

const STEP: f32 = 0.005;

/// Away from the goal; half-way it goes to and fro for three seconds, which undoes nothing.
fn easy(shift: f32) -> Rows {
    let mut rows = vec![];
    let (mut x, mut y) = (0.0_f32, shift);
    for t in 0..180 {
        rows.push((x, y));
        if (60..120).contains(&t) {
            y += if (t - 60) % 20 < 10 { STEP } else { -STEP };
        } else {
            x += STEP;
        }
    }
    rows
}

/// Towards the goal, wavering; failures stay where they are before they are there.
fn hard(shift: f32, success: bool) -> Rows {
    let steps = |t: u8| if success || t < 50 { 120 - t } else { 70 };
    let aside = |t: u8| shift + 0.05 * (f32::from(t) * 0.3).sin();
    (0..120).map(|t| (f32::from(steps(t)) * STEP, aside(t))).collect()
}

/// What recordings differ in.
struct Form {
    pose: usize,
    side: usize,
    labels: bool,
}

const FORM: Form = Form { pose: 7, side: 8, labels: true };

fn record(root: &Path, episodes: &[(Rows, bool)], form: &Form) {
    let names: Vec<String> = (0..form.pose).map(|i| format!("p{i}")).collect();
    let mut features = vec![
        ("tcp".to_owned(), Feature::vector(&names)),
        ("jaw".to_owned(), Feature::vector(&["left", "right"])),
        ("front".to_owned(), Feature::image(form.side, form.side)),
    ];
    if form.labels {
        features.push(("next.success".to_owned(), Feature::scalar(Dtype::Bool)));
    }
    let mut writer = Writer::create(root, 20.0, Some("other_arm"), features).unwrap();
    for (rows, success) in episodes {
        let n = rows.len();
        let pose = |&(x, y): &(f32, f32)| {
            let mut row = vec![x, y, 0.2, 0.0, 1.0, 0.0, 0.0];
            row.resize(form.pose, 0.0);
            row
        };
        let image = |&(x, _): &(f32, f32)| {
            let pixels = vec![(x * 400.0) as u8; form.side * form.side * 3];
            encode_png(form.side, form.side, &pixels).unwrap()
        };
        let mut columns = vec![
            ("tcp".to_owned(), Column::F32(rows.iter().flat_map(pose).collect())),
            ("jaw".to_owned(), Column::F32(rows.iter().flat_map(|_| [1.0, 40.0]).collect())),
            ("front".to_owned(), Column::Png(rows.iter().map(image).collect())),
        ];
        if form.labels {
            let flags = (0..n).map(|t| *success && t + 1 == n).collect();
            columns.push(("next.success".to_owned(), Column::Bool(flags)));
        }
        writer.push(&Table { rows: n, columns }, "unplug").unwrap();
    }
    writer.finish().unwrap();
}

fn record_easy(root: &Path) {
    record(root, &[(easy(0.0), true), (easy(0.05), true), (easy(-0.05), true)], &FORM);
}

fn record_hard(root: &Path, form: &Form) {
    let rollouts: Vec<(Rows, bool)> =
        (0..10_u8).map(|i| (hard(f32::from(i) * 0.02 - 0.1, i % 3 > 0), i % 3 > 0)).collect();
    record(root, &rollouts, form);
}

/// The example that `cargo test` built beside this test.
fn refine(dataset: &Path, out: &Path, arguments: &[&str]) -> Output {
    let mut program: PathBuf = std::env::current_exe().unwrap();
    program.pop();
    program.pop();
    let small = [
        "critic.image_size=16",
        "critic.crop_size=16",
        "critic.encoder_blocks=[1]",
        "critic.hidden=[64,64]",
        "critic.steps=300",
        "critic.lr=0.002",
        "critic.colour_jitter=0.0",
        "critic.dropout=0.0",
        "advantage.horizon=60",
        "advantage.smooth=15",
        "advantage.min_run=15",
    ];
    // A test may name the gripper otherwise.
    let gripper: &[&str] = if arguments.contains(&"--gripper") { &[] } else { &["--gripper", "jaw[1]"] };
    Command::new(program.join("examples/refine"))
        .arg("--dataset")
        .arg(dataset)
        .arg("--out")
        .arg(out)
        .args(["--pose", "tcp", "--gripper-range", "0,80"])
        .args(gripper)
        .args(small.iter().flat_map(|s| ["--set", s]))
        .args(arguments)
        .output()
        .unwrap()
}

fn assert_success(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stderr.clone()).unwrap()
}

fn refusal(dataset: &Path, out: &Path, arguments: &[&str]) -> String {
    let output = refine(dataset, out, arguments);
    assert!(!output.status.success());
    assert!(!out.join("meta/info.json").exists(), "a refused run left a dataset");
    String::from_utf8(output.stderr).unwrap()
}

#[test]
fn what_makes_no_progress_is_left_out_and_the_critic_serves_again() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    record_easy(&at("easy"));
    record_hard(&at("hard"), &FORM);
    let hard = at("hard");
    let output = refine(&at("easy"), &at("out"), &["--train-critic", hard.to_str().unwrap()]);
    let progress = assert_success(&output);
    for words in ["10 rollouts, 6 successful", "step 150 of 300, loss", "held-out rollouts; saved in"] {
        assert!(progress.contains(words), "expected `{words}` in: {progress}");
    }
    let printed = String::from_utf8(output.stdout).unwrap();
    assert!(printed.contains("without progress"), "{printed}");

    let report: serde_json::Value =
        serde_json::from_slice(&std::fs::read(at("out/report/report.json")).unwrap()).unwrap();
    let count = |name: &str| report["fates"][name].as_u64().unwrap() as usize;
    let fates = ["kept", "still", "resampled", "low_advantage", "too_short", "after_goal"];
    assert_eq!(count("frames"), fates.map(count).iter().sum::<usize>());
    assert!(count("low_advantage") > 90, "{}", report["fates"]);
    assert_eq!(report["critic"]["about"]["successes"], 6);
    // Far from the goal nothing tells a rollout that will succeed from one that will not.
    assert!(report["critic"]["about"]["train_loss"].as_f64().unwrap() < 0.2, "{}", report["critic"]);

    // What goes is the to and fro: rows 60 to 120 of each recording, less what the moving average blurs.
    let csv = std::fs::read_to_string(at("out/report/frames.csv")).unwrap();
    let lines: Vec<Vec<&str>> = csv.lines().map(|l| l.split(',').collect()).collect();
    assert_eq!(
        lines[0],
        ["episode", "frame", "time_s", "source_frame", "speed_m_s", "value", "advantage", "fate"]
    );
    let low: Vec<usize> =
        lines.iter().filter(|l| l[7] == "low_advantage").map(|l| l[3].parse().unwrap()).collect();
    assert_eq!(low.len(), count("low_advantage"));
    let idle = low.iter().filter(|r| (60..=120).contains(*r)).count();
    assert!(idle * 10 >= low.len() * 8, "{idle} of {} lie in the to and fro", low.len());
    assert!(lines[1..].iter().all(|l| l[5].parse::<f32>().is_ok() && l[6].parse::<f32>().is_ok()));

    let dataset = Dataset::open(at("out")).unwrap();
    assert!(dataset.len() > 3, "recordings are split where frames were left out");
    assert_eq!(dataset.info().total_frames, count("kept"));
    let page = std::fs::read_to_string(at("out/report/report.html")).unwrap();
    for words in [
        "low advantage",
        "among the lowest 30 % of all frames",
        ">advantage<",
        ">threshold<",
        "10 hard rollouts",
    ] {
        assert!(page.contains(words), "expected `{words}`");
    }
    assert!(!page.contains("NaN"));

    // The same critic again, and one trained anew: the same bytes.
    let critic = at("out/critic");
    let progress =
        assert_success(&refine(&at("easy"), &at("again"), &["--critic", critic.to_str().unwrap()]));
    assert!(progress.contains("critic: ") && !progress.contains("step"), "{progress}");
    assert_eq!(std::fs::read_to_string(at("again/report/frames.csv")).unwrap(), csv);
    assert_success(&refine(&at("easy"), &at("anew"), &["--json", "--train-critic", hard.to_str().unwrap()]));
    for file in ["critic.json", "model.safetensors"] {
        let read = |root: &str| std::fs::read(at(root).join("critic").join(file)).unwrap();
        assert!(read("out") == read("anew"), "{file}");
    }
}

#[test]
fn a_critic_that_does_not_fit_is_refused_with_what_was_expected_and_found() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    record_easy(&at("easy"));
    record_hard(&at("hard"), &FORM);
    let hard = at("hard");
    let quick = ["--set", "critic.steps=2", "--train-critic", hard.to_str().unwrap()];
    assert_success(&refine(&at("easy"), &at("out"), &quick));
    let critic = at("out/critic");
    let with = ["--critic", critic.to_str().unwrap()];
    let refused = |arguments: &[&str]| refusal(&at("easy"), &at("no"), &[&with, arguments].concat());
    let message = refused(&["--gripper", "jaw[0]", "--fps", "10"]);
    for words in [
        "gripper: expected jaw[1], 1 number, 0 to 80, found jaw[0], 1 number, 0 to 80",
        "rate: expected 20 Hz, found 10 Hz",
    ] {
        assert!(message.contains(words), "expected `{words}` in: {message}");
    }
    let message = refused(&["--object", "tcp"]);
    assert!(message.contains("object: expected none, found tcp, 7 numbers, Wxyz"), "{message}");

    // A recording whose images have another size.
    record(&at("large"), &[(easy(0.0), true)], &Form { side: 12, ..FORM });
    let message = refusal(&at("large"), &at("no"), &with);
    assert!(message.contains("camera front: expected [8, 8, 3], found [12, 12, 3]"), "{message}");

    // Damage.
    let json = std::fs::read_to_string(critic.join("critic.json")).unwrap();
    std::fs::write(critic.join("critic.json"), json.replace("\"state_dim\": 15", "\"state_dim\": 16"))
        .unwrap();
    assert!(refused(&[]).contains("expected state_dim 15, found 16"));
    std::fs::write(critic.join("critic.json"), json.replace("\"format\": 1", "\"format\": 7")).unwrap();
    assert!(refused(&[]).contains("expected format 1, found 7"));
    std::fs::write(critic.join("critic.json"), &json).unwrap();
    let weights = critic.join("model.safetensors");
    let mut bytes = std::fs::read(&weights).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    std::fs::write(&weights, bytes).unwrap();
    assert!(refused(&[]).contains("SHA-256"));
    assert!(
        refusal(&at("easy"), &at("no"), &["--critic", at("none").to_str().unwrap()]).contains("critic.json")
    );
}

#[test]
fn rollouts_that_cannot_teach_are_refused_before_any_work() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    record_easy(&at("easy"));
    let refused = |name: &str, form: &Form, arguments: &[&str]| {
        record_hard(&at(name), form);
        let root = at(name);
        let train = ["--train-critic", root.to_str().unwrap()];
        let message = refusal(&at("easy"), &at("out"), &[&train, arguments].concat());
        assert!(!at("out").exists(), "{message}");
        message
    };
    let message = refused("unlabelled", &Form { labels: false, ..FORM }, &[]);
    assert!(
        message.contains("column `next.success`: expected one Bool") && message.contains("found none"),
        "{message}"
    );
    let message = refused("labelled", &FORM, &["--success", "jaw"]);
    assert!(
        message.contains("column `jaw`: expected one Bool") && message.contains("Float32 x 2"),
        "{message}"
    );
    let message = refused("wide", &Form { pose: 8, ..FORM }, &[]);
    assert!(message.contains("`tcp`: expected 7 numbers") && message.contains("found 8"), "{message}");
    let message = refused("sharp", &Form { side: 12, ..FORM }, &[]);
    assert!(message.contains("camera front: expected [8, 8, 3], found [12, 12, 3]"), "{message}");
    let message = refused("fine", &FORM, &["--set", "critic.crop_size=20"]);
    assert!(message.contains("crop_size: expected 1 to image_size (16), got 20"), "{message}");
    let message = refused("again", &FORM, &["--critic", "somewhere"]);
    assert!(message.contains("cannot be used with"), "{message}");

    let failures: Vec<(Rows, bool)> = (0..3).map(|_| (hard(0.0, false), false)).collect();
    record(&at("failures"), &failures, &FORM);
    let root = at("failures");
    let message = refusal(&at("easy"), &at("out"), &["--train-critic", root.to_str().unwrap()]);
    assert!(message.contains("expected at least one successful rollout, found none in 3"), "{message}");
}
