use auto_e2h::core::{Direction, Kind, Origin, stream};
use auto_e2h::data::Source;
use auto_e2h::data::lerobot::Dataset;
use auto_e2h::env::{Env, demonstrate, task};
use auto_e2h::learn::methods::Recap;
use auto_e2h::learn::{
    Accepted, Collected, Json, Lesson, Method, Parts, Result, Round, Run, RunOptions, Tools,
};
use auto_e2h::policy::DiffusionPolicy;
use auto_e2h::refine::{Fate, reverse};
use auto_e2h::report::folder::sealed;
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

fn options(out: &Path) -> RunOptions {
    RunOptions {
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
        quiet: true,
        ..RunOptions::new("nut_assembly")
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
    let accepted = run.lesson(1, &base, &*hard, || Ok(collected)).unwrap();

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
    let stored = run.lesson(1, &base, &*hard, || unreachable!("it is stored")).unwrap();
    assert_eq!(stored.segments, accepted.segments);
    assert_eq!(stored.collection, accepted.collection);

    let updated = run.update(1, &*hard, &base, &[accepted]).unwrap();
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
    let accepted = run.lesson(1, &base, &*hard, || Ok(collected)).unwrap();
    assert!(accepted.collection.notes.iter().any(|n| n.contains("no hard rollout succeeded")));
    assert!(!accepted.collection.fates.contains_key(&Fate::LowAdvantage));
    assert!(!accepted.segments.is_empty());

    let none = [run.lesson(2, &base, &*hard, || Ok(Collected::default())).unwrap()];
    assert!(none[0].segments.is_empty());
    let same = run.update(2, &*hard, &base, &none).unwrap();
    assert_eq!(same.weights().unwrap(), hard.weights().unwrap());
    let record = run.evaluate(2, &*same, none.last()).unwrap();
    assert!(record.skipped);
}

#[test]
fn every_method_makes_its_own_lesson_of_the_same_rollouts() {
    let dir = tempfile::tempdir().unwrap();
    let lesson = |method: &str| {
        let mut options = options(&dir.path().join(method));
        method.clone_into(&mut options.method);
        options.set.push("train.initial_steps=2".to_owned());
        let run = Run::open(&options).unwrap();
        let demonstrations = run.demonstrations().unwrap();
        let hard = run.train_initial(&demonstrations).unwrap();
        run.lesson(1, &demonstrations, &*hard, || Ok(scripted(&run))).unwrap()
    };
    let [whole, literal, no_kinematic, no_critic, direct] =
        ["auto-e2h", "auto-e2h-literal", "no-kinematic", "no-critic", "direct-h"].map(lesson);
    let fates = |accepted: &Accepted| accepted.collection.fates.clone();

    assert!(fates(&whole).contains_key(&Fate::LowAdvantage) && fates(&whole).contains_key(&Fate::Static));
    // No gates: what they say is not in the notes, and pauses shorter than 16 frames stay.
    assert!(literal.collection.notes.iter().all(|n| n.contains("0 of") || !n.starts_with("suffix")));
    assert!(fates(&literal).get(&Fate::Static) < fates(&whole).get(&Fate::Static));
    assert!(
        !fates(&no_kinematic).contains_key(&Fate::Static)
            && !fates(&no_kinematic).contains_key(&Fate::Resampled)
    );
    assert!(fates(&no_kinematic).contains_key(&Fate::LowAdvantage));
    assert!(
        !fates(&no_critic).contains_key(&Fate::LowAdvantage) && no_critic.collection.critic_loss.is_none()
    );
    // Hard successes, forwards, each with its own labels.
    assert_eq!((direct.collection.accepted, direct.collection.hard_successes), (3, 3));
    for segment in &direct.segments {
        assert!(segment.origin.direction == Direction::Hard && !segment.origin.reversed);
    }
}

#[test]
fn recap_learns_from_every_rollout_with_the_label_that_its_outcome_or_its_source_says() {
    let dir = tempfile::tempdir().unwrap();
    let open = |name: &str, set: &[&str], resume: bool| {
        let mut options = options(&dir.path().join(name));
        "recap".clone_into(&mut options.method);
        options.set.push("train.initial_steps=2".to_owned());
        options.set.extend(set.iter().map(|s| (*s).to_owned()));
        options.resume = resume;
        Run::open(&options).unwrap()
    };
    let run = open("run", &[], false);
    let base = run.demonstrations().unwrap();
    let hard = run.train_initial(&base).unwrap();
    let collected = scripted(&run);
    let rollouts = collected.hard.clone();
    let made = run.lesson(1, &base, &*hard, || Ok(collected)).unwrap();
    // Three successes and the first half of a fourth, whole and forwards; labels as those of reversals.
    assert_eq!((made.segments.len(), made.collection.accepted), (4, 4));
    for (segment, rollout) in made.segments.iter().zip(&rollouts) {
        assert!(segment.origin.direction == Direction::Hard && !segment.origin.reversed);
        assert_eq!((&segment.state, segment.outcome), (&rollout.state, rollout.outcome));
        assert_eq!(segment.terminal, rollout.outcome.is_success());
        assert_eq!(segment.action[3][..3], segment.state[4][..3], "the goal is the pose that followed");
    }
    let frames: usize = rollouts.iter().map(auto_e2h::core::Episode::len).sum();
    let share = 100.0 * (frames - rollouts[3].len()) as f64 / frames as f64;
    let note = format!("recap: 3 of 4 rollouts are positive, {share:.0} % of their frames");
    assert_eq!(made.collection.notes, [note]);
    assert!(made.collection.critic_loss.is_none());

    // What another process reads back has the same labels: they are in what is stored.
    drop(run);
    let run = open("run", &[], true);
    let read = run.lesson(1, &base, &*hard, || unreachable!("it is stored")).unwrap();
    assert_eq!(read.segments, made.segments);
    let rounds = [&read.segments[..], &made.segments[..]];
    let rows = |s: &Source| s.episodes.iter().map(|e| e.len()).sum::<usize>() as f32;
    let sources = Recap.sources(&base, &rounds, run.config());
    let labels: Vec<_> = sources.iter().map(|s| (s.label, s.episodes.len())).collect();
    // Two rounds, because what is accepted accumulates.
    assert_eq!(labels, [(Some(1.0), base.hard.len()), (Some(1.0), 6), (Some(-1.0), 2)]);
    assert!((sources[0].share - 0.5).abs() < 1e-6);
    assert!((sources[1].share + sources[2].share - 0.5).abs() < 1e-6);
    let (good, bad) = (sources[1].share / rows(&sources[1]), sources[2].share / rows(&sources[2]));
    assert!((good / bad - 1.0).abs() < 1e-4, "a window of a rollout is as likely as any other: {good} {bad}");

    let literal = open("source", &["recap.indicator=source", "loop.accumulate=false"], false);
    let sources = Recap.sources(&base, &rounds, literal.config());
    let labels: Vec<_> = sources.iter().map(|s| (s.label, s.episodes.len())).collect();
    assert_eq!(labels, [(Some(1.0), base.hard.len()), (Some(1.0), 0), (Some(-1.0), 4)]);

    // Updates have the indicator and what it is sampled with, from the first on; the policy before has not.
    let policy = |place: &Path| DiffusionPolicy::load(place).unwrap().1.config;
    assert!(!policy(&run.path().join("iteration_00/policy")).indicator);
    drop(run);
    let guided = open("guided", &["recap.guidance=2.0"], false);
    guided.train_initial(&guided.demonstrations().unwrap()).unwrap();
    let updated = guided.update(1, &*hard, &base, &[read]).unwrap();
    let found = policy(&guided.path().join("iteration_01/policy"));
    assert!(found.indicator && (found.guidance - 2.0).abs() < 1e-6, "{found:?}");
    assert!((policy(&guided.path().join("iteration_00/policy")).guidance - 1.0).abs() < 1e-6);
    // And the next goes on from there.
    let again = guided.update(2, &*updated, &base, &[made]).unwrap();
    assert_ne!(again.weights().unwrap(), updated.weights().unwrap());
}

#[test]
fn tr_drl_dp_keeps_what_dynamics_models_confirm_and_labels_it_by_the_inverse_one() {
    let dir = tempfile::tempdir().unwrap();
    let open = |name: &str, set: &[&str]| {
        let mut options = options(&dir.path().join(name));
        "tr-drl-dp".clone_into(&mut options.method);
        options.set.push("train.initial_steps=2".to_owned());
        options.set.extend(set.iter().map(|s| (*s).to_owned()));
        Run::open(&options).unwrap()
    };
    let lesson = |name: &str, set: &[&str]| {
        let run = open(name, set);
        let base = run.demonstrations().unwrap();
        let hard = run.train_initial(&base).unwrap();
        let collected = scripted(&run);
        let reversed: Vec<_> =
            collected.easy.iter().map(|e| reverse(e, &run.config().refine.reverse)).collect();
        (run.lesson(1, &base, &*hard, || Ok(collected)).unwrap(), reversed, run)
    };
    let (made, reversed, run) = lesson("run", &[]);
    let fates = &made.collection.fates;
    let frames: usize = reversed.iter().map(|e| e.len()).sum();
    assert_eq!(fates.values().sum::<usize>(), frames);
    // A fifth goes whatever the errors are, and with it what is too short.
    let gone = fates[&Fate::DynamicsError] as f64 / frames as f64;
    assert!((gone - 0.2).abs() < 0.01, "{gone}");
    assert!(fates.keys().all(|f| [Fate::Kept, Fate::DynamicsError, Fate::TooShort].contains(f)), "{fates:?}");
    assert!(made.collection.notes[0].contains("mm from the next poses"), "{:?}", made.collection.notes);
    assert!(made.collection.critic_loss.is_none());
    for segment in &made.segments {
        let from = reversed.iter().find(|e| e.origin.episode == segment.origin.episode).unwrap();
        let row = from.source.iter().position(|s| *s == segment.source[0]).unwrap();
        assert_eq!(segment.state[0], from.state[row]);
        assert_ne!(segment.action[0][..3], from.action[row][..3], "labels are the inverse model's");
        assert_eq!(segment.action[0][7], from.action[row][7], "the gripper's are the recording's");
    }
    let reversals = std::fs::read_to_string(run.path().join("iteration_01/reversals.json")).unwrap();
    assert!(reversals.contains("dynamics_error"));
    let picture = std::fs::read_to_string(run.path().join("iteration_01/filter.svg")).unwrap();
    assert!(picture.contains("dynamics error"));

    // Every value counts.
    let base: Vec<_> = made.segments.iter().map(|s| (s.source.clone(), s.action.clone())).collect();
    for (i, set) in [
        "dynamics.gates=true",
        "dynamics.network.hidden=[8]",
        "dynamics.network.steps=21",
        "dynamics.network.batch=63",
        "dynamics.network.lr=0.002",
        "dynamics.network.validation=0.5",
        "dynamics.filter.smooth=3",
        "dynamics.filter.percentile=50.0",
        "dynamics.filter.min_run=150",
    ]
    .into_iter()
    .enumerate()
    {
        // No scripted recording fails the usual gates: none is as still in the hand as this asks for.
        let strict = "refine.gate.slip_m=0.0000001";
        let (other, ..) = lesson(&format!("other{i}"), &[set, strict]);
        let other: Vec<_> = other.segments.iter().map(|s| (s.source.clone(), s.action.clone())).collect();
        assert!(base != other, "{set}");
    }
}

#[test]
fn hard_demonstrations_alone_are_of_the_hard_task() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options(&dir.path().join("run"));
    options.method = "hard-demos".to_owned();
    options.set.push("train.initial_steps=2".to_owned());
    let run = Run::open(&options).unwrap();
    assert_eq!(run.iterations(), 0);
    run.train_initial(&run.demonstrations().unwrap()).unwrap();
    let recorded = Dataset::open(run.path().join("demonstrations_hard")).unwrap();
    let first = recorded.read_episode(0).unwrap();
    assert!(first.origin.direction == Direction::Hard && first.outcome.is_success());
    assert_eq!(recorded.len(), 2);
}

#[test]
fn a_stage_of_ones_own_is_made_once_and_verified() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options(&dir.path().join("run"));
    let make = |run: &Run, made: &std::cell::Cell<u32>| {
        run.stage("mine/counts.json", || {
            made.set(made.get() + 1);
            Ok(Json(BTreeMap::from([("nuts".to_owned(), 3)])))
        })
    };
    let made = std::cell::Cell::new(0);
    let first = make(&Run::open(&options).unwrap(), &made).unwrap();
    options.resume = true;
    let run = Run::open(&options).unwrap();
    assert_eq!(make(&run, &made).unwrap(), first);
    assert_eq!(made.get(), 1);
    let file = run.path().join("mine/counts.json");
    let text = std::fs::read_to_string(&file).unwrap().replace("\"nuts\": 3", "\"nuts\": 4");
    std::fs::write(&file, text).unwrap();
    let message = make(&run, &made).unwrap_err().to_string();
    assert!(message.contains("counts.json") && message.contains("SHA-256"), "{message}");
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
    let collected = run.collect(1, &*hard, &*easy).unwrap();
    assert_eq!(collected.easy.len() + collected.rejected.len(), collected.easy_rollouts);

    let kept = Dataset::open(run.path().join("iteration_01/rollouts")).unwrap();
    assert_eq!(kept.len(), collected.hard.len() + collected.easy_rollouts);
    assert_eq!(kept.read_episode(0).unwrap(), collected.hard[0], "each cycle begins with its hard rollout");
    assert_eq!(kept.read_episode(1).unwrap().origin.direction, Direction::Easy);
    // The second collection of a resumed run leaves the dataset as it is.
    run.collect(1, &*hard, &*easy).unwrap();
}

#[test]
fn minutes_of_a_stage_are_those_of_all_processes_that_worked_on_it() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options(&dir.path().join("run"));
    options.set.push("train.initial_steps=2".to_owned());
    let run = Run::open(&options).unwrap();
    let demonstrations = run.demonstrations().unwrap();
    options.stop.ask(15);
    assert!(run.train_initial(&demonstrations).is_err(), "it was asked to stop");
    // As if it had worked for long.
    let spent = run.path().join("iteration_00/policy/training.json");
    let text = std::fs::read_to_string(&spent).unwrap();
    assert!(text.contains("\"minutes\""), "{text}");
    std::fs::write(&spent, format!("{}\n", sealed("{\n  \"minutes\": 1000.0\n}"))).unwrap();
    drop(run);

    options.stop = auto_e2h::learn::Stop::default();
    options.resume = true;
    let run = Run::open(&options).unwrap();
    let hard = run.train_initial(&demonstrations).unwrap();
    let minutes = run.evaluate(0, &*hard, None).unwrap().stage_minutes["train"];
    assert!((1000.0..1001.0).contains(&minutes), "{minutes}");
    assert!(!spent.exists(), "left over");
}

/// Learns nothing from a round.
struct Idle;

impl Method for Idle {
    fn name(&self) -> &str {
        "idle"
    }

    fn lesson(&self, _: &Round<'_>, _: &Tools<'_>) -> Result<Lesson> {
        Ok(Lesson::default())
    }
}

#[test]
fn a_method_of_ones_own_is_told_from_the_usual_one() {
    let dir = tempfile::tempdir().unwrap();
    let mut options = options(&dir.path().join("run"));
    options.set.push("train.initial_steps=2".to_owned());
    let parts = Parts { method: Some(Arc::new(Idle)), ..Parts::default() };
    let run = Run::open_with(&options, &parts).unwrap();
    let base = run.demonstrations().unwrap();
    let hard = run.train_initial(&base).unwrap();
    let accepted = run.lesson(1, &base, &*hard, || Ok(scripted(&run))).unwrap();
    assert!(accepted.segments.is_empty() && accepted.collection.hard_successes == 3);
    drop(run);

    options.resume = true;
    let message = Run::open(&options).err().unwrap().to_string();
    assert!(message.contains("found nut_assembly smoke idle diffusion seed 5"), "{message}");
    Run::open_with(&options, &parts).unwrap();
}
