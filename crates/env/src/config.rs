use crate::Task;
use e2h_core::Direction;
use serde::{Deserialize, Serialize};

/// What an [`Env`](crate::Env) is built with, beside its task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct EnvConfig {
    /// Side of the square images, pixels. 72 on a laptop (cropped to 64), 144 as in the paper (cropped to 128).
    pub image_size: usize,
    /// Whether observations bring images.
    pub cameras: bool,
    /// Control steps after which a hard episode times out.
    pub horizon_hard: usize,
    /// Control steps after which an easy episode times out.
    pub horizon_easy: usize,
    /// Control steps in a row that a success predicate has to hold.
    pub hold_steps: usize,
    /// Furthest that the goal position moves in one control step, m (0.03 is 0.6 m/s).
    pub max_goal_step_m: f64,
    /// Furthest that the goal orientation turns in one control step, rad.
    pub max_goal_step_rad: f64,
    /// Control steps for which a policy's last goal is held before each of its chunks, while it thinks: a robot's pauses, in
    /// collection and in evaluation. The chunk is an answer to what was seen before them. 0: the world waits for the policy.
    pub latency: usize,
    /// Standard deviation of the joint noise round the home posture at a reset, rad.
    pub home_noise_rad: f64,
}

impl Default for EnvConfig {
    fn default() -> Self {
        Self {
            image_size: 72,
            cameras: true,
            horizon_hard: 500,
            horizon_easy: 500,
            hold_steps: 10,
            max_goal_step_m: 0.03,
            max_goal_step_rad: 0.15,
            latency: 0,
            home_noise_rad: 0.01,
        }
    }
}

impl EnvConfig {
    /// The defaults without images, with the horizons of a task: for measuring demonstrators.
    #[must_use]
    pub fn physics(task: &dyn Task) -> Self {
        Self {
            horizon_hard: task.horizon(Direction::Hard),
            horizon_easy: task.horizon(Direction::Easy),
            ..Self::blind()
        }
    }

    /// The defaults without images: for physics alone.
    #[must_use]
    pub fn blind() -> Self {
        Self { cameras: false, ..Self::default() }
    }
}

/// Longest episode, control steps: a quarter of an hour.
const MOST_STEPS: usize = 20_000;
/// Largest image of an observation, pixels per side: every step of every episode keeps its images.
const MOST_SIDE: usize = 1024;

fn whole(problems: &mut Vec<String>, name: &str, value: usize, [least, most]: [usize; 2]) {
    if !(least..=most).contains(&value) {
        problems.push(format!("{name}: expected {least} to {most}, got {value}"));
    }
}

fn number(problems: &mut Vec<String>, name: &str, value: f64, [least, most]: [f64; 2]) {
    if !(least..=most).contains(&value) {
        problems.push(format!("{name}: expected {least} to {most}, got {value}"));
    }
}

fn range(problems: &mut Vec<String>, name: &str, [low, high]: [f64; 2], [least, most]: [f64; 2]) {
    if !(least <= low && low <= high && high <= most) {
        problems.push(format!("{name}: expected a range within {least} to {most}, got [{low}, {high}]"));
    }
}

impl EnvConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        for (name, value, bounds) in [
            ("image_size", self.image_size, [1, MOST_SIDE]),
            ("horizon_hard", self.horizon_hard, [1, MOST_STEPS]),
            ("horizon_easy", self.horizon_easy, [1, MOST_STEPS]),
        ] {
            whole(&mut problems, name, value, bounds);
        }
        // A success that has to be held for longer than an episode lasts is none.
        let shortest = self.horizon_hard.min(self.horizon_easy).max(1);
        whole(&mut problems, "hold_steps", self.hold_steps, [1, shortest]);
        // A policy that thinks as long as an episode lasts does nothing in it.
        whole(&mut problems, "latency", self.latency, [0, shortest - 1]);
        for (name, value, bounds) in [
            ("max_goal_step_m", self.max_goal_step_m, [1e-4, 1.0]),
            ("max_goal_step_rad", self.max_goal_step_rad, [1e-4, std::f64::consts::PI]),
            ("home_noise_rad", self.home_noise_rad, [0.0, 1.0]),
        ] {
            number(&mut problems, name, value, bounds);
        }
        problems
    }
}

impl DemonstratorConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        for (name, value, bounds) in [
            ("waypoint_noise_m", self.waypoint_noise_m, [0.0, 1.0]),
            ("waypoint_noise_rad", self.waypoint_noise_rad, [0.0, std::f64::consts::PI]),
            ("bow", self.bow, [0.0, 1.0]),
            ("acceleration", self.acceleration, [1e-3, 100.0]),
            ("pause_probability", self.pause_probability, [0.0, 1.0]),
            ("slow_probability", self.slow_probability, [0.0, 1.0]),
        ] {
            number(&mut problems, name, value, bounds);
        }
        for (name, value, bounds) in [
            ("speed", self.speed, [1e-3, 10.0]),
            ("pause_s", self.pause_s, [0.0, 60.0]),
            ("slow_speed", self.slow_speed, [1e-3, 10.0]),
            ("slow_length_m", self.slow_length_m, [0.0, 10.0]),
            ("grip_dwell_s", self.grip_dwell_s, [0.0, 60.0]),
        ] {
            range(&mut problems, name, value, bounds);
        }
        whole(&mut problems, "tail", self.tail, [1, 1000]);
        problems
    }
}

/// Which form of a task, and who demonstrates it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TaskOptions {
    /// Name of the variant; empty for the task's default.
    pub variant: String,
    /// Free space between the object and the hole or holder that it goes into, m per side; 0 for the task's default.
    pub clearance: f64,
    /// The scripted demonstrator.
    pub demonstrator: DemonstratorConfig,
}

/// How much like a person the scripted demonstrator moves.
///
/// Hesitations and slow phases are the static and low-speed segments that the kinematic filter is for. They fall between
/// and inside movements; the pauses beside a gripper change are separate ([`Self::grip_dwell_s`]), because a reversed
/// release needs the time in which the fingers open.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DemonstratorConfig {
    /// Standard deviation of the free waypoints, m; grasp and placing are exact to a tenth of it.
    pub waypoint_noise_m: f64,
    /// Standard deviation of the yaw at free waypoints, rad.
    pub waypoint_noise_rad: f64,
    /// Largest sideways bow of a movement, as a fraction of its length.
    pub bow: f64,
    /// Speed range from which each movement draws, m/s.
    pub speed: [f64; 2],
    /// Acceleration, m/s^2.
    pub acceleration: f64,
    /// Chance of a hesitation before a movement.
    pub pause_probability: f64,
    /// Range of the length of a hesitation, s.
    pub pause_s: [f64; 2],
    /// Chance that a movement has a slow stretch.
    pub slow_probability: f64,
    /// Speed range of a slow stretch, m/s.
    pub slow_speed: [f64; 2],
    /// Range of the length of a slow stretch, m.
    pub slow_length_m: [f64; 2],
    /// Range of the wait before and after a gripper command, s.
    pub grip_dwell_s: [f64; 2],
    /// Control steps recorded after completion, with the arm at rest.
    pub tail: usize,
}

impl Default for DemonstratorConfig {
    fn default() -> Self {
        Self {
            waypoint_noise_m: 0.004,
            waypoint_noise_rad: 0.03,
            bow: 0.08,
            speed: [0.10, 0.25],
            acceleration: 1.0,
            pause_probability: 0.25,
            pause_s: [0.2, 1.5],
            slow_probability: 0.25,
            slow_speed: [0.03, 0.05],
            slow_length_m: [0.02, 0.05],
            grip_dwell_s: [0.35, 0.55],
            tail: 10,
        }
    }
}

impl DemonstratorConfig {
    /// Without variation: the same straight, even movements every time.
    #[must_use]
    pub fn clean() -> Self {
        Self {
            waypoint_noise_m: 0.0,
            waypoint_noise_rad: 0.0,
            bow: 0.0,
            speed: [0.18, 0.18],
            pause_probability: 0.0,
            slow_probability: 0.0,
            grip_dwell_s: [0.4, 0.4],
            ..Self::default()
        }
    }
}
