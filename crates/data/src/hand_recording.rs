//! What is known of demonstrations recorded by hand beside their dataset: of which scene they are, and how long each took.

use crate::file::file_error;
use crate::{Error, Result, read_text, write_atomic};
use e2h_core::Direction;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Its file, in the folder of the dataset.
pub const RECORDING_FILE: &str = "recording.json";

/// How one demonstration came about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Take {
    /// Index of the episode in the dataset.
    pub episode: usize,
    /// Seconds by the clock on the wall from its first control step to its last.
    pub seconds: f64,
    /// Seconds by the clock since the demonstration before it was saved, or since the program began: what it cost a person,
    /// resets and discarded attempts included.
    pub cost_seconds: f64,
    /// Attempts that were discarded before it.
    pub discarded: usize,
}

/// What is known of a recorded dataset: `recording.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HandRecording {
    /// Task pair.
    pub task: String,
    /// Variant of the scene.
    pub variant: String,
    /// Free space round what goes into a hole, m a side; 0 for the task's default.
    pub clearance: f64,
    /// Which task of the pair.
    pub direction: Direction,
    /// One entry for each episode whose time is known; an episode that was saved at the very instant of a kill may have none.
    pub takes: Vec<Take>,
}

impl HandRecording {
    /// Reads it beside a dataset; none where there is none.
    ///
    /// # Errors
    /// When it cannot be read, or is not what is written here.
    pub fn read(root: &Path) -> Result<Option<Self>> {
        let path = root.join(RECORDING_FILE);
        let text = match read_text(&path) {
            Ok(text) => text,
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(file_error(&path, "file", "one that can be read", e.to_string())),
        };
        let parsed: std::result::Result<Self, _> = serde_json::from_str(&text);
        parsed.map(Some).map_err(|e| file_error(&path, "file", "what is known of a recording", e.to_string()))
    }

    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// When the file system refuses.
    pub fn write(&self, root: &Path) -> Result<()> {
        let path = root.join(RECORDING_FILE);
        let json = |e: serde_json::Error| -> Error { file_error(&path, "JSON", "a value", e.to_string()) };
        let text = serde_json::to_string_pretty(self).map_err(json)?;
        write_atomic(&path, format!("{text}\n").as_bytes())
    }
}
