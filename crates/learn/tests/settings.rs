//! Every key of every preset: absurd values are refused, and another sound value makes another run.
#![allow(clippy::unwrap_used, reason = "tests")]

use e2h_core::{Direction, Episode, Image, Kind, Observation, Origin, Outcome, stream};
use e2h_env::{Env, demonstrate, task};
use e2h_learn::methods::AutoE2h;
use e2h_learn::record::Collection;
use e2h_learn::{Accepted, Collected, Demonstrations, Method as _, Run, RunConfig, RunOptions, Trained};
use e2h_policy::DiffusionPolicy;
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::Path;
use std::sync::Arc;
use toml::{Table, Value};

const PRESETS: [&str; 3] = ["smoke", "laptop", "paper"];
const TASK: &str = "nut_assembly";

fn entries(preset: &str) -> Vec<(String, Value)> {
    fn walk(table: &Table, path: &str, out: &mut Vec<(String, Value)>) {
        for (k, v) in table {
            match v {
                Value::Table(t) => walk(t, &format!("{path}{k}."), out),
                _ => out.push((format!("{path}{k}"), v.clone())),
            }
        }
    }
    let mut out = vec![];
    let text = RunConfig::resolve(preset, TASK, &[]).unwrap().text;
    walk(&text.parse().unwrap(), "", &mut out);
    out
}

fn absurd(key: &str, value: &Value) -> Vec<String> {
    let list = |values: &[&str]| values.iter().map(|v| (*v).to_owned()).collect();
    match value {
        // Any number that is not negative is a seed.
        Value::Integer(_) if key == "evaluation.seed" => list(&["-1"]),
        Value::Integer(_) => list(&["-1", "4000000000", "9223372036854775807"]),
        // What is too large a rate depends on all else; a loss that is no number tells it.
        Value::Float(_) if key.ends_with(".lr") => list(&["nan", "inf", "0.0", "-1e30"]),
        Value::Float(_) => list(&["nan", "inf", "1e30", "-1e30"]),
        Value::String(_) => list(&["no_such_thing", "\u{1b}[2J"]),
        Value::Boolean(_) => list(&["2"]),
        Value::Array(a) => match a.first() {
            Some(Value::Integer(_)) => list(&["[-1]", "[9223372036854775807]", "[16, 9223372036854775807]"]),
            Some(Value::Float(_)) => ["nan", "1e30", "-1e30"]
                .iter()
                .map(|bad| format!("[{bad}{}]", ", 1.0".repeat(a.len() - 1)))
                .collect(),
            Some(Value::String(_)) => list(&["[\"foo\"]", "[\"table\", \"table\"]", "[1]"]),
            _ => list(&[
                "[{ mean = [nan, 0, 0], std = [1, 1, 1] }]",
                "[{ mean = [0, 0, 0], std = [0, 1, 1] }]",
            ]),
        },
        _ => vec![],
    }
}

#[test]
fn absurd_values_are_refused_for_every_key_of_every_preset() {
    let mut passed = vec![];
    for preset in PRESETS {
        for (key, value) in entries(preset) {
            for bad in absurd(&key, &value) {
                let set = format!("{key}={bad}");
                match RunConfig::resolve(preset, TASK, std::slice::from_ref(&set)) {
                    Ok(_) => passed.push(format!("{preset}: {set}")),
                    Err(e) => {
                        let (text, last) = (e.to_string(), key.rsplit('.').next().unwrap());
                        if !text.contains(last) || text.contains(char::is_control) {
                            passed.push(format!("{set}: not told by name: {text:?}"));
                        }
                    }
                }
            }
        }
    }
    assert!(passed.is_empty(), "{passed:#?}");
}

#[test]
fn values_that_contradict_each_other_are_refused() {
    for (set, words) in [
        (&["env.image_size=40"][..], "policy.image_size"),
        (&["env.cameras=false"], "env.cameras"),
        (&["policy.guidance=2.0"], "conditioning_dropout"),
        (&["recap.guidance=2.0", "train.step.indicator_dropout=0.0"], "indicator_dropout"),
        (&["recap.indicator=advantage"], "recap.indicator"),
        (&["env.hold_steps=301"], "hold_steps"),
        (&["critic.network.crop_size=33"], "crop_size"),
        (&["refine.gate.closings=3"], "closings"),
        (&["task.demonstrator.speed=[0.2, 0.1]"], "speed"),
        (&["policy.down_dims=[65536, 65536]"], "parameters"),
        (&["train.step.conditions=1000000"], "train.step.conditions"),
        (&["refine.kinematic.slow_speed=0.01"], "slow_speed"),
    ] {
        let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
        let text = RunConfig::resolve("smoke", TASK, &set).unwrap_err().to_string();
        assert!(text.contains(words), "{set:?}: {text}");
    }
}

/// Part of a run that a setting acts on.
#[derive(Clone, Copy, PartialEq)]
enum Stage {
    Demonstrate,
    Train,
    Update,
    Collect,
    Refine,
    Accumulate,
    Evaluate,
    Length,
}
use Stage::*;

/// A setting's other value (with others that it needs), and where it shows; or why it shows nowhere.
type Change = (&'static str, Result<(Stage, &'static str), &'static str>);

/// Small, with every stage sensitive to every setting.
const BASE: &[&str] = &[
    "task.demonstrator.pause_probability=1.0",
    "task.demonstrator.slow_probability=1.0",
    "task.demonstrator.speed=[0.10, 0.22]",
    "env.image_size=24",
    "env.horizon_hard=48",
    "env.horizon_easy=500",
    "loop.demonstrations=1",
    "loop.cycles=2",
    "loop.loops=1",
    "loop.after_failure=continue",
    "loop.keep_rollouts=true", // so that easy rollouts that fail are seen
    "policy.image_size=24",
    "policy.crop_size=20",
    "policy.n_action_steps=8",
    "policy.down_dims=[16, 32]",
    "policy.step_embed_dim=16",
    "train.easy_steps=3",
    "train.initial_steps=3",
    "train.update_steps=3",
    "train.step.conditions=8",
    "train.step.noises=2",
    "train.step.conditioning_dropout=0.5",
    "train.step.adam.weight_decay=0.01",
    "train.step.schedule.warmup=0",
    "refine.reverse.open_width_m=0.081",
    "refine.reverse.labels=undisturbed",
    "refine.goal.percentile=0.0",
    "refine.goal.least=0.0",
    "refine.suffix.enabled=true",
    "refine.suffix.value=-1.0",
    "refine.suffix.keep=150",
    "refine.suffix.min_successes=1",
    "critic.network.crop_size=16",
    "evaluation.trials=1",
    "evaluation.parallel=1",
];

const EXPLORE: &str = "policies of no training never move the object; tests/explore.rs has one that does";

const RECAP: &str = "of the method recap alone; tests/pipeline.rs has what it changes there";
const TR_DRL: &str = "of the method tr-drl alone; tests/tr_drl.rs has what each changes there";
/// Of the method `tr-drl-dp` alone.
const DYNAMICS: &str = "of the method tr-drl-dp alone; tests/pipeline.rs has what each changes there";

const CHANGES: &[Change] = &[
    ("task.name", Err("each pair has its own program, and another name is refused")),
    ("task.variant", Ok((Demonstrate, "square"))),
    ("task.clearance", Err("this pair has none; tests/pairs.rs of e2h-env has those that do")),
    ("task.demonstrator.waypoint_noise_m", Ok((Demonstrate, "0.01"))),
    ("task.demonstrator.waypoint_noise_rad", Ok((Demonstrate, "0.1"))),
    ("task.demonstrator.bow", Ok((Demonstrate, "0.2"))),
    ("task.demonstrator.speed", Ok((Demonstrate, "[0.2,0.22]"))),
    ("task.demonstrator.acceleration", Ok((Demonstrate, "1.0"))),
    ("task.demonstrator.pause_probability", Ok((Demonstrate, "0.0"))),
    ("task.demonstrator.pause_s", Ok((Demonstrate, "[0.1,0.2]"))),
    ("task.demonstrator.slow_probability", Ok((Demonstrate, "0.0"))),
    ("task.demonstrator.slow_speed", Ok((Demonstrate, "[0.06,0.07]"))),
    ("task.demonstrator.slow_length_m", Ok((Demonstrate, "[0.01,0.02]"))),
    ("task.demonstrator.grip_dwell_s", Ok((Demonstrate, "[0.3,0.35]"))),
    ("task.demonstrator.tail", Ok((Demonstrate, "12"))),
    ("env.image_size", Ok((Demonstrate, "26 policy.image_size=26"))),
    ("env.cameras", Ok((Demonstrate, "false policy.cameras=[]"))),
    ("env.horizon_hard", Ok((Collect, "40"))),
    ("env.horizon_easy", Ok((Collect, "200"))),
    ("env.hold_steps", Ok((Demonstrate, "48"))),
    ("env.max_goal_step_m", Ok((Demonstrate, "0.004"))),
    ("env.max_goal_step_rad", Ok((Demonstrate, "0.0002"))),
    ("env.latency", Ok((Collect, "2"))),
    ("env.home_noise_rad", Ok((Demonstrate, "0.02"))),
    ("loop.demonstrations", Ok((Demonstrate, "2"))),
    ("loop.iterations", Ok((Length, "2"))),
    ("loop.cycles", Ok((Collect, "1"))),
    ("loop.loops", Ok((Collect, "2"))),
    ("loop.after_failure", Ok((Collect, "assembled"))),
    ("loop.homing", Ok((Collect, "false"))),
    ("loop.accumulate", Ok((Accumulate, "false"))),
    ("loop.base_share", Ok((Update, "0.1"))),
    ("loop.refine_demonstrations", Ok((Demonstrate, "true"))),
    ("loop.refine_easy_demonstrations", Ok((Demonstrate, "false"))),
    ("loop.keep_rollouts", Ok((Collect, "false"))),
    ("loop.explore.enabled", Ok((Collect, "true"))),
    ("loop.explore.share", Err(EXPLORE)),
    ("loop.explore.sideways_m", Err(EXPLORE)),
    ("loop.explore.up_m", Err(EXPLORE)),
    ("loop.explore.yaw_rad", Err(EXPLORE)),
    ("loop.explore.band_hz", Err(EXPLORE)),
    ("loop.explore.ramp_m", Err(EXPLORE)),
    ("loop.explore.release", Err(EXPLORE)),
    ("loop.explore.grip_m", Err(EXPLORE)),
    ("loop.explore.turn", Err(EXPLORE)),
    ("loop.explore.lower", Err(EXPLORE)),
    ("loop.explore.growth", Err(EXPLORE)),
    ("policy.n_obs_steps", Ok((Train, "1"))),
    ("policy.n_image_steps", Ok((Train, "2"))),
    ("policy.horizon", Ok((Train, "18"))),
    ("policy.n_action_steps", Ok((Train, "9"))),
    ("policy.lerobot_alignment", Ok((Train, "true"))),
    ("policy.cameras", Ok((Train, "[\"wrist\"]"))),
    ("policy.image_size", Ok((Demonstrate, "26 env.image_size=26"))),
    ("policy.crop_size", Ok((Train, "18"))),
    (
        "policy.image_scaling",
        Ok((Train, "[{mean=[0.5,0.5,0.5],std=[0.1,0.1,0.1]},{mean=[0.5,0.5,0.5],std=[0.1,0.1,0.1]}]")),
    ),
    ("policy.share_encoder", Ok((Train, "true"))),
    ("policy.encoder_width", Ok((Train, "32"))),
    ("policy.encoder_blocks", Ok((Train, "[2]"))),
    ("policy.keypoints", Ok((Train, "5"))),
    ("policy.image_features", Ok((Train, "9"))),
    ("policy.relative_features", Ok((Train, "false"))),
    ("policy.tool_frame_features", Ok((Train, "true"))),
    ("policy.down_dims", Ok((Train, "[16,48]"))),
    ("policy.kernel_size", Ok((Train, "3"))),
    ("policy.n_groups", Ok((Train, "4"))),
    ("policy.step_embed_dim", Ok((Train, "18"))),
    ("policy.prediction", Ok((Train, "epsilon"))),
    ("policy.train_timesteps", Ok((Train, "90"))),
    ("policy.inference_steps", Ok((Train, "3"))),
    ("policy.guidance", Ok((Train, "2.0"))),
    ("train.easy_steps", Ok((Train, "4"))),
    ("train.initial_steps", Ok((Train, "4"))),
    ("train.update_steps", Ok((Update, "4"))),
    ("train.update_from", Ok((Update, "scratch"))),
    ("train.easy_update_steps", Ok((Refine, "1"))),
    ("train.save_every", Err("where a run can go on, which tests/resume.rs shows to change nothing")),
    ("train.normaliser_margin", Ok((Demonstrate, "0.2"))),
    ("train.step.conditions", Ok((Train, "9"))),
    ("train.step.noises", Ok((Train, "3"))),
    ("train.step.shards", Ok((Train, "2"))),
    ("train.step.conditioning_dropout", Ok((Train, "0.9"))),
    ("train.step.indicator_dropout", Err(RECAP)),
    ("train.step.observation_noise", Ok((Train, "0.2"))),
    ("train.step.keypoint_sharpness", Ok((Train, "2.0"))),
    ("train.step.adam.beta1", Ok((Train, "0.5"))),
    ("train.step.adam.beta2", Ok((Train, "0.9"))),
    ("train.step.adam.eps", Ok((Train, "1e-3"))),
    ("train.step.adam.weight_decay", Ok((Train, "0.1"))),
    ("train.step.adam.decoupled", Ok((Train, "false"))),
    ("train.step.adam.clip_norm", Ok((Train, "0.001"))),
    ("train.step.schedule.kind", Ok((Train, "constant"))),
    ("train.step.schedule.lr", Ok((Train, "2e-3"))),
    ("train.step.schedule.warmup", Ok((Train, "3"))),
    ("train.step.ema.power", Ok((Train, "2.0"))),
    ("train.step.ema.max", Ok((Train, "0.1"))),
    ("refine.kinematic_enabled", Ok((Refine, "false"))),
    ("refine.reverse.lookahead", Ok((Refine, "2"))),
    ("refine.reverse.open_width_m", Ok((Refine, "0.2"))),
    ("refine.reverse.open_at", Ok((Refine, "0.999"))),
    ("refine.reverse.close_at", Ok((Refine, "0.05"))),
    ("refine.reverse.labels", Ok((Refine, "travelled"))),
    ("refine.reverse.labels_fade", Ok((Refine, "30"))),
    ("refine.kinematic.static_speed", Ok((Refine, "0.01"))),
    ("refine.kinematic.static_frames", Ok((Refine, "40"))),
    ("refine.kinematic.static_drift", Ok((Refine, "0.0005"))),
    ("refine.kinematic.rotation_speed", Ok((Refine, "0.0001"))),
    ("refine.kinematic.protect_gripper", Ok((Refine, "false"))),
    ("refine.kinematic.protect_frames", Ok((Refine, "12"))),
    ("refine.kinematic.gripper_motion", Ok((Refine, "0.000001"))),
    ("refine.kinematic.object_drift", Ok((Refine, "0.0001"))),
    ("refine.kinematic.slow_speed", Ok((Refine, "0.12"))),
    ("refine.kinematic.slow_min_frames", Ok((Refine, "60"))),
    ("refine.kinematic.resample_step", Ok((Refine, "0.009"))),
    ("refine.kinematic.resample_rotation", Ok((Refine, "0.0005"))),
    ("refine.kinematic.speed_window", Ok((Refine, "1"))),
    ("refine.kinematic.retime_all", Ok((Refine, "true"))),
    ("refine.kinematic.smooth_frames", Ok((Refine, "5"))),
    ("refine.goal.enabled", Ok((Refine, "true"))),
    ("refine.goal.percentile", Ok((Refine, "100.0"))),
    ("refine.goal.least", Ok((Refine, "0.05"))),
    ("refine.gate.enabled", Ok((Refine, "false"))),
    ("refine.gate.slip_m", Ok((Refine, "0.000001"))),
    ("refine.gate.loose_m", Ok((Refine, "1e-7"))),
    ("refine.advantage.gamma", Ok((Refine, "0.9"))),
    ("refine.advantage.lambda", Ok((Refine, "0.5"))),
    ("refine.advantage.smooth", Ok((Refine, "5"))),
    ("refine.advantage.percentile", Ok((Refine, "60.0"))),
    ("refine.advantage.min_run", Ok((Refine, "5"))),
    ("refine.suffix.enabled", Ok((Refine, "false"))),
    ("refine.suffix.value", Ok((Refine, "1.0"))),
    ("refine.suffix.frames", Ok((Refine, "12"))),
    ("refine.suffix.keep", Ok((Refine, "100"))),
    ("refine.suffix.min_successes", Ok((Refine, "100"))),
    ("critic.enabled", Ok((Refine, "false"))),
    ("critic.network.crop_size", Ok((Refine, "14"))),
    ("critic.network.hidden", Ok((Refine, "[8]"))),
    ("critic.network.dropout", Ok((Refine, "0.5"))),
    ("critic.network.colour_jitter", Ok((Refine, "0.5"))),
    ("critic.network.batch", Ok((Refine, "9"))),
    ("critic.network.steps", Ok((Refine, "6"))),
    ("critic.network.validation", Ok((Refine, "0.6"))),
    ("critic.network.adam.lr", Ok((Refine, "1e-2"))),
    ("critic.network.adam.beta1", Ok((Refine, "0.5"))),
    ("critic.network.adam.beta2", Ok((Refine, "0.9"))),
    ("critic.network.adam.eps", Ok((Refine, "1e-2"))),
    ("critic.network.adam.weight_decay", Ok((Refine, "1.0"))),
    ("critic.network.adam.decoupled", Ok((Refine, "true"))),
    ("critic.network.adam.clip_norm", Ok((Refine, "0.0001"))),
    ("recap.indicator", Err(RECAP)),
    ("recap.guidance", Err(RECAP)),
    ("dynamics.gates", Err(DYNAMICS)),
    ("dynamics.network.hidden", Err(DYNAMICS)),
    ("dynamics.network.steps", Err(DYNAMICS)),
    ("dynamics.network.batch", Err(DYNAMICS)),
    ("dynamics.network.lr", Err(DYNAMICS)),
    ("dynamics.network.validation", Err(DYNAMICS)),
    ("dynamics.filter.smooth", Err(DYNAMICS)),
    ("dynamics.filter.percentile", Err(DYNAMICS)),
    ("dynamics.filter.min_run", Err(DYNAMICS)),
    ("tr_drl.demonstrations", Err(TR_DRL)),
    ("tr_drl.reward", Err(TR_DRL)),
    ("tr_drl.episodes", Err(TR_DRL)),
    ("tr_drl.random_episodes", Err(TR_DRL)),
    ("tr_drl.batch", Err(TR_DRL)),
    ("tr_drl.tolerance", Err(TR_DRL)),
    ("tr_drl.shaping", Err(TR_DRL)),
    ("tr_drl.shaping_limit", Err(TR_DRL)),
    ("tr_drl.potential_steps", Err(TR_DRL)),
    ("tr_drl.potential_more_steps", Err(TR_DRL)),
    ("tr_drl.agent.hidden", Err(TR_DRL)),
    ("tr_drl.agent.layer_norm", Err(TR_DRL)),
    ("tr_drl.agent.entropy_in_target", Err(TR_DRL)),
    ("tr_drl.agent.gamma", Err(TR_DRL)),
    ("tr_drl.agent.tau", Err(TR_DRL)),
    ("tr_drl.agent.lr", Err(TR_DRL)),
    ("tr_drl.agent.alpha", Err(TR_DRL)),
    ("tr_drl.agent.actor_every", Err(TR_DRL)),
    ("tr_drl.agent.restart_above", Err(TR_DRL)),
    ("evaluation.trials", Ok((Evaluate, "2"))),
    ("evaluation.seed", Ok((Evaluate, "7"))),
    ("evaluation.parallel", Err("how many trials the policy answers at once: changes last bits alone")),
    ("evaluation.filmed", Ok((Evaluate, "0"))),
    ("device.tf32", Err("a GPU's")),
    ("device.bf16", Err("a GPU's")),
];

fn open(out: &Path, change: &str) -> Run {
    // The last word wins.
    let set = BASE.iter().copied().chain(change.split(' ').filter(|c| !c.is_empty()));
    let options = RunOptions {
        preset: "smoke".to_owned(),
        seed: 5,
        set: set.map(str::to_owned).collect(),
        out: Some(out.to_owned()),
        quiet: true,
        ..RunOptions::new(TASK)
    };
    Run::open(&options).unwrap()
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let to = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy(&entry.path(), &to);
        } else {
            std::fs::copy(entry.path(), to).unwrap();
        }
    }
}

fn print(value: &impl std::fmt::Debug) -> u64 {
    let mut hasher = DefaultHasher::new();
    format!("{value:?}").hash(&mut hasher);
    hasher.finish()
}

/// What the stages after the demonstrations are given, made once.
struct Given {
    demonstrations: std::path::PathBuf,
    hard: std::path::PathBuf,
    easy: std::path::PathBuf,
    collected: Vec<Episode>,
}

impl Given {
    fn policy(&self, folder: &Path) -> DiffusionPolicy {
        DiffusionPolicy::load(folder).unwrap().0
    }

    fn accepted(&self) -> Accepted {
        Accepted {
            segments: self.collected.iter().cloned().map(Arc::new).collect(),
            easy: vec![],
            collection: Collection::default(),
            stage_minutes: BTreeMap::new(),
        }
    }

    /// Scripted episodes in place of rollouts, one of each kind cut short.
    fn collected(&self) -> Collected {
        let (easy, hard): (Vec<_>, Vec<_>) =
            self.collected.iter().cloned().partition(|e| e.origin.direction == Direction::Easy);
        Collected {
            easy_rollouts: easy.len(),
            easy_successes: easy.len(),
            hard,
            easy,
            ..Collected::default()
        }
    }
}

fn record(run: &Run) -> Vec<Episode> {
    let config = run.config();
    let env = e2h_env::EnvConfig { horizon_hard: 500, horizon_easy: 500, ..config.env.clone() };
    let mut env = Env::new(task(&config.task.name, &config.task.options()).unwrap(), &env).unwrap();
    let mut all = vec![];
    for direction in [Direction::Easy, Direction::Hard] {
        for i in 0..3 {
            let mut origin = Origin::demonstration(TASK, direction, i, 5);
            (origin.kind, origin.iteration) = (Kind::Rollout, 1);
            let mut rng = stream(77, direction.name(), 0, u64::from(i));
            let mut episode =
                demonstrate(&mut env, direction, &config.task.demonstrator, origin, &mut rng).unwrap();
            episode.excursion.fill([0.01, 0.0, 0.0, 0.1]);
            if i == 2 {
                episode = episode.select(&(0..episode.len() / 2).collect::<Vec<_>>());
                episode.outcome = Outcome::Timeout;
            }
            all.push(episode);
        }
    }
    all
}

/// What the policy does where the first demonstration begins.
fn act(run: &Run, policy: &dyn Trained, base: &Demonstrations) -> u64 {
    let c = &run.config().policy;
    let episode = &base.easy[0];
    let image = |name: &String| {
        let frames = episode.frames.iter().find(|f| f.camera == *name).unwrap();
        Image { height: frames.height, width: frames.width, data: frames.image(0).unwrap().into_owned() }
    };
    let observation = Observation { state: episode.state[0], frames: c.cameras.iter().map(image).collect() };
    let history = vec![&observation; c.n_obs_steps];
    print(&policy.act(&[history], &mut [stream(1, "act", 0, 0)]).unwrap())
}

fn observe(stage: Stage, change: &str, given: Option<&Given>) -> String {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("run");
    let run = open(&out, change);
    if stage == Length {
        return run.iterations().to_string();
    }
    if let Some(given) = given.filter(|_| stage != Demonstrate) {
        copy(&given.demonstrations, &out.join("demonstrations"));
    }
    let mut base = match run.demonstrations() {
        Ok(base) => base,
        Err(e) => return e.to_string(),
    };
    let Some(given) = given.filter(|_| stage != Demonstrate) else {
        return format!(
            "{} {} {} {}",
            print(&base.easy),
            print(&base.easy_training),
            print(&base.hard),
            print(&base.normaliser)
        );
    };
    match stage {
        Train => {
            let (hard, easy) = (run.train_initial(&base).unwrap(), run.train_easy(&base).unwrap());
            let weights = [&hard, &easy].map(|p| print(&p.weights().unwrap()));
            format!("{weights:?} {}", act(&run, &*hard, &base))
        }
        Update => {
            let hard = given.policy(&given.hard);
            print(&run.update(1, &hard, &base, &[given.accepted()]).unwrap().weights().unwrap()).to_string()
        }
        Collect => {
            let (hard, easy) = (given.policy(&given.hard), given.policy(&given.easy));
            print(&run.collect(1, &hard, &easy).unwrap()).to_string()
        }
        Accumulate => {
            let rounds = [given.accepted(), given.accepted()];
            let segments = rounds.each_ref().map(|r| &r.segments[..]);
            let sources = AutoE2h.sources(&base, &segments, run.config());
            sources.iter().map(|s| s.episodes.len()).sum::<usize>().to_string()
        }
        Evaluate => {
            std::fs::create_dir_all(out.join("iteration_00")).unwrap();
            let record = run.evaluate(0, &given.policy(&given.hard), None).unwrap();
            let film = std::fs::read(out.join("iteration_00/rollouts.png")).ok();
            format!("{} {}", record.evaluation.trials, print(&film))
        }
        _ => {
            // Ends of demonstrations that differ, for the gate of the goal.
            base.hard.extend(given.collected.iter().skip(3).cloned().map(Arc::new));
            let hard = given.policy(&given.hard);
            let accepted = run.lesson(1, &base, &hard, || Ok(given.collected())).unwrap();
            let picture = std::fs::read(out.join("iteration_01/filter.svg")).ok();
            let easy = out.join("iteration_01/easy_segments").exists();
            format!(
                "{} {} {} {easy}",
                print(&accepted.segments),
                print(&accepted.collection),
                print(&picture)
            )
        }
    }
}

#[test]
fn another_value_of_every_key_makes_another_run() {
    let listed: BTreeSet<&str> = CHANGES.iter().map(|(key, _)| *key).collect();
    let all: Vec<String> = entries("smoke").into_iter().map(|(key, _)| key).collect();
    let missing: Vec<&String> = all.iter().filter(|k| !listed.contains(k.as_str())).collect();
    assert!(missing.is_empty(), "no other value of {missing:?}: say one, or why it shows nowhere");

    let dir = tempfile::tempdir().unwrap();
    let run = open(&dir.path().join("run"), "");
    let base = run.demonstrations().unwrap();
    run.train_initial(&base).unwrap();
    run.train_easy(&base).unwrap();
    let given = Given {
        demonstrations: dir.path().join("run/demonstrations"),
        hard: dir.path().join("run/iteration_00/policy"),
        easy: dir.path().join("run/policy_easy"),
        collected: record(&run),
    };
    let stages = [Demonstrate, Train, Update, Collect, Refine, Accumulate, Evaluate, Length];
    let before = stages.map(|stage| observe(stage, "", Some(&given)));
    let again = stages.map(|stage| observe(stage, "", Some(&given)));
    assert_eq!(before, again, "the same values make the same run");
    let idle: Vec<&str> = CHANGES
        .iter()
        .filter_map(|(key, change)| {
            let (stage, value) = change.ok()?;
            let after = observe(stage, &format!("{key}={value}"), Some(&given));
            let place = stages.iter().position(|s| *s == stage)?;
            (after == before[place]).then_some(*key)
        })
        .collect();
    assert!(idle.is_empty(), "without effect: {idle:?}");
}
