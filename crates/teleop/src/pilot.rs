//! From what is held to where the hand is to go: smooth, slow enough, and within reach.

use crate::controls::{Control, Event, Sticks};
use crate::{Error, Result};
use e2h_core::{CONTROL_HZ, Pose};
use nalgebra::{UnitQuaternion, Vector3};
use std::collections::BTreeSet;

const DT: f64 = 1.0 / CONTROL_HZ;
/// Part of the speed when going slowly.
const SLOW: f64 = 0.25;
/// Distance from home, m and rad, at which it has been reached.
const THERE: f64 = 5e-4;
/// A stick that is pushed less than this is at rest.
const DEAD: f64 = 0.12;

/// How fast and how far the goal may go.
#[derive(Debug, Clone, PartialEq)]
pub struct Limits {
    /// Speed, m/s. Scripted demonstrators go at 0.10 to 0.25.
    pub speed: f64,
    /// Speed of turning, rad/s.
    pub turn: f64,
    /// Acceleration, m/s^2; of turning, so many rad/s^2 by four.
    pub acceleration: f64,
    /// How far the goal may be ahead of the hand, m: what is pressed against something is pressed no harder.
    pub lead: f64,
    /// Where the tool centre point may go: x, y, z, m in the frame of the robot's base. A start outside widens it.
    pub workspace: [[f64; 2]; 3],
    /// How far the hand may be turned from where it began, rad to either side.
    pub yaw: f64,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            speed: 0.2,
            turn: 0.8,
            acceleration: 1.0,
            lead: 0.03,
            workspace: [[0.28, 0.78], [-0.40, 0.40], [0.004, 0.50]],
            yaw: 1.7,
        }
    }
}

impl Limits {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        for (name, value, least, most) in [
            ("speed", self.speed, 1e-3, 0.6),
            ("turn", self.turn, 1e-3, 3.0),
            ("acceleration", self.acceleration, 1e-2, 100.0),
            ("lead", self.lead, 1e-3, 1.0),
            ("yaw", self.yaw, 0.0, std::f64::consts::PI),
        ] {
            if !(least..=most).contains(&value) {
                problems.push(format!("{name}: expected {least} to {most}, got {value}"));
            }
        }
        for (axis, [low, high]) in ["x", "y", "z"].iter().zip(self.workspace) {
            if !(low.is_finite() && high.is_finite() && low < high) {
                problems.push(format!("workspace, {axis}: expected a range, got [{low}, {high}]"));
            }
        }
        problems
    }
}

/// Turns what is held into goals, one a control step.
#[derive(Debug, Clone)]
pub struct Pilot {
    limits: Limits,
    held: BTreeSet<Control>,
    /// Pressed since the last control step, and perhaps let go again: a tap moves the hand by a step.
    tapped: BTreeSet<Control>,
    sticks: Sticks,
    home: Pose,
    position: Vector3<f64>,
    yaw: f64,
    velocity: Vector3<f64>,
    turning: f64,
    open: bool,
}

impl Pilot {
    /// A hand that is at `start` and holds still.
    ///
    /// # Errors
    /// [`Error::Limits`] lists values that cannot work.
    pub fn new(limits: Limits, start: &Pose, open: bool) -> Result<Self> {
        let problems = limits.validate();
        if !problems.is_empty() {
            return Err(Error::Limits(problems));
        }
        Ok(Self {
            limits,
            held: BTreeSet::new(),
            tapped: BTreeSet::new(),
            sticks: Sticks::default(),
            home: *start,
            position: start.position,
            yaw: 0.0,
            velocity: Vector3::zeros(),
            turning: 0.0,
            open,
        })
    }

    /// The hand was put elsewhere. What is held stays held.
    pub fn place(&mut self, start: &Pose, open: bool) {
        (self.home, self.position, self.open) = (*start, start.position, open);
        (self.yaw, self.velocity, self.turning) = (0.0, Vector3::zeros(), 0.0);
    }

    /// Takes note of a change; true where it is a press that was not held already.
    pub fn handle(&mut self, event: Event) -> bool {
        match event {
            Event::Press(control) => {
                let new = self.held.insert(control);
                self.tapped.insert(control);
                if new && control == Control::Gripper {
                    self.open = !self.open;
                }
                return new;
            }
            Event::Release(control) => drop(self.held.remove(&control)),
            Event::Sticks(sticks) => self.sticks = sticks,
            Event::ReleaseAll => {
                self.held.clear();
                self.tapped.clear();
                self.sticks = Sticks::default();
            }
        }
        false
    }

    fn down(&self, control: Control) -> bool {
        self.held.contains(&control) || self.tapped.contains(&control)
    }

    /// Distance of the goal from where the hand began, m.
    #[must_use]
    pub fn from_home(&self) -> f64 {
        (self.position - self.home.position).norm()
    }

    /// The goal and the gripper command of the next control step, for a hand that is measured at `tcp`.
    pub fn advance(&mut self, tcp: &Pose) -> (Pose, bool) {
        let slow = if self.down(Control::Slow) { SLOW } else { 1.0 };
        let (wanted, turn) = if self.down(Control::Home) { self.homewards() } else { self.asked(slow) };
        self.tapped.clear();
        let most = self.limits.acceleration * DT;
        let change = wanted - self.velocity;
        self.velocity += change * (most / change.norm().max(most));
        let most = 4.0 * most;
        self.turning += (turn - self.turning).clamp(-most, most);

        let next = self.position + self.velocity * DT;
        let mut inside = next;
        for axis in 0..3 {
            let [low, high] = self.limits.workspace[axis];
            let home = self.home.position[axis];
            inside[axis] = next[axis].clamp(low.min(home), high.max(home));
            if inside[axis] != next[axis] {
                self.velocity[axis] = 0.0;
            }
        }
        // Where the hand does not follow, the goal waits for it.
        let ahead = inside - tcp.position;
        if ahead.norm() > self.limits.lead {
            inside = tcp.position + ahead * (self.limits.lead / ahead.norm());
        }
        self.position = inside;
        let yaw = self.limits.yaw;
        self.yaw = (self.yaw + self.turning * DT).clamp(-yaw, yaw);
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw) * self.home.orientation;
        (Pose::new(self.position, turned), self.open)
    }

    /// The velocity that keys and sticks ask for, m/s and rad/s.
    fn asked(&self, slow: f64) -> (Vector3<f64>, f64) {
        let axis = |plus: Control, minus: Control, stick: f64| {
            let key = f64::from(i8::from(self.down(plus)) - i8::from(self.down(minus)));
            let stick = if stick.is_finite() && stick.abs() > DEAD { stick } else { 0.0 };
            (key + stick).clamp(-1.0, 1.0)
        };
        let s = &self.sticks;
        let way = Vector3::new(
            axis(Control::Forward, Control::Back, s.forward),
            axis(Control::Left, Control::Right, s.left),
            axis(Control::Up, Control::Down, s.up),
        );
        // No faster on a diagonal.
        let way = way / way.norm().max(1.0);
        let turn = axis(Control::TurnLeft, Control::TurnRight, s.turn);
        (way * (self.limits.speed * slow), turn * self.limits.turn * slow)
    }

    /// The velocity that leads home: up first, so that nothing is swept off the table.
    fn homewards(&self) -> (Vector3<f64>, f64) {
        let mut way = self.home.position - self.position;
        if way.z > 0.01 {
            (way.x, way.y) = (0.0, 0.0);
        }
        let stop = |distance: f64, speed: f64, brake: f64| {
            if distance < THERE {
                distance / DT
            } else {
                speed.min((brake * distance).sqrt()).min(distance / DT)
            }
        };
        let distance = way.norm();
        let speed = stop(distance, self.limits.speed, self.limits.acceleration);
        let turn = stop(self.yaw.abs(), self.limits.turn, 4.0 * self.limits.acceleration);
        (way * (speed / distance.max(1e-12)), -turn * self.yaw.signum())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use e2h_env::toolkit::down;

    fn start() -> Pose {
        Pose::new(Vector3::new(0.5, 0.0, 0.2), down(0.0))
    }

    /// Steps a hand that follows at once.
    fn fly(pilot: &mut Pilot, steps: usize) -> Vec<Pose> {
        let mut tcp = Pose::new(pilot.position, start().orientation);
        let step = |_| {
            tcp = pilot.advance(&tcp).0;
            tcp
        };
        (0..steps).map(step).collect()
    }

    #[test]
    fn every_direction_goes_its_own_way_at_no_more_than_the_speed() {
        let ways = [
            (Control::Forward, [1.0, 0.0, 0.0]),
            (Control::Back, [-1.0, 0.0, 0.0]),
            (Control::Left, [0.0, 1.0, 0.0]),
            (Control::Right, [0.0, -1.0, 0.0]),
            (Control::Up, [0.0, 0.0, 1.0]),
            (Control::Down, [0.0, 0.0, -1.0]),
        ];
        for (control, way) in ways {
            let mut pilot = Pilot::new(Limits::default(), &start(), true).unwrap();
            pilot.handle(Event::Press(control));
            let poses = fly(&mut pilot, 10);
            let moved = poses[9].position - start().position;
            assert!((moved.normalize() - Vector3::from(way)).norm() < 1e-9, "{control:?}: {moved}");
            let mut before = start().position;
            let mut speed_before = 0.0;
            for pose in &poses {
                let speed = (pose.position - before).norm() * CONTROL_HZ;
                assert!(speed < 0.2 + 1e-9 && speed - speed_before < 0.05 + 1e-9, "{control:?}: {speed}");
                (before, speed_before) = (pose.position, speed);
            }
            pilot.handle(Event::Release(control));
            let rest = fly(&mut pilot, 8);
            assert!((rest[7].position - rest[6].position).norm() < 1e-12, "it does not stop");
        }
        // All at once, and slowly.
        let mut pilot = Pilot::new(Limits::default(), &start(), true).unwrap();
        for control in [Control::Forward, Control::Left, Control::Up, Control::Slow] {
            pilot.handle(Event::Press(control));
        }
        let poses = fly(&mut pilot, 10);
        assert!(((poses[9].position - poses[8].position).norm() * CONTROL_HZ - 0.05).abs() < 1e-9);
    }

    #[test]
    fn the_hand_turns_about_the_vertical_and_no_further_than_it_may() {
        let mut pilot = Pilot::new(Limits::default(), &start(), true).unwrap();
        pilot.handle(Event::Press(Control::TurnLeft));
        let poses = fly(&mut pilot, 20);
        let x = |pose: &Pose| pose.orientation * Vector3::x();
        assert!(x(&poses[19]).y > 0.3 && x(&poses[19]).z.abs() < 1e-9, "{}", x(&poses[19]));
        let end = fly(&mut pilot, 100)[99];
        assert!((end.orientation.angle_to(&start().orientation) - 1.7).abs() < 1e-9);
        pilot.handle(Event::Release(Control::TurnLeft));
        pilot.handle(Event::Press(Control::Home));
        let end = fly(&mut pilot, 200)[199];
        assert!(end.orientation.angle_to(&start().orientation) < 1e-3);
    }

    #[test]
    fn the_goal_stays_in_the_workspace_and_near_the_hand() {
        let limits = Limits::default();
        for (control, axis, edge) in
            [(Control::Down, 2, 0.004), (Control::Forward, 0, 0.78), (Control::Right, 1, -0.4)]
        {
            let mut pilot = Pilot::new(limits.clone(), &start(), true).unwrap();
            pilot.handle(Event::Press(control));
            let end = fly(&mut pilot, 200)[199];
            assert!((end.position[axis] - edge).abs() < 1e-9, "{control:?}: {}", end.position);
        }
        // A hand that is held fast.
        let mut pilot = Pilot::new(limits.clone(), &start(), true).unwrap();
        pilot.handle(Event::Press(Control::Down));
        for _ in 0..50 {
            let (goal, _) = pilot.advance(&start());
            assert!((goal.position - start().position).norm() <= limits.lead + 1e-9);
        }
        // It can always come back.
        pilot.handle(Event::Release(Control::Down));
        pilot.handle(Event::Press(Control::Up));
        for _ in 0..8 {
            pilot.advance(&start());
        }
        assert!(pilot.position.z > 0.2 - limits.lead);
    }

    #[test]
    fn home_is_reached_by_way_of_up() {
        let mut pilot = Pilot::new(Limits::default(), &start(), true).unwrap();
        for control in [Control::Down, Control::Left, Control::TurnRight] {
            pilot.handle(Event::Press(control));
        }
        fly(&mut pilot, 20);
        pilot.handle(Event::ReleaseAll);
        pilot.handle(Event::Press(Control::Home));
        let poses = fly(&mut pilot, 100);
        let aside = |p: &Pose| p.position.y;
        let first = poses[5..].iter().find(|p| aside(p) < aside(&poses[5]) - 1e-3).unwrap();
        assert!(first.position.z > 0.18, "it went aside at {}", first.position.z);
        assert!(pilot.from_home() < 1e-3, "{}", pilot.from_home());
    }

    #[test]
    fn a_tap_between_two_steps_is_a_step() {
        let mut pilot = Pilot::new(Limits::default(), &start(), true).unwrap();
        pilot.handle(Event::Press(Control::Up));
        pilot.handle(Event::Release(Control::Up));
        let poses = fly(&mut pilot, 10);
        let risen = poses[9].position.z - 0.2;
        assert!(risen > 0.002 && risen < 0.005, "{risen}");
    }

    #[test]
    fn the_gripper_toggles_once_a_press_and_sticks_add_to_keys() {
        let mut pilot = Pilot::new(Limits::default(), &start(), true).unwrap();
        assert!(pilot.handle(Event::Press(Control::Gripper)));
        // A key that repeats.
        assert!(!pilot.handle(Event::Press(Control::Gripper)));
        assert!(!pilot.advance(&start()).1);
        pilot.handle(Event::Release(Control::Gripper));
        pilot.handle(Event::Press(Control::Gripper));
        assert!(pilot.advance(&start()).1);
        pilot.handle(Event::Sticks(Sticks { forward: 0.5, left: 0.05, up: f64::NAN, turn: 0.0 }));
        let end = fly(&mut pilot, 10);
        let speed = (end[9].position - end[8].position) * CONTROL_HZ;
        assert!((speed - Vector3::new(0.1, 0.0, 0.0)).norm() < 1e-9, "{speed}");
        pilot.handle(Event::ReleaseAll);
        let end = fly(&mut pilot, 10);
        assert!((end[9].position - end[8].position).norm() < 1e-12);
    }

    #[test]
    fn limits_that_cannot_work_are_all_named() {
        let mut limits = Limits { speed: 0.0, lead: f64::NAN, ..Limits::default() };
        limits.workspace[1] = [0.4, -0.4];
        let message = Pilot::new(limits, &start(), true).unwrap_err().to_string();
        for word in ["speed", "lead", "workspace, y"] {
            assert!(message.contains(word), "{word} in {message}");
        }
    }
}
