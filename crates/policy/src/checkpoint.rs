//! A policy on disk: `policy.json` and `model.safetensors` in one folder, which stand alone.

use crate::folder::{read_description, read_verified, write_description, write_weights};
use crate::lerobot::POSITION_GRID;
use crate::{Error, PolicyConfig, Result};
use e2h_core::{ACTION_DIM, Direction, STATE_DIM};
use e2h_data::Normaliser;
use e2h_nn::Weights;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Version of the checkpoint folder's layout; a reader refuses others.
pub const CHECKPOINT_FORMAT: u32 = 1;

/// The class of policies that these checkpoints are of.
const KIND: &str = "diffusion";
const CONFIG_FILE: &str = "policy.json";

/// Where a policy comes from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Task pair, for example `nut_assembly`.
    pub task: String,
    /// Which task of the pair it does; none where nobody says it.
    #[serde(with = "said")]
    pub direction: Option<Direction>,
    /// Preset of the run.
    pub preset: String,
    /// Run seed.
    pub seed: u64,
    /// Updates behind this policy.
    pub iteration: u32,
    /// Version of the library that trained it.
    pub version: String,
    /// Resolved configuration of the run, so that an evaluation can rebuild the environment.
    pub run: serde_json::Value,
}

/// A direction as files have it: `hard`, `easy`, or nothing between the quotes.
mod said {
    use e2h_core::Direction;
    use serde::{Deserialize, Deserializer, Serializer};

    pub(super) fn serialize<S: Serializer>(said: &Option<Direction>, s: S) -> Result<S::Ok, S::Error> {
        s.serialize_str(said.map_or("", Direction::name))
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(d: D) -> Result<Option<Direction>, D::Error> {
        #[derive(Deserialize)]
        #[serde(rename_all = "lowercase")]
        enum Said {
            Hard,
            Easy,
            #[serde(rename = "")]
            Nothing,
        }
        Ok(match Said::deserialize(d)? {
            Said::Hard => Some(Direction::Hard),
            Said::Easy => Some(Direction::Easy),
            Said::Nothing => None,
        })
    }
}

/// Everything of a checkpoint but the weights.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Architecture and inference settings.
    pub config: PolicyConfig,
    /// Scaling of states and actions.
    pub normaliser: Normaliser,
    /// Where it comes from.
    pub provenance: Provenance,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: u32,
    /// Class of the policy; none in files of version 0.1.
    #[serde(default = "kind")]
    kind: String,
    state_dim: usize,
    action_dim: usize,
    weights_sha256: String,
    config: PolicyConfig,
    normaliser: Normaliser,
    provenance: Provenance,
}

fn kind() -> String {
    KIND.to_owned()
}

impl Checkpoint {
    /// Writes both files, each beside its place, synced and renamed; the weights first, so that a folder with a
    /// `policy.json` is whole.
    ///
    /// # Errors
    /// When a weight is not finite, and nothing is written then; when the folder cannot be written.
    pub fn write(&self, dir: &Path, weights: &Weights) -> Result<()> {
        self.write_with(dir, weights, &BTreeMap::new())
    }

    /// The same with metadata in the header of the weights.
    pub(crate) fn write_with(
        &self,
        dir: &Path,
        weights: &Weights,
        metadata: &BTreeMap<String, String>,
    ) -> Result<()> {
        let weights_sha256 = write_weights(dir, weights, metadata)?;
        let file = File {
            format: CHECKPOINT_FORMAT,
            kind: kind(),
            state_dim: STATE_DIM,
            action_dim: ACTION_DIM,
            weights_sha256,
            config: self.config.clone(),
            normaliser: self.normaliser.clone(),
            provenance: self.provenance.clone(),
        };
        write_description(dir, CONFIG_FILE, &file)
    }

    /// Reads both files and checks that they belong together.
    ///
    /// # Errors
    /// When a file is missing, of another format or version, or the weights are not those that were saved with it.
    pub fn read(dir: &Path) -> Result<(Self, Weights)> {
        let path = dir.join(CONFIG_FILE);
        let value = read_description(&path, Some(KIND), &[("format", CHECKPOINT_FORMAT.into())])?;
        let fail = |problem: String| Error::Checkpoint { path: path.clone(), problem };
        let file: File = serde_json::from_value(value).map_err(|e| fail(e.to_string()))?;
        if (file.state_dim, file.action_dim) != (STATE_DIM, ACTION_DIM) {
            return Err(fail(format!(
                "expected state of {STATE_DIM} and action of {ACTION_DIM} numbers, found {} and {}",
                file.state_dim, file.action_dim
            )));
        }
        file.config.validate().map_err(|e| fail(e.to_string()))?;
        let normaliser = file.normaliser.check().map_err(|e| fail(e.to_string()))?;
        let mut weights = read_verified(dir, &file.weights_sha256)?;
        // In a folder that LeRobot opens too; computed here.
        weights.retain(|name, _| !name.ends_with(POSITION_GRID));
        Ok((Self { config: file.config, normaliser, provenance: file.provenance }, weights))
    }
}
