//! Episodes on disk, training windows and the min-max normaliser of Auto-E2H.
//!
//! Knows neither Candle nor MuJoCo, and nothing of what is learned: a window is a list of row numbers, a batch a list of
//! windows. Whoever trains copies the rows where its tensors are.
//!
//! ```
//! use e2h_core::{Direction, Episode, Observation, Origin};
//! use e2h_data::lerobot::{Dataset, Writer, features_of};
//! use e2h_data::{Normaliser, NormaliserConfig, WindowConfig, Windows};
//!
//! let mut episode = Episode::new(Origin::demonstration("nut_assembly", Direction::Easy, 0, 42), &[]);
//! for t in 0..20 {
//!     episode.push(&Observation { state: [t as f32; 15], frames: vec![] }, &[t as f32; 8])?;
//! }
//! let folder = tempfile::tempdir()?;
//! let root = folder.path().join("easy");
//! let mut writer = Writer::create(&root, 20.0, Some("panda"), features_of(&episode))?;
//! writer.push_episode(&episode)?;
//! writer.finish()?;
//! let episodes = vec![Dataset::open(&root)?.read_episode(0)?];
//!
//! let normaliser = Normaliser::fit(&episodes, &NormaliserConfig::default())?;
//! assert_eq!(normaliser.normalise_state(&episodes[0].state[19])[0], 1.0);
//!
//! let windows = Windows::new(&episodes, &WindowConfig::default());
//! let window = windows.window(0);
//! assert_eq!(window.observations, [0, 0]);
//! assert_eq!(window.actions, (0..16).collect::<Vec<_>>());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod atomic;
mod error;
mod file;
#[cfg(test)]
mod fixture;
mod hand_recording;
pub mod lerobot;
mod normalise;
mod recording;
mod resize;
mod sample;
mod window;

pub use atomic::write as write_atomic;
pub use error::{Error, Result};
pub use file::{MOST_TEXT, MOST_WEIGHTS, read_file, read_regular, read_text};
pub use hand_recording::{HandRecording, RECORDING_FILE, Take};
pub use normalise::{Normaliser, NormaliserConfig};
pub use recording::{
    ACTION_FEATURE, CameraLayout, ENVIRONMENT_FEATURE, Layout, RecordedSource, Recording, STATE_FEATURE,
};
pub use resize::resize_image;
pub use sample::{Pick, Sampler, Source};
pub use window::{Alignment, Window, WindowConfig, Windows};
