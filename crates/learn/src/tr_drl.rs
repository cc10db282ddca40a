//! TR-DRL: two soft actor-critic agents, one a direction, that learn from each other's reversed transitions.

mod agents;
mod trip;

use e2h_policy::sac::SacConfig;
use serde::{Deserialize, Serialize};

pub(crate) use agents::{Agents, Report};
pub(crate) use trip::{Kind, Trip, play, replay, side};

/// Of which directions there are demonstrations.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Demonstrated {
    /// Of the easy task alone, as every other method has them.
    #[default]
    Easy,
    /// As many of the hard one as well (the release of TR-DRL).
    Both,
}

/// What a success is worth.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reward {
    /// An episode ends with it, with all that would come: 1 / (1 - gamma).
    #[default]
    Absorbing,
    /// 1 a decision in the goal, and the episode goes on to its horizon (the release of TR-DRL).
    Literal,
}

/// Settings of the method `tr-drl`. Its rounds are those of [`LoopConfig::iterations`](crate::config::LoopConfig::iterations).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrDrlConfig {
    /// Of which directions there are demonstrations.
    pub demonstrations: Demonstrated,
    /// What a success is worth.
    pub reward: Reward,
    /// Episodes of each direction in a round.
    pub episodes: usize,
    /// Episodes of each direction at the start with actions drawn evenly.
    pub random_episodes: usize,
    /// Transitions of an update: from episodes, from demonstrations, and reversed ones, of which those are used that the dynamics models
    /// confirm.
    pub batch: [usize; 3],
    /// Largest error with which a reversed transition is confirmed, as a share of the range in demonstrations.
    pub tolerance: f32,
    /// Factor on the difference of potentials that rewards a decision without success.
    pub shaping: f32,
    /// Largest size of that reward.
    pub shaping_limit: f32,
    /// Steps of the potentials on demonstrations, before all else.
    pub potential_steps: usize,
    /// Steps of them after each success.
    pub potential_more_steps: usize,
    /// The agents; the dynamics models and the potentials have their sizes and learning rate.
    pub agent: SacConfig,
}

impl Default for TrDrlConfig {
    /// Sizes for a CPU.
    fn default() -> Self {
        Self {
            demonstrations: Demonstrated::Easy,
            reward: Reward::Absorbing,
            episodes: 25,
            random_episodes: 5,
            batch: [128, 64, 64],
            tolerance: 0.01,
            shaping: 250.0,
            shaping_limit: 0.5,
            potential_steps: 1000,
            potential_more_steps: 100,
            agent: SacConfig::default(),
        }
    }
}

impl TrDrlConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems: Vec<String> =
            self.agent.validate().into_iter().map(|p| format!("agent.{p}")).collect();
        for (name, value, least, most) in [
            ("episodes", self.episodes, 1, 100_000),
            ("random_episodes", self.random_episodes, 0, 100_000),
            ("potential_steps", self.potential_steps, 0, 1_000_000),
            ("potential_more_steps", self.potential_more_steps, 0, 1_000_000),
        ] {
            if !(least..=most).contains(&value) {
                problems.push(format!("{name}: expected {least} to {most}, got {value}"));
            }
        }
        if self.batch[0] == 0 || self.batch.iter().any(|n| *n > 1 << 16) {
            let found = self.batch;
            problems.push(format!(
                "batch: expected 1 to 65536 from episodes, 0 to 65536 of the others, got {found:?}"
            ));
        }
        for (name, value, most) in [
            ("tolerance", self.tolerance, 1.0),
            ("shaping", self.shaping, 1e6),
            ("shaping_limit", self.shaping_limit, 1e3),
        ] {
            if !(0.0..=most).contains(&value) {
                problems.push(format!("{name}: expected 0 to {most}, got {value}"));
            }
        }
        problems
    }
}
