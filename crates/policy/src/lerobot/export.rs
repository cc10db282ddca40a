//! A checkpoint of ours as a folder for LeRobot.

use super::description::{Description, network_obstacles, obstacles};
use super::features::Features;
use super::scaling::Scalings;
use super::{CONFIG_FILE, POSITION_GRID, processors};
use crate::folder::write_weights;
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
    let (features, scalings) = (Features::of_tasks(c), Scalings::of(&ours.normaliser, &c.image_scaling));
    ours.write_with(dir, &with_grids(weights, c, features.crop), &metadata(&ours.provenance, dir)?)?;
    describe(dir, c, &features, &scalings)?;
    Ok(Exported { files: files(dir)?, notes: notes(c) })
}

/// Writes a policy that was trained on recordings into `dir`, a new folder: what [`super::import`] and LeRobot open.
///
/// # Errors
/// [`Error::Lerobot`] lists everything that LeRobot cannot express; nothing is written then. Also when a weight is not finite
/// or the folder cannot be written.
pub fn save(
    dir: &Path,
    c: &PolicyConfig,
    features: &Features,
    scalings: &Scalings,
    weights: &Weights,
    provenance: &Provenance,
) -> Result<()> {
    let problems = network_obstacles(c);
    if !problems.is_empty() {
        let path = dir.to_owned();
        return Err(Error::Lerobot { doing: "writing for LeRobot", path, obstacles: problems });
    }
    std::fs::create_dir_all(dir).map_err(|source| Error::Io {
        doing: "creating",
        path: dir.to_owned(),
        source,
    })?;
    let weights = weights.clone();
    let weights = if features.cameras.is_empty() { weights } else { with_grids(weights, c, features.crop) };
    write_weights(dir, &weights, &metadata(provenance, dir)?)?;
    describe(dir, c, features, scalings)
}

/// Where the weights come from. One entry, because the library writes several in no fixed order.
fn metadata(provenance: &Provenance, dir: &Path) -> Result<BTreeMap<String, String>> {
    let header = Header { version: env!("CARGO_PKG_VERSION").to_owned(), provenance: provenance.clone() };
    Ok(BTreeMap::from([(HEADER.to_owned(), json(&header, dir)?)]))
}

/// Writes all but the weights; `config.json` last.
fn describe(dir: &Path, c: &PolicyConfig, features: &Features, scalings: &Scalings) -> Result<()> {
    let description = Description::of(c, features, processors::modes(scalings));
    processors::write(dir, &description, scalings)?;
    let path = dir.join(CONFIG_FILE);
    write_atomic(&path, json(&description, &path)?.as_bytes())?;
    Ok(())
}

fn json(value: &impl Serialize, path: &Path) -> Result<String> {
    serde_json::to_string_pretty(value)
        .map_err(|e| Error::Checkpoint { path: path.to_owned(), problem: e.to_string() })
}

/// LeRobot keeps the positions of the spatial softmax beside the weights.
fn with_grids(mut weights: Weights, c: &PolicyConfig, crop: [usize; 2]) -> Weights {
    let (h, w) = c.encoder(crop[0], crop[1]).map_size();
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
