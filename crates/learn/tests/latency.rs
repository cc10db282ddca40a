//! While a policy thinks its last goal is held, and what it answers is an answer to what it saw before.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Action, ActionChunk, Direction, Observation, Origin, Policy, Rng, State};
use e2h_env::{Env, EnvConfig, TaskOptions, task};
use e2h_learn::{Progress, RunConfig, collect, evaluate};
use std::sync::Mutex;

/// Rises by 5 mm a step, four steps a chunk, and remembers what it saw.
#[derive(Default)]
struct Rise(Mutex<Vec<State>>);

impl Policy for Rise {
    fn n_obs_steps(&self) -> usize {
        1
    }

    fn act(&self, histories: &[Vec<&Observation>], _: &mut [Rng]) -> e2h_core::Result<Vec<ActionChunk>> {
        let act = |history: &Vec<&Observation>| {
            let s = history[0].state;
            self.0.lock().unwrap().push(s);
            let goal = |step: u8| {
                let mut action: Action = [0.0; 8];
                action[..7].copy_from_slice(&s[..7]);
                action[2] += 0.005 * f32::from(step);
                action[7] = 1.0;
                action
            };
            (1..=4).map(goal).collect()
        };
        Ok(histories.iter().map(act).collect())
    }
}

fn env(latency: usize) -> Env {
    let config =
        EnvConfig { cameras: false, horizon_hard: 24, horizon_easy: 24, latency, ..EnvConfig::default() };
    Env::new(task("cube_pick_place", &TaskOptions::default()).unwrap(), &config).unwrap()
}

#[test]
fn goals_are_held_before_each_chunk_and_chunks_answer_what_was_seen_before() {
    let mut config = RunConfig::resolve("smoke", "cube_pick_place", &[]).unwrap().config.closed_loop;
    (config.cycles, config.loops, config.keep_rollouts) = (1, 1, true);
    config.explore.enabled = false;
    let origin = Origin::demonstration("cube_pick_place", Direction::Easy, 0, 7);
    for latency in [0, 3] {
        let (hard, easy) = (Rise::default(), Rise::default());
        let all =
            collect(vec![env(latency)], &hard, &easy, &config, &origin, None, &Progress::new(true)).unwrap();
        let episode = &all.hard[0];
        let period = latency + 4;
        assert_eq!(episode.len(), 24);
        let seen = hard.0.into_inner().unwrap();
        assert_eq!(seen.len(), 24_usize.div_ceil(period));
        for (n, state) in seen.iter().enumerate() {
            assert_eq!(*state, episode.state[n * period], "chunk {n} with latency {latency}");
        }
        for (t, action) in episode.action.iter().enumerate() {
            if t % period < latency {
                let before = t.checked_sub(1).map_or(action, |t| &episode.action[t]);
                let off = action.iter().zip(before).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                assert!(off < 1e-6, "row {t}: {off}");
            } else {
                let step = (t % period - latency + 1) as f32;
                let rise = action[2] - episode.state[t - t % period][2];
                assert!((rise - 0.005 * step).abs() < 1e-6, "row {t}: {rise}");
            }
        }
    }
}

#[test]
fn trials_take_the_time_that_the_policy_thinks() {
    let calls = |latency| {
        let policy = Rise::default();
        let done =
            evaluate(vec![env(latency)], &policy, Direction::Hard, 0..1, 5, None, &Progress::new(true))
                .unwrap();
        assert_eq!(done.evaluation.outcomes[0].steps, 24, "the clock runs on");
        policy.0.into_inner().unwrap().len()
    };
    assert_eq!((calls(0), calls(2), calls(20)), (6, 4, 1));
}
