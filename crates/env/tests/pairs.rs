//! What every task pair and variant must hold.
#![allow(clippy::unwrap_used, reason = "tests")]

use e2h_core::{Action, Direction, Origin, Outcome, Pose, Rng, stream};
use e2h_env::{
    Blind, DemonstratorConfig, Env, EnvConfig, Error, Task, TaskOptions, demonstrate, probe, registry,
    replay, task, variants,
};
use e2h_refine::{ReverseConfig, reverse};
use nalgebra::Vector3;
use std::sync::Arc;

const BOTH: [Direction; 2] = [Direction::Hard, Direction::Easy];

fn all() -> Vec<Arc<dyn Task>> {
    let options = |v: &str| TaskOptions { variant: v.to_owned(), ..TaskOptions::default() };
    registry().iter().flat_map(|t| variants(t).iter().map(move |v| task(t, &options(v)).unwrap())).collect()
}

fn blind(task: &Arc<dyn Task>) -> Env {
    Env::new(task.clone(), &EnvConfig::physics(&**task)).unwrap()
}

/// The pair that tests of the environment itself use.
fn nut() -> Env {
    blind(&task("nut_assembly", &TaskOptions::default()).unwrap())
}

/// Runs a check on every pair and variant, several at a time.
fn each(check: impl Fn(&Arc<dyn Task>, &mut Env) + Sync) {
    let tasks = all();
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    std::thread::scope(|scope| {
        for worker in 0..threads {
            let (tasks, check) = (&tasks, &check);
            scope.spawn(move || {
                for task in tasks.iter().skip(worker).step_by(threads) {
                    check(task, &mut blind(task));
                }
            });
        }
    });
}

fn label(task: &Arc<dyn Task>) -> String {
    format!("{}:{}", task.name(), task.variant())
}

fn rng(name: &str, index: u64) -> Rng {
    stream(3, name, 0, index)
}

fn record(env: &mut Env, direction: Direction, config: &DemonstratorConfig, index: u64) -> e2h_core::Episode {
    let origin = Origin::demonstration(env.task().name(), direction, index as u32, 3);
    demonstrate(env, direction, config, origin, &mut rng(direction.name(), index)).unwrap()
}

/// The action that asks for what the controller does anyway.
fn stay(env: &Env) -> Action {
    toward(env, &env.sim().goal(), env.sim().opens())
}

fn toward(env: &Env, goal: &Pose, open: bool) -> Action {
    let p = goal.to_row(&env.task().eef_reference());
    [p[0], p[1], p[2], p[3], p[4], p[5], p[6], if open { 1.0 } else { 0.0 }]
}

/// Runs the demonstrator from the scene as it is; true when the goal was held at its end.
fn carry_on(env: &mut Env, direction: Direction, rng: &mut Rng) -> bool {
    env.begin(direction).unwrap();
    let task = env.task().clone();
    let mut expert = task.expert(direction, task.demonstrator(), rng);
    for _ in 0..env.horizon(direction) {
        let action = expert.act(env.sim());
        if let Some(outcome) = env.step(&action).unwrap() {
            return outcome.is_success();
        }
    }
    false
}

#[test]
fn the_same_seed_gives_the_same_states_in_every_environment() {
    each(|task, first| {
        let mut second = first.clone_shared().unwrap();
        for direction in BOTH {
            let path = |env: &mut Env| {
                let episode = record(env, direction, task.demonstrator(), 0);
                (episode.state, env.save())
            };
            assert_eq!(path(first), path(&mut second), "{} {direction}", label(task));
        }
    });
}

#[test]
fn a_restored_state_continues_bit_for_bit() {
    each(|task, env| {
        let actions = record(env, Direction::Hard, task.demonstrator(), 1).action;
        env.reset(Direction::Hard, &mut rng("hard", 1)).unwrap();
        let (before, after) = actions.split_at(actions.len() / 2); // the object is in the hand by then
        for action in before {
            env.step(action).unwrap();
        }
        let saved = env.save();
        let run = |env: &mut Env| {
            after.iter().take(60).map(|a| (env.step(a).unwrap(), env.save())).collect::<Vec<_>>()
        };
        let first = run(env);
        env.restore(&saved).unwrap();
        assert_eq!(env.save(), saved);
        assert_eq!(run(env), first);
        let mut other = env.clone_shared().unwrap();
        other.restore(&saved).unwrap();
        assert_eq!(run(&mut other), first);
        assert!(matches!(other.restore(&saved.numbers()[1..].to_vec().into()), Err(Error::State { .. })));
    });
}

#[test]
fn what_ends_one_task_starts_the_other_and_is_not_its_goal() {
    each(|task, env| {
        let name = label(task);
        for direction in BOTH {
            for index in 0..12 {
                env.reset(direction, &mut rng("start", index)).unwrap();
                assert!(!env.success(direction), "{name} {direction} {index} starts at its goal");
                let lies = env.sim().object().position;
                env.home().unwrap();
                let moved = (env.sim().object().position - lies).norm();
                // A brush that leans settles a little further as the hand leaves.
                assert!(moved < 2.5e-3, "{name} {direction}: homing moved the object by {moved}");
                // Those of the easy task are what a sloppier hand than the demonstrator's leaves.
                assert!(
                    env.success(direction.reverse()),
                    "{name} {direction} {index} starts off the other's goal"
                );
            }
        }
    });
}

#[test]
fn demonstrators_reset_the_scene_for_each_other_without_end() {
    each(|task, env| {
        let mut rng = rng("cycle", 0);
        env.reset(Direction::Hard, &mut rng).unwrap();
        for cycle in 0..2 {
            for direction in BOTH {
                let good = carry_on(env, direction, &mut rng);
                assert!(good && env.success(direction), "{} {direction} {cycle}", label(task));
                assert!(!env.success(direction.reverse()), "{} {direction} {cycle}", label(task));
                env.home().unwrap();
                assert!(env.success(direction), "{} {direction}: homing undid it", label(task));
            }
        }
    });
}

#[test]
fn experts_succeed_end_at_home_and_press_nothing_into_anything() {
    each(|task, env| {
        for direction in BOTH {
            for index in 10..14 {
                let episode = record(env, direction, task.demonstrator(), index);
                let name = format!("{} {direction} {index}", label(task));
                assert!(episode.outcome.is_success(), "{name}: {:?}", episode.outcome);
                assert!((20..450).contains(&episode.len()), "{name}: {} rows", episode.len());
                let from_home = (env.sim().tcp().position - env.sim().home().position).norm();
                assert!(!task.homes() || from_home < 0.05, "{name}: {from_home} m from home");
                episode.validate().unwrap();
            }
            let clean = record(env, direction, &DemonstratorConfig::clean(), 0);
            assert!(clean.outcome.is_success(), "{} {direction}, clean", label(task));
            env.reset(direction, &mut rng("deep", 0)).unwrap();
            let mut expert = task.expert(direction, task.demonstrator(), &mut rng("deep", 1));
            for _ in 0..env.horizon(direction) {
                let action = expert.act(env.sim());
                env.step(&action).unwrap();
                let depth = env.sim().penetration();
                assert!(depth < 1e-3, "{} {direction}: a contact is {:.2} mm deep", label(task), depth * 1e3);
                if expert.done() {
                    break;
                }
            }
        }
    });
}

#[test]
fn reversed_easy_demonstrations_replay_in_the_hard_task() {
    each(|task, env| {
        let config = ReverseConfig { reference_quaternion: task.eef_reference(), ..ReverseConfig::default() };
        let good = (20..24)
            .filter(|&index| {
                let easy = record(env, Direction::Easy, task.demonstrator(), index);
                env.begin(Direction::Hard).unwrap();
                let outcome = replay(env, &reverse(&easy, &config).action).unwrap();
                outcome.is_some_and(Outcome::is_success)
            })
            .count();
        assert!(good >= 3, "{}: {good} of 4", label(task));
    });
}

#[test]
fn policies_that_do_not_look_fail_and_break_nothing() {
    let policies =
        [Blind::Still, Blind::Random { hold: 1 }, Blind::Random { hold: 1 }, Blind::Random { hold: 20 }];
    each(|task, env| {
        for direction in BOTH {
            for (trial, policy) in policies.into_iter().enumerate() {
                let name = format!("{} {direction} {policy:?}", label(task));
                let probed = probe(env, direction, policy, &mut rng("blind", trial as u64)).unwrap();
                assert!(!probed.through_table, "{name}: the object went through the table");
                // An arm that sweeps hits what is in its way, and presses on it with all its force.
                let most = if policy == (Blind::Random { hold: 20 }) { 6e-3 } else { 1e-3 };
                assert!(probed.deepest < most, "{name}: a contact is {:.2} mm deep", probed.deepest * 1e3);
                let ends = [Outcome::Timeout, Outcome::Dropped];
                assert!(ends.contains(&probed.outcome), "{name}: {:?}", probed.outcome);
                assert!(
                    policy != Blind::Still || probed.outcome == Outcome::Timeout,
                    "{name}: {:?}",
                    probed.outcome
                );
            }
        }
    });
}

#[test]
fn a_dropped_object_ends_an_episode_that_must_hold_it() {
    each(|task, env| {
        for direction in BOTH {
            env.reset(direction, &mut rng("drop", 0)).unwrap();
            let open = toward(env, &env.sim().goal(), true);
            let outcomes: Vec<_> = (0..12).filter_map(|_| env.step(&open).unwrap()).collect();
            let holds = task.holds();
            assert_eq!(outcomes.contains(&Outcome::Dropped), holds, "{} {direction}", label(task));
        }
    });
}

#[test]
fn clearances_are_checked_and_the_tightest_still_works() {
    for name in registry() {
        let with = |clearance| task(name, &TaskOptions { clearance, ..TaskOptions::default() });
        let message = |clearance| with(clearance).err().unwrap().to_string();
        let text = message(-0.001);
        assert!(text.contains(name) && text.contains("expected") && text.contains("-0.001"), "{text}");
        assert!(message(f64::NAN).contains("NaN"));
        let tighter = [0.001, 0.02].into_iter().find_map(|c| with(c).ok());
        assert_eq!(tighter.is_none(), text.contains("no hole"), "{text}");
        if let Some(task) = tighter {
            let mut env = blind(&task);
            let good = (0..3).filter(|&i| {
                record(&mut env, Direction::Hard, &DemonstratorConfig::clean(), i).outcome.is_success()
            });
            assert!(good.count() >= 2, "{name} with little room");
        }
    }
}

#[test]
fn both_cameras_see_the_object_at_a_start() {
    each(|task, env| {
        for camera in ["table", "wrist"] {
            for direction in BOTH {
                let mut images = vec![];
                for index in 0..2 {
                    env.reset(direction, &mut rng("look", index)).unwrap();
                    images.push(env.render(camera, 72, 72).unwrap());
                }
                let pixels = |k: usize| images[k].data.chunks_exact(3);
                let differ = pixels(0).zip(pixels(1)).filter(|(a, b)| a != b).count();
                assert!(differ > 20, "{} {camera}: two starts differ in {differ} pixels", label(task));
            }
        }
    });
}

#[test]
fn a_moving_goal_is_followed_within_one_control_step() {
    let mut env = nut();
    env.reset(Direction::Hard, &mut rng("lag", 0)).unwrap();
    let start = env.sim().goal();
    let mut reached = vec![];
    let goal = |t: usize| {
        let mut goal = start;
        goal.position += Vector3::new(0.6, -0.64, 0.48).normalize() * (0.1 / e2h_core::CONTROL_HZ * t as f64);
        goal
    };
    for t in 1..=40 {
        let action = toward(&env, &goal(t), true);
        env.step(&action).unwrap();
        reached.push(env.sim().tcp().position);
    }
    // After the step that asks for goal t, the arm must be at least where goal t - 1 was.
    for t in 10..=40 {
        let error = (reached[t - 1] - goal(t).position).norm();
        assert!(error < 0.005, "{:.1} mm behind goal {t}; a step is 5 mm", error * 1e3);
        // In fact the feed-forward leaves far less.
        assert!(error < 0.001, "{:.2} mm behind goal {t}", error * 1e3);
    }
}

#[test]
fn a_diverged_simulation_ends_the_episode_and_a_reset_repairs_it() {
    let mut env = nut();
    env.reset(Direction::Hard, &mut rng("diverge", 0)).unwrap();
    let mut state = env.save().numbers().to_vec();
    state[1 + 16] = 1e12; // time, then 16 positions, then the first joint's velocity
    env.restore(&state.into()).unwrap();
    let action = stay(&env);
    assert_eq!(env.step(&action).unwrap(), Some(Outcome::Diverged));
    env.reset(Direction::Hard, &mut rng("diverge", 0)).unwrap();
    let action = stay(&env);
    assert_eq!(env.step(&action).unwrap(), None);
    assert!(env.state().iter().all(|v| v.is_finite()));
    assert!(!std::path::Path::new("MUJOCO_LOG.TXT").exists());
}

#[test]
fn actions_that_mean_nothing_are_refused_before_anything_moves() {
    let mut env = nut();
    env.reset(Direction::Hard, &mut rng("bad", 0)).unwrap();
    let before = env.save();
    for (entry, value) in [(0, f32::NAN), (7, f32::INFINITY)] {
        let mut action = stay(&env);
        action[entry] = value;
        assert!(matches!(env.step(&action), Err(Error::Action { .. })));
    }
    let mut action = stay(&env);
    action[3..7].fill(0.0);
    assert!(env.step(&action).unwrap_err().to_string().contains("quaternion"));
    assert_eq!(env.save(), before);
}

#[test]
fn an_unreachable_goal_leaves_the_arm_sound() {
    let mut env = nut();
    env.reset(Direction::Hard, &mut rng("far", 0)).unwrap();
    let far = [2.0, 1.0, 1.5, 0.0, 1.0, 0.0, 0.0, 1.0];
    for _ in 0..100 {
        assert_ne!(env.step(&far).unwrap(), Some(Outcome::Diverged));
    }
    env.home().unwrap();
    assert!((env.sim().tcp().position - env.sim().home().position).norm() < 1e-3);
}

#[test]
fn there_is_no_room_for_an_excursion_at_the_goal_and_some_on_the_way() {
    each(|task, env| {
        for k in 0..20 {
            env.reset(Direction::Easy, &mut rng("room", k)).unwrap();
            let room = task.room(env.sim());
            assert!(room <= 0.0, "{}: {room} m at an easy start", label(task));
        }
        let mut expert = task.expert(Direction::Easy, &DemonstratorConfig::clean(), &mut rng("room", 20));
        let mut most = f64::NEG_INFINITY;
        while !expert.done() && env.steps() < env.horizon(Direction::Easy) {
            let action = expert.act(env.sim());
            env.step(&action).unwrap();
            most = most.max(task.room(env.sim()));
        }
        assert!(most > 0.03, "{}: {most} m at best", label(task));
    });
}

#[test]
fn every_start_of_the_hard_task_is_where_the_object_may_be_put_down() {
    each(|task, env| {
        for k in 0..20 {
            env.reset(Direction::Hard, &mut rng("put down", k)).unwrap();
            let p = env.sim().object().position;
            assert_eq!(task.put_down(&p), p, "{}", label(task));
            for far in [Vector3::new(3.0, -2.0, 0.0), Vector3::new(-4.0, 5.0, 0.1)] {
                let q = task.put_down(&(p + far));
                assert_eq!((task.put_down(&q), q.z), (q, p.z + far.z), "{}", label(task));
            }
        }
    });
}

/// Demonstrations end anywhere in the region, so a policy that learned from them goes on moving there: it has to count.
#[test]
fn a_rod_is_out_while_it_still_moves() {
    let task = task("rod_insertion", &TaskOptions::default()).unwrap();
    let (mut env, config) = (blind(&task), DemonstratorConfig::clean());
    let moving = (0..5).filter(|&i| {
        let origin = Origin::demonstration("rod_insertion", Direction::Easy, i, 0);
        let mut rng = stream(0, "moving", 0, u64::from(i));
        let episode = demonstrate(&mut env, Direction::Easy, &config, origin, &mut rng).unwrap();
        let Outcome::Success { at } = episode.outcome else { panic!("{:?}", episode.outcome) };
        (episode.eef(at + 1).position - episode.eef(at).position).norm() > 0.003
    });
    assert!(moving.count() >= 3);
}
