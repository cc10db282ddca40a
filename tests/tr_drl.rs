//! The method `tr-drl`: its loop, its record, and how it goes on.

use auto_e2h::core::Direction;
use auto_e2h::learn::{Progress, Published, Run, RunOptions, Stop, evaluate};
use std::path::Path;

fn options(out: &Path, set: &[&str]) -> RunOptions {
    let mut all: Vec<String> =
        ["loop.iterations=2", "loop.demonstrations=2", "evaluation.trials=2", "env.horizon_easy=300"]
            .map(str::to_owned)
            .to_vec();
    all.extend(set.iter().map(|s| (*s).to_owned()));
    RunOptions {
        preset: "smoke".to_owned(),
        method: "tr-drl".to_owned(),
        seed: 3,
        set: all,
        out: Some(out.to_owned()),
        quiet: true,
        ..RunOptions::new("nut_assembly")
    }
}

/// Demonstrations are played again from where they began, which their own seed draws.
#[test]
fn demonstrations_of_a_run_with_another_seed_are_adapted_all_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let [own, given] = ["own", "given"].map(|n| dir.path().join(n));
    Run::open(&options(&own, &["loop.iterations=0"])).unwrap().learn().unwrap();
    let other = RunOptions {
        seed: 8,
        demonstrations: Some(own.join("demonstrations")),
        ..options(&given, &["loop.iterations=0"])
    };
    let (results, _) = Run::open(&other).unwrap().learn().unwrap();
    assert_eq!((results.seed, results.given.unwrap().episodes), (8, 2));
}

/// The weights that a run of these values ends with.
fn weights(out: &Path, set: &[&str]) -> Vec<u8> {
    Run::open(&options(out, set)).unwrap().learn().unwrap();
    let last =
        std::fs::read_dir(out).unwrap().flatten().map(|e| e.path()).filter(|p| p.join("policy").exists());
    std::fs::read(last.max().unwrap().join("policy/model.safetensors")).unwrap()
}

#[test]
fn both_agents_learn_and_what_they_leave_is_a_run_like_any_other() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let run = Run::open(&options(&out, &["tr_drl.demonstrations=both"])).unwrap();
    let (results, page) = run.learn().unwrap();
    assert_eq!((results.method.as_str(), results.iterations.len()), ("tr-drl", 3));
    let last = &results.iterations[2];
    let collection = last.collection.as_ref().unwrap();
    assert_eq!((collection.cycles, collection.easy_rollouts), (2, 2));
    // Nothing resets itself here.
    assert_eq!((collection.resets.values().sum::<usize>(), collection.automatic_reset_rate()), (4, 0.0));
    // Two episodes of two directions; in the first of each no update.
    assert!(last.updates > 300 && !last.skipped, "{}", last.updates);
    assert!(collection.notes.iter().any(|n| n.contains("reversed transitions confirmed")));
    assert!(std::fs::read_to_string(page).unwrap().contains("iteration 2"));
    assert!(results.hard_demonstration_steps.is_some());
    // Of agents and optimisers the last round's are kept; of episodes all.
    let there = |n: u32, file: &str| out.join(format!("iteration_{n:02}/{file}")).exists();
    assert!(!there(1, "agents.safetensors") && there(2, "agents.safetensors"));
    assert!(there(1, "episodes.safetensors") && there(2, "episodes.safetensors"));

    // Its policy stands alone, and does what was measured.
    let published = Published::open(&out.join("iteration_02/policy")).unwrap();
    assert_eq!((published.policy().n_obs_steps(), published.direction), (1, Direction::Hard));
    let envs = published.envs(1).unwrap();
    let seed = published.config.evaluation.seed;
    let again =
        evaluate(envs, published.policy(), Direction::Hard, 0..2, seed, None, &Progress::new(true)).unwrap();
    assert_eq!(again.evaluation.outcomes, last.evaluation.outcomes);
}

#[test]
fn a_run_that_was_stopped_ends_with_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let whole = weights(&dir.path().join("whole"), &[]);
    let out = dir.path().join("stopped");
    // Shorter, and then as long: what a stop after the first round leaves.
    Run::open(&options(&out, &["loop.iterations=1"])).unwrap().learn().unwrap();
    let stop = Stop::default();
    stop.ask(15);
    let stopped = RunOptions { resume: true, stop, ..options(&out, &[]) };
    assert!(Run::open(&stopped).unwrap().learn().is_err());
    let again = RunOptions { resume: true, ..options(&out, &[]) };
    Run::open(&again).unwrap().learn().unwrap();
    assert!(std::fs::read(out.join("iteration_02/policy/model.safetensors")).unwrap() == whole);

    // A damaged round is named.
    let file = out.join("iteration_01/episodes.safetensors");
    let mut bytes = std::fs::read(&file).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    std::fs::remove_file(out.join("results.json")).unwrap();
    let told = Run::open(&again).unwrap().learn().unwrap_err().to_string();
    assert!(told.contains("episodes.safetensors") && !told.contains('\n'), "{told}");
}

#[test]
fn every_value_counts() {
    let dir = tempfile::tempdir().unwrap();
    let with = |set: &str| {
        let all: Vec<&str> = [
            "loop.iterations=1",
            "tr_drl.demonstrations=both",
            "tr_drl.episodes=1",
            "tr_drl.random_episodes=0",
        ]
        .into_iter()
        .chain(set.split(' ').filter(|s| !s.is_empty()))
        .collect();
        weights(&dir.path().join(set.replace([' ', '='], "_") + "x"), &all)
    };
    let before = with("");
    assert!(before == with(" "));
    for change in [
        "tr_drl.demonstrations=easy",
        "tr_drl.reward=literal",
        "tr_drl.episodes=2",
        "tr_drl.random_episodes=1",
        "tr_drl.batch=[16,8,7]",
        "tr_drl.tolerance=1.0",
        "tr_drl.shaping=10.0",
        "tr_drl.shaping_limit=0.1",
        "tr_drl.potential_steps=11",
        "tr_drl.agent.hidden=[8]",
        "tr_drl.agent.layer_norm=false",
        "tr_drl.agent.entropy_in_target=true",
        "tr_drl.agent.gamma=0.9",
        "tr_drl.agent.tau=0.5",
        "tr_drl.agent.lr=0.001",
        "tr_drl.agent.alpha=0.5",
        "tr_drl.agent.actor_every=1",
        "tr_drl.agent.restart_above=1e-6",
    ] {
        assert!(with(change) != before, "{change}");
    }
}

#[test]
fn pairs_that_its_agents_do_not_know_are_refused_by_name_before_any_work() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let mut other = RunOptions { set: vec![], ..options(&out, &[]) };
    "disk".clone_into(&mut other.task);
    let told = Run::open(&other).err().unwrap().to_string();
    assert!(told.contains("nut_assembly (loose), peg_insertion") && told.contains("found disk"), "{told}");
    assert!(!out.exists());
    let square = options(&out, &["task.variant=square"]);
    assert!(Run::open(&square).err().unwrap().to_string().contains("found nut_assembly (square)"));
    assert!(square.resolve().is_err() && !out.exists());
}
