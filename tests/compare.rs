use crate::{SMALL, assert_success, example, nut_assembly, text};
use auto_e2h::learn::methods;
use auto_e2h::report::compare::Comparison;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

/// Long enough for the demonstrator of the hard task.
const LONG: &str = "--set=env.horizon_hard=400";

/// The methods that run on every pair.
fn everywhere() -> Vec<&'static str> {
    methods::registry().iter().map(|m| m.name).filter(|n| *n != "tr-drl").collect()
}

/// A comparison of every one of them on two pairs.
fn compare(out: &Path, arguments: &[&str]) -> Command {
    let names = everywhere();
    let mut command = example("compare");
    command.args(["--tasks", "nut_assembly,disk", "--methods", &names.join(","), "--seeds", "0"]);
    command.args(["--preset", "smoke", "--trials", "4", "--quiet", "--out"]).arg(out);
    command.args(SMALL).arg(LONG).args(arguments);
    command
}

fn done(out: &Path) -> usize {
    ["nut_assembly", "disk"]
        .iter()
        .flat_map(|task| std::fs::read_dir(out.join(task)).into_iter().flatten().flatten())
        .filter(|e| e.path().extension().is_some_and(|e| e == "json"))
        .count()
}

#[test]
fn all_methods_on_two_pairs_stopped_sharded_and_merged() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("compare");
    let all = 2 * everywhere().len();

    // Asked to stop, it stops its runs, which save what they have.
    let mut child = compare(&out, &[]).stderr(Stdio::piped()).spawn().unwrap();
    while !out.join("nut_assembly").join("auto-e2h-0/run.json").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended before it began");
        std::thread::sleep(Duration::from_millis(20));
    }
    assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
    let stopped = child.wait_with_output().unwrap();
    assert_eq!(stopped.status.code(), Some(143), "{}", text(&stopped.stderr));
    assert!(text(&stopped.stderr).contains("goes on from here"));
    assert!(done(&out) < all);

    // One of two machines, then the other one.
    assert_success(&compare(&out, &["--shard", "1/2"]).output().unwrap());
    assert_eq!(done(&out), all.div_ceil(2));
    let output = compare(&out, &["--shard", "2/2"]).output().unwrap();
    assert_success(&output);
    assert!(text(&output.stdout).contains(&format!("{all} of {all} runs")), "{}", text(&output.stdout));

    let json = std::fs::read_to_string(out.join("compare.json")).unwrap();
    let comparison: Comparison = serde_json::from_str(&json).unwrap();
    assert_eq!(comparison.methods().len(), everywhere().len());
    assert_eq!(comparison.reference, "auto-e2h");
    assert!(comparison.runs.iter().all(|r| r.last.outcomes.len() == 4 && r.initial.trials == 4));
    for name in everywhere().into_iter().filter(|n| *n != "auto-e2h") {
        for column in ["compare.html", "iterations.csv", "trials.csv"] {
            assert!(std::fs::read_to_string(out.join(column)).unwrap().contains(name), "{column}: {name}");
        }
    }

    // Nothing is left to do, and the page of what is there is the same.
    assert_success(&compare(&out, &["--merge"]).output().unwrap());
    assert_eq!(std::fs::read_to_string(out.join("compare.json")).unwrap(), json);

    // A run that began with another one's demonstrations and policies ends like one that made its own.
    let alone = dir.path().join("alone");
    assert_success(&nut_assembly(&alone, &["--method", "direct-h", LONG]).output().unwrap());
    let shared = out.join("nut_assembly/direct-h-0");
    for file in
        ["demonstrations/data", "policy_easy/model.safetensors", "iteration_00/policy/model.safetensors"]
    {
        assert!(shared.join(file).exists(), "{file}");
    }
    let weights = |run: &Path, file: &str| std::fs::read(run.join(file)).unwrap();
    for file in [
        "policy_easy/model.safetensors",
        "iteration_00/policy/model.safetensors",
        "iteration_01/policy/model.safetensors",
    ] {
        assert_eq!(weights(&alone, file), weights(&shared, file), "{file}");
    }
    // It was copied: its provenance is of the run that made it.
    let provenance = std::fs::read_to_string(shared.join("iteration_00/policy/policy.json")).unwrap();
    let first = out.join("nut_assembly/auto-e2h-0/iteration_00/policy/policy.json");
    assert_eq!(provenance, std::fs::read_to_string(first).unwrap());

    // Four trials tell nothing apart, so there are more; once that is the plan, it stays so.
    assert_success(&compare(&out, &["--until-decided", "8"]).output().unwrap());
    let json = std::fs::read_to_string(out.join("compare.json")).unwrap();
    let more: Comparison = serde_json::from_str(&json).unwrap();
    assert_eq!(more.until_decided, Some(8));
    for (before, after) in comparison.runs.iter().zip(&more.runs) {
        assert_eq!(after.last.outcomes.len(), 8, "{}", after.results.method);
        assert_eq!(after.last.outcomes[..4], before.last.outcomes[..], "{}", after.results.method);
    }
    assert_success(&compare(&out, &["--merge"]).output().unwrap());
    assert_eq!(std::fs::read_to_string(out.join("compare.json")).unwrap(), json);
    assert!(std::fs::read_to_string(out.join("compare.html")).unwrap().contains("s a demonstration"));

    // What is not of this comparison is refused before any work.
    let refused = |arguments: &[&str], words: &[&str]| {
        let output = compare(&out, arguments).output().unwrap();
        let told = text(&output.stderr);
        assert!(!output.status.success(), "{arguments:?}");
        assert!(words.iter().all(|w| told.contains(w)), "{arguments:?}: {told}");
        assert_eq!(told.trim_end().lines().count(), 1, "{told}");
    };
    refused(&["--set", "loop.cycles=3"], &["another comparison", "loop.cycles=3"]);
    refused(&["--evaluation-seed", "1"], &["another comparison", "800000"]);
    refused(&["--until-decided", "9"], &["another comparison", "until_decided"]);
    refused(&["--until-decided", "3"], &["--until-decided", "--trials (4)"]);
    refused(&["--shard", "3/2"], &["--shard", "1 to N", "3/2"]);
    refused(&["--only", "disk/auto-e2h/7"], &["--only", "disk/auto-e2h/7"]);
}

#[test]
fn what_cannot_run_is_said_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |arguments: &[&str], words: &str| {
        let out = dir.path().join("none");
        let output = example("compare").args(arguments).arg("--out").arg(&out).output().unwrap();
        let told = text(&output.stderr);
        assert!(!output.status.success() && told.contains(words), "{arguments:?}: {told}");
        assert!(!out.exists(), "{arguments:?}");
    };
    refused(&["--tasks", "nut_asembly"], "did you mean `nut_assembly`");
    refused(&["--tasks", "disk", "--methods", "auto-e2h,direkt-h"], "did you mean `direct-h`");
    refused(&["--tasks", "nut_assembly,disk", "--methods", "auto-e2h,tr-drl"], "found disk");
    refused(&["--tasks", "disk", "--preset", "smok"], "did you mean `smoke`");
    refused(&["--tasks", "disk", "--set", "loop.cycels=3"], "loop.cycles");
    refused(&["--tasks", "disk,disk"], "named twice");
    refused(&["--tasks", "disk", "--trials", "0"], "--trials");
    refused(&["--tasks", "disk", "--device", "gpu"], "cpu, cuda or cuda:N");
    refused(&["--tasks", "disk", "--merge"], "no plan.json");
    // Somebody else's folder stays as it is.
    std::fs::write(dir.path().join("mine.txt"), "x").unwrap();
    let output = example("compare").args(["--tasks", "disk", "--out"]).arg(dir.path()).output().unwrap();
    assert!(!output.status.success() && text(&output.stderr).contains("another folder"));
}

#[test]
fn agents_from_states_are_compared_like_any_other_method() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("compare");
    let mut command = example("compare");
    command.args([
        "--tasks",
        "nut_assembly",
        "--methods",
        "auto-e2h,tr-drl",
        "--seeds",
        "0",
        "--preset",
        "smoke",
    ]);
    command.args(["--trials", "4", "--quiet", "--set=loop.iterations=1", "--out"]).arg(&out).args(SMALL);
    assert_success(&command.output().unwrap());
    let json = std::fs::read_to_string(out.join("compare.json")).unwrap();
    let comparison: Comparison = serde_json::from_str(&json).unwrap();
    assert_eq!(comparison.methods(), ["auto-e2h", "tr-drl"]);
    assert!(comparison.runs.iter().all(|r| r.last.outcomes.len() == 4 && r.initial.trials == 4));
    assert!(std::fs::read_to_string(out.join("compare.html")).unwrap().contains("tr-drl"));
}
