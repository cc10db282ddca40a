//! What the folders of policies and critics have in common: a description in JSON, and the weights that it names by their
//! SHA-256. Each stands alone.

use crate::{Error, Result};
use e2h_nn::Weights;
use serde::Serialize;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// Where the weights lie.
pub(crate) const WEIGHTS_FILE: &str = "model.safetensors";

fn io(doing: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { doing, path, source }
}

/// Writes the weights, which are numbers, into `dir`, made where it is not there; their SHA-256. They come first: a folder with a
/// description is whole.
pub(crate) fn write_weights(
    dir: &Path,
    weights: &Weights,
    metadata: &BTreeMap<String, String>,
) -> Result<String> {
    let path = dir.join(WEIGHTS_FILE);
    finite(weights, &path)?;
    std::fs::create_dir_all(dir).map_err(io("creating", dir))?;
    e2h_nn::save_weights(&path, weights, metadata)?;
    Ok(hex(&std::fs::read(&path).map_err(io("reading back", &path))?))
}

/// Writes a JSON file beside its place, synced and renamed.
pub(crate) fn write_description(dir: &Path, name: &str, value: &impl Serialize) -> Result<()> {
    let path = dir.join(name);
    let mut text = serde_json::to_string_pretty(value)
        .map_err(|e| Error::Checkpoint { path: path.clone(), problem: e.to_string() })?;
    text.push('\n');
    Ok(e2h_data::write_atomic(&path, text.as_bytes())?)
}

/// Reads a description whose entries `numbers` have these values. They are looked at alone first: a newer file may have fields that
/// this reader does not know.
pub(crate) fn read_description(
    path: &Path,
    kind: Option<&str>,
    numbers: &[(&str, u64)],
) -> Result<serde_json::Value> {
    let bytes = e2h_data::read_file(path, e2h_data::MOST_TEXT).map_err(io("reading checkpoint", path))?;
    let fail = |problem: String| Error::Checkpoint { path: path.to_owned(), problem };
    let value: serde_json::Value =
        serde_json::from_slice(&bytes).map_err(|e| fail(format!("expected JSON, found {e}")))?;
    if let (Some(kind), Some(found)) = (kind, value.get("kind").and_then(serde_json::Value::as_str))
        && found != kind
    {
        let found = e2h_core::one_line(found);
        return Err(fail(format!("expected a policy of kind `{kind}`, found `{found}`")));
    }
    for (name, expected) in numbers {
        let found = value.get(name).and_then(serde_json::Value::as_u64);
        if found != Some(*expected) {
            let found = found.map_or("none".to_owned(), |f| f.to_string());
            return Err(fail(format!("expected {name} {expected}, found {found}")));
        }
    }
    Ok(value)
}

/// Reads the weights of `dir`, if they are those with this SHA-256: the bytes that were verified are the ones that are parsed.
pub(crate) fn read_verified(dir: &Path, sha256: &str) -> Result<Weights> {
    let path = dir.join(WEIGHTS_FILE);
    let bytes =
        e2h_data::read_file(&path, e2h_data::MOST_WEIGHTS).map_err(io("reading checkpoint", &path))?;
    let found = hex(&bytes);
    if found != sha256 {
        let problem = format!("expected SHA-256 {sha256}, found {found}");
        return Err(Error::Checkpoint { path, problem });
    }
    let (weights, _) = e2h_nn::parse_weights(&bytes, &path, |_| false)?;
    finite(&weights, &path)?;
    Ok(weights)
}

/// Reads weights to act with, which are numbers, without the tensors whose names `skip` holds for; with their metadata.
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

fn hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}
