//! What every task pair and variant must hold.
#![allow(clippy::unwrap_used, reason = "tests")]

use e2h_core::{Action, Direction, Origin, Outcome, Pose, Rng, stream};
use e2h_env::{
    DemonstratorConfig, Env, EnvConfig, Error, Task, TaskOptions, demonstrate, registry, replay, task,
    variants,
};
use e2h_refine::{ReverseConfig, reverse};
use nalgebra::Vector3;
use rand::Rng as _;
use std::sync::Arc;

const BOTH: [Direction; 2] = [Direction::Hard, Direction::Easy];

fn all() -> Vec<Arc<dyn Task>> {
    let options = |v: &str| TaskOptions { variant: v.to_owned(), ..TaskOptions::default() };
    registry().iter().flat_map(|t| variants(t).iter().map(move |v| task(t, &options(v)).unwrap())).collect()
}

fn blind(task: &Arc<dyn Task>) -> Env {
    Env::new(task.clone(), &EnvConfig::blind()).unwrap()
}

fn rng(name: &str, index: u64) -> Rng {
    stream(3, name, 0, index)
}

fn record(env: &mut Env, direction: Direction, config: &DemonstratorConfig, index: u64) -> e2h_core::Episode {
    let origin = Origin::demonstration(env.task().name(), direction, index as u32, 3);
    demonstrate(env, direction, config, origin, &mut rng(direction.name(), index)).unwrap()
}

/// The action that asks for the pose the controller has anyway.
fn stay(env: &Env) -> Action {
    toward(&env.sim().goal(), true)
}

fn toward(goal: &Pose, open: bool) -> Action {
    let p = goal.to_row(&[0.0, 1.0, 0.0, 0.0]);
    [p[0], p[1], p[2], p[3], p[4], p[5], p[6], if open { 1.0 } else { 0.0 }]
}

#[test]
fn the_same_seed_gives_the_same_states_in_every_environment() {
    for task in all() {
        let mut first = blind(&task);
        let mut second = first.clone_shared().unwrap();
        for direction in BOTH {
            let path = |env: &mut Env| {
                let episode = record(env, direction, task.demonstrator(), 0);
                (episode.state, env.save())
            };
            assert_eq!(path(&mut first), path(&mut second), "{} {direction}", task.variant());
        }
    }
}

#[test]
fn a_restored_state_continues_bit_for_bit() {
    for task in all() {
        let mut env = blind(&task);
        let actions = record(&mut env, Direction::Hard, task.demonstrator(), 1).action;
        env.reset(Direction::Hard, &mut rng("hard", 1)).unwrap();
        let (before, after) = actions.split_at(120); // the nut is in the hand by then
        for action in before {
            env.step(action).unwrap();
        }
        let saved = env.save();
        let run = |env: &mut Env| {
            after[..60].iter().map(|a| (env.step(a).unwrap(), env.save())).collect::<Vec<_>>()
        };
        let first = run(&mut env);
        env.restore(&saved).unwrap();
        assert_eq!(env.save(), saved);
        assert_eq!(run(&mut env), first);
        let mut other = env.clone_shared().unwrap();
        other.restore(&saved).unwrap();
        assert_eq!(run(&mut other), first);
        assert!(matches!(other.restore(&saved[1..]), Err(Error::State { .. })));
    }
}

#[test]
fn what_ends_one_task_starts_the_other_and_is_not_its_goal() {
    for task in all() {
        let mut env = blind(&task);
        for direction in BOTH {
            for index in 0..4 {
                env.reset(direction, &mut rng("start", index)).unwrap();
                assert!(!env.success(direction), "{} {direction} starts at its goal", task.variant());
                let lies = env.sim().object().position;
                env.home().unwrap();
                assert!((env.sim().object().position - lies).norm() < 1e-3, "homing moved the object");
                assert!(
                    env.success(direction.reverse()),
                    "{} {direction} starts off the other's goal",
                    task.variant()
                );
            }
            let episode = record(&mut env, direction, task.demonstrator(), 2);
            assert!(episode.outcome.is_success() && env.success(direction));
            assert!(!env.success(direction.reverse()));
        }
    }
}

#[test]
fn experts_succeed_and_end_at_home() {
    for task in all() {
        let mut env = blind(&task);
        for direction in BOTH {
            for index in 10..13 {
                let episode = record(&mut env, direction, task.demonstrator(), index);
                assert!(episode.outcome.is_success(), "{} {direction} {index}", task.variant());
                assert!((100..450).contains(&episode.len()), "{} rows", episode.len());
                assert!((env.sim().tcp().position - env.sim().home().position).norm() < 0.05);
                episode.validate().unwrap();
            }
            let clean = record(&mut env, direction, &DemonstratorConfig::clean(), 0);
            assert!(clean.outcome.is_success());
        }
    }
}

#[test]
fn reversed_easy_demonstrations_replay_in_the_hard_task() {
    for task in all() {
        let mut env = blind(&task);
        let good = (20..23)
            .filter(|&index| {
                let easy = record(&mut env, Direction::Easy, task.demonstrator(), index);
                env.begin(Direction::Hard).unwrap();
                let outcome = replay(&mut env, &reverse(&easy, &ReverseConfig::default()).action).unwrap();
                outcome.is_some_and(Outcome::is_success)
            })
            .count();
        assert!(good >= 2, "{}: {good} of 3", task.variant());
    }
}

#[test]
fn idle_and_random_policies_fail() {
    let config = EnvConfig { horizon_hard: 80, horizon_easy: 80, ..EnvConfig::blind() };
    for task in all() {
        let mut env = Env::new(task.clone(), &config).unwrap();
        for direction in BOTH {
            for moving in [false, true] {
                let mut rng = rng("idle", 0);
                env.reset(direction, &mut rng).unwrap();
                let outcome = loop {
                    let mut action = stay(&env);
                    if moving {
                        for v in &mut action[..3] {
                            *v += rng.random_range(-0.03..0.03);
                        }
                        action[7] = f32::from(u8::from(rng.random_bool(0.5)));
                    }
                    if let Some(outcome) = env.step(&action).unwrap() {
                        break outcome;
                    }
                };
                assert_eq!(outcome, Outcome::Timeout, "{} {direction}", task.variant());
                assert_eq!(env.steps(), 80);
            }
        }
    }
}

#[test]
fn a_moving_goal_is_followed_within_one_control_step() {
    let mut env = blind(&all()[0]);
    env.reset(Direction::Hard, &mut rng("lag", 0)).unwrap();
    let start = env.sim().goal();
    let mut reached = vec![];
    let goal = |t: usize| {
        let mut goal = start;
        goal.position += Vector3::new(0.6, -0.64, 0.48).normalize() * (0.1 / e2h_core::CONTROL_HZ * t as f64);
        goal
    };
    for t in 1..=40 {
        env.step(&toward(&goal(t), true)).unwrap();
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
    let mut env = blind(&all()[0]);
    env.reset(Direction::Hard, &mut rng("diverge", 0)).unwrap();
    let mut state = env.save();
    state[1 + 16] = 1e12; // time, then 16 positions, then the first joint's velocity
    env.restore(&state).unwrap();
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
    let mut env = blind(&all()[0]);
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
    let mut env = blind(&all()[0]);
    env.reset(Direction::Hard, &mut rng("far", 0)).unwrap();
    let far = [2.0, 1.0, 1.5, 0.0, 1.0, 0.0, 0.0, 1.0];
    for _ in 0..100 {
        assert_ne!(env.step(&far).unwrap(), Some(Outcome::Diverged));
    }
    env.home().unwrap();
    assert!((env.sim().tcp().position - env.sim().home().position).norm() < 1e-3);
}
