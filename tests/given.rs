use crate::{assert_same_results, assert_success, example, nut_assembly, text};
use arrow_array::{Array as _, Float32Array, RecordBatch, make_array};
use auto_e2h::core::{Direction, Episode, Kind, Outcome};
use auto_e2h::data::HandRecording;
use auto_e2h::data::lerobot::{Column, Dataset, Dtype, Feature, Features, Writer, features_of, to_table};
use auto_e2h::report::folder::RunFolder;
use auto_e2h::report::record::RunResults;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use std::path::{Path, PathBuf};
use std::process::Command;

const SHORT: &str = "--set=loop.iterations=0";

/// A run that is given demonstrations.
fn given(out: &Path, demonstrations: &Path, arguments: &[&str]) -> Command {
    let mut command = nut_assembly(out, arguments);
    command.arg("--demonstrations").arg(demonstrations);
    command
}

/// Refused before any work: with these words, all of them, and without a folder.
fn refused(mut command: Command, out: &Path, words: &[&str]) {
    let output = command.output().unwrap();
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{message}");
    for word in words {
        assert!(message.contains(word), "expected `{word}` in: {message}");
    }
    assert!(!out.exists(), "a refused run left a folder: {message}");
}

fn episodes(dataset: &Path) -> Vec<Episode> {
    let dataset = Dataset::open(dataset).unwrap();
    (0..dataset.len()).map(|i| dataset.read_episode(i).unwrap()).collect()
}

fn write(folder: &Path, fps: f64, episodes: &[Episode]) -> PathBuf {
    let mut writer = Writer::create(folder, fps, None, features_of(&episodes[0])).unwrap();
    for episode in episodes {
        writer.push_episode(episode).unwrap();
    }
    writer.finish().unwrap();
    folder.to_owned()
}

#[test]
fn a_run_given_what_another_recorded_ends_with_the_same_bytes_also_where_it_was_stopped() {
    let dir = tempfile::tempdir().unwrap();
    let [own, same, moved] = ["own", "same", "moved"].map(|n| dir.path().join(n));
    assert_success(&nut_assembly(&own, &[]).output().unwrap());
    let recorded = own.join("demonstrations");
    let output = given(&same, &recorded, &[]).output().unwrap();
    assert_success(&output);
    assert_same_results(&own, &same);
    // Another seed of the run: the demonstrations are the same, and what is learned of them is not.
    let output = given(&moved, &recorded, &["--seed", "9", SHORT]).output().unwrap();
    assert_success(&output);
    let bytes = |run: &Path, file: &str| std::fs::read(run.join(file)).unwrap();
    let file = "demonstrations/data/chunk-000/file-000.parquet";
    assert!(bytes(&own, file) == bytes(&moved, file));
    let file = "iteration_00/policy/model.safetensors";
    assert!(bytes(&own, file) != bytes(&moved, file));

    // It says where they came from.
    let results: RunResults = RunFolder::open(&same).unwrap().get("results.json").unwrap().unwrap();
    let from = results.given.unwrap();
    let all = Dataset::open(&recorded).unwrap().len();
    assert_eq!((from.episodes, from.of, from.resized, results.demonstrations), (all, all, false, all));
    assert!(from.from.ends_with("demonstrations") && from.sha256.len() == 64);
    let page = std::fs::read_to_string(same.join("report.html")).unwrap();
    assert!(page.contains(&format!("{all} of {all} episodes of")) && page.contains(&from.sha256));
    let page = std::fs::read_to_string(own.join("report.html")).unwrap();
    assert!(page.contains("the scripted demonstrator"));
}

#[test]
fn a_resumed_run_needs_its_demonstrations_no_more_and_notices_others() {
    let dir = tempfile::tempdir().unwrap();
    let [own, whole, stopped, early] = ["own", "whole", "stopped", "early"].map(|n| dir.path().join(n));
    assert_success(&nut_assembly(&own, &["--seed", "3", SHORT]).output().unwrap());
    let recorded = dir.path().join("by_hand");
    std::fs::rename(own.join("demonstrations"), &recorded).unwrap();
    assert_success(&given(&whole, &recorded, &[]).output().unwrap());

    let mut child = given(&stopped, &recorded, &[]).stdout(std::process::Stdio::null()).spawn().unwrap();
    while !stopped.join("policy_easy/notes.json").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it could be killed");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!stopped.join("results.json").exists(), "it was killed too late");

    // A run that was killed before it had its copy.
    assert_success(&given(&early, &recorded, &[SHORT]).output().unwrap());
    for folder in ["demonstrations", "policy_easy", "iteration_00"] {
        std::fs::remove_dir_all(early.join(folder)).unwrap();
    }

    let fails = |mut command: Command, words: &[&str]| {
        let output = command.output().unwrap();
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{message}");
        for word in words {
            assert!(message.contains(word), "expected `{word}` in: {message}");
        }
    };
    // One episode fewer: the same, and other bytes.
    let fewer = episodes(&recorded);
    let fewer = write(&dir.path().join("fewer"), 20.0, &fewer[..fewer.len() - 1]);
    fails(
        given(&stopped, &fewer, &["--resume"]),
        &["run.json", "expected", "demonstrations given", "SHA-256"],
    );
    // A run with scripted demonstrations is none that was given some.
    fails(given(&own, &recorded, &["--resume", "--seed", "3", SHORT]), &["run.json", "demonstrations given"]);
    // A dataset of the same bytes elsewhere is the same.
    let elsewhere = dir.path().join("elsewhere");
    std::fs::rename(&recorded, &elsewhere).unwrap();
    assert_success(&given(&stopped, &elsewhere, &["--resume"]).output().unwrap());
    assert_same_results(&whole, &stopped);
    // With its own copy it needs none; without, it asks.
    assert_success(&nut_assembly(&whole, &["--resume"]).output().unwrap());
    fails(nut_assembly(&early, &["--resume", SHORT]), &["by_hand", "give --demonstrations again"]);
    assert_success(&given(&early, &elsewhere, &["--resume", SHORT]).output().unwrap());
}

#[test]
fn demonstrations_that_do_not_fit_are_refused_with_all_that_does_not() {
    let dir = tempfile::tempdir().unwrap();
    let [own, out] = ["own", "out"].map(|n| dir.path().join(n));
    assert_success(&nut_assembly(&own, &[SHORT]).output().unwrap());
    let recorded = own.join("demonstrations");
    let good = episodes(&recorded);
    let n = good.len();
    let wrong = |name: &str, change: &dyn Fn(&mut Episode)| {
        let mut episodes = good.clone();
        episodes.iter_mut().for_each(change);
        write(&dir.path().join(name), 20.0, &episodes)
    };
    let run = |demonstrations: &Path, arguments: &[&str]| {
        given(&out, demonstrations, &[&[SHORT], arguments].concat())
    };
    let refuse = |demonstrations: &Path, words: &[&str]| refused(run(demonstrations, &[]), &out, words);

    refuse(&dir.path().join("nowhere"), &["nowhere", "do not fit", "info.json"]);
    // What is wrong with the columns comes as one list.
    let mut short = good[0].clone();
    short.frames.remove(0);
    let mut others: Features = features_of(&short);
    others[2].1 = Feature::vector(&["x", "y", "z", "roll", "pitch", "yaw", "gripper"]);
    others[0].1.names = serde_json::json!(vec!["joint"; 15]);
    others.retain(|(name, _)| name != "next.success");
    others.push(("next.reward".to_owned(), Feature::scalar(Dtype::Float32)));
    let mut table = to_table(&short, &[]).unwrap();
    table.columns[2].1 = Column::F32(vec![0.5; 7 * table.rows]);
    table.columns.retain(|(name, _)| name != "next.success");
    table.columns.push(("next.reward".to_owned(), Column::F32(vec![0.0; table.rows])));
    let foreign = dir.path().join("foreign");
    let mut writer = Writer::create(&foreign, 30.0, None, others).unwrap();
    writer.push(&table, "nut_assembly").unwrap();
    writer.finish().unwrap();
    refuse(
        &foreign,
        &[
            "expected 20 Hz, found 30",
            "an entry `eef_x`, found `joint`",
            "`observation.images.table`: expected image [32, 32, 3], found none",
            "`action`: expected float32 [8], found float32 [7]",
            "`next.success`: expected bool [1], found none",
        ],
    );
    let sharp = ["--set=env.image_size=48", "--set=policy.image_size=48"];
    refused(run(&recorded, &sharp), &out, &["images of 48 x 48 or larger, found 32 x 32"]);

    refuse(
        &wrong("disk", &|e| e.origin.task = "disk".to_owned()),
        &["task: expected `nut_assembly`, found `disk`"],
    );
    refuse(
        &wrong("hard", &|e| e.origin.direction = Direction::Hard),
        &["direction: expected easy, found hard"],
    );
    refuse(&wrong("turned", &|e| e.origin.reversed = true), &["expected easy, found reversed easy"]);
    refuse(&wrong("rollouts", &|e| e.origin.kind = Kind::Rollout), &["a whole demonstration, found rollout"]);
    refuse(&wrong("gripper", &|e| e.action[3][7] = 1.5), &["gripper commands of 0 to 1"]);
    refuse(&wrong("turns", &|e| e.action[3][4] = 9.0), &["action: expected quaternions of length 1"]);
    // Some fail, and all: how many are left is told.
    let failures = wrong("failures", &|e| e.outcome = Outcome::Timeout);
    refuse(&failures, &["successful episodes: expected 1, found 0"]);
    let more = format!("--set=loop.demonstrations={}", n + 1);
    refused(
        run(&recorded, &[&more]),
        &out,
        &[&format!("successful episodes: expected {}, found {n}", n + 1)],
    );

    let broken = wrong("broken", &|_| ());
    not_finite(&broken);
    refuse(&broken, &["episode 0", "row 2", "finite"]);
    // No episodes at all.
    let empty = wrong("empty", &|_| ());
    std::fs::remove_dir_all(empty.join("data")).unwrap();
    std::fs::remove_dir_all(empty.join("meta/episodes")).unwrap();
    let info = std::fs::read_to_string(empty.join("meta/info.json")).unwrap();
    let mut info: serde_json::Value = serde_json::from_str(&info).unwrap();
    for key in ["total_episodes", "total_frames", "total_tasks"] {
        info[key] = 0.into();
    }
    std::fs::write(empty.join("meta/info.json"), info.to_string()).unwrap();
    refuse(&empty, &["no episodes"]);
    // A recording of another scene.
    let scene = |variant: &str| HandRecording {
        task: "nut_assembly".to_owned(),
        variant: variant.to_owned(),
        clearance: 0.0,
        direction: Direction::Easy,
        takes: vec![],
    };
    scene("square").write(&failures).unwrap();
    refuse(&failures, &["recorded variant: expected loose, found square"]);
}

/// Makes one number of the actions none, which no writer here does.
fn not_finite(dataset: &Path) {
    let path = dataset.join("data/chunk-000/file-000.parquet");
    let reader = ParquetRecordBatchReaderBuilder::try_new(std::fs::File::open(&path).unwrap()).unwrap();
    let batches: Vec<RecordBatch> = reader.build().unwrap().map(Result::unwrap).collect();
    let mut writer =
        ArrowWriter::try_new(std::fs::File::create(&path).unwrap(), batches[0].schema(), None).unwrap();
    for batch in batches {
        let at = batch.schema().index_of("action").unwrap();
        let mut columns = batch.columns().to_vec();
        let lists = columns[at].to_data();
        let numbers = make_array(lists.child_data()[0].clone());
        let numbers = numbers.as_any().downcast_ref::<Float32Array>().unwrap().values();
        let broken = numbers.iter().enumerate().map(|(i, v)| if i == 21 { f32::NAN } else { *v });
        let broken = broken.collect::<Float32Array>().to_data();
        columns[at] = make_array(lists.into_builder().child_data(vec![broken]).build().unwrap());
        writer.write(&RecordBatch::try_new(batch.schema(), columns).unwrap()).unwrap();
    }
    writer.close().unwrap();
}

#[test]
fn failures_are_left_out_and_larger_images_made_smaller_for_any_method_and_any_pair() {
    let dir = tempfile::tempdir().unwrap();
    let [own, out, pair] = ["own", "out", "pair"].map(|n| dir.path().join(n));
    assert_success(
        &nut_assembly(&own, &[SHORT, "--set=env.image_size=64", "--set=policy.image_size=64"])
            .output()
            .unwrap(),
    );
    let mut all = episodes(&own.join("demonstrations"));
    let n = all.len();
    all[1].outcome = Outcome::Timeout;
    let mixed = write(&dir.path().join("mixed"), 20.0, &all);
    assert_success(&given(&out, &mixed, &["--method", "recap"]).output().unwrap());
    let copied = episodes(&out.join("demonstrations"));
    assert_eq!(copied.len(), n - 1);
    assert_eq!(copied[1].origin, all[2].origin);
    assert!(copied[1].state == all[2].state && copied[1].action == all[2].action);
    let sizes: Vec<_> = copied[0].frames.iter().map(|f| (&*f.camera, f.height, f.width)).collect();
    assert_eq!(sizes, [("table", 32, 32), ("wrist", 32, 32)]);
    let results: RunResults = RunFolder::open(&out).unwrap().get("results.json").unwrap().unwrap();
    let words = results.given.unwrap().words();
    assert!(words.starts_with(&format!("{} of {n} episodes of", n - 1)), "{words}");
    assert!(words.contains("images made smaller"), "{words}");
    // As many as were asked for.
    let two = dir.path().join("two");
    assert_success(&given(&two, &mixed, &[SHORT, "--set=loop.demonstrations=2"]).output().unwrap());
    assert_eq!(episodes(&two.join("demonstrations")).len(), 2);

    // A pair of one's own.
    let block = |out: &Path| {
        let mut command = example("own_task");
        command.args(["--preset", "smoke", "--quiet", SHORT, "--out"]).arg(out).args(crate::SMALL);
        command
    };
    assert_success(&block(&pair).output().unwrap());
    let again = dir.path().join("again");
    let output = block(&again).arg("--demonstrations").arg(pair.join("demonstrations")).output().unwrap();
    assert_success(&output);
    assert_same_results(&pair, &again);
    refused(
        {
            let mut command = block(&dir.path().join("other"));
            command.arg("--demonstrations").arg(&mixed);
            command
        },
        &dir.path().join("other"),
        &["task: expected `block_on_pedestal`, found `nut_assembly`"],
    );
}
