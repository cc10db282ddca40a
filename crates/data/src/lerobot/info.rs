//! `meta/info.json`: what a dataset says of itself.

use super::feature::{DEFAULT_FEATURES, Feature, Features, Skipped, VERSION, is_default};
use crate::file::{file_error, unsupported};
use crate::{Error, Result};
use serde::de::{Error as _, MapAccess, Visitor};
use serde::ser::SerializeMap;
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use serde_json::{Map, Value};
use std::path::{Component, Path, PathBuf};

/// Files in a folder, before the next folder begins.
const FILES_A_CHUNK: usize = 1000;

/// The contents of `meta/info.json`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
pub struct Info {
    /// Version of the layout.
    pub codebase_version: String,
    /// What recorded it.
    #[serde(default)]
    pub robot_type: Option<String>,
    /// Episodes.
    pub total_episodes: usize,
    /// Rows of all episodes.
    pub total_frames: usize,
    /// Different tasks.
    pub total_tasks: usize,
    /// Files in a folder.
    #[serde(default = "files_a_chunk")]
    pub chunks_size: usize,
    /// A data file that reaches this size is closed; MiB.
    #[serde(default = "data_file_size")]
    pub data_files_size_in_mb: usize,
    /// The same for videos; MiB.
    #[serde(default = "video_file_size")]
    pub video_files_size_in_mb: usize,
    /// Rows a second, Hz.
    pub fps: f64,
    /// Named ranges of episodes.
    #[serde(default)]
    pub splits: Map<String, Value>,
    /// Where data files are, below the root.
    pub data_path: String,
    /// Where videos are, below the root; none without videos.
    #[serde(default)]
    pub video_path: Option<String>,
    /// All features that can be read, those of [`DEFAULT_FEATURES`] included.
    #[serde(deserialize_with = "in_order::features")]
    pub features: Features,
    /// The others.
    #[serde(skip)]
    pub skipped: Vec<Skipped>,
    /// What else the file says; kept as it is.
    #[serde(flatten)]
    pub more: Map<String, Value>,
}

fn files_a_chunk() -> usize {
    FILES_A_CHUNK
}

fn data_file_size() -> usize {
    100
}

fn video_file_size() -> usize {
    200
}

/// LeRobot writes whole rates as integers and compares them as such.
fn whole_rate(fps: f64) -> Value {
    // Whole and below 2^32.
    if fps.fract() == 0.0 && (0.0..4e9).contains(&fps) { (fps as u64).into() } else { fps.into() }
}

impl Serialize for Info {
    fn serialize<S: Serializer>(&self, s: S) -> std::result::Result<S::Ok, S::Error> {
        let mut map = s.serialize_map(None)?;
        map.serialize_entry("codebase_version", &self.codebase_version)?;
        map.serialize_entry("robot_type", &self.robot_type)?;
        map.serialize_entry("total_episodes", &self.total_episodes)?;
        map.serialize_entry("total_frames", &self.total_frames)?;
        map.serialize_entry("total_tasks", &self.total_tasks)?;
        map.serialize_entry("chunks_size", &self.chunks_size)?;
        map.serialize_entry("data_files_size_in_mb", &self.data_files_size_in_mb)?;
        map.serialize_entry("video_files_size_in_mb", &self.video_files_size_in_mb)?;
        map.serialize_entry("fps", &whole_rate(self.fps))?;
        map.serialize_entry("splits", &self.splits)?;
        map.serialize_entry("data_path", &self.data_path)?;
        map.serialize_entry("video_path", &self.video_path)?;
        map.serialize_entry("features", &in_order::All(self))?;
        for (key, value) in &self.more {
            map.serialize_entry(key, value)?;
        }
        map.end()
    }
}

mod in_order {
    use super::*;

    /// All features, skipped ones at their old places.
    pub(super) struct All<'a>(pub(super) &'a Info);

    impl Serialize for All<'_> {
        fn serialize<S: Serializer>(&self, s: S) -> std::result::Result<S::Ok, S::Error> {
            let mut map = s.serialize_map(None)?;
            let mut features = self.0.features.iter();
            let mut skipped = self.0.skipped.iter().peekable();
            for place in 0.. {
                if let Some(found) = skipped.next_if(|s| s.place <= place) {
                    map.serialize_entry(&found.name, &found.value)?;
                } else if let Some((name, feature)) = features.next() {
                    map.serialize_entry(name, feature)?;
                } else if skipped.peek().is_none() {
                    break;
                }
            }
            map.end()
        }
    }

    /// Names and what is said of each, as they follow each other.
    pub(super) struct Entries(pub(super) Vec<(String, Value)>);

    impl<'de> Deserialize<'de> for Entries {
        fn deserialize<D: Deserializer<'de>>(d: D) -> std::result::Result<Self, D::Error> {
            struct InOrder;
            impl<'de> Visitor<'de> for InOrder {
                type Value = Entries;
                fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                    f.write_str("a map of features")
                }
                fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<Entries, A::Error> {
                    let mut found: Vec<(String, Value)> = vec![];
                    while let Some((name, value)) = map.next_entry::<String, Value>()? {
                        if found.iter().any(|(n, _)| *n == name) {
                            return Err(A::Error::custom(format!("feature `{name}` stands there twice")));
                        }
                        found.push((name, value));
                    }
                    Ok(Entries(found))
                }
            }
            d.deserialize_map(InOrder)
        }
    }

    /// Those of them that are features at all; [`Info::parse`] says what becomes of the others.
    pub(super) fn features<'de, D: Deserializer<'de>>(d: D) -> std::result::Result<Features, D::Error> {
        let entries = Entries::deserialize(d)?.0.into_iter();
        Ok(entries.filter_map(|(name, v)| Some((name, Feature::deserialize(v).ok()?))).collect())
    }
}

impl Info {
    /// What a new dataset says of itself. `features` are those beside [`DEFAULT_FEATURES`].
    ///
    /// # Errors
    /// Names the first feature that cannot be.
    pub fn new(fps: f64, robot_type: Option<&str>, features: Features) -> Result<Self> {
        let defaults = DEFAULT_FEATURES.iter().map(|(n, dtype)| ((*n).to_owned(), Feature::scalar(*dtype)));
        let info = Self {
            codebase_version: VERSION.to_owned(),
            robot_type: robot_type.map(str::to_owned),
            total_episodes: 0,
            total_frames: 0,
            total_tasks: 0,
            chunks_size: FILES_A_CHUNK,
            data_files_size_in_mb: data_file_size(),
            video_files_size_in_mb: video_file_size(),
            fps,
            splits: Map::new(),
            data_path: "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet".to_owned(),
            video_path: None,
            features: features.into_iter().chain(defaults).collect(),
            skipped: vec![],
            more: Map::new(),
        };
        match info.problem() {
            None => Ok(info),
            Some((column, expected, found)) => Err(Error::Column { column, expected, found }),
        }
    }

    /// Reads and checks the file's text.
    pub(crate) fn parse(text: &[u8], path: &Path) -> Result<Self> {
        // The version first: other versions have other keys.
        #[derive(Deserialize)]
        struct Version {
            codebase_version: String,
        }
        let json = |e: serde_json::Error| file_error(path, "JSON", "a LeRobot info.json", e.to_string());
        let Version { codebase_version: version } = serde_json::from_slice(text).map_err(json)?;
        if version != VERSION {
            return Err(unsupported(path, "codebase_version", VERSION, version));
        }
        let mut info: Self = serde_json::from_slice(text).map_err(json)?;
        info.skip(text).map_err(json)?;
        if let Some((what, expected, found)) = info.problem() {
            return Err(file_error(path, &what, expected, found));
        }
        for (name, dtype) in DEFAULT_FEATURES {
            let feature = info.feature(name).map(Feature::describe);
            let expected = Feature::scalar(dtype).describe();
            if feature.as_deref() != Some(expected.as_str()) {
                let found = feature.unwrap_or_else(|| "none".to_owned());
                return Err(file_error(path, &format!("feature `{name}`"), expected, found));
            }
        }
        info.data_file(0, 0).map_err(|found| file_error(path, "data_path", INSIDE, found))?;
        if info.video_path.is_some() {
            info.video_file("camera", 0, 0).map_err(|found| file_error(path, "video_path", INSIDE, found))?;
        }
        Ok(info)
    }

    /// Puts aside what cannot be read.
    fn skip(&mut self, text: &[u8]) -> std::result::Result<(), serde_json::Error> {
        #[derive(Deserialize)]
        struct Listed {
            features: in_order::Entries,
        }
        let Listed { features: in_order::Entries(entries) } = serde_json::from_slice(text)?;
        self.features.clear();
        for (place, (name, value)) in entries.into_iter().enumerate() {
            let (expected, found) = match Feature::deserialize(&value) {
                Ok(feature) => match feature.problem(self.video_path.is_some()) {
                    Some((expected, found)) => (expected.to_owned(), found),
                    None => {
                        self.features.push((name, feature));
                        continue;
                    }
                },
                Err(e) => ("a type and a shape that are known".to_owned(), e.to_string()),
            };
            self.skipped.push(Skipped { name, expected, found, place, value });
        }
        Ok(())
    }

    /// The feature of that name.
    #[must_use]
    pub fn feature(&self, name: &str) -> Option<&Feature> {
        self.features.iter().find(|(n, _)| n == name).map(|(_, f)| f)
    }

    /// The features beside [`DEFAULT_FEATURES`].
    #[must_use]
    pub fn own_features(&self) -> Features {
        self.features.iter().filter(|(n, _)| !is_default(n)).cloned().collect()
    }

    /// The first contradiction: what, expected, found.
    fn problem(&self) -> Option<(String, String, String)> {
        let bad =
            |what: &str, expected: &str, found: String| Some((what.to_owned(), expected.to_owned(), found));
        if !(self.fps.is_finite() && self.fps > 0.0) {
            return bad("fps", "a positive rate, Hz", self.fps.to_string());
        }
        if self.chunks_size == 0 {
            return bad("chunks_size", "at least 1", "0".to_owned());
        }
        let skipped = self.skipped.iter().map(|s| (&s.name, None));
        let all = self.features.iter().map(|(name, feature)| (name, Some(feature)));
        for (i, (name, feature)) in all.chain(skipped).enumerate() {
            let what = format!("feature `{name}`");
            let control = name.contains(char::is_control);
            if name.is_empty() || control || name.contains(['/', '\\']) || name == ".." || name == "." {
                return bad(&what, "a name without `/` and control characters", format!("{name:?}"));
            }
            if self.features.iter().take(i).any(|(n, _)| n == name) && feature.is_some() {
                return bad(&what, "each name once", "it twice".to_owned());
            }
            if let Some((expected, found)) = feature.and_then(|f| f.problem(self.video_path.is_some())) {
                return bad(&what, expected, found);
            }
        }
        None
    }

    /// A data file, below the root.
    pub(crate) fn data_file(&self, chunk: usize, file: usize) -> std::result::Result<PathBuf, String> {
        expand(&self.data_path, None, chunk, file)
    }

    /// A video file, below the root.
    pub(crate) fn video_file(
        &self,
        key: &str,
        chunk: usize,
        file: usize,
    ) -> std::result::Result<PathBuf, String> {
        expand(self.video_path.as_deref().unwrap_or_default(), Some(key), chunk, file)
    }

    /// The place after the one given: (folder, file).
    pub(crate) fn next_file(&self, (chunk, file): (usize, usize)) -> (usize, usize) {
        if file + 1 >= self.chunks_size { (chunk + 1, 0) } else { (chunk, file + 1) }
    }
}

/// What a path template must lead to.
pub(crate) const INSIDE: &str = "a path inside the dataset made of {chunk_index:03d} and {file_index:03d}";

/// A path template with its numbers filled in; refused where it leaves the dataset.
fn expand(
    template: &str,
    key: Option<&str>,
    chunk: usize,
    file: usize,
) -> std::result::Result<PathBuf, String> {
    let filled = template
        .replace("{chunk_index:03d}", &format!("{chunk:03}"))
        .replace("{file_index:03d}", &format!("{file:03}"));
    let numbers = template.contains("{chunk_index:03d}") && template.contains("{file_index:03d}");
    let filled = match key {
        Some(key) => filled.replace("{video_key}", key),
        None => filled,
    };
    let path = PathBuf::from(&filled);
    let inside = path.components().all(|c| matches!(c, Component::Normal(_)));
    let plain = !filled.contains(['{', '}', '\\']) && !filled.contains(char::is_control);
    if inside && numbers && plain { Ok(path) } else { Err(template.to_owned()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lerobot::Dtype;

    fn info() -> Info {
        let features = vec![("z".to_owned(), Feature::vector(&["a", "b"]))];
        Info::new(20.0, Some("arm"), features).unwrap()
    }

    fn refusal(change: impl FnOnce(&mut Value)) -> String {
        let mut value = serde_json::to_value(info()).unwrap();
        change(&mut value);
        Info::parse(value.to_string().as_bytes(), Path::new("info.json")).unwrap_err().to_string()
    }

    #[test]
    fn the_order_of_features_and_unknown_keys_survive() {
        let mut info = info();
        info.more.insert("total_videos".to_owned(), 3.into());
        info.features[0].1.more.insert("fps".to_owned(), 30.into());
        let text = serde_json::to_vec(&info).unwrap();
        assert_eq!(Info::parse(&text, Path::new("x")).unwrap(), info);
        let text = String::from_utf8(text).unwrap();
        assert!(text.contains("\"fps\":20,") && text.contains("\"total_videos\":3"), "{text}");
        assert!(text.find("\"z\"").unwrap() < text.find("\"timestamp\"").unwrap());
    }

    #[test]
    fn what_cannot_be_is_named() {
        let other = refusal(|v| v["codebase_version"] = "v2.1".into());
        assert!(other.contains("codebase_version: expected v3.0, found v2.1"), "{other}");
        assert!(refusal(|v| v["fps"] = 0.into()).contains("fps: expected a positive rate"));
        assert!(refusal(|v| v["features"]["index"]["dtype"] = "bool".into()).contains("int64 [1]"));
        assert!(refusal(|v| *v = Value::Null).contains("JSON"));
    }

    #[test]
    fn what_cannot_be_read_is_put_aside_and_kept_as_it_is() {
        let text = serde_json::to_string(&info()).unwrap();
        let z = r#""z":{"dtype":"float32","shape":[2],"names":["a","b"]}"#;
        assert!(text.contains(z), "{text}");
        for (other, expected) in [
            (r#""z":{"dtype":"float32","shape":[0],"names":null}"#, "none 0, found [0]"),
            (r#""z":{"dtype":"float32","shape":[18446744073709551615,2],"names":null}"#, "a shape of 1 to 5"),
            (r#""z":{"dtype":"complex","shape":[2],"names":null,"more":{"a":1}}"#, "complex"),
            (r#""z":{"dtype":"image","shape":[4,4,1],"names":null}"#, "found [4, 4, 1]"),
            (r#""z":{"dtype":"video","shape":[4,4,3],"names":null}"#, "video_path"),
            (r#""z":{"dtype":"string","shape":[2],"names":null}"#, "shape [1] for text"),
            (r#""z":["language"]"#, "found"),
        ] {
            let text = text.replace(z, other);
            let info = Info::parse(text.as_bytes(), Path::new("x")).unwrap();
            assert_eq!((info.features.len(), info.skipped.len()), (5, 1), "{other}");
            let Skipped { name, expected: wanted, found, .. } = &info.skipped[0];
            assert!(
                name == "z" && format!("{wanted}, found {found}").contains(expected),
                "{wanted}, {found}"
            );
            let back: Value = serde_json::from_str(&text).unwrap();
            assert_eq!(serde_json::to_value(&info).unwrap(), back);
            let written = serde_json::to_string(&info).unwrap();
            assert!(written.find("\"z\"").unwrap() < written.find("\"timestamp\"").unwrap(), "{written}");
        }
        let nameless = text.replace(r#","names":["a","b"]"#, "");
        assert_eq!(Info::parse(nameless.as_bytes(), Path::new("x")).unwrap().skipped, []);
    }

    #[test]
    fn channels_may_come_first_or_last() {
        let size = |shape: &[usize], names: &[&str]| {
            let shape = shape.to_vec();
            Feature { shape, names: names.to_vec().into(), ..Feature::image(1, 1) }.image_size()
        };
        assert_eq!(size(&[3, 24, 32], &["channels", "height", "width"]), Some((24, 32)));
        assert_eq!(size(&[3, 24, 32], &[]), Some((24, 32)));
        assert_eq!(size(&[24, 32, 3], &["height", "width", "channel"]), Some((24, 32)));
        assert_eq!(size(&[3, 32, 3], &["channel", "height", "width"]), Some((32, 3)));
        assert_eq!(size(&[3, 32, 3], &["height", "width", "channel"]), Some((3, 32)));
        assert_eq!(size(&[24, 32, 1], &[]), None);
        assert_eq!(Feature::vector(&["a"]).image_size(), None);
    }

    #[test]
    fn paths_stay_in_the_dataset() {
        for path in
            ["/etc/{chunk_index:03d}{file_index:03d}", "../{chunk_index:03d}/{file_index:03d}", "data/x"]
        {
            assert!(refusal(|v| v["data_path"] = path.into()).contains("data_path"), "{path}");
        }
        assert_eq!(info().data_file(1, 22).unwrap(), Path::new("data/chunk-001/file-022.parquet"));
        for name in ["a/b", "..", ""] {
            let features = vec![(name.to_owned(), Feature::scalar(Dtype::Bool))];
            assert!(matches!(Info::new(20.0, None, features), Err(Error::Column { .. })), "{name}");
        }
        let twice = vec![("timestamp".to_owned(), Feature::scalar(Dtype::Float32))];
        assert!(Info::new(20.0, None, twice).is_err());
    }

    #[test]
    fn files_are_counted_as_lerobot_counts_them() {
        assert_eq!(info().next_file((0, 998)), (0, 999));
        assert_eq!(info().next_file((0, 999)), (1, 0));
    }
}
