use crate::{assert_success, example, text};

#[test]
fn nut_assembly_runs_from_nothing_and_its_checkpoint_evaluates() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let output = example("nut_assembly")
        .args(["--preset", "smoke", "--seed", "3", "--out"])
        .arg(&out)
        .output()
        .unwrap();
    assert_success(&output);
    let printed = text(&output.stdout);
    assert!(printed.contains("report.html") && printed.contains("Wilson"), "{printed}");
    let html = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(html.contains("<svg") && html.contains("nut_assembly"));
    assert!(
        !html.contains("http://") || html.contains("http://www.w3.org"),
        "the page refers to the network"
    );
    assert!(out.join("results.json").exists());

    let video = dir.path().join("rollouts.png");
    let output = example("evaluate")
        .args(["--trials", "2", "--seed", "5", "--json", "--filmed", "1", "--checkpoint"])
        .arg(out.join("iteration_01/policy"))
        .arg("--video")
        .arg(&video)
        .output()
        .unwrap();
    assert_success(&output);
    let line = text(&output.stdout);
    assert_eq!(line.lines().count(), 1, "{line}");
    let value: serde_json::Value = serde_json::from_str(&line).unwrap();
    assert_eq!(value["task"], "nut_assembly");
    assert_eq!(value["trials"], 2);
    assert!(value["successes"].is_u64() && value["wilson95"].as_array().unwrap().len() == 2);
    assert!(std::fs::read(video).unwrap().starts_with(b"\x89PNG"));
}

#[test]
fn experts_print_one_line_a_pair() {
    let output = example("experts").args(["--all", "--trials", "2", "--json"]).output().unwrap();
    assert_success(&output);
    let printed = text(&output.stdout);
    for line in printed.lines() {
        let value: serde_json::Value = serde_json::from_str(line).unwrap();
        for key in ["trials", "hard_expert", "easy_expert", "reversed_replay"] {
            assert_eq!(value[key], 2, "{line}");
        }
    }
    assert!(printed.lines().count() >= 1);
}
