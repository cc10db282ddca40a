//! The image-conditioned diffusion policy of Auto-E2H and its critic, on the layers of `e2h-nn`.
//!
//! Deliberately knows neither tasks nor simulators: it sees [`e2h_core::Episode`]s and observations only.
//!
//! ```
//! use e2h_policy::{DiffusionPolicy, PolicyConfig};
//! use e2h_data::{Normaliser, NormaliserConfig};
//! # use e2h_core::{Direction, Episode, Observation, Origin, Policy};
//!
//! # let mut demonstrations = vec![Episode::new(Origin::demonstration("t", Direction::Easy, 0, 0), &[])];
//! # for t in 0..20 {
//! #     let x = t as f32;
//! #     let state = [x, x, x, 0., 1., 0., 0., x, x, x, 1., 0., 0., 0., x];
//! #     demonstrations[0].push(&Observation { state, frames: vec![] }, &[x, x, x, 0., 1., 0., 0., x])?;
//! # }
//! let config = PolicyConfig { cameras: vec![], ..PolicyConfig::tiny() };
//! let normaliser = Normaliser::fit(&demonstrations, &NormaliserConfig::default())?;
//! let policy = DiffusionPolicy::untrained(&config, &normaliser, 0)?;
//! let observation = Observation { state: demonstrations[0].state[3], frames: vec![] };
//! let chunk = policy.act(&[vec![&observation; config.n_obs_steps]], &mut [e2h_core::stream(0, "act", 0, 0)])?;
//! assert_eq!(chunk[0].len(), config.n_action_steps);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod batch;
mod checkpoint;
mod config;
mod critic;
mod critic_file;
mod ddim;
mod divergence;
mod dynamics;
mod error;
mod examples;
mod folder;
pub mod lerobot;
mod model;
mod policy;
pub mod sac;
mod train;
mod train_config;

pub use checkpoint::{CHECKPOINT_FORMAT, Checkpoint, Provenance};
pub use config::{EncoderNorm, ImageScaling, PolicyConfig, Prediction, SamplerKind};
pub use critic::{Critic, CriticReport, CriticTraining, train_critic};
pub use critic_file::{CRITIC_FORMAT, CriticProvenance};
pub use ddim::{Ddim, DdimStep};
pub use dynamics::{Dynamics, DynamicsConfig, DynamicsReport, DynamicsTraining, train_dynamics};
pub use error::{Error, Result};
pub use examples::TrainingData;
pub use model::DiffusionModel;
pub use policy::DiffusionPolicy;
pub use train::Trainer;
pub use train_config::{CriticConfig, ScheduleConfig, ScheduleKind, ScheduledAdam, TrainConfig};
