//! Between an environment's rows and an agent's numbers.

use super::Confirmation;
use crate::{Error, Result};
use e2h_core::state::{EEF, EEF_POSITION, EEF_QUATERNION, OBJECT, OBJECT_POSITION, OPENING};
use e2h_core::{Action, Episode, Pose, State};
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Control steps of a decision.
pub const REPEAT: usize = 2;
/// How far the goal moves in a control step at most, m along each axis.
const STEP_M: f64 = 0.02;
/// How far it turns, rad about each axis.
const STEP_RAD: f64 = 0.1;
/// How far beyond what was demonstrated the hand may be sent, m.
const BEYOND: f32 = 0.05;
/// Opening of the gripper that is 1 to an agent, m from the middle of its range.
const HALF_OPENING: f32 = 0.04;
/// Shortest side of a box that numbers are scaled by, m.
const SHORTEST: f32 = 1e-3;
/// Movement of an object at rest, m: contacts shake it.
const STILL: f32 = 1e-5;

/// A box along the axes, m.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Bounds {
    low: [f32; 3],
    high: [f32; 3],
}

impl Bounds {
    fn of(points: impl Iterator<Item = [f32; 3]>) -> Self {
        let none = Self { low: [f32::INFINITY; 3], high: [f32::NEG_INFINITY; 3] };
        points.fold(none, |b, p| Self {
            low: std::array::from_fn(|i| b.low[i].min(p[i])),
            high: std::array::from_fn(|i| b.high[i].max(p[i])),
        })
    }

    fn side(&self, i: usize) -> f32 {
        (self.high[i] - self.low[i]).max(SHORTEST)
    }

    /// From -1 to 1 within the box.
    fn scale(&self, p: &[f32], i: usize) -> f32 {
        2.0 * (p[i] - self.low[i]) / self.side(i) - 1.0
    }
}

/// What an agent of one task sees of a state, and what its actions mean: fitted on demonstrations, without any image.
///
/// An action is how the goal of the hand moves from where the hand is: along the axes, and either whether the gripper is open, or, for an
/// object that is held throughout, how the hand turns. It counts for [`REPEAT`] control steps.
///
/// # Source
/// `jyp9961/TR-DRL e56d60e`. Differs: the scenes, and so the entries; theirs have the constants of robosuite.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Adapter {
    /// Where hands were.
    hand: Bounds,
    /// Where objects were.
    object: Bounds,
    /// Where the object shall be, m.
    goal: [f32; 3],
    /// Where the hand is then, m.
    goal_hand: [f32; 3],
    /// The hand's orientation (wxyz) where actions do not turn it.
    home: [f32; 4],
    /// The object is held from the beginning to the end.
    held: bool,
}

fn point(row: &[f32], at: std::ops::Range<usize>) -> [f32; 3] {
    std::array::from_fn(|i| row[at.start + i])
}

/// The first two columns of a rotation.
fn six(q: &UnitQuaternion<f64>) -> [f32; 6] {
    let m = q.to_rotation_matrix();
    std::array::from_fn(|i| m[(i % 3, i / 3)] as f32)
}

impl Adapter {
    /// Fits the scaling on all `demonstrations`, and takes the goal from the last rows in `ends`: those of this task. `home` is the
    /// orientation (wxyz) that the hand keeps where objects are not held throughout.
    ///
    /// # Errors
    /// [`Error::Data`] without demonstrations or ends.
    pub fn fit(demonstrations: &[&Episode], ends: &[State], home: [f32; 4], held: bool) -> Result<Self> {
        let rows = || demonstrations.iter().flat_map(|e| &e.state);
        if rows().next().is_none() || ends.is_empty() {
            return Err(Error::Data("agent: expected demonstrations with rows, found none".to_owned()));
        }
        let mean = |at: &std::ops::Range<usize>| -> [f32; 3] {
            let n = ends.len() as f32;
            std::array::from_fn(|i| ends.iter().map(|r| r[at.start + i]).sum::<f32>() / n)
        };
        Ok(Self {
            hand: Bounds::of(rows().map(|r| point(r, EEF_POSITION))),
            object: Bounds::of(rows().map(|r| point(r, OBJECT_POSITION))),
            goal: mean(&OBJECT_POSITION),
            goal_hand: mean(&EEF_POSITION),
            home,
            held,
        })
    }

    /// Numbers of an observation.
    #[must_use]
    pub fn observation(&self) -> usize {
        if self.held { 37 } else { 19 }
    }

    /// Numbers of an action.
    #[must_use]
    pub fn action(&self) -> usize {
        if self.held { 6 } else { 4 }
    }

    /// What an agent sees of a state.
    #[must_use]
    pub fn observe(&self, state: &[f32]) -> Vec<f32> {
        let (hand, object) = (point(state, EEF_POSITION), point(state, OBJECT_POSITION));
        let orientation = Pose::from_row(&state[OBJECT]).orientation;
        let mut out = Vec::with_capacity(self.observation());
        out.extend((0..3).map(|i| self.hand.scale(&hand, i)));
        out.extend((0..3).map(|i| self.object.scale(&object, i)));
        out.extend((0..3).map(|i| 5.0 * (object[i] - self.goal[i])));
        out.extend(six(&orientation));
        out.extend((0..3).map(|i| 10.0 * (object[i] - hand[i])));
        out.push(state[OPENING] / HALF_OPENING - 1.0);
        if self.held {
            let tool = Pose::from_row(&state[EEF]);
            let back = tool.orientation.inverse();
            let there = back * (Pose::from_row(&state[OBJECT]).position - tool.position);
            out.extend((0..3).map(|i| 5.0 * (hand[i] - self.goal_hand[i])));
            out.extend(six(&tool.orientation));
            out.extend(there.iter().map(|v| 10.0 * *v as f32));
            out.extend(six(&(back * orientation)));
        }
        out
    }

    /// Entries of an observation that potentials see: the object's, or, where it is held, all.
    #[must_use]
    pub fn of_potentials(&self) -> std::ops::Range<usize> {
        if self.held { 0..self.observation() } else { 3..15 }
    }

    /// When dynamics models confirm a transition: they miss the object, and a hand that holds it, by less than the share `tolerance` of where
    /// they were in demonstrations; or the object has not moved.
    #[must_use]
    pub fn confirmation(&self, tolerance: f32) -> Confirmation {
        let entries = if self.held { (0..6).collect() } else { (3..6).collect() };
        // The box is 2 wide to an agent.
        let still = |i: usize| (3 + i, 2.0 * STILL / self.object.side(i));
        Confirmation { entries, tolerance: 2.0 * tolerance, object: (0..3).map(still).collect() }
    }

    /// The actions of the control steps of a decision.
    #[must_use]
    pub fn actions(&self, state: &[f32], action: &[f32]) -> [Action; REPEAT] {
        let tool = Pose::from_row(&state[EEF]);
        let reference: [f64; 4] = std::array::from_fn(|i| f64::from(state[EEF_QUATERNION.start + i]));
        let number = |i: usize| f64::from(action.get(i).copied().unwrap_or(0.0)).clamp(-1.0, 1.0);
        std::array::from_fn(|j| {
            let n = (j + 1) as f64;
            let there: [f64; 3] = std::array::from_fn(|i| {
                let to = tool.position[i] + n * STEP_M * number(i);
                let bound = |b: [f32; 3], by: f32| f64::from(b[i] + by);
                to.clamp(bound(self.hand.low, -BEYOND), bound(self.hand.high, BEYOND))
            });
            let orientation = if self.held {
                let turn = Vector3::new(number(3), number(4), number(5)) * (n * STEP_RAD);
                UnitQuaternion::from_scaled_axis(turn) * tool.orientation
            } else {
                let row: Vec<f32> = [0.0; 3].into_iter().chain(self.home).collect();
                Pose::from_row(&row).orientation
            };
            let row = Pose::new(Vector3::from(there), orientation).to_row(&reference);
            let open = !self.held && number(3) > 0.0;
            let mut out = [0.0; 8];
            out[..7].copy_from_slice(&row);
            out[7] = f32::from(u8::from(open));
            out
        })
    }

    /// The action that comes nearest to what a demonstrator did in the control steps of a decision, the first of them from `state`.
    #[must_use]
    pub fn label(&self, state: &[f32], done: &[Action]) -> Vec<f32> {
        let Some(last) = done.last() else { return vec![0.0; self.action()] };
        let (tool, goal) = (Pose::from_row(&state[EEF]), Pose::from_row(&last[..7]));
        let n = done.len() as f64;
        let by = (goal.position - tool.position) / (n * STEP_M);
        let mut out: Vec<f32> = by.iter().map(|v| v.clamp(-1.0, 1.0) as f32).collect();
        if self.held {
            let turn = (goal.orientation * tool.orientation.inverse()).scaled_axis() / (n * STEP_RAD);
            out.extend(turn.iter().map(|v| v.clamp(-1.0, 1.0) as f32));
        } else {
            out.push(if last[7] > 0.5 { 1.0 } else { -1.0 });
        }
        out
    }

    /// Refuses numbers that no fit makes.
    pub(super) fn check(&self) -> Result<()> {
        let numbers =
            [self.hand.low, self.hand.high, self.object.low, self.object.high, self.goal, self.goal_hand];
        let finite = numbers.iter().flatten().chain(&self.home).all(|v| v.is_finite());
        let ordered = |b: &Bounds| (0..3).all(|i| b.low[i] <= b.high[i]);
        if finite && ordered(&self.hand) && ordered(&self.object) {
            return Ok(());
        }
        Err(Error::Data("agent: expected finite boxes with low ends below high ones".to_owned()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use e2h_core::{Direction, Origin, STATE_DIM};

    fn demonstration(held: bool) -> Episode {
        let mut episode = Episode::new(Origin::demonstration("test", Direction::Hard, 0, 0), &[]);
        for i in 0..10 {
            let v = i as f32 / 10.0;
            let mut state: State = [0.0; STATE_DIM];
            state[..7].copy_from_slice(&[0.4 + 0.2 * v, -0.1, 0.3, 0.0, 1.0, 0.0, 0.0]);
            state[7..14].copy_from_slice(&[0.4 + 0.2 * v, -0.1, 0.2 * v, 1.0, 0.0, 0.0, 0.0]);
            state[14] = if held { 0.03 } else { 0.08 };
            episode.state.push(state);
        }
        episode
    }

    fn adapter(held: bool) -> (Adapter, State) {
        let e = demonstration(held);
        let last = e.state[9];
        let a = Adapter::fit(&[&e], &[last], [0.0, 1.0, 0.0, 0.0], held).unwrap();
        (a, e.state[4])
    }

    #[test]
    fn an_action_and_its_label_are_the_same() {
        for held in [false, true] {
            let (adapter, state) = adapter(held);
            let action: Vec<f32> =
                if held { vec![0.5, -0.3, 0.9, 0.2, -0.4, 0.1] } else { vec![0.5, -0.3, 0.9, 1.0] };
            let label = adapter.label(&state, &adapter.actions(&state, &action));
            for (a, b) in action.iter().zip(&label) {
                assert!((a - b).abs() < 1e-4, "{action:?} {label:?}");
            }
            assert_eq!(label.len(), adapter.action());
            assert_eq!(adapter.observe(&state).len(), adapter.observation());
        }
    }

    #[test]
    fn goals_stay_near_what_was_demonstrated_and_beyond_one_is_one() {
        let (adapter, mut state) = adapter(false);
        state[0] = 0.63;
        let [_, far] = adapter.actions(&state, &[9.0, 0.0, 0.0, -0.2]);
        assert!((far[0] - 0.63).abs() < 1e-6 && far[7] == 0.0, "{far:?}");
        let [near, far] = adapter.actions(&state, &[-9.0, 0.0, 0.0, 0.2]);
        assert!((near[0] - 0.61).abs() < 1e-6 && (far[0] - 0.59).abs() < 1e-6 && far[7] == 1.0);
        let mut done = [0.0; 8];
        done[..7].copy_from_slice(&[2.0, -0.1, 0.3, 0.0, 1.0, 0.0, 0.0]);
        assert_eq!(adapter.label(&state, &[done, done])[..3], [1.0, 0.0, 0.0]);
    }

    #[test]
    fn the_goal_is_where_the_ends_are_and_none_are_refused() {
        let (adapter, _) = adapter(false);
        let e = demonstration(false);
        let at_goal = adapter.observe(&e.state[9]);
        assert!(at_goal[6..9].iter().all(|v| v.abs() < 1e-6));
        // The ends of the demonstrated range.
        assert!((at_goal[0] - 1.0).abs() < 1e-6 && (adapter.observe(&e.state[0])[0] + 1.0).abs() < 1e-6);
        assert!(Adapter::fit(&[&e], &[], [0.0, 1.0, 0.0, 0.0], false).is_err());
        assert!(Adapter::fit(&[], &[e.state[0]], [0.0, 1.0, 0.0, 0.0], false).is_err());
    }

    #[test]
    fn what_does_not_move_is_confirmed() {
        let (adapter, state) = adapter(false);
        let c = adapter.confirmation(0.01);
        assert_eq!(c.entries, [3, 4, 5]);
        let (now, mut next) = (adapter.observe(&state), state);
        next[7] += 0.9e-5;
        let moved = adapter.observe(&next);
        assert!(c.object.iter().all(|&(i, most)| (moved[i] - now[i]).abs() < most));
        next[7] += 0.5e-5;
        let moved = adapter.observe(&next);
        assert!(!c.object.iter().all(|&(i, most)| (moved[i] - now[i]).abs() < most));
    }
}
