use e2h_core::Episode;
use serde::{Deserialize, Serialize};
use std::borrow::Borrow;

/// Which row the first predicted action belongs to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Alignment {
    /// The newest observation's row: 16 actions are predicted and all can be executed.
    #[default]
    Paper,
    /// The oldest observation's row, as in LeRobot and Diffusion Policy: the first `n_obs_steps - 1` are never executed.
    LeRobot,
}

/// Shape of a training window.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindowConfig {
    /// Observations, To; control steps. Paper: 2.
    pub n_obs_steps: usize,
    /// Actions, T; control steps. Paper: 16.
    pub horizon: usize,
    /// Which row the first action belongs to.
    pub alignment: Alignment,
}

impl Default for WindowConfig {
    fn default() -> Self {
        Self { n_obs_steps: 2, horizon: 16, alignment: Alignment::Paper }
    }
}

impl WindowConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        if self.n_obs_steps == 0 {
            problems.push("n_obs_steps: expected at least 1, got 0".to_owned());
        }
        let least = match self.alignment {
            Alignment::Paper => 1,
            Alignment::LeRobot => self.n_obs_steps.max(1),
        };
        if self.horizon < least {
            problems.push(format!("horizon: expected at least {least}, got {}", self.horizon));
        }
        problems
    }
}

/// The rows that one training example is made of.
///
/// # Shapes
/// `observations` (To), `actions` (T), `mask` (T).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Window {
    /// Index of the episode.
    pub episode: usize,
    /// Rows seen, oldest first; before the start the first row is repeated.
    pub observations: Vec<usize>,
    /// Rows whose actions are to be predicted; outside the episode the nearest row is repeated.
    pub actions: Vec<usize>,
    /// Whether an action counts in the loss. False only past the end of a segment that was cut out of a longer path: what
    /// follows there is not known, and repeating the last goal would teach the policy to stop.
    pub mask: Vec<bool>,
}

/// All windows over a list of episodes: one for every row of every episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Windows {
    config: WindowConfig,
    /// For each episode: the index of its first window, its rows, and whether its end is the end of the task.
    episodes: Vec<(usize, usize, bool)>,
    len: usize,
}

impl Windows {
    /// Indexes the windows; copies nothing.
    #[must_use]
    pub fn new<E: Borrow<Episode>>(episodes: &[E], config: &WindowConfig) -> Self {
        let lengths = episodes.iter().map(|e| (e.borrow().len(), e.borrow().terminal));
        Self::of_lengths(lengths, config, 0)
    }

    /// The same of episodes with so many rows, and whether their end is the end of the task. The last `drop_last` rows of an
    /// episode are the newest of no window, where more rows are there.
    ///
    /// # Source
    /// LeRobot 0.4.4, `drop_n_last_frames` of `EpisodeAwareSampler`.
    #[must_use]
    pub fn of_lengths(
        episodes: impl IntoIterator<Item = (usize, bool)>,
        config: &WindowConfig,
        drop_last: usize,
    ) -> Self {
        let mut len = 0;
        let index = |(rows, terminal): (usize, bool)| {
            let first = len;
            len += rows.saturating_sub(drop_last).max(rows.min(1));
            (first, rows, terminal)
        };
        let episodes = episodes.into_iter().map(index).collect();
        Self { config: config.clone(), episodes, len }
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// True without windows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Window `index`, the one whose newest observation is row `index` of the episodes laid end to end.
    ///
    /// # Panics
    /// When `index` is not below [`Windows::len`].
    #[must_use]
    pub fn window(&self, index: usize) -> Window {
        assert!(index < self.len, "window {index} of {}", self.len);
        // Empty episodes share their first window's index with the next one; the last of them is the one with rows.
        let episode = self.episodes.partition_point(|&(first, ..)| first <= index) - 1;
        let (first, rows, terminal) = self.episodes[episode];
        let now = index - first;
        let before = self.config.n_obs_steps.saturating_sub(1);
        let lead = match self.config.alignment {
            Alignment::Paper => 0,
            Alignment::LeRobot => before,
        };
        // Counted from `lead` rows before the newest observation, so `ahead - lead` may lie before the episode.
        let ahead = now..now + self.config.horizon;
        Window {
            episode,
            observations: (0..=before).map(|i| (now + i).saturating_sub(before)).collect(),
            actions: ahead.clone().map(|row| row.saturating_sub(lead).min(rows - 1)).collect(),
            mask: ahead.map(|row| terminal || row.saturating_sub(lead) < rows).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::episode;
    use proptest::prelude::*;

    fn window(rows: usize, terminal: bool, alignment: Alignment, index: usize) -> Window {
        let e = Episode { terminal, ..episode(rows) };
        let config = WindowConfig { horizon: 4, alignment, ..WindowConfig::default() };
        Windows::new(&[e], &config).window(index)
    }

    #[test]
    fn the_first_row_is_repeated_before_the_start() {
        let w = window(10, true, Alignment::Paper, 0);
        assert_eq!((w.observations, w.actions, w.mask), (vec![0, 0], vec![0, 1, 2, 3], vec![true; 4]));
        let w = window(10, true, Alignment::LeRobot, 0);
        assert_eq!((w.observations, w.actions, w.mask), (vec![0, 0], vec![0, 0, 1, 2], vec![true; 4]));
    }

    #[test]
    fn the_end_of_a_task_repeats_and_the_end_of_a_cut_is_masked() {
        let w = window(10, true, Alignment::Paper, 8);
        assert_eq!((w.observations, w.actions, w.mask), (vec![7, 8], vec![8, 9, 9, 9], vec![true; 4]));
        let w = window(10, false, Alignment::Paper, 8);
        assert_eq!((w.actions, w.mask), (vec![8, 9, 9, 9], vec![true, true, false, false]));
        let w = window(10, false, Alignment::LeRobot, 8);
        assert_eq!((w.actions, w.mask), (vec![7, 8, 9, 9], vec![true, true, true, false]));
    }

    #[test]
    fn the_last_rows_of_an_episode_may_be_the_newest_of_no_window() {
        let config = WindowConfig { horizon: 4, ..WindowConfig::default() };
        let windows = Windows::of_lengths([(10, true), (0, true), (3, true)], &config, 7);
        // Three of the first episode; of one that is too short for it, its first row.
        assert_eq!(windows.len(), 4);
        assert_eq!((windows.window(2).episode, windows.window(2).actions), (0, vec![2, 3, 4, 5]));
        assert_eq!((windows.window(3).episode, windows.window(3).actions), (2, vec![0, 1, 2, 2]));
    }

    #[test]
    fn all_problems_are_listed() {
        let config = WindowConfig { n_obs_steps: 0, horizon: 0, ..WindowConfig::default() };
        assert_eq!(config.validate().len(), 2);
        let config = WindowConfig { n_obs_steps: 3, horizon: 2, alignment: Alignment::LeRobot };
        assert_eq!(config.validate(), ["horizon: expected at least 3, got 2"]);
    }

    proptest! {
        #[test]
        fn every_row_is_the_newest_of_one_window_inside_its_episode(
            lengths in prop::collection::vec((0_usize..30, any::<bool>()), 0..8),
            n_obs_steps in 1_usize..5, horizon in 5_usize..20, lerobot: bool,
        ) {
            let episodes: Vec<Episode> =
                lengths.iter().map(|&(n, terminal)| Episode { terminal, ..episode(n) }).collect();
            let alignment = if lerobot { Alignment::LeRobot } else { Alignment::Paper };
            let windows = Windows::new(&episodes, &WindowConfig { n_obs_steps, horizon, alignment });
            let rows = lengths.iter().enumerate().flat_map(|(e, &(n, _))| (0..n).map(move |t| (e, t)));
            prop_assert_eq!(windows.len(), rows.clone().count());
            for (i, (e, t)) in rows.enumerate() {
                let (n, terminal) = lengths[e];
                let w = windows.window(i);
                prop_assert_eq!(w.episode, e);
                prop_assert_eq!(w.observations.last(), Some(&t));
                prop_assert_eq!((w.observations.len(), w.actions.len(), w.mask.len()), (n_obs_steps, horizon, horizon));
                prop_assert!(w.observations.iter().chain(&w.actions).all(|&r| r < n));
                for rows in [&w.observations, &w.actions] {
                    prop_assert!(rows.windows(2).all(|p| p[1] == p[0] + 1 || p[0] == p[1] && (p[0] == 0 || p[0] == n - 1)));
                }
                // Padding at the start: as many copies as rows are missing.
                let copies = w.observations.iter().filter(|&&r| r == 0).count();
                prop_assert_eq!(copies, n_obs_steps.saturating_sub(t));
                let lead = if lerobot { n_obs_steps - 1 } else { 0 };
                let past = (t + horizon).saturating_sub(lead).saturating_sub(n).min(horizon);
                let masked = w.mask.iter().filter(|&&m| !m).count();
                prop_assert_eq!(masked, if terminal { 0 } else { past });
                prop_assert!(w.mask.windows(2).all(|p| p[0] || !p[1]));
            }
        }
    }
}
