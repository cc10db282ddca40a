//! A critic on disk: `critic.json` and `model.safetensors` in one folder, which stand alone.

use crate::folder::{read_description, read_verified, write_description, write_weights};
use crate::{Critic, CriticConfig, Error, PolicyConfig, Result};
use e2h_core::STATE_DIM;
use e2h_data::Normaliser;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Version of the folder's layout; a reader refuses others.
pub const CRITIC_FORMAT: u32 = 1;

const CONFIG_FILE: &str = "critic.json";

/// What a critic was trained on, and how well.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CriticProvenance {
    /// Where each of its inputs comes from, in words that are compared: for example `pose` is `tcp, 7 numbers, Xyzw`.
    pub inputs: BTreeMap<String, String>,
    /// Orientations are written in the hemisphere of this quaternion (wxyz).
    pub reference_quaternion: [f64; 4],
    /// Rollouts that it learned from, held-out ones included.
    pub rollouts: usize,
    /// Those that succeeded.
    pub successes: usize,
    /// Horizon H of the hard task, control steps.
    pub horizon: usize,
    /// Seed of its training.
    pub seed: u64,
    /// Mean squared error over the last tenth of the training steps.
    pub train_loss: f64,
    /// Mean squared error on the rollouts held out; none without any.
    pub validation_loss: Option<f64>,
    /// Version of the library that trained it.
    pub version: String,
}

impl CriticProvenance {
    /// Checks that the inputs are those that the critic was trained on.
    ///
    /// # Errors
    /// Names every input that differs, with what was expected and found.
    pub fn check_inputs(&self, found: &BTreeMap<String, String>, path: &Path) -> Result<()> {
        let names: std::collections::BTreeSet<&String> = self.inputs.keys().chain(found.keys()).collect();
        let said =
            |map: &BTreeMap<String, String>, name: &String| map.get(name).map_or("none", |s| s).to_owned();
        let problems: Vec<String> = names
            .into_iter()
            .map(|name| (name, said(&self.inputs, name), said(found, name)))
            .filter(|(_, expected, found)| expected != found)
            .map(|(name, expected, found)| format!("{name}: expected {expected}, found {found}"))
            .collect();
        if problems.is_empty() {
            return Ok(());
        }
        Err(Error::Checkpoint { path: path.to_owned(), problem: problems.join("; ") })
    }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: u32,
    state_dim: usize,
    weights_sha256: String,
    network: PolicyConfig,
    critic: CriticConfig,
    normaliser: Normaliser,
    provenance: CriticProvenance,
}

impl Critic {
    /// Writes the folder; the weights first, so that one with a `critic.json` is whole.
    ///
    /// # Errors
    /// When the folder cannot be written.
    pub fn save(&self, dir: &Path, critic: &CriticConfig, provenance: &CriticProvenance) -> Result<()> {
        let weights_sha256 = write_weights(dir, &self.params.export()?, &BTreeMap::new())?;
        let file = File {
            format: CRITIC_FORMAT,
            state_dim: STATE_DIM,
            weights_sha256,
            network: self.config.clone(),
            critic: critic.clone(),
            normaliser: self.normaliser.clone(),
            provenance: provenance.clone(),
        };
        write_description(dir, CONFIG_FILE, &file)
    }

    /// Reads a folder that [`Critic::save`] wrote.
    ///
    /// # Errors
    /// When a file is missing, of another format, width or network, or the weights are not those that were saved with it;
    /// names what was expected and found.
    pub fn load(dir: &Path) -> Result<(Self, CriticProvenance)> {
        let path = dir.join(CONFIG_FILE);
        let numbers = [("format", u64::from(CRITIC_FORMAT)), ("state_dim", STATE_DIM as u64)];
        let value = read_description(&path, None, &numbers)?;
        let fail = |problem: String| Error::Checkpoint { path: path.clone(), problem };
        let file: File = serde_json::from_value(value).map_err(|e| fail(e.to_string()))?;
        file.network.validate().map_err(|e| fail(e.to_string()))?;
        let normaliser = file.normaliser.check().map_err(|e| fail(e.to_string()))?;
        let weights = read_verified(dir, &file.weights_sha256)?;
        // Up to version 0.1 a crop larger than the policy's was cut to it; the network says what was trained with.
        let settings = CriticConfig { crop_size: file.network.crop_size, ..file.critic };
        let critic = Self::with_weights(&file.network, &settings, &normaliser, &weights)
            .map_err(|e| Error::Checkpoint { path: dir.to_owned(), problem: e.to_string() })?;
        Ok((critic, file.provenance))
    }
}
