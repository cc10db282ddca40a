use auto_e2h::core::{Direction, Kind, Origin, stream};
use auto_e2h::data::lerobot::Dataset;
use auto_e2h::env::{Env, demonstrate, task};
use auto_e2h::learn::{Collected, Run, RunOptions};
use auto_e2h::refine::Fate;
use std::path::Path;
use std::time::Duration;

fn options(out: &Path) -> RunOptions {
    RunOptions {
        task: "nut_assembly".to_owned(),
        preset: "smoke".to_owned(),
        seed: 5,
        // People who pause, and little training.
        set: [
            "env.horizon_hard=500",
            "env.horizon_easy=500",
            "task.demonstrator.speed=[0.10, 0.22]",
            "task.demonstrator.pause_probability=0.3",
            "task.demonstrator.slow_probability=0.25",
            "loop.demonstrations=2",
            "loop.cycles=2",
            "train.easy_steps=40",
            "train.initial_steps=20",
            "train.update_steps=20",
        ]
        .map(str::to_owned)
        .to_vec(),
        out: Some(out.to_owned()),
        resume: false,
        device: "cpu".to_owned(),
        threads: None,
        quiet: true,
        tensorboard: false,
        stop: auto_e2h::learn::Stop::default(),
    }
}

/// Scripted episodes in place of rollouts: what a trained pair of policies would bring, without the training.
fn scripted(run: &Run) -> Collected {
    let config = run.config();
    let pair = task(&config.task.name, &config.task.options()).unwrap();
    let mut env = Env::new(pair, &config.env).unwrap();
    let mut record = |direction: Direction, episode: u32| {
        let mut origin = Origin::demonstration("nut_assembly", direction, episode, 5);
        (origin.kind, origin.iteration) = (Kind::Rollout, 1);
        let mut rng = stream(77, direction.name(), 0, u64::from(episode));
        let episode = demonstrate(&mut env, direction, &config.task.demonstrator, origin, &mut rng).unwrap();
        assert!(episode.outcome.is_success());
        episode
    };
    let easy: Vec<_> = (0..3).map(|i| record(Direction::Easy, i)).collect();
    let mut hard: Vec<_> = (0..4).map(|i| record(Direction::Hard, i)).collect();
    // One failure: the first half of a success.
    let half: Vec<usize> = (0..hard[3].len() / 2).collect();
    hard[3] = hard[3].select(&half);
    hard[3].outcome = auto_e2h::core::Outcome::Timeout;
    Collected { easy_rollouts: 4, easy_successes: 3, hard, easy, ..Collected::default() }
}

#[test]
fn accepted_rollouts_are_refined_stored_and_learned_from() {
    let dir = tempfile::tempdir().unwrap();
    let run = Run::open(&options(&dir.path().join("run"))).unwrap();
    let base = run.demonstrations().unwrap();
    let hard = run.train_initial(&base).unwrap();
    let collected = scripted(&run);
    let frames: usize = collected.easy.iter().map(auto_e2h::core::Episode::len).sum();
    let accepted = run.refine(1, collected, Duration::ZERO, &base, &hard).unwrap();

    let c = &accepted.collection;
    assert_eq!((c.accepted, c.hard_successes), (3, 3));
    assert_eq!(c.fates.values().sum::<usize>(), frames, "every frame has one fate: {:?}", c.fates);
    assert_eq!(c.frames_kept, accepted.segments.iter().map(|s| s.len()).sum::<usize>());
    assert!(c.fates[&Fate::Kept] < frames && c.fates.contains_key(&Fate::LowAdvantage), "{:?}", c.fates);
    assert!(c.critic_loss.is_some_and(f64::is_finite));
    assert!(matches!(&c.notes[..], [goals] if goals.starts_with("goals:")), "{:?}", c.notes);
    for segment in &accepted.segments {
        segment.validate().unwrap();
        assert!(segment.origin.reversed && segment.origin.kind == Kind::Refined);
    }
    let stored = run.stored(1).unwrap().unwrap();
    assert_eq!(stored.segments, accepted.segments);
    assert_eq!(stored.collection, accepted.collection);

    let updated = run.update(1, &hard, &base, &run.training_set(1, &accepted).unwrap()).unwrap();
    assert_ne!(updated.weights().unwrap(), hard.weights().unwrap());
}

#[test]
fn without_a_hard_success_the_critic_is_skipped_and_without_rollouts_the_update() {
    let dir = tempfile::tempdir().unwrap();
    let run = Run::open(&options(&dir.path().join("run"))).unwrap();
    let base = run.demonstrations().unwrap();
    let hard = run.train_initial(&base).unwrap();
    let mut collected = scripted(&run);
    collected.hard.retain(|e| !e.outcome.is_success());
    let accepted = run.refine(1, collected, Duration::ZERO, &base, &hard).unwrap();
    assert!(accepted.collection.notes.iter().any(|n| n.contains("no hard rollout succeeded")));
    assert!(!accepted.collection.fates.contains_key(&Fate::LowAdvantage));
    assert!(!accepted.segments.is_empty());

    let none = run.refine(2, Collected::default(), Duration::ZERO, &base, &hard).unwrap();
    assert!(none.segments.is_empty());
    let same = run.update(2, &hard, &base, &none.segments).unwrap();
    assert_eq!(same.weights().unwrap(), hard.weights().unwrap());
    let record = run.evaluate(2, &same, Some(&none)).unwrap();
    assert!(record.skipped);
}

#[test]
fn all_rollouts_are_kept_as_a_dataset_when_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options(&dir.path().join("run"));
    options.set.extend(
        ["loop.keep_rollouts=true", "train.easy_steps=2", "train.initial_steps=2"].map(str::to_owned),
    );
    let run = Run::open(&options).unwrap();
    let base = run.demonstrations().unwrap();
    let (easy, hard) = (run.train_easy(&base).unwrap(), run.train_initial(&base).unwrap());
    let collected = run.collect(1, &hard, &easy).unwrap();
    assert_eq!(collected.easy.len() + collected.rejected.len(), collected.easy_rollouts);

    let kept = Dataset::open(run.path().join("iteration_01/rollouts")).unwrap();
    assert_eq!(kept.len(), collected.hard.len() + collected.easy_rollouts);
    assert_eq!(kept.read_episode(0).unwrap(), collected.hard[0], "each cycle begins with its hard rollout");
    assert_eq!(kept.read_episode(1).unwrap().origin.direction, Direction::Easy);
    // The second collection of a resumed run leaves the dataset as it is.
    run.collect(1, &hard, &easy).unwrap();
}
