use crate::{Error, Result};
use half::{bf16, f16};
use safetensors::tensor::{Dtype, SafeTensors, TensorView};
use std::collections::{BTreeMap, HashMap};
use std::io::Write;
use std::path::Path;

/// A tensor on the host, row-major, in PyTorch's layout.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct HostTensor {
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
    /// As many numbers as the product of `shape`.
    pub data: Vec<f32>,
}

/// Tensors by name, sorted: PyTorch's names and layouts.
pub type Weights = BTreeMap<String, HostTensor>;

/// Writes a safetensors file: beside its place first, synced, then renamed over it, so that a reader sees the old file or
/// the new one.
///
/// # Errors
/// [`Error::Io`] when the folder cannot be written, [`Error::File`] when a tensor's data and shape disagree.
pub fn save_weights(
    path: impl AsRef<Path>,
    weights: &Weights,
    metadata: &BTreeMap<String, String>,
) -> Result<()> {
    let path = path.as_ref();
    let io = |doing| move |source| Error::Io { doing, path: path.to_path_buf(), source };
    let bytes: Vec<(&String, &HostTensor, Vec<u8>)> =
        weights.iter().map(|(n, t)| (n, t, t.data.iter().flat_map(|v| v.to_le_bytes()).collect())).collect();
    let file = |found: String| Error::File {
        path: path.to_path_buf(),
        expected: "tensors whose data fill their shapes",
        found,
    };
    let mut views = Vec::with_capacity(bytes.len());
    for (name, tensor, data) in &bytes {
        let view = TensorView::new(Dtype::F32, tensor.shape.clone(), data)
            .map_err(|e| file(format!("`{name}`: {e}")))?;
        views.push((*name, view));
    }
    let metadata: HashMap<String, String> = metadata.iter().map(|(k, v)| (k.clone(), v.clone())).collect();
    let content = safetensors::serialize(views, Some(metadata)).map_err(|e| file(e.to_string()))?;
    let folder = match path.parent() {
        Some(p) if !p.as_os_str().is_empty() => p,
        _ => Path::new("."),
    };
    let mut temporary = tempfile::NamedTempFile::new_in(folder).map_err(io("creating a file beside"))?;
    temporary.write_all(&content).map_err(io("writing"))?;
    // A temporary file is private to its owner; weights are as readable as any other file.
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let mode = std::fs::Permissions::from_mode(0o644);
        temporary.as_file().set_permissions(mode).map_err(io("setting the permissions of"))?;
    }
    temporary.as_file().sync_all().map_err(io("syncing"))?;
    temporary.persist(path).map_err(|e| io("renaming to")(e.error))?;
    // The rename itself lasts only once the folder is synced; folders cannot be opened everywhere.
    #[cfg(unix)]
    std::fs::File::open(folder).and_then(|d| d.sync_all()).map_err(io("syncing the folder of"))?;
    Ok(())
}

/// Text of a file for a message of one line.
fn printable(text: &str) -> String {
    text.replace(char::is_control, "\u{fffd}")
}

/// Reads a safetensors file, with its metadata. Numbers of 16 bits (`F16`, `BF16`) become the same numbers in `f32`.
///
/// # Errors
/// [`Error::Io`] when the file cannot be read, [`Error::File`] when it is no safetensors file or holds another number
/// type.
pub fn load_weights(path: impl AsRef<Path>) -> Result<(Weights, BTreeMap<String, String>)> {
    load_weights_without(path, |_| false)
}

/// [`load_weights`] without the tensors whose names `skip` holds for, whatever they are.
///
/// # Errors
/// As [`load_weights`].
pub fn load_weights_without(
    path: impl AsRef<Path>,
    skip: impl Fn(&str) -> bool,
) -> Result<(Weights, BTreeMap<String, String>)> {
    let path = path.as_ref();
    let io = |source| Error::Io { doing: "reading", path: path.to_path_buf(), source };
    // Pipes wait for ever, and devices never end.
    if !std::fs::metadata(path).map_err(io)?.is_file() {
        let problem = "expected a regular file, found a folder, a pipe or a device";
        return Err(io(std::io::Error::new(std::io::ErrorKind::InvalidInput, problem)));
    }
    let bytes = std::fs::read(path).map_err(io)?;
    parse_weights(&bytes, path, skip)
}

/// The same of bytes that were read already; `path` is where they come from, for messages.
///
/// # Errors
/// [`Error::File`] as in [`load_weights`].
pub fn parse_weights(
    bytes: &[u8],
    path: &Path,
    skip: impl Fn(&str) -> bool,
) -> Result<(Weights, BTreeMap<String, String>)> {
    let not = |e: safetensors::SafeTensorError| Error::File {
        path: path.to_path_buf(),
        expected: "a safetensors file",
        found: printable(&e.to_string()),
    };
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(not)?;
    let metadata = header.metadata().iter().flatten().map(|(k, v)| (k.clone(), v.clone())).collect();
    let mut weights = Weights::new();
    for (name, view) in SafeTensors::deserialize(bytes).map_err(not)?.tensors() {
        if skip(&name) {
            continue;
        }
        let bytes = view.data();
        let data = match view.dtype() {
            Dtype::F32 => {
                bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
            }
            Dtype::F16 => bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()).collect(),
            Dtype::BF16 => {
                bytes.chunks_exact(2).map(|b| bf16::from_le_bytes([b[0], b[1]]).to_f32()).collect()
            }
            other => {
                return Err(Error::File {
                    path: path.to_path_buf(),
                    expected: "tensors of type F32, F16 or BF16",
                    found: format!("`{}` of type {other:?}", printable(&name)),
                });
            }
        };
        weights.insert(name, HostTensor { shape: view.shape().to_vec(), data });
    }
    Ok((weights, metadata))
}
