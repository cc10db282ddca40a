//! Optimisers, the moving average of the weights and the learning-rate schedules.

mod adam;
mod ema;
mod schedule;

pub use adam::{Adam, AdamConfig};
pub use ema::{Ema, EmaConfig};
pub use schedule::{LrSchedule, learning_rate};
