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

/// Fastest that the hand turns to where it puts the object down, rad/s.
const TURN_SPEED: f64 = 1.5;
/// How far from where it held the object the empty hand begins to turn back, and over what distance it does, m.
const LEAVES: (f64, f64) = (0.03, 0.10);

/// How far the hand goes down in a control step, m, to put down an object that the policy lets go of in the air.
const LOWER_M: f64 = 0.004;
/// Object that comes down less than this in such a step lies on something, m.
const LIES_M: f64 = 0.001;
/// Most steps down, and steps in which the hand then stays where it is and opens.
const LOWERING: (usize, usize) = (50, 5);

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
    /// How much of the turns at which the object may be put down ([`e2h_env::Task::put_down_turn`]) is used, in [0, 1]: a rollout
    /// draws its own turn evenly from them, the hand takes it once the object is clear, and keeps it until it leaves the object.
    /// Reversed, the object is grasped at a turn that no demonstration may have shown, and turned back on the way. 0: the policy
    /// chooses.
    #[serde(default)]
    pub turn: f64,
    /// True: where the policy lets go of an object in the air, the hand brings it down first. Reversed, a fall has no grasp.
    #[serde(default)]
    pub lower: bool,
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
            turn: 0.0,
            lower: false,
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
        within("turn", self.turn, [0.0, 1.0], "");
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

/// What is done where a policy lets go.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Lowering {
    /// Nothing yet.
    Waits,
    /// Steps down so far, height of the object before the last of them, and steps in which it did not come down.
    Down(usize, f64, usize),
    /// Steps in which the hand stays and opens.
    Opens(usize),
    Over,
}

/// The excursion of one rollout.
#[derive(Debug, Clone)]
pub(crate) struct Wander {
    ramp: f64,
    release: f64,
    /// Place of the grip along the jaws, m.
    grip: f64,
    /// Turn from home at which the object is put down, rad; None: as the policy wants.
    turn: Option<f64>,
    /// How much of the way from the policy's turn to that one is gone, in [0, 1].
    turned: f64,
    /// Of x, y, z (m) and yaw (rad).
    axes: [[Wave; WAVES]; 4],
    /// Seconds that the excursion has run.
    clock: f64,
    /// The policy's goal of the step before.
    before: Option<Vector3<f64>>,
    now: [f64; 4],
    /// By how much the object was out of where it may be put down when it was last held, m.
    back: [f64; 2],
    /// Where the object was in the hand when it was last held, m.
    held: Vector3<f64>,
    /// Where the hand was on the object then, m.
    on_object: Vector3<f64>,
    lowering: Lowering,
}

impl Wander {
    /// Draws an excursion, its turn from `turns` to either side. All of its random numbers are drawn here.
    pub(crate) fn new(config: &ExploreConfig, iteration: u32, turns: f64, rng: &mut Rng) -> Self {
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
        let turn = config.turn * rng.random_range(-1.0..=1.0) * turns;
        Self {
            ramp: config.ramp_m,
            release: config.release,
            grip,
            turn: (config.turn * turns > 0.0).then_some(turn),
            turned: 0.0,
            axes,
            clock: 0.0,
            before: None,
            now: [0.0; 4],
            back: [0.0; 2],
            held: Vector3::zeros(),
            on_object: Vector3::zeros(),
            lowering: if config.lower { Lowering::Waits } else { Lowering::Over },
        }
    }

    /// By how much the goal of the last step was displaced; the place of the grip is no part of it, as there is no way back from it.
    pub(crate) fn now(&self) -> e2h_core::Excursion {
        // Stored episodes are f32.
        self.now.map(|v| v as f32)
    }

    /// How far the hand is from where it held the object, m.
    fn away(&self, env: &Env) -> f64 {
        let object = env.sim().object();
        (env.sim().tcp().position - object.position - object.orientation * self.on_object).norm()
    }

    /// What to do before `action`, which lets go of an object in the air: another step down, or, where it lies, one in which the hand stays
    /// and opens. None: the action itself.
    pub(crate) fn before(&mut self, env: &Env, action: &Action) -> Option<Action> {
        let sim = env.sim();
        let height = sim.object().position.z;
        if self.lowering == Lowering::Waits {
            let lets_go = action[7] > 0.5 && !sim.opens() && sim.touching();
            if !lets_go || !env.task().homes() || env.task().room(sim) <= 0.0 {
                return None;
            }
            self.lowering = Lowering::Down(0, f64::INFINITY, 0);
        }
        let (mut goal, mut open) = (sim.goal(), false);
        if let Lowering::Down(steps, before, lies) = self.lowering {
            let lies = if before - height < LIES_M { lies + 1 } else { 0 };
            if steps < LOWERING.0 && lies < 2 {
                goal.position.z -= LOWER_M;
                self.lowering = Lowering::Down(steps + 1, height, lies);
            } else {
                self.lowering = Lowering::Opens(0);
            }
        }
        match self.lowering {
            Lowering::Opens(steps) if steps < LOWERING.1 => {
                // Not where the goal is by now, which is in the table.
                goal.position.z = sim.tcp().position.z;
                (self.lowering, open) = (Lowering::Opens(steps + 1), true);
            }
            Lowering::Opens(_) => self.lowering = Lowering::Over,
            _ => {}
        }
        if matches!(self.lowering, Lowering::Over | Lowering::Waits) {
            return None;
        }
        let mut out = *action;
        out[..7].copy_from_slice(&goal.to_row(&[3, 4, 5, 6].map(|i| f64::from(action[i]))));
        out[7] = f32::from(u8::from(open));
        Some(out)
    }

    /// The part of the excursion that brings the hand's turn from `goal`'s to that of this rollout, rad.
    fn turning(&mut self, env: &Env, goal: &Pose, free: f64, height: f64) -> f64 {
        let sim = env.sim();
        let Some(turn) = self.turn else { return 0.0 };
        let way = turn - turn_from(&env.task().home(), goal);
        let (from, over) = LEAVES;
        let left = if sim.touching() { 0.0 } else { ((self.away(env) - from) / over).clamp(0.0, 1.0) };
        // An object that is being put down is no longer turned: it would rub on the table.
        let most = TURN_SPEED / CONTROL_HZ / way.abs().max(1e-6) * if sim.touching() { height } else { 1.0 };
        let wanted = free.min(1.0 - left);
        self.turned += (wanted - self.turned).clamp(-most, most);
        self.turned * way
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
        } else if self.turn.is_some() {
            self.away(env) - 0.02
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
        self.now[3] += self.turning(env, &goal, free, height);
        // Jaws close along the tool's y axis, and its z axis is the way it points.
        let grip = if env.task().homes() { Vector3::new(self.grip, 0.0, 0.0) } else { Vector3::zeros() };
        let tcp = sim.tcp();
        if sim.touching() {
            let object = sim.object();
            self.held = tcp.orientation.inverse() * (object.position - tcp.position);
            self.on_object = object.orientation.inverse() * (tcp.position - object.position);
        }
        // A hand that takes a turn of its own goes round the object, which so comes to where the policy wants it.
        let about = if self.turn.is_some() { self.held } else { Vector3::zeros() };
        let displaced = |[x, y, z, yaw]: [f64; 4]| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw) * goal.orientation;
            let round = goal.orientation * about - turn * about;
            Pose::new(goal.position + Vector3::new(x, y, z) + round + turn * grip, turn)
        };
        // As the object comes down it is brought to where it may lie, as it sits in the hand.
        if sim.touching() {
            let there = displaced(self.now);
            let lands = there.position + there.orientation * self.held;
            let back = env.task().put_down(&lands) - lands;
            self.back = [back.x, back.y];
        }
        // Policies whose objects lie at a strange turn let go early: it is brought there sooner.
        let down = if self.turn.is_some() { (2.0 * (1.0 - height)).min(1.0) } else { 1.0 - height };
        for (now, back) in self.now.iter_mut().zip(self.back) {
            *now += free * down * back;
        }
        let displaced = displaced(self.now);
        // The way round the object is a part of it.
        let round = goal.orientation * about - displaced.orientation * about;
        self.now.iter_mut().zip(&round).for_each(|(now, v)| *now += v);
        let mut out = *action;
        // The action's own hemisphere, so that no sign flips.
        out[..7].copy_from_slice(&displaced.to_row(&[3, 4, 5, 6].map(|i| f64::from(action[i]))));
        out
    }
}

/// The turn about the vertical from one pose to another, rad, in (-pi, pi].
fn turn_from(from: &Pose, to: &Pose) -> f64 {
    let q = to.orientation * from.orientation.inverse();
    let angle = 2.0 * q.k.atan2(q.w);
    angle - TAU * (angle / TAU).round()
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
        assert!(wrong(|c| c.turn = 1.5).contains("turn: expected 0 to 1"));
        assert!(wrong(|c| c.grip_m = 0.05).contains("grip_m: expected 0 to 0.03 m"));
        // 30 mm, doubled four times, are 480 mm.
        assert!(
            wrong(|c| c.growth = 2.0)
                .contains("sideways_m: expected 0 to 0.3 (times 16.00 in the last iteration)")
        );
    }
}
