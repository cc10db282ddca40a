//! Images of a round lie on the disk, and are the same there as in memory.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Action, ActionChunk, Direction, Episode, ImageStore, Kind, Observation, Origin, Policy, Rng};
use e2h_env::{Env, EnvConfig, TaskOptions, task};
use e2h_learn::{Collected, Progress, Run, RunConfig, RunOptions, collect};

/// Stays where it is.
struct Still;

impl Policy for Still {
    fn n_obs_steps(&self) -> usize {
        1
    }

    fn act(&self, histories: &[Vec<&Observation>], _: &mut [Rng]) -> e2h_core::Result<Vec<ActionChunk>> {
        let act = |history: &Vec<&Observation>| {
            let mut action: Action = [0.0; 8];
            action[..7].copy_from_slice(&history[0].state[..7]);
            action[7] = 1.0;
            vec![action; 16]
        };
        Ok(histories.iter().map(act).collect())
    }
}

fn collected(store: Option<&ImageStore>) -> Collected {
    let env = EnvConfig { horizon_hard: 16, horizon_easy: 16, image_size: 16, ..EnvConfig::default() };
    let mut config = RunConfig::resolve("smoke", "cube_pick_place", &[]).unwrap().config.closed_loop;
    (config.cycles, config.loops, config.keep_rollouts) = (3, 2, true);
    let first = Env::new(task("cube_pick_place", &TaskOptions::default()).unwrap(), &env).unwrap();
    let envs = (0..config.loops).map(|_| first.clone_shared().unwrap()).collect();
    let origin =
        Origin { kind: Kind::Rollout, ..Origin::demonstration("cube_pick_place", Direction::Easy, 0, 7) };
    collect(envs, &Still, &Still, &config, &origin, store, &Progress::new(true)).unwrap()
}

fn in_memory(episodes: &[Episode]) -> usize {
    let images = episodes.iter().flat_map(|e| &e.frames).flat_map(|f| &f.images);
    images.filter(|image| image.in_memory()).count()
}

#[test]
fn rollouts_that_have_ended_take_no_memory_for_images_and_change_in_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let store = ImageStore::create(folder.path()).unwrap();
    let (stored, memory) = (collected(Some(&store)), collected(None));
    assert_eq!((stored.hard.len(), stored.rejected.len()), (3, 3));
    assert!(in_memory(&memory.hard) > 0);
    assert_eq!((in_memory(&stored.hard), in_memory(&stored.rejected)), (0, 0));
    assert_eq!((&stored.hard, &stored.rejected), (&memory.hard, &memory.rejected));
    // A row has the images of two cameras.
    let rows: usize = stored.hard.iter().chain(&stored.rejected).map(Episode::len).sum();
    assert_eq!(store.bytes(), (rows * 2 * 16 * 16 * 3) as u64);
}

#[test]
fn demonstrations_of_a_run_lie_on_the_disk_when_made_and_when_read_again() {
    let folder = tempfile::tempdir().unwrap();
    let options = |resume| RunOptions {
        preset: "smoke".to_owned(),
        out: Some(folder.path().join("run")),
        resume,
        quiet: true,
        ..RunOptions::new("cube_pick_place")
    };
    let made = Run::open(&options(false)).unwrap().demonstrations().unwrap();
    let read = Run::open(&options(true)).unwrap().demonstrations().unwrap();
    assert_eq!(made.easy, read.easy);
    assert!(made.easy[0].frames.iter().any(|f| !f.images.is_empty()));
    assert_eq!((in_memory(&made.easy), in_memory(&read.easy)), (0, 0));
}
