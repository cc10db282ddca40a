//! The bytes of one episode: a safetensors file that says what it is.

use crate::atomic::io;
use crate::{Error, Result};
use e2h_core::{ACTION_DIM, Episode, Frames, Origin, Outcome, STATE_DIM, one_line};
use safetensors::tensor::{Dtype, Metadata, SafeTensorError, SafeTensors, TensorView};
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// Key of the one entry in the file's metadata. One, because a map of several has no order and bytes would not repeat.
const KEY: &str = "auto_e2h.episode";
/// Version of the layout.
const FORMAT: u32 = 1;
/// What a damaged file should have been.
pub(crate) const WHOLE: &str = "a whole safetensors file";

/// What a file says of its episode beside the columns.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Header {
    format: u32,
    pub(crate) outcome: Outcome,
    pub(crate) terminal: bool,
    pub(crate) cameras: Vec<String>,
    pub(crate) origin: Origin,
}

/// The same bytes for the same episode.
pub(crate) fn encode(episode: &Episode, path: &Path) -> Result<Vec<u8>> {
    let rows = episode.len();
    let state: Vec<u8> = episode.state.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let action: Vec<u8> = episode.action.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    let source: Vec<u8> = episode.source.iter().flat_map(|v| v.to_le_bytes()).collect();
    let bad = |found: String| file_error(path, "episode", "an encodable episode", found);
    let view = |dtype, shape, bytes| TensorView::new(dtype, shape, bytes).map_err(|e| bad(e.to_string()));
    let mut tensors = vec![
        ("state".to_owned(), view(Dtype::F32, vec![rows, STATE_DIM], &state)?),
        ("action".to_owned(), view(Dtype::F32, vec![rows, ACTION_DIM], &action)?),
        ("source".to_owned(), view(Dtype::U32, vec![rows], &source)?),
    ];
    let excursion: Vec<u8> = episode.excursion.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
    // Files without it are those of episodes that nothing displaced, and of earlier versions.
    if episode.excursion.iter().flatten().any(|&v| v != 0.0) {
        tensors.push(("excursion".to_owned(), view(Dtype::F32, vec![rows, 4], &excursion)?));
    }
    let images: Vec<Vec<u8>> = episode.frames.iter().map(Frames::to_bytes).collect();
    for (f, images) in episode.frames.iter().zip(&images) {
        let shape = vec![rows, f.height, f.width, 3];
        tensors.push((format!("frames.{}", f.camera), view(Dtype::U8, shape, images)?));
    }
    let header = Header {
        format: FORMAT,
        outcome: episode.outcome,
        terminal: episode.terminal,
        cameras: episode.frames.iter().map(|f| f.camera.clone()).collect(),
        origin: episode.origin.clone(),
    };
    let header = serde_json::to_string(&header).map_err(|e| bad(e.to_string()))?;
    let metadata = HashMap::from([(KEY.to_owned(), header)]);
    safetensors::serialize(tensors, Some(metadata)).map_err(|e| bad(e.to_string()))
}

/// What a file says of its columns.
pub(crate) struct Found {
    pub(crate) header: Header,
    pub(crate) rows: usize,
    /// Bytes that the whole file must have.
    pub(crate) length: usize,
}

/// Reads the header of a file from its first bytes; those of the columns need not be there.
pub(crate) fn header(bytes: &[u8], path: &Path) -> Result<Found> {
    let broken = |found: String| file_error(path, "file", WHOLE, found);
    let size = bytes.first_chunk().map(|b| u64::from_le_bytes(*b)).and_then(|n| usize::try_from(n).ok());
    let end = size.and_then(|n| n.checked_add(8));
    let json =
        end.and_then(|end| bytes.get(8..end)).ok_or_else(|| broken(format!("{} bytes", bytes.len())))?;
    let metadata: Metadata = serde_json::from_slice(json).map_err(|e| broken(e.to_string()))?;
    let length = (8 + json.len())
        .checked_add(metadata.data_len())
        .ok_or_else(|| broken("columns beyond what a file can hold".to_owned()))?;
    let entry = metadata.metadata().as_ref().and_then(|m| m.get(KEY));
    let Some(entry) = entry else {
        return Err(file_error(path, "metadata", format!("key `{KEY}`"), "none: not an episode"));
    };
    // The version first: other versions may have other keys.
    #[derive(Deserialize)]
    struct Version {
        format: u32,
    }
    let json = |e: serde_json::Error| file_error(path, KEY, "an episode header", e.to_string());
    let version: Version = serde_json::from_str(entry).map_err(json)?;
    if version.format != FORMAT {
        return Err(file_error(path, "format", FORMAT.to_string(), version.format.to_string()));
    }
    let header: Header = serde_json::from_str(entry).map_err(json)?;
    let rows = check_columns(&header, &metadata, path)?;
    Ok(Found { header, rows, length })
}

/// Every column that the header promises is there with the right type and shape, and no other.
fn check_columns(header: &Header, metadata: &Metadata, path: &Path) -> Result<usize> {
    let mut found: Vec<String> = metadata.offset_keys();
    let mut expected = vec!["state".to_owned(), "action".to_owned(), "source".to_owned()];
    expected.extend(header.cameras.iter().map(|c| format!("frames.{c}")));
    if found.iter().any(|name| name == "excursion") {
        expected.push("excursion".to_owned());
    }
    found.sort();
    expected.sort();
    if found != expected {
        return Err(file_error(path, "columns", format!("{expected:?}"), format!("{found:?}")));
    }
    let rows = metadata.info("state").and_then(|i| i.shape.first().copied()).unwrap_or(0);
    for name in &found {
        let Some(info) = metadata.info(name) else { continue };
        let shape = &info.shape;
        let (dtype, wanted) = match name.as_str() {
            "state" => (Dtype::F32, vec![rows, STATE_DIM]),
            "action" => (Dtype::F32, vec![rows, ACTION_DIM]),
            "source" => (Dtype::U32, vec![rows]),
            "excursion" => (Dtype::F32, vec![rows, 4]),
            _ if shape.len() == 4 => (Dtype::U8, vec![rows, shape[1], shape[2], 3]),
            _ => (Dtype::U8, vec![rows, 0, 0, 3]),
        };
        if info.dtype != dtype || *shape != wanted {
            let found = format!("{:?} {shape:?}", info.dtype);
            return Err(file_error(path, name, format!("{dtype:?} {wanted:?}"), found));
        }
    }
    Ok(rows)
}

/// The episode in `bytes`.
pub(crate) fn decode(bytes: &[u8], path: &Path) -> Result<Episode> {
    let Found { header, rows: length, .. } = header(bytes, path)?;
    let broken = |e: SafeTensorError| file_error(path, "file", WHOLE, e.to_string());
    let file = SafeTensors::deserialize(bytes).map_err(broken)?;
    let tensor = |name: &str| file.tensor(name).map_err(broken);
    let camera = |camera: &String| {
        let view = tensor(&format!("frames.{camera}"))?;
        let (height, width) = (view.shape()[1], view.shape()[2]);
        Ok(Frames::new(camera, height, width, view.data()))
    };
    let episode = Episode {
        state: rows(tensor("state")?.data()),
        action: rows(tensor("action")?.data()),
        frames: header.cameras.iter().map(camera).collect::<Result<_>>()?,
        source: tensor("source")?.data().as_chunks().0.iter().map(|b| u32::from_le_bytes(*b)).collect(),
        excursion: tensor("excursion").map_or_else(|_| vec![[0.0; 4]; length], |t| rows(t.data())),
        outcome: header.outcome,
        terminal: header.terminal,
        origin: header.origin,
    };
    episode
        .validate()
        .map_err(|e| file_error(path, "episode", "finite rows of one length", e.to_string()))?;
    Ok(episode)
}

fn rows<const N: usize>(bytes: &[u8]) -> Vec<[f32; N]> {
    let number = |row: &[u8], i: usize| row[4 * i..].first_chunk().map_or(0.0, |b| f32::from_le_bytes(*b));
    bytes.chunks_exact(4 * N).map(|row| std::array::from_fn(|i| number(row, i))).collect()
}

pub(crate) fn file_error(
    path: &Path,
    what: &str,
    expected: impl Into<String>,
    found: impl Into<String>,
) -> Error {
    Error::File {
        path: path.to_owned(),
        what: one_line(what),
        expected: one_line(&expected.into()),
        found: one_line(&found.into()),
    }
}

pub(crate) fn unsupported(
    path: &Path,
    what: &str,
    expected: impl Into<String>,
    found: impl Into<String>,
) -> Error {
    Error::Unsupported {
        path: path.to_owned(),
        what: one_line(what),
        expected: one_line(&expected.into()),
        found: one_line(&found.into()),
    }
}

/// Opens a regular file, or a link to one. Reading from pipes waits for ever, and devices never end: they are refused before
/// they are opened.
pub(crate) fn open_regular(path: &Path) -> Result<File> {
    let found = std::fs::metadata(path).map_err(io("open", path))?;
    if !found.is_file() {
        let kind = if found.is_dir() { "a folder" } else { "a pipe, a device or a socket" };
        return Err(unsupported(path, "file", "a regular file", kind));
    }
    File::open(path).map_err(io("open", path))
}

/// The bytes of a regular file of at most `limit` bytes.
///
/// # Errors
/// When it is a folder, a pipe or a device (it is not opened then), when it is larger, or when the file system refuses.
pub fn read_regular(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let file = open_regular(path)?;
    let length = file.metadata().map_err(io("read", path))?.len();
    let large = |found: u64| unsupported(path, "file", format!("at most {limit} bytes"), found.to_string());
    if length > limit {
        return Err(large(length));
    }
    let mut bytes = vec![];
    // It may grow while it is read.
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes).map_err(io("read", path))?;
    if bytes.len() as u64 > limit { Err(large(bytes.len() as u64)) } else { Ok(bytes) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_regular_files_within_the_limit_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x");
        std::fs::write(&path, b"12345").unwrap();
        assert_eq!(read_regular(&path, 5).unwrap(), b"12345");
        let large = read_regular(&path, 4).unwrap_err();
        assert!(large.is_unsupported() && large.to_string().contains("at most 4 bytes, found 5"), "{large}");
        assert!(read_regular(folder.path(), 5).unwrap_err().to_string().contains("found a folder"));
        assert!(!read_regular(&folder.path().join("none"), 5).unwrap_err().is_unsupported());
        #[cfg(unix)]
        {
            let zero = read_regular(Path::new("/dev/zero"), 5).unwrap_err().to_string();
            assert!(zero.contains("expected a regular file, found a pipe, a device or a socket"), "{zero}");
            let pipe = folder.path().join("pipe");
            assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
            assert!(read_regular(&pipe, 5).unwrap_err().to_string().contains("a pipe"));
            std::os::unix::fs::symlink(&path, folder.path().join("link")).unwrap();
            assert_eq!(read_regular(&folder.path().join("link"), 5).unwrap(), b"12345");
        }
    }
}
