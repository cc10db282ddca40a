//! A run of several ranks, here threads: the same bytes as of one, and one account of what goes wrong.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::Threads;
use e2h_learn::record::RunResults;
use e2h_learn::{Error, Parts, Result, Run, RunOptions, Stop};
use std::path::{Path, PathBuf};
use std::rc::Rc;
use std::time::Duration;

/// Sizes at which the smoke preset takes seconds. Five lanes and three trials, which no number of ranks divides.
const SMALL: [&str; 12] = [
    "env.horizon_hard=48",
    "train.easy_steps=12",
    "train.initial_steps=12",
    "train.update_steps=12",
    "train.easy_update_steps=4",
    "train.save_every=4",
    "train.step.shards=4",
    "loop.cycles=5",
    "loop.loops=5",
    "loop.keep_rollouts=true",
    "evaluation.trials=3",
    "evaluation.parallel=3",
];

fn options(out: &Path) -> RunOptions {
    RunOptions {
        preset: "smoke".to_owned(),
        seed: 3,
        set: SMALL.map(str::to_owned).to_vec(),
        out: Some(out.to_owned()),
        quiet: true,
        ..RunOptions::new("nut_assembly")
    }
}

fn learn(ranks: usize, options: &RunOptions) -> Vec<Result<RunResults>> {
    Threads::run(ranks, |team| {
        let run = Run::open_team(options, &Parts::default(), Rc::new(team))?;
        Ok(run.learn()?.0)
    })
}

/// All files below `dir` that hold no times, with their bytes.
fn results(dir: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let (mut found, mut folders) = (vec![], vec![dir.to_owned()]);
    while let Some(folder) = folders.pop() {
        for path in std::fs::read_dir(folder).unwrap().flatten().map(|entry| entry.path()) {
            let ending = path.extension().map(|e| e.to_string_lossy().into_owned()).unwrap_or_default();
            if path.is_dir() {
                folders.push(path);
            } else if ["safetensors", "parquet", "svg", "png", "toml"].contains(&&*ending)
                || path.ends_with("policy.json")
                || path.ends_with("reversals.json")
            {
                found.push((path.strip_prefix(dir).unwrap().to_owned(), std::fs::read(&path).unwrap()));
            }
        }
    }
    found.sort();
    found
}

fn assert_same(a: &Path, b: &Path) {
    let (a, b) = (results(a), results(b));
    let names = |r: &[(PathBuf, Vec<u8>)]| r.iter().map(|(n, _)| n.clone()).collect::<Vec<_>>();
    assert_eq!(names(&a), names(&b));
    for ((name, x), (_, y)) in a.iter().zip(&b) {
        assert!(x == y, "{} differs", name.display());
    }
    assert!(a.len() > 12, "expected a whole run, found {:?}", names(&a));
}

#[test]
fn a_run_has_the_same_bytes_on_1_2_and_4_ranks_also_stopped_on_4_and_resumed_on_2() {
    let dir = tempfile::tempdir().unwrap();
    let place = |name: &str| dir.path().join(name);
    let one = learn(1, &options(&place("1"))).remove(0).unwrap();
    for ranks in [2, 4] {
        let out = place(&ranks.to_string());
        for results in learn(ranks, &options(&out)) {
            let results = results.unwrap();
            for (a, b) in results.iterations.iter().zip(&one.iterations) {
                assert_eq!(a.evaluation.outcomes, b.evaluation.outcomes);
                assert_eq!(a.collection, b.collection);
            }
            assert_eq!(results.iterations.len(), 2);
        }
        assert_same(&place("1"), &out);
    }

    let stopped = RunOptions { stop: Stop::default(), ..options(&place("stopped")) };
    let errors = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !place("stopped/iteration_00/policy/training.safetensors").exists() {
                std::thread::sleep(Duration::from_millis(1));
            }
            stopped.stop.ask(15);
        });
        learn(4, &stopped)
    });
    let mut errors = errors.into_iter().map(|done| done.unwrap_err());
    assert!(matches!(errors.next(), Some(Error::Stopped { signal: 15 })));
    assert!(errors.all(|e| matches!(e, Error::Led(why) if why.starts_with("rank 0: stopped"))));
    let again = RunOptions { resume: true, ..options(&place("stopped")) };
    assert!(learn(2, &again).iter().all(Result::is_ok));
    assert_same(&place("1"), &place("stopped"));
}

#[test]
fn what_cannot_begin_is_said_by_the_first_rank_and_known_to_all() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let said = |done: Vec<Result<RunResults>>| {
        let mut errors = done.into_iter().map(|done| done.unwrap_err());
        let first = errors.next().unwrap();
        assert!(errors.all(|e| matches!(e, Error::Led(why) if why == format!("rank 0: {first}"))));
        first.to_string()
    };
    let message = said(learn(3, &options(&out)));
    assert!(message.contains("train.step.shards: expected a multiple of the 3 ranks, got 4"), "{message}");
    assert!(!out.exists(), "nothing was begun");
    std::fs::create_dir(&out).unwrap();
    std::fs::write(out.join("run.json"), "{}").unwrap();
    let message = said(learn(2, &options(&out)));
    assert!(message.contains("--resume"), "{message}");
}
