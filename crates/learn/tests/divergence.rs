//! A simulation that runs away on the way home or while a start comes to rest costs an external reset, and no more.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Action, ActionChunk, Direction, Observation, Origin, Policy, Pose, Rng};
use e2h_env::{DemonstratorConfig, Env, EnvConfig, Expert, Sim, Task, TaskOptions, task};
use e2h_learn::config::AfterFailure;
use e2h_learn::record::ResetCause;
use e2h_learn::{Collected, Progress, Result, RunConfig, collect, evaluate};
use nalgebra::Vector3;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

/// MuJoCo takes a position beyond this for one that ran away, m.
const FAR: f64 = 1e10;
/// Control steps of a hard rollout.
const HORIZON: usize = 20;

/// The cube, whose starts are spoiled.
struct Spoiled {
    sound: Arc<dyn Task>,
    /// Starts that diverge at once, until none is left.
    starts: AtomicUsize,
    /// Starts that diverge this many seconds later, until none is left.
    later: (f64, AtomicUsize),
}

fn one_of(left: &AtomicUsize) -> bool {
    left.fetch_update(SeqCst, SeqCst, |n| n.checked_sub(1)).is_ok()
}

impl Task for Spoiled {
    fn name(&self) -> &str {
        self.sound.name()
    }
    fn scene(&self) -> String {
        self.sound.scene()
    }
    fn object(&self) -> &str {
        self.sound.object()
    }
    fn home(&self) -> Pose {
        self.sound.home()
    }
    fn horizon(&self, direction: Direction) -> usize {
        self.sound.horizon(direction)
    }
    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> e2h_env::Result<()> {
        self.sound.place(direction, sim, rng)?;
        let mut pose = sim.object();
        if one_of(&self.starts) {
            pose.position = Vector3::new(0.0, 0.0, -2.0 * FAR);
        } else if one_of(&self.later.1) {
            // It falls across the limit.
            let way = 0.5 * 9.81 * self.later.0.powi(2);
            pose.position = Vector3::new(0.0, 0.0, way - FAR);
        } else {
            return Ok(());
        }
        sim.set_object(&pose)
    }
    fn success(&self, direction: Direction, sim: &Sim) -> bool {
        self.sound.success(direction, sim)
    }
    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert> {
        self.sound.expert(direction, config, rng)
    }
    fn demonstrator(&self) -> &DemonstratorConfig {
        self.sound.demonstrator()
    }
}

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
            vec![action; 4]
        };
        Ok(histories.iter().map(act).collect())
    }
}

fn env(starts: usize, later: (f64, usize)) -> Env {
    let sound = task("cube_pick_place", &TaskOptions::default()).unwrap();
    let later = (later.0, AtomicUsize::new(later.1));
    let config = EnvConfig {
        cameras: false,
        hold_steps: 1,
        horizon_hard: HORIZON,
        horizon_easy: HORIZON,
        ..EnvConfig::default()
    };
    Env::new(Arc::new(Spoiled { sound, starts: AtomicUsize::new(starts), later }), &config).unwrap()
}

fn collected(env: Env) -> Result<Collected> {
    let mut config = RunConfig::resolve("smoke", "cube_pick_place", &[]).unwrap().config.closed_loop;
    (config.cycles, config.homing, config.after_failure) = (3, true, AfterFailure::Continue);
    let origin = Origin::demonstration("cube_pick_place", Direction::Easy, 0, 3);
    collect(vec![env], &Still, &Still, &config, &origin, None, &Progress::new(true))
}

fn resets(collected: &Collected) -> Vec<(ResetCause, usize)> {
    collected.resets.iter().map(|(cause, n)| (*cause, *n)).collect()
}

#[test]
fn a_way_home_that_diverges_is_an_external_reset() {
    // Four control steps of settling, those of the rollout, and some of the way home.
    let seconds = (4 + HORIZON + 5) as f64 / e2h_core::CONTROL_HZ;
    let collected = collected(env(0, (seconds, 1))).unwrap();
    // The reset is to the easy task's start, where this policy fails; where the hard task starts the easy one is done.
    assert_eq!(
        resets(&collected),
        [(ResetCause::EasyFailed, 1), (ResetCause::HomingDiverged, 1), (ResetCause::Start, 1)]
    );
    assert_eq!((collected.hard.len(), collected.easy_rollouts, collected.plain.resets), (3, 3, 2));
}

#[test]
fn a_start_that_diverges_is_drawn_again_and_counted() {
    let collected = collected(env(2, (0.0, 0))).unwrap();
    assert_eq!(resets(&collected), [(ResetCause::ResetDiverged, 2), (ResetCause::Start, 1)]);
    let evaluated =
        evaluate(vec![env(3, (0.0, 0))], &Still, Direction::Hard, 0..2, 0, None, &Progress::new(true))
            .unwrap();
    assert_eq!(evaluated.evaluation.outcomes.len(), 2);
}

#[test]
fn starts_that_always_diverge_are_an_error() {
    let error = collected(env(usize::MAX, (0.0, 0))).unwrap_err().to_string();
    assert!(error.contains("the start of an episode"), "{error}");
}
