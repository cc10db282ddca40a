//! Features: the columns of a dataset, their types and shapes.

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Version of the layout that is read and written.
pub const VERSION: &str = "v3.0";
/// Numbers that one row of one feature may hold: 256 Mi, far above any camera, far below any memory.
const LARGEST: usize = 1 << 28;

/// Type of the numbers of a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Dtype {
    /// 32-bit float.
    Float32,
    /// 64-bit float.
    Float64,
    /// 8-bit integer.
    Int8,
    /// 16-bit integer.
    Int16,
    /// 32-bit integer.
    Int32,
    /// 64-bit integer.
    Int64,
    /// 8-bit integer without sign.
    UInt8,
    /// 16-bit integer without sign.
    UInt16,
    /// 32-bit integer without sign.
    UInt32,
    /// True or false.
    Bool,
    /// Text.
    String,
    /// A PNG file in a Parquet column.
    Image,
    /// A stretch of an MP4 file beside the Parquet files.
    Video,
}

/// One feature of a dataset: type, shape and names of its entries.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Feature {
    /// Type of the numbers.
    pub dtype: Dtype,
    /// Shape of one row: `[1]` is a plain number, `[height, width, 3]` an image. Some recorders write `[3, height, width]` of
    /// images that lie in their files as all others do, see [`Feature::image_size`].
    pub shape: Vec<usize>,
    /// Names of the entries: a list, null, or what else a recorder put there.
    #[serde(default)]
    pub names: Value,
    /// What else `info.json` says of it; kept as it is.
    #[serde(flatten)]
    pub more: Map<String, Value>,
}

impl Feature {
    /// A plain number.
    #[must_use]
    pub fn scalar(dtype: Dtype) -> Self {
        Self { dtype, shape: vec![1], names: Value::Null, more: Map::new() }
    }

    /// A vector of 32-bit floats with named entries.
    #[must_use]
    pub fn vector<S: AsRef<str>>(names: &[S]) -> Self {
        let names: Vec<&str> = names.iter().map(AsRef::as_ref).collect();
        Self { dtype: Dtype::Float32, shape: vec![names.len()], names: names.into(), more: Map::new() }
    }

    /// An RGB image stored as PNG.
    #[must_use]
    pub fn image(height: usize, width: usize) -> Self {
        let names = Value::from(vec!["height", "width", "channels"]);
        Self { dtype: Dtype::Image, shape: vec![height, width, 3], names, more: Map::new() }
    }

    /// Numbers in one row.
    #[must_use]
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// Rows and columns of an image; none for what is no image of three channels. Where the shape could be read either way,
    /// the names of its entries decide.
    #[must_use]
    pub fn image_size(&self) -> Option<(usize, usize)> {
        let first = self.names.as_array().and_then(|n| n.first()).and_then(Value::as_str);
        let channels_first = first.is_some_and(|n| n.starts_with("channel") || n == "c");
        match self.shape[..] {
            _ if !self.is_visual() => None,
            [3, height, width] if channels_first || width != 3 => Some((height, width)),
            [height, width, 3] => Some((height, width)),
            _ => None,
        }
    }

    /// What keeps a feature from being read here: what is expected, and what was found.
    pub(super) fn problem(&self, videos: bool) -> Option<(&'static str, String)> {
        let shape = || format!("{:?}", self.shape);
        let size = self.shape.iter().try_fold(1_usize, |a, &b| a.checked_mul(b));
        let deep = self.shape.len() > 5;
        if self.shape.is_empty() || deep || size.is_none_or(|n| n == 0 || n > LARGEST) {
            return Some(("a shape of 1 to 5 sizes, none 0", shape()));
        }
        let image = self.image_size().is_some_and(|(h, w)| h < 1 << 16 && w < 1 << 16);
        if self.is_visual() && !image {
            return Some(("an image of shape [height, width, 3] or [3, height, width]", shape()));
        }
        if self.dtype == Dtype::String && self.shape != [1] {
            return Some(("shape [1] for text", shape()));
        }
        if self.dtype == Dtype::Video && !videos {
            return Some(("a video_path, since there are videos", "null".to_owned()));
        }
        None
    }

    /// True for images, in Parquet or in videos.
    #[must_use]
    pub fn is_visual(&self) -> bool {
        matches!(self.dtype, Dtype::Image | Dtype::Video)
    }

    /// Names of the entries, where they are a plain list of text.
    #[must_use]
    pub fn entry_names(&self) -> Option<Vec<&str>> {
        self.names.as_array()?.iter().map(Value::as_str).collect()
    }

    pub(crate) fn describe(&self) -> String {
        format!("{:?} {:?}", self.dtype, self.shape).to_lowercase()
    }
}

/// A feature that `info.json` names and that cannot be read here: an unknown type, or a shape that is none. It closes nothing
/// but itself; who asks for it gets an error.
#[derive(Debug, Clone, PartialEq)]
pub struct Skipped {
    /// Name of the feature.
    pub name: String,
    /// What is read here.
    pub expected: String,
    /// What the file says.
    pub found: String,
    /// Its place among all features.
    pub(super) place: usize,
    /// What the file says of it; kept as it is.
    pub(super) value: Value,
}

/// Features in the order of `info.json`, which is the order of columns.
pub type Features = Vec<(String, Feature)>;

/// The columns that every dataset has. `timestamp` is in seconds since the episode began, `index` counts over all episodes.
pub const DEFAULT_FEATURES: [(&str, Dtype); 5] = [
    ("timestamp", Dtype::Float32),
    ("frame_index", Dtype::Int64),
    ("episode_index", Dtype::Int64),
    ("index", Dtype::Int64),
    ("task_index", Dtype::Int64),
];

pub(crate) fn is_default(name: &str) -> bool {
    DEFAULT_FEATURES.iter().any(|(n, _)| *n == name)
}
