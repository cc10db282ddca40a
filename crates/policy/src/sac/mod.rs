//! Soft actor-critic from low-dimensional observations, and what TR-DRL adds to it: dynamics models that confirm reversed transitions,
//! and learned potentials.
//!
//! Everything here works on rows of numbers; what they mean, and where they come from, is the caller's.
//!
//! ```
//! use e2h_nn::Compute;
//! use e2h_policy::sac::{Batch, Sac, SacConfig};
//!
//! let config = SacConfig { hidden: vec![16], ..SacConfig::default() };
//! let mut sac = Sac::new(&config, 3, 2, &Compute::cpu(), 0, "example")?;
//! let mut rng = e2h_core::stream(0, "example", 0, 0);
//! let action = sac.actor().act(&[0.1, 0.2, 0.3], Some(&mut rng))?;
//! assert!(action.len() == 2 && action.iter().all(|a| a.abs() <= 1.0));
//! let mut batch = Batch::default();
//! batch.push(&[0.1, 0.2, 0.3], &action, 1.0, &[0.0, 0.0, 0.0], 0.0);
//! let report = sac.update(&batch, &mut rng)?;
//! assert!(report.critic_loss.is_finite());
//! # Ok::<(), e2h_policy::Error>(())
//! ```

mod adapter;
mod agent;
mod gaussian;
#[cfg(test)]
mod golden;
mod models;
mod network;
mod policy;
mod potential;
mod replay;

pub use adapter::{Adapter, REPEAT};
pub use agent::{Sac, SacReport};
pub use models::{Confirmation, Models};
pub use network::Actor;
pub use policy::{KIND, StatePolicy};
pub use potential::Potential;
pub use replay::{Batch, Replay};

use serde::{Deserialize, Serialize};

/// Sizes and training of an agent.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SacConfig {
    /// Widths of the hidden layers of every network.
    pub hidden: Vec<usize>,
    /// Whether the critics have a layer norm before each ReLU. Without one, rewards that end an episode let their values grow without bound.
    pub layer_norm: bool,
    /// Whether the target of the critics has the entropy of the next action (the paper's).
    pub entropy_in_target: bool,
    /// Discount a decision, in [0, 1).
    pub gamma: f32,
    /// Share of the critics that their targets take over at a time.
    pub tau: f32,
    /// Adam's learning rate, of every network and of alpha.
    pub lr: f32,
    /// Weight of the entropy at the start; it is learned then.
    pub alpha: f32,
    /// Critic updates for one of the actor, of alpha and of the targets.
    pub actor_every: usize,
    /// Loss of the critics above which critics, targets and actor begin anew.
    pub restart_above: f32,
}

impl Default for SacConfig {
    /// Sizes and rates for a CPU.
    fn default() -> Self {
        Self {
            hidden: vec![256, 256],
            layer_norm: true,
            entropy_in_target: false,
            gamma: 0.99,
            tau: 0.01,
            lr: 3e-4,
            alpha: 0.1,
            actor_every: 2,
            restart_above: 1000.0,
        }
    }
}

impl SacConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        let mut check = |good: bool, words: String| {
            if !good {
                problems.push(words);
            }
        };
        // A file may say any: 8 layers of 4096 are half a gigabyte.
        let widths =
            self.hidden.iter().all(|w| (1..=4096).contains(w)) && (1..=8).contains(&self.hidden.len());
        let found = &self.hidden;
        check(widths, format!("hidden: expected 1 to 8 widths from 1 to 4096, got {found:?}"));
        check(
            (0.0..1.0).contains(&self.gamma),
            format!("gamma: expected 0 or more and below 1, got {}", self.gamma),
        );
        for (name, v, most) in [
            ("tau", self.tau, 1.0),
            ("lr", self.lr, 1.0),
            ("alpha", self.alpha, 100.0),
            ("restart_above", self.restart_above, 1e9),
        ] {
            check(v > 0.0 && v <= most, format!("{name}: expected above 0, at most {most}, got {v}"));
        }
        let every = (1..=1000).contains(&self.actor_every);
        check(every, format!("actor_every: expected 1 to 1000, got {}", self.actor_every));
        problems
    }
}
