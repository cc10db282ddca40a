//! An episode by decisions, and what can be learned of it in either direction.

use super::Reward;
use crate::Result;
use e2h_core::{Action, Direction, Outcome, STATE_DIM, State};
use e2h_env::Env;
use e2h_nn::{HostTensor, Weights};
use e2h_policy::sac::{Adapter, REPEAT};

/// Where an episode comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Demonstration,
    Rollout,
}

/// An episode by decisions.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Trip {
    pub(crate) direction: Direction,
    /// One more than decisions.
    pub(crate) states: Vec<State>,
    /// Of all decisions, one after the other.
    pub(crate) actions: Vec<f32>,
    /// Whether a state is in the goal of the hard and of the easy task.
    good: Vec<[bool; 2]>,
    /// The first state of a success that was held.
    pub(crate) success: Option<usize>,
    /// Nothing comes after its end: the object was dropped, or the simulation diverged.
    lost: bool,
    /// Control steps.
    pub(crate) steps: usize,
}

/// Place of a direction in pairs: the hard one's comes first.
pub(crate) fn side(direction: Direction) -> usize {
    usize::from(direction == Direction::Easy)
}

/// A transition: what is stored of it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    pub(super) now: State,
    pub(super) action: Vec<f32>,
    pub(super) next: State,
    pub(super) reward: f32,
    pub(super) bootstrap: f32,
}

impl Row {
    pub(super) fn width(actions: usize) -> usize {
        2 * STATE_DIM + actions + 2
    }

    pub(super) fn numbers(&self) -> Vec<f32> {
        [&self.now[..], &self.action, &self.next, &[self.reward, self.bootstrap]].concat()
    }
}

/// The parts of a stored transition.
pub(super) struct Parts<'a> {
    pub(super) now: &'a [f32],
    pub(super) action: &'a [f32],
    pub(super) next: &'a [f32],
    pub(super) reward: f32,
    pub(super) bootstrap: f32,
}

pub(super) fn parts(row: &[f32], actions: usize) -> Parts<'_> {
    let (now, rest) = row.split_at(STATE_DIM);
    let (action, rest) = rest.split_at(actions);
    let (next, rest) = rest.split_at(STATE_DIM);
    Parts { now, action, next, reward: rest[0], bootstrap: rest[1] }
}

/// Plays an episode of `direction` from the scene as it is. With [`Reward::Absorbing`] it ends once success was held.
pub(crate) fn play(
    env: &mut Env,
    adapter: &Adapter,
    direction: Direction,
    reward: Reward,
    mut act: impl FnMut(&State) -> Result<Vec<f32>>,
) -> Result<Trip> {
    let mut trip = Trip {
        direction,
        states: vec![env.state()],
        actions: vec![],
        good: vec![[Direction::Hard, Direction::Easy].map(|d| env.success(d))],
        success: None,
        lost: false,
        steps: 0,
    };
    let horizon = env.horizon(direction);
    'episode: while trip.steps < horizon {
        let now = env.state();
        let action = act(&now)?;
        let goals = adapter.actions(&now, &action);
        trip.actions.extend(action);
        let mut ends = false;
        for goal in &goals {
            let outcome = env.step(goal)?;
            trip.steps += 1;
            if let Some(Outcome::Success { at }) = outcome {
                trip.success = trip.success.or(Some(at.div_ceil(REPEAT)));
            }
            trip.lost |= matches!(outcome, Some(Outcome::Dropped | Outcome::Diverged));
            let done = matches!(outcome, Some(Outcome::Success { .. }));
            ends = trip.lost || trip.steps >= horizon || (done && reward == Reward::Absorbing);
            if ends {
                break;
            }
        }
        trip.states.push(env.state());
        trip.good.push([Direction::Hard, Direction::Easy].map(|d| env.success(d)));
        if ends {
            break 'episode;
        }
    }
    // An episode that goes on has succeeded if it is in the goal at its end.
    let last = trip.good.last().is_some_and(|good| good[side(direction)]);
    trip.success = trip.success.filter(|_| last || reward == Reward::Absorbing);
    Ok(trip)
}

/// Plays what a demonstrator did, decision by decision towards the goals that it had, then holds the last of them.
pub(crate) fn replay(
    env: &mut Env,
    adapter: &Adapter,
    direction: Direction,
    reward: Reward,
    done: &[Action],
) -> Result<Trip> {
    let mut at = 0;
    play(env, adapter, direction, reward, |state| {
        let from = at.min(done.len().saturating_sub(REPEAT));
        at += REPEAT;
        Ok(adapter.label(state, &done[from..(from + REPEAT).min(done.len())]))
    })
}

impl Trip {
    pub(crate) fn decisions(&self) -> usize {
        self.states.len() - 1
    }

    fn action(&self, t: usize) -> Vec<f32> {
        let a = self.actions.len() / self.decisions().max(1);
        self.actions[t * a..][..a].to_vec()
    }

    /// Its transitions, as the agent of its own direction has them.
    pub(super) fn transitions(&self, reward: Reward, gamma: f32) -> Vec<Row> {
        let row = |t: usize, reward: f32, bootstrap: f32| Row {
            now: self.states[t],
            action: self.action(t),
            next: self.states[t + 1],
            reward,
            bootstrap,
        };
        let last = self.decisions();
        let end = match (reward, self.success) {
            (Reward::Absorbing, Some(at)) => at.clamp(1, last.max(1)),
            _ => last,
        };
        (0..end.min(last))
            .map(|t| match (reward, self.success) {
                (Reward::Absorbing, Some(at)) if t + 1 >= at => row(t, 1.0 / (1.0 - gamma), 0.0),
                (Reward::Literal, _) if self.good[t + 1][side(self.direction)] => row(t, 1.0, 1.0),
                _ => row(t, 0.0, f32::from(u8::from(!(self.lost && t + 1 == last)))),
            })
            .collect()
    }

    /// Its transitions turned round, for the agent of the other direction; none where that one's goal is not at its beginning. Their actions
    /// are unknown.
    pub(super) fn reversed(&self, reward: Reward, gamma: f32) -> Vec<Row> {
        let goal = |t: usize| self.good[t][side(self.direction.reverse())];
        if !goal(0) {
            return vec![];
        }
        // The last state of those at the beginning that are in that goal.
        let reached = (0..self.states.len()).take_while(|t| goal(*t)).last().unwrap_or(0);
        let first = if reward == Reward::Absorbing { reached } else { 0 };
        let actions = vec![0.0; self.actions.len() / self.decisions().max(1)];
        (first..self.decisions())
            .map(|t| {
                let (reward, bootstrap) = match reward {
                    Reward::Absorbing if t == reached => (1.0 / (1.0 - gamma), 0.0),
                    Reward::Literal if goal(t) => (1.0, 1.0),
                    _ => (0.0, 1.0),
                };
                Row {
                    now: self.states[t + 1],
                    action: actions.clone(),
                    next: self.states[t],
                    reward,
                    bootstrap,
                }
            })
            .collect()
    }

    /// As tensors, below `prefix`.
    pub(crate) fn state(&self, prefix: &str, all: &mut Weights) {
        let flag = |b: bool| f32::from(u8::from(b));
        let success = self.success.map_or(-1.0, |s| s as f32);
        let notes = vec![side(self.direction) as f32, success, flag(self.lost), self.steps as f32];
        let good: Vec<f32> = self.good.iter().flatten().map(|b| flag(*b)).collect();
        for (name, width, data) in [
            ("states", STATE_DIM, self.states.as_flattened().to_vec()),
            ("actions", (self.actions.len() / self.decisions().max(1)).max(1), self.actions.clone()),
            ("good", 2, good),
            ("notes", 4, notes),
        ] {
            all.insert(
                format!("{prefix}{name}"),
                HostTensor { shape: vec![data.len() / width, width], data },
            );
        }
    }

    /// What [`Trip::state`] added; none where it is not there, or not of its form.
    pub(crate) fn load(prefix: &str, all: &Weights) -> Option<Self> {
        let of = |name: &str| all.get(&format!("{prefix}{name}")).map(|t| &t.data[..]);
        let &[direction, success, lost, steps] = of("notes")? else { return None };
        let states: Vec<State> =
            of("states")?.chunks_exact(STATE_DIM).map(|c| std::array::from_fn(|i| c[i])).collect();
        let good: Vec<[bool; 2]> = of("good")?.chunks_exact(2).map(|c| [c[0] > 0.5, c[1] > 0.5]).collect();
        let actions = of("actions")?.to_vec();
        let whole =
            states.len() > 1 && states.len() == good.len() && actions.len().is_multiple_of(states.len() - 1);
        whole.then(|| Self {
            direction: if direction > 0.5 { Direction::Easy } else { Direction::Hard },
            states,
            actions,
            good,
            success: (success >= 0.0).then_some(success as usize),
            lost: lost > 0.5,
            steps: steps as usize,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four decisions that leave the hard goal after the second state, and hold the easy one from the fourth.
    fn trip() -> Trip {
        Trip {
            direction: Direction::Easy,
            states: (0..5).map(|i| [i as f32; STATE_DIM]).collect(),
            actions: (0..8).map(|i| i as f32 / 8.0).collect(),
            good: [[true, false], [true, false], [false, false], [false, true], [false, true]].to_vec(),
            success: Some(3),
            lost: false,
            steps: 8,
        }
    }

    fn short(rows: &[Row]) -> Vec<(f32, f32, f32, f32)> {
        rows.iter().map(|r| (r.now[0], r.next[0], r.reward, r.bootstrap)).collect()
    }

    #[test]
    fn an_absorbing_success_ends_it_in_both_directions() {
        let t = trip();
        let rows = t.transitions(Reward::Absorbing, 0.75);
        assert_eq!(short(&rows), [(0.0, 1.0, 0.0, 1.0), (1.0, 2.0, 0.0, 1.0), (2.0, 3.0, 4.0, 0.0)]);
        assert_eq!(rows[1].action, [0.25, 0.375]);
        let rows = t.reversed(Reward::Absorbing, 0.75);
        assert_eq!(short(&rows), [(2.0, 1.0, 4.0, 0.0), (3.0, 2.0, 0.0, 1.0), (4.0, 3.0, 0.0, 1.0)]);
    }

    #[test]
    fn a_literal_success_goes_on() {
        let t = trip();
        let own: Vec<f32> = t.transitions(Reward::Literal, 0.75).iter().map(|r| r.reward).collect();
        assert_eq!(own, [0.0, 0.0, 1.0, 1.0]);
        let rows = t.reversed(Reward::Literal, 0.75);
        assert_eq!(rows.iter().map(|r| r.reward).collect::<Vec<_>>(), [1.0, 1.0, 0.0, 0.0]);
        assert!(rows.iter().all(|r| r.bootstrap == 1.0));
    }

    #[test]
    fn what_begins_elsewhere_is_not_turned_round_and_a_loss_has_nothing_after_it() {
        let mut t = trip();
        t.good[0] = [false, false];
        assert!(t.reversed(Reward::Absorbing, 0.75).is_empty());
        (t.success, t.lost) = (None, true);
        let rows = t.transitions(Reward::Absorbing, 0.75);
        assert_eq!(rows.iter().map(|r| r.bootstrap).collect::<Vec<_>>(), [1.0, 1.0, 1.0, 0.0]);
    }

    #[test]
    fn it_is_read_as_it_was_written() {
        let mut all = Weights::new();
        trip().state("a.", &mut all);
        assert_eq!(Trip::load("a.", &all), Some(trip()));
        assert_eq!(Trip::load("b.", &all), None);
    }
}
