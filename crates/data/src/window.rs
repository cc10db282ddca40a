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
    /// For each episode: the index of its first window, and whether its end is the end of the task.
    episodes: Vec<(usize, bool)>,
    len: usize,
}

impl Windows {
    /// Indexes the windows; copies nothing.
    #[must_use]
    pub fn new<E: Borrow<Episode>>(episodes: &[E], config: &WindowConfig) -> Self {
        let mut len = 0;
        let index = |e: &E| {
            let first = len;
            len += e.borrow().len();
            (first, e.borrow().terminal)
        };
        let episodes = episodes.iter().map(index).collect();
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
        let episode = self.episodes.partition_point(|&(first, _)| first <= index) - 1;
        let (first, terminal) = self.episodes[episode];
        let rows = self.episodes.get(episode + 1).map_or(self.len, |&(next, _)| next) - first;
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
