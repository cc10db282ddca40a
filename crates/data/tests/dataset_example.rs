//! The status that `dataset check` ends with, and its words for each kind of finding.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_data::lerobot::{Column, Dtype, Feature, Table, Writer};
use std::path::{Path, PathBuf};
use std::process::Command;

/// The example that `cargo test` built beside this test: its status and its words.
fn check(root: &Path, arguments: &[&str]) -> (Option<i32>, String) {
    let mut program: PathBuf = std::env::current_exe().unwrap();
    program.pop();
    program.pop();
    let program = program.join("examples/dataset");
    let output = Command::new(program).arg("check").arg(root).args(arguments).output().unwrap();
    (output.status.code(), String::from_utf8(output.stdout).unwrap())
}

#[test]
fn only_a_sound_dataset_ends_with_0_and_each_kind_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("set");
    let features = ["x", "y"].map(|name| (name.to_owned(), Feature::scalar(Dtype::Float32)));
    let mut writer = Writer::create(&root, 20.0, None, features.to_vec()).unwrap();
    for _ in 0..2 {
        let columns = ["x", "y"].map(|name| (name.to_owned(), Column::F32(vec![0.5; 9])));
        writer.push(&Table { rows: 9, columns: columns.to_vec() }, "t").unwrap();
        writer.commit().unwrap();
    }
    assert_eq!((check(&root, &[]).0, check(&root, &["--repair"]).0), (Some(0), Some(0)));

    std::fs::remove_file(root.join("meta/stats.json")).unwrap();
    let (status, words) = check(&root, &[]);
    assert!(
        status == Some(3) && words.contains("stale: ") && words.contains("the rows are whole"),
        "{words}"
    );
    let (status, words) = check(&root, &["--json"]);
    assert!(status == Some(3) && words.contains("\"kind\":\"stale\""), "{words}");
    assert_eq!(check(&root, &["--repair"]).0, Some(0));

    let info = root.join("meta/info.json");
    let text = std::fs::read_to_string(&info).unwrap();
    std::fs::write(&info, text.replacen("\"float32\"", "\"depth\"", 1)).unwrap();
    let (status, words) = check(&root, &["--repair"]);
    assert!(
        status == Some(4) && words.contains("unsupported: ") && words.contains("touches nothing"),
        "{words}"
    );
    std::fs::write(&info, text).unwrap();

    std::fs::write(root.join("data/chunk-000/file-001.parquet"), b"half").unwrap();
    let (status, words) = check(&root, &[]);
    assert!(status == Some(1) && words.contains("damage (from episode 1 on): "), "{words}");
    assert!(words.contains("--repair keeps 1 episodes"), "{words}");
    let (status, words) = check(&root, &["--repair"]);
    assert!(status == Some(0) && words.contains("repaired: kept the first 1 of 2 episodes"), "{words}");
    assert_eq!(check(&folder.path().join("none"), &[]).0, Some(1));
}
