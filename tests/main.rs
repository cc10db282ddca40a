//! Tests of the whole, in one binary: each module says what it is about.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot be set up should fail")]

mod architecture; // the invariants of ARCHITECTURE.md that a program can check
mod compare; // several methods on several pairs, stopped, in parts, with shared beginnings
mod errors; // wrong input and trouble with files: a clear message, before any work, nothing lost
mod examples; // every example binary with the smoke preset
mod faults; // signals, closed pipes, flipped bits and a MuJoCo that cannot go on
mod front_door; // what `cargo run` lists, and what every example says of itself
mod given; // demonstrations that a run is given: the same bytes as from its own, refusals, resuming
mod imitation; // `train` on datasets of a robot that this project does not know
mod pipeline; // refinement, critic and update on scripted rollouts
mod resume; // kills at random instants, and thread counts: the same bytes
mod served; // a policy behind a socket: the results of its checkpoint, and who may ask
mod teleop; // demonstrations recorded by hand, without a window, and given to a run
mod tr_drl; // reinforcement learning from states, its loop and its record

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Sizes at which the smoke preset takes seconds.
const SMALL: [&str; 7] = [
    "--set=env.horizon_hard=48",
    "--set=train.easy_steps=12",
    "--set=train.initial_steps=12",
    "--set=train.update_steps=12",
    "--set=train.save_every=4",
    "--set=loop.cycles=2",
    "--set=evaluation.filmed=0",
];

/// A program of `examples/`, built by the same `cargo test`.
fn example(name: &str) -> Command {
    let mut path = std::env::current_exe().expect("the test's own path");
    path.pop();
    path.pop();
    Command::new(path.join("examples").join(name))
}

fn nut_assembly(out: &Path, arguments: &[&str]) -> Command {
    let mut command = example("nut_assembly");
    command.args(["--preset", "smoke", "--quiet", "--out"]).arg(out).args(SMALL).args(arguments);
    command
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn assert_success(output: &Output) {
    assert!(output.status.success(), "{}\n{}", text(&output.stdout), text(&output.stderr));
}

/// All files below `dir` that hold results and no times, with their bytes.
fn results(dir: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = vec![];
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path
                .extension()
                .is_some_and(|e| e == "safetensors" || e == "parquet" || e == "svg" || e == "toml")
                || path.ends_with("policy.json")
            {
                let bytes = std::fs::read(&path).expect("a file");
                found.push((path.strip_prefix(dir).expect("a file below").to_owned(), bytes));
            }
        }
    }
    found.sort();
    found
}

fn assert_same_results(a: &Path, b: &Path) {
    let (a, b) = (results(a), results(b));
    let names = |r: &[(PathBuf, Vec<u8>)]| r.iter().map(|(n, _)| n.clone()).collect::<Vec<_>>();
    assert_eq!(names(&a), names(&b));
    for ((name, x), (_, y)) in a.iter().zip(&b) {
        assert!(x == y, "{} differs", name.display());
    }
    assert!(a.len() > 5, "expected a whole run, found {:?}", names(&a));
}
