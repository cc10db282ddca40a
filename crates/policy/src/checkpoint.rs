//! A policy on disk: `policy.json` and `model.safetensors` in one folder, which stand alone.

use crate::lerobot::POSITION_GRID;
use crate::{Error, PolicyConfig, Result};
use e2h_core::{ACTION_DIM, STATE_DIM};
use e2h_data::Normaliser;
use e2h_nn::Weights;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// Version of the checkpoint folder's layout; a reader refuses others.
pub const CHECKPOINT_FORMAT: u32 = 1;

/// The class of policies that these checkpoints are of.
const KIND: &str = "diffusion";
const CONFIG_FILE: &str = "policy.json";
const WEIGHTS_FILE: &str = "model.safetensors";

/// Where a policy comes from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Task pair, for example `nut_assembly`.
    pub task: String,
    /// `hard` or `easy`.
    pub direction: String,
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
        let io = |doing: &'static str, path: &Path| {
            let path = path.to_owned();
            move |source| Error::Io { doing, path, source }
        };
        let weights_path = dir.join(WEIGHTS_FILE);
        finite(weights, &weights_path)?;
        std::fs::create_dir_all(dir).map_err(io("creating", dir))?;
        e2h_nn::save_weights(&weights_path, weights, metadata)?;
        let bytes = std::fs::read(&weights_path).map_err(io("reading back", &weights_path))?;
        let file = File {
            format: CHECKPOINT_FORMAT,
            kind: kind(),
            state_dim: STATE_DIM,
            action_dim: ACTION_DIM,
            weights_sha256: hex(&bytes),
            config: self.config.clone(),
            normaliser: self.normaliser.clone(),
            provenance: self.provenance.clone(),
        };
        write_beside(dir, CONFIG_FILE, &file)
    }

    /// Reads both files and checks that they belong together.
    ///
    /// # Errors
    /// When a file is missing, of another format or version, or the weights are not those that were saved with it.
    pub fn read(dir: &Path) -> Result<(Self, Weights)> {
        let path = dir.join(CONFIG_FILE);
        let text = std::fs::read_to_string(&path).map_err(|source| Error::Io {
            doing: "reading checkpoint",
            path: path.clone(),
            source,
        })?;
        let fail = |problem: String| Error::Checkpoint { path: path.clone(), problem };
        // The version is looked at alone first: a newer file may have fields that this reader does not know.
        let value: serde_json::Value =
            serde_json::from_str(&text).map_err(|e| fail(format!("expected JSON, found {e}")))?;
        let found = value.get("kind").and_then(serde_json::Value::as_str).unwrap_or(KIND);
        if found != KIND {
            let found = e2h_core::one_line(found);
            return Err(fail(format!("expected a policy of kind `{KIND}`, found `{found}`")));
        }
        let format = value.get("format").and_then(serde_json::Value::as_u64);
        if format != Some(u64::from(CHECKPOINT_FORMAT)) {
            let found = format.map_or("none".to_owned(), |f| f.to_string());
            return Err(fail(format!("expected format {CHECKPOINT_FORMAT}, found {found}")));
        }
        let file: File = serde_json::from_value(value).map_err(|e| fail(e.to_string()))?;
        if (file.state_dim, file.action_dim) != (STATE_DIM, ACTION_DIM) {
            return Err(fail(format!(
                "expected state of {STATE_DIM} and action of {ACTION_DIM} numbers, found {} and {}",
                file.state_dim, file.action_dim
            )));
        }
        file.config.validate().map_err(|e| fail(e.to_string()))?;
        let normaliser = file.normaliser.check().map_err(|e| fail(e.to_string()))?;
        let weights_path = dir.join(WEIGHTS_FILE);
        let bytes = std::fs::read(&weights_path).map_err(|source| Error::Io {
            doing: "reading checkpoint",
            path: weights_path.clone(),
            source,
        })?;
        let found = hex(&bytes);
        if found != file.weights_sha256 {
            return Err(Error::Checkpoint {
                path: weights_path,
                problem: format!("expected SHA-256 {}, found {found}", file.weights_sha256),
            });
        }
        let (mut weights, _) = read_weights(&weights_path)?;
        // In a folder that LeRobot opens too; computed here.
        weights.retain(|name, _| !name.ends_with(POSITION_GRID));
        Ok((Self { config: file.config, normaliser, provenance: file.provenance }, weights))
    }
}

/// Writes a JSON file beside its place, synced and renamed.
pub(crate) fn write_beside(dir: &Path, name: &str, value: &impl Serialize) -> Result<()> {
    let path = dir.join(name);
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|e| Error::Checkpoint { path: path.clone(), problem: e.to_string() })?;
    text.push('\n');
    Ok(e2h_data::write_atomic(&path, text.as_bytes())?)
}

/// Reads weights to act with, which are numbers.
pub(crate) fn read_weights(path: &Path) -> Result<(Weights, BTreeMap<String, String>)> {
    read_weights_without(path, |_| false)
}

/// [`read_weights`] without the tensors whose names `skip` holds for.
pub(crate) fn read_weights_without(
    path: &Path,
    skip: impl Fn(&str) -> bool,
) -> Result<(Weights, BTreeMap<String, String>)> {
    let (weights, metadata) = e2h_nn::load_weights_without(path, skip)?;
    finite(&weights, path)?;
    Ok((weights, metadata))
}

/// Weights to act with are numbers, read or written.
fn finite(weights: &Weights, path: &Path) -> Result<()> {
    for (name, tensor) in weights {
        if let Some(entry) = tensor.data.iter().position(|v| !v.is_finite()) {
            let problem =
                format!("`{name}`, entry {entry}: expected a finite number, found {}", tensor.data[entry]);
            return Err(Error::Checkpoint { path: path.to_owned(), problem });
        }
    }
    Ok(())
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}
