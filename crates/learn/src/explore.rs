//! Exploration in the easy direction: a smooth random excursion of the goal poses that the easy policy asks for.
//!
//! Easy rollouts of a policy end where its few demonstrations ended. Their reversals start where the hard policy is good
//! already and show no correction. Where the object is clear of its goal ([`e2h_env::Task::room`]) the easy direction is safe to
//! disturb; turned round in time, an excursion is a way back. At the goal it is zero, so that reversals end exactly.
//!
//! # Source
//! TRASS (arXiv 1810.01128) explores outward from goals and learns the reverse; DART (arXiv 1703.09327) and CCIL
//! (arXiv 2310.12972) disturb demonstrations to get corrections. The shape of the excursion is ours.

use e2h_core::{Action, CONTROL_HZ, Pose, Rng};
use e2h_env::Env;
use nalgebra::{UnitQuaternion, Vector3};
use rand::Rng as _;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Furthest excursion that a configuration may ask for, m (one deviation): the arm's reach is 0.85 m.
const LARGEST_M: f64 = 0.3;
/// Furthest that the grip may be out of place, m (one deviation): pads are 2 cm wide.
const LARGEST_GRIP_M: f64 = 0.03;
/// Largest turn that a configuration may ask for, rad (one deviation).
const LARGEST_RAD: f64 = 1.5;
/// Sinusoids of one axis.
const WAVES: usize = 3;
/// Speed of the policy's own goals above which the excursion runs at its full rate, m/s: where the policy takes care, so does it.
const FULL_SPEED: f64 = 0.1;

/// How collection explores.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExploreConfig {
    /// False: easy rollouts of collection are as the policy wants them (the paper's).
    pub enabled: bool,
    /// Share of cycles that explore, in [0, 1]; the others show what the policy does by itself.
    pub share: f64,
    /// Deviation of the excursion to either side, m.
    pub sideways_m: f64,
    /// Deviation up and down, m.
    pub up_m: f64,
    /// Deviation of the turn about the vertical, rad.
    pub yaw_rad: f64,
    /// Lowest and highest frequency, Hz.
    pub band_hz: [f64; 2],
    /// Room of the object over which the excursion grows to its full size, m.
    pub ramp_m: f64,
    /// Part of the sideways excursion and of the turn that is left where the object is put down, in [0, 1]: how wide the
    /// region is that it may end in.
    pub release: f64,
    /// Deviation of the place of the grip along the jaws, m: a rollout holds its hand off all that the policy asks for by as much, at
    /// its goals too, so that it takes the object beside the usual place. Its reversal shows how an object that is held there is
    /// brought to its goal; where all grips are the same, the hand alone seems to say where the object is. Not in pairs that
    /// hold the object throughout.
    #[serde(default)]
    pub grip_m: f64,
    /// Factor on the deviations of the excursion from one iteration to the next.
    pub growth: f64,
}

impl Default for ExploreConfig {
    /// None at all: what configurations from before say.
    fn default() -> Self {
        Self {
            enabled: false,
            share: 1.0,
            sideways_m: 0.03,
            up_m: 0.015,
            yaw_rad: 0.2,
            band_hz: [0.05, 0.3],
            ramp_m: 0.08,
            release: 1.0,
            grip_m: 0.0,
            growth: 1.0,
        }
    }
}

impl ExploreConfig {
    /// All problems with the values, for a loop of `iterations`.
    #[must_use]
    pub fn validate(&self, iterations: u32) -> Vec<String> {
        let mut problems = vec![];
        let mut within = |name: &str, value: f64, [low, high]: [f64; 2], unit: &str| {
            if !(low..=high).contains(&value) {
                problems.push(format!("{name}: expected {low} to {high}{unit}, got {value}"));
            }
        };
        within("share", self.share, [0.0, 1.0], "");
        within("release", self.release, [0.0, 1.0], "");
        within("grip_m", self.grip_m, [0.0, LARGEST_GRIP_M], " m");
        within("growth", self.growth, [0.5, 2.0], "");
        within("ramp_m", self.ramp_m, [0.001, 1.0], " m");
        let growth =
            self.growth.max(1.0).powi(i32::try_from(iterations.saturating_sub(1)).unwrap_or(i32::MAX));
        let [low, high] = self.band_hz;
        if !(0.0 < low && low <= high && high <= CONTROL_HZ / 4.0) {
            problems.push(format!(
                "band_hz: expected 0 < low <= high <= {}, got {low} and {high}",
                CONTROL_HZ / 4.0
            ));
        }
        for (name, value, most) in [
            ("sideways_m", self.sideways_m, LARGEST_M),
            ("up_m", self.up_m, LARGEST_M),
            ("yaw_rad", self.yaw_rad, LARGEST_RAD),
        ] {
            if !(value >= 0.0 && value * growth <= most) {
                let grown = if growth > 1.0 {
                    format!(" (times {growth:.2} in the last iteration)")
                } else {
                    String::new()
                };
                problems.push(format!("{name}: expected 0 to {most}{grown}, got {value}"));
            }
        }
        problems
    }

    /// Whether a cycle explores: the share of them, evenly spread.
    #[must_use]
    pub fn explores(&self, cycle: usize) -> bool {
        let before = |n: usize| (n as f64 * self.share + 1e-9).floor();
        self.enabled && before(cycle + 1) > before(cycle)
    }
}

/// Amplitude, frequency (Hz) and phase (rad) of one sinusoid.
type Wave = (f64, f64, f64);

/// The excursion of one rollout.
#[derive(Debug, Clone)]
pub(crate) struct Wander {
    ramp: f64,
    release: f64,
    /// Place of the grip along the jaws, m.
    grip: f64,
    /// Of x, y, z (m) and yaw (rad).
    axes: [[Wave; WAVES]; 4],
    /// Seconds that the excursion has run.
    clock: f64,
    /// The policy's goal of the step before.
    before: Option<Vector3<f64>>,
    now: [f64; 4],
    /// By how much the object was out of where it may be put down when it was last held, m.
    back: [f64; 2],
}

impl Wander {
    /// Draws an excursion. All of its random numbers are drawn here.
    pub(crate) fn new(config: &ExploreConfig, iteration: u32, rng: &mut Rng) -> Self {
        let growth = config.growth.powi(i32::try_from(iteration.saturating_sub(1)).unwrap_or(i32::MAX));
        let sigmas = [config.sideways_m, config.sideways_m, config.up_m, config.yaw_rad];
        let [low, high] = config.band_hz;
        // The variance of the sum comes to 0.85 of the deviation squared; few rollouts go further than twice the deviation.
        let axes = sigmas.map(|sigma| {
            std::array::from_fn(|_| {
                let amplitude = 1.6 * (2.0_f64 / 3.0).sqrt() * sigma * growth * rng.random::<f64>();
                (amplitude, low + (high - low) * rng.random::<f64>(), TAU * rng.random::<f64>())
            })
        });
        // Drawn last, so that a run without it draws what it always did. Uniform, with the deviation asked for.
        let grip = 3.0_f64.sqrt() * config.grip_m * rng.random_range(-1.0..=1.0);
        Self {
            ramp: config.ramp_m,
            release: config.release,
            grip,
            axes,
            clock: 0.0,
            before: None,
            now: [0.0; 4],
            back: [0.0; 2],
        }
    }

    /// By how much the goal of the last step was displaced; the place of the grip is no part of it, as there is no way back from it.
    pub(crate) fn now(&self) -> e2h_core::Excursion {
        // Stored episodes are f32.
        self.now.map(|v| v as f32)
    }

    /// The action displaced, given the scene as it is.
    pub(crate) fn displace(&mut self, env: &Env, action: &Action) -> Action {
        let sim = env.sim();
        let share = |distance: f64| (distance / self.ramp).clamp(0.0, 1.0);
        let free = share(env.task().room(sim));
        // How far above where things are put down the object is, or the empty hand from the object: there, up and down is
        // not free, and the hand should not wander sideways while it puts down or lets go.
        let height = if !env.task().homes() {
            f64::INFINITY
        } else if sim.touching() {
            sim.object().position.z - sim.object_start().position.z
        } else {
            (sim.tcp().position - sim.object().position).norm() - 0.04
        };
        let height = share(height);
        let goal = Pose::from_row(&action[..7]);
        let speed = self.before.map_or(0.0, |b| (goal.position - b).norm() * CONTROL_HZ);
        self.before = Some(goal.position);
        self.clock += (speed / FULL_SPEED).min(1.0) * height / CONTROL_HZ;
        let low = free * (self.release + (1.0 - self.release) * height);
        let weights = [low, low, free * height, low];
        for ((now, axis), weight) in self.now.iter_mut().zip(&self.axes).zip(weights) {
            let wave = |&(amplitude, hz, phase): &Wave| amplitude * (TAU * hz * self.clock + phase).sin();
            *now = weight * axis.iter().map(wave).sum::<f64>();
        }
        // Jaws close along the tool's y axis, and its z axis is the way it points.
        let grip = if env.task().homes() { Vector3::new(self.grip, 0.0, 0.0) } else { Vector3::zeros() };
        let displaced = |[x, y, z, yaw]: [f64; 4]| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw) * goal.orientation;
            Pose::new(goal.position + Vector3::new(x, y, z) + turn * grip, turn)
        };
        // As the object comes down it is brought to where it may lie, as it sits in the hand.
        if sim.touching() {
            let tcp = sim.tcp();
            let held = tcp.orientation.inverse() * (sim.object().position - tcp.position);
            let there = displaced(self.now);
            let lands = there.position + there.orientation * held;
            let back = env.task().put_down(&lands) - lands;
            self.back = [back.x, back.y];
        }
        for (now, back) in self.now.iter_mut().zip(self.back) {
            *now += free * (1.0 - height) * back;
        }
        let displaced = displaced(self.now);
        let mut out = *action;
        // The action's own hemisphere, so that no sign flips.
        out[..7].copy_from_slice(&displaced.to_row(&[3, 4, 5, 6].map(|i| f64::from(action[i]))));
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cycles_explore_in_the_share_asked_for_evenly_spread() {
        let config = |share| ExploreConfig { enabled: true, share, ..ExploreConfig::default() };
        let count = |c: &ExploreConfig, n: usize| (0..n).filter(|&i| c.explores(i)).count();
        assert_eq!((count(&config(1.0), 40), count(&config(0.0), 40)), (40, 0));
        assert_eq!((count(&config(0.7), 40), count(&config(0.7), 10)), (28, 7));
        assert_eq!(count(&ExploreConfig::default(), 40), 0);
    }

    #[test]
    fn values_that_cannot_be_are_refused_by_name() {
        let sound = ExploreConfig::default();
        assert!(sound.validate(100).is_empty());
        let wrong = |change: fn(&mut ExploreConfig)| {
            let mut config = sound.clone();
            change(&mut config);
            config.validate(5).join("; ")
        };
        assert!(wrong(|c| c.sideways_m = -0.01).contains("sideways_m: expected 0 to 0.3"));
        assert!(wrong(|c| c.up_m = f64::NAN).contains("up_m"));
        assert!(wrong(|c| c.sideways_m = 2.0).contains("got 2"));
        assert!(wrong(|c| c.band_hz = [0.3, 0.05]).contains("low <= high"));
        assert!(wrong(|c| c.band_hz = [0.0, 0.05]).contains("band_hz"));
        assert!(wrong(|c| c.share = 1.5).contains("share: expected 0 to 1"));
        assert!(wrong(|c| c.ramp_m = 0.0).contains("ramp_m"));
        assert!(wrong(|c| c.grip_m = 0.05).contains("grip_m: expected 0 to 0.03 m"));
        // 30 mm, doubled four times, are 480 mm.
        assert!(
            wrong(|c| c.growth = 2.0)
                .contains("sideways_m: expected 0 to 0.3 (times 16.00 in the last iteration)")
        );
    }
}
