//! From recordings of the easy task to training data for the hard one: reversal, kinematic filter, advantage filter.
//!
//! Pure functions on episodes. Knows neither Candle nor MuJoCo: what a critic thinks of a row arrives as a number.
//! Nothing is dropped in silence: every stage returns what became of each frame it was given ([`Fate`]).
//!
//! ```
//! use e2h_core::{Direction, Episode, Origin};
//! use e2h_refine::{Fate, KinematicConfig, ReverseConfig, kinematic_filter, reverse};
//!
//! let mut easy = Episode::new(Origin::demonstration("nut_assembly", Direction::Easy, 0, 42), &[]);
//! for t in 0..60 {
//!     let mut state = [0.0; 15];
//!     state[0] = 0.01 * (t as f32).min(20.0); // moves for a second, then stands still for two
//!     state[3] = 1.0;
//!     easy.push(&e2h_core::Observation { state, frames: vec![] }, &[0.0; 8])?;
//! }
//! let config = ReverseConfig { reference_quaternion: [1.0, 0.0, 0.0, 0.0], ..ReverseConfig::default() };
//! let hard = reverse(&easy, &config);
//! let refined = kinematic_filter(&hard, &KinematicConfig::default(), &config);
//! assert_eq!(refined.fates.len(), 60);
//! assert_eq!(refined.fates.iter().filter(|&&f| f == Fate::Static).count(), 37);
//! assert_eq!(refined.segments[0].len(), 23);
//! # Ok::<(), e2h_core::Error>(())
//! ```

mod advantage;
mod compose;
mod dynamics;
mod error;
mod fate;
#[cfg(test)]
mod fixture;
mod goal;
mod gripper;
mod kinematic;
mod limits;
mod motion;
mod resample;
mod retime;
mod reverse;
mod series;
mod smooth;
mod still;
mod suffix;

pub use advantage::{AdvantageConfig, advantage_filter, advantages};
pub use compose::critic_filter;
pub use dynamics::{DynamicsFilterConfig, dynamics_filter};
pub use error::{Error, Result};
pub use fate::{Fate, RefineReport, Refined, merge_fates};
pub use goal::{Goal, GoalConfig};
pub use gripper::{GateConfig, gate, gripper_switches, held_on, slip};
pub use kinematic::{KinematicConfig, kinematic_filter};
pub use resample::resample;
pub use reverse::{Labels, ReverseConfig, rebuild_actions, reverse};
pub use series::{moving_average, percentile, runs};
pub use suffix::{SuffixConfig, cut_suffix};
