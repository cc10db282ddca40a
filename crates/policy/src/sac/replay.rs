//! Rows to learn from.

use e2h_core::Rng;
use rand::Rng as _;

/// The newest rows of numbers, up to a number of them.
#[derive(Debug, Clone, PartialEq)]
pub struct Replay {
    width: usize,
    capacity: usize,
    data: Vec<f32>,
    /// Where the next row goes once it is full.
    next: usize,
}

impl Replay {
    /// Room for `capacity` rows of `width` numbers; memory is taken as rows come.
    #[must_use]
    pub fn new(width: usize, capacity: usize) -> Self {
        Self { width: width.max(1), capacity: capacity.max(1), data: vec![], next: 0 }
    }

    /// Rows that are there.
    #[must_use]
    pub fn len(&self) -> usize {
        self.data.len() / self.width
    }

    /// True without rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.data.is_empty()
    }

    /// Adds a row, in place of the oldest when there is no room.
    ///
    /// # Panics
    /// When the row has another width.
    pub fn push(&mut self, row: &[f32]) {
        assert_eq!(row.len(), self.width, "numbers of a row");
        if self.len() < self.capacity {
            self.data.extend_from_slice(row);
        } else {
            self.data[self.next * self.width..][..self.width].copy_from_slice(row);
            self.next = (self.next + 1) % self.capacity;
        }
    }

    /// `n` rows, drawn with replacement; none when nothing is there.
    pub fn draw<'a, 'r>(
        &'a self,
        n: usize,
        rng: &'r mut Rng,
    ) -> impl Iterator<Item = &'a [f32]> + use<'a, 'r> {
        let rows = self.len();
        let n = if rows == 0 { 0 } else { n };
        (0..n).map(move |_| &self.data[rng.random_range(0..rows) * self.width..][..self.width])
    }
}

/// Transitions of an update, row by row.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Batch {
    /// Observations, (B, O).
    pub observation: Vec<f32>,
    /// Actions, (B, A).
    pub action: Vec<f32>,
    /// Rewards, (B).
    pub reward: Vec<f32>,
    /// Observations after the action, (B, O).
    pub next: Vec<f32>,
    /// 1 where the value of `next` counts, 0 where nothing comes after, (B).
    pub bootstrap: Vec<f32>,
}

impl Batch {
    /// Adds a transition.
    pub fn push(&mut self, observation: &[f32], action: &[f32], reward: f32, next: &[f32], bootstrap: f32) {
        self.observation.extend_from_slice(observation);
        self.action.extend_from_slice(action);
        self.reward.push(reward);
        self.next.extend_from_slice(next);
        self.bootstrap.push(bootstrap);
    }

    /// Transitions, B.
    #[must_use]
    pub fn len(&self) -> usize {
        self.reward.len()
    }

    /// True without transitions.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.reward.is_empty()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_oldest_row_goes_first_and_draws_are_of_what_is_there() {
        let mut replay = Replay::new(2, 3);
        let mut rng = e2h_core::stream(0, "replay", 0, 0);
        assert_eq!(replay.draw(5, &mut rng).count(), 0);
        for i in 0..5 {
            replay.push(&[i as f32, 10.0 * i as f32]);
        }
        assert_eq!(replay.len(), 3);
        let mut seen: Vec<f32> = replay.draw(200, &mut rng).map(|row| row[0]).collect();
        seen.sort_by(f32::total_cmp);
        seen.dedup();
        assert_eq!(seen, [2.0, 3.0, 4.0]);
        assert!(replay.draw(9, &mut rng).all(|row| (row[1] - 10.0 * row[0]).abs() < 1e-6));
    }
}
