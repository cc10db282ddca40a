use crate::{assert_same_results, assert_success, nut_assembly};
use rand::{Rng as _, SeedableRng as _};
use std::time::{Duration, Instant};

#[test]
fn a_run_killed_at_random_instants_ends_with_the_same_bytes_whatever_the_threads() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, killed) = (dir.path().join("whole"), dir.path().join("killed"));
    let start = Instant::now();
    assert_success(&nut_assembly(&whole, &["--threads", "1"]).output().unwrap());
    let whole_run = start.elapsed();

    // Seeded, so that a failure can be tried again; the instants still vary with the machine's speed.
    let mut rng = rand::rngs::StdRng::seed_from_u64(7);
    let mut kills = 0;
    for attempt in 0..40 {
        let threads = ["1", "2", "3"][attempt % 3];
        let mut child = nut_assembly(&killed, &["--threads", threads])
            .args(killed.exists().then_some("--resume"))
            .stdout(std::process::Stdio::null())
            .spawn()
            .unwrap();
        let limit = if attempt < 6 { whole_run.mul_f64(rng.random_range(0.02..0.6)) } else { Duration::MAX };
        let begun = Instant::now();
        let status = loop {
            if let Some(status) = child.try_wait().unwrap() {
                break Some(status);
            }
            if begun.elapsed() > limit {
                child.kill().unwrap();
                child.wait().unwrap();
                break None;
            }
            std::thread::sleep(Duration::from_millis(2));
        };
        match status {
            Some(status) => {
                assert!(status.success(), "a resumed run failed");
                break;
            }
            None => kills += 1,
        }
    }
    assert!(kills >= 2, "the run was never killed");
    assert_same_results(&whole, &killed);
}

#[test]
fn a_run_of_a_version_with_other_keys_goes_on_where_a_default_says_how_and_is_refused_elsewhere() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let resume = || nut_assembly(&out, &["--resume", "--set=loop.iterations=0"]).output().unwrap();
    assert_success(&nut_assembly(&out, &["--set=loop.iterations=0"]).output().unwrap());
    let place = out.join("config.toml");
    let whole = std::fs::read_to_string(&place).unwrap();
    let without = |key: &str| -> String {
        let is = |line: &&str| line.split(" =").next() == Some(key);
        assert_eq!(whole.lines().filter(is).count(), 1, "{key} in {whole}");
        whole.lines().filter(|line| !is(line)).flat_map(|line| [line, "\n"]).collect()
    };
    let unknown = whole.replace("[loop]\n", "[loop]\nforgotten = 1\n");
    for (config, word) in [(without("cycles"), "cycles"), (unknown, "forgotten")] {
        std::fs::write(&place, &config).unwrap();
        let output = resume();
        let words = crate::text(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{words}");
        for word in ["config.toml", "expected one of this version", word] {
            assert!(words.contains(word), "expected `{word}` in: {words}");
        }
        assert_eq!(words.lines().count(), 1, "{words}");
        assert_eq!(std::fs::read_to_string(&place).unwrap(), config, "a refused run was changed");
    }
    // Came with a default; and values count, not how they are written.
    for config in
        [without("update_from"), whole.replace("update_from = \"policy\"", "update_from = 'policy'")]
    {
        assert_ne!(config, whole);
        std::fs::write(&place, config).unwrap();
        assert_success(&resume());
        assert_eq!(std::fs::read_to_string(&place).unwrap(), whole);
    }
}

#[test]
fn a_run_made_longer_goes_on_as_if_it_had_been_that_long() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, longer) = (dir.path().join("whole"), dir.path().join("longer"));
    assert_success(&nut_assembly(&whole, &["--set=loop.iterations=1"]).output().unwrap());
    assert_success(&nut_assembly(&longer, &["--set=loop.iterations=0"]).output().unwrap());
    assert_success(&nut_assembly(&longer, &["--resume", "--set=loop.iterations=1"]).output().unwrap());
    let weights =
        |run: &std::path::Path| std::fs::read(run.join("iteration_01/policy/model.safetensors")).unwrap();
    assert!(weights(&whole) == weights(&longer));
    let config = |run: &std::path::Path| std::fs::read_to_string(run.join("config.toml")).unwrap();
    assert_eq!(config(&whole), config(&longer));
}

/// Labels of what earlier rounds brought are made anew from the disk, and the initial policy is the one that all methods share.
#[test]
fn a_run_of_recap_goes_on_with_the_same_bytes_and_begins_as_every_other() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, killed, usual) =
        (dir.path().join("whole"), dir.path().join("killed"), dir.path().join("usual"));
    let two = ["--method", "recap", "--set=loop.iterations=2"];
    assert_success(&nut_assembly(&whole, &two).args(["--threads", "1"]).output().unwrap());
    let mut child = nut_assembly(&killed, &two).stdout(std::process::Stdio::null()).spawn().unwrap();
    while !killed.join("iteration_01/policy/notes.json").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it could be killed");
        std::thread::sleep(Duration::from_millis(2));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    assert!(!killed.join("iteration_02/policy/notes.json").exists(), "it was killed too late");
    assert_success(&nut_assembly(&killed, &two).args(["--resume", "--threads", "2"]).output().unwrap());
    assert_same_results(&whole, &killed);
    assert_success(&nut_assembly(&usual, &["--set=loop.iterations=0"]).output().unwrap());
    let bytes = |run: &std::path::Path, file: &str| std::fs::read(run.join(file)).unwrap();
    let initial = "iteration_00/policy/model.safetensors";
    assert!(bytes(&whole, initial) == bytes(&usual, initial));
    let policy = |n: u32| {
        let text = bytes(&whole, &format!("iteration_{n:02}/policy/policy.json"));
        crate::text(&text).contains("\"indicator\": true")
    };
    assert_eq!([0, 1, 2].map(policy), [false, true, true]);
}
