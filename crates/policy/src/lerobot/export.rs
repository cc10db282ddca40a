//! A checkpoint of ours as a folder for LeRobot.

use super::description::{Description, obstacles};
use super::{CONFIG_FILE, POSITION_GRID, processors};
use crate::{Checkpoint, Error, PolicyConfig, Provenance, Result};
use e2h_data::write_atomic;
use e2h_nn::{SpatialSoftmax, Weights};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Key of our own entry in the metadata of `model.safetensors`: a JSON object with `version` and `provenance`.
pub const HEADER: &str = "auto_e2h";

#[derive(Serialize, Deserialize)]
pub(super) struct Header {
    pub(super) version: String,
    pub(super) provenance: Provenance,
}

/// What became of a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Exported {
    /// Names of the files, sorted.
    pub files: Vec<String>,
    /// What the policy does here and LeRobot does not do after the network or before it; sentences.
    pub notes: Vec<String>,
}

/// Writes the checkpoint in `checkpoint` for LeRobot into `dir`, which is one of our checkpoints as well.
///
/// `config.json` comes last: a folder that has it is whole.
///
/// # Errors
/// [`Error::Lerobot`] lists everything that LeRobot cannot express; nothing is written then. Also when the checkpoint cannot
/// be read, or `dir` holds something.
pub fn export(checkpoint: &Path, dir: &Path) -> Result<Exported> {
    let (ours, weights) = Checkpoint::read(checkpoint)?;
    let c = &ours.config;
    let problems = obstacles(c);
    if !problems.is_empty() {
        let path = checkpoint.to_owned();
        return Err(Error::Lerobot { doing: "writing for LeRobot", path, obstacles: problems });
    }
    if std::fs::read_dir(dir).is_ok_and(|mut entries| entries.next().is_some()) {
        let problem = "expected a new or an empty folder, found files in it".to_owned();
        return Err(Error::Checkpoint { path: dir.to_owned(), problem });
    }
    std::fs::create_dir_all(dir).map_err(|source| Error::Io {
        doing: "creating",
        path: dir.to_owned(),
        source,
    })?;
    let description = Description::of(c);
    let header =
        Header { version: env!("CARGO_PKG_VERSION").to_owned(), provenance: ours.provenance.clone() };
    // One entry, because the library writes several in no fixed order.
    let metadata = BTreeMap::from([(HEADER.to_owned(), json(&header, dir)?)]);
    ours.write_with(dir, &with_grids(weights, c), &metadata)?;
    processors::write(dir, &description, c, &ours.normaliser)?;
    let path = dir.join(CONFIG_FILE);
    write_atomic(&path, json(&description, &path)?.as_bytes())?;
    Ok(Exported { files: files(dir)?, notes: notes(c) })
}

fn json(value: &impl Serialize, path: &Path) -> Result<String> {
    serde_json::to_string_pretty(value)
        .map_err(|e| Error::Checkpoint { path: path.to_owned(), problem: e.to_string() })
}

/// LeRobot keeps the positions of the spatial softmax beside the weights.
fn with_grids(mut weights: Weights, c: &PolicyConfig) -> Weights {
    let (h, w) = c.encoder(c.crop_size, c.crop_size).map_size();
    let ends = ".pool.nets.weight";
    let encoders: Vec<String> =
        weights.keys().filter_map(|n| n.strip_suffix(ends).map(str::to_owned)).collect();
    for encoder in encoders {
        weights.insert(format!("{encoder}{POSITION_GRID}"), SpatialSoftmax::position_grid(h, w));
    }
    weights
}

fn files(dir: &Path) -> Result<Vec<String>> {
    let io = |source| Error::Io { doing: "listing", path: dir.to_owned(), source };
    let mut names = vec![];
    for entry in std::fs::read_dir(dir).map_err(io)? {
        names.push(entry.map_err(io)?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    Ok(names)
}

fn notes(c: &PolicyConfig) -> Vec<String> {
    let mut notes = vec![];
    if c.unit_quaternion {
        notes.push(
            "LeRobot returns the quaternion of an action as predicted: scale it to length 1 before use \
             (policy.unit_quaternion)"
                .to_owned(),
        );
    }
    if c.state_limit > 0.0 {
        notes.push(format!(
            "LeRobot does not limit states: normalised entries beyond {} act otherwise there (policy.state_limit)",
            c.state_limit
        ));
    }
    notes
}
