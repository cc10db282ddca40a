use crate::{DemonstratorConfig, Sim};
use e2h_core::{Action, CONTROL_HZ, Pose, Rng};
use nalgebra::{UnitQuaternion, Vector3};
use rand::{Rng as _, SeedableRng};
use rand_distr::{Distribution, Normal};

/// A scripted demonstrator for one episode. It sees everything; policies only see observations.
pub trait Expert: Send {
    /// The action of this control step.
    fn act(&mut self, sim: &Sim) -> Action;

    /// True when the script is through and the arm only holds its pose.
    fn done(&self) -> bool;
}

/// A piece of a demonstration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Phase {
    /// Move to a pose.
    Move {
        /// Where to.
        to: Pose,
        /// Fraction of the drawn speed.
        pace: f64,
        /// A free movement bows and ends near its waypoint; an exact one goes straight to it.
        free: bool,
    },
    /// Open or close the gripper, with a wait before and after.
    Grip {
        /// Open or close.
        open: bool,
    },
}

/// Gives the phase of an index from the scene as it is when that phase begins; `None` after the last.
type Plan = Box<dyn FnMut(usize, &Sim, &mut Rng) -> Option<Phase> + Send>;

/// An [`Expert`] that follows a plan of phases with the variation of a [`DemonstratorConfig`].
pub struct Script {
    plan: Plan,
    config: DemonstratorConfig,
    rng: Rng,
    next: usize,
    goal: Option<Pose>,
    open: bool,
    now: Vec<Segment>, // what is left of the phase, last first
    done: bool,
}

enum Segment {
    Wait(usize),
    Set { open: bool },
    Travel(Travel),
}

/// A movement along a bowed line with a bell-shaped speed.
struct Travel {
    from: Pose,
    to: Pose,
    bow: Vector3<f64>,
    length: f64,
    cruise: f64,
    slow: Option<([f64; 2], f64)>, // stretch of the path, m, and the speed on it
    at: f64,
    speed: f64,
}

/// Path length that a turn by one radian counts as, m: keeps turns under about 0.9 rad/s.
const METRES_PER_RADIAN: f64 = 0.25;
const DT: f64 = 1.0 / CONTROL_HZ;

impl Script {
    /// A script that draws its variation from a fork of `rng`. The gripper starts as it is.
    pub fn new(
        config: &DemonstratorConfig,
        rng: &mut Rng,
        plan: impl FnMut(usize, &Sim, &mut Rng) -> Option<Phase> + Send + 'static,
    ) -> Self {
        Self {
            plan: Box::new(plan),
            config: config.clone(),
            rng: Rng::from_rng(rng),
            next: 0,
            goal: None,
            open: true,
            now: vec![],
            done: false,
        }
    }

    fn begin(&mut self, phase: Phase, goal: Pose) {
        match phase {
            Phase::Grip { open } => {
                let mut dwell = || steps(draw(&mut self.rng, self.config.grip_dwell_s));
                let (before, after) = (dwell(), dwell());
                self.now = vec![Segment::Wait(after), Segment::Set { open }, Segment::Wait(before)];
            }
            Phase::Move { to, pace, free } => {
                self.now = vec![Segment::Travel(self.travel(goal, to, pace, free))];
                if self.rng.random_bool(self.config.pause_probability) {
                    self.now.push(Segment::Wait(steps(draw(&mut self.rng, self.config.pause_s))));
                }
            }
        }
    }

    fn travel(&mut self, from: Pose, to: Pose, pace: f64, free: bool) -> Travel {
        let rng = &mut self.rng;
        let config = &self.config;
        let noise = if free { 1.0 } else { 0.1 };
        let mut jitter = || gauss(rng, config.waypoint_noise_m * noise);
        let offset = Vector3::new(jitter(), jitter(), if free { jitter() } else { 0.0 });
        let turn = gauss(rng, config.waypoint_noise_rad * noise);
        let to = Pose::new(
            to.position + offset,
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn) * to.orientation,
        );
        let line = to.position - from.position;
        let length = line.norm().max(METRES_PER_RADIAN * from.orientation.angle_to(&to.orientation));
        let bow = if free && config.bow > 0.0 {
            let random = Vector3::from_fn(|_, _| draw(rng, [-1.0, 1.0]));
            let aside = random - line * (random.dot(&line) / line.norm_squared().max(1e-9));
            // Upwards at most: a bow must not dip into the table.
            Vector3::new(aside.x, aside.y, aside.z.abs()) * (config.bow * line.norm() / 3f64.sqrt())
        } else {
            Vector3::zeros()
        };
        let cruise = draw(rng, config.speed) * pace;
        let slow = (length > 0.03 && rng.random_bool(config.slow_probability)).then(|| {
            let stretch = draw(rng, config.slow_length_m).min(length);
            let start = draw(rng, [0.0, length - stretch]);
            ([start, start + stretch], draw(rng, config.slow_speed))
        });
        Travel { from, to, bow, length, cruise, slow, at: 0.0, speed: 0.0 }
    }
}

impl Expert for Script {
    fn act(&mut self, sim: &Sim) -> Action {
        let mut goal = self.goal.unwrap_or_else(|| {
            self.open = sim.opens();
            sim.goal()
        });
        loop {
            match self.now.last_mut() {
                None => match (self.plan)(self.next, sim, &mut self.rng) {
                    Some(phase) => {
                        self.next += 1;
                        self.begin(phase, goal);
                    }
                    None => {
                        self.done = true;
                        break;
                    }
                },
                Some(Segment::Wait(0)) => drop(self.now.pop()),
                Some(Segment::Wait(left)) => {
                    *left -= 1;
                    break;
                }
                Some(Segment::Set { open }) => {
                    self.open = *open;
                    self.now.pop();
                }
                Some(Segment::Travel(travel)) => {
                    if travel.at >= travel.length {
                        self.now.pop();
                        continue;
                    }
                    goal = travel.advance(self.config.acceleration);
                    break;
                }
            }
        }
        self.goal = Some(goal);
        action(&goal, self.open)
    }

    fn done(&self) -> bool {
        self.done
    }
}

impl Travel {
    fn advance(&mut self, acceleration: f64) -> Pose {
        let wanted = match self.slow {
            Some(([a, b], speed)) if (a..b).contains(&self.at) => speed.min(self.cruise),
            _ => self.cruise,
        };
        let left = self.length - self.at;
        // Never faster than what can still be braked, never so slow that it does not arrive.
        let brake = (2.0 * acceleration * left).sqrt();
        let creep = acceleration * DT;
        self.speed = wanted.min(self.speed + creep).min(brake).max(creep.min(wanted));
        self.at = (self.at + self.speed * DT).min(self.length);
        let f = self.at / self.length;
        let mut pose = self.from.interpolate(&self.to, f);
        pose.position += self.bow * (4.0 * f * (1.0 - f));
        pose
    }
}

/// The action that asks for a pose and a gripper command.
pub(crate) fn action(goal: &Pose, open: bool) -> Action {
    // The gripper points down in every task so far; tasks that do not keep their own reference when they record.
    let [x, y, z, qw, qx, qy, qz] = goal.to_row(&[0.0, 1.0, 0.0, 0.0]);
    [x, y, z, qw, qx, qy, qz, f32::from(u8::from(open))]
}

fn steps(seconds: f64) -> usize {
    (seconds * CONTROL_HZ).round().max(0.0) as usize
}

/// Uniform in a range; its lower end when the range is empty.
pub fn draw(rng: &mut Rng, [low, high]: [f64; 2]) -> f64 {
    low + (high - low).max(0.0) * rng.random::<f64>()
}

/// Normal with mean zero; zero when the deviation is not a number to draw with.
pub(crate) fn gauss(rng: &mut Rng, deviation: f64) -> f64 {
    Normal::new(0.0, deviation).map_or(0.0, |n| n.sample(rng))
}

/// A normal step in the plane, m.
pub fn scatter(rng: &mut Rng, deviation: f64) -> Vector3<f64> {
    Vector3::new(gauss(rng, deviation), gauss(rng, deviation), 0.0)
}
