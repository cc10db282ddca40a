//! Folders as this project and LeRobot write them, in which one file at a time is replaced.

use e2h_core::{Direction, Episode, Frames, Observation, Origin};
use e2h_data::lerobot::{Column, Dtype, Feature, Table, Writer, encode_png, features_of, to_table};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// The files of [`dataset`].
pub const DATA: &str = "data/chunk-000/file-000.parquet";
pub const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";
pub const TASKS: &str = "meta/tasks.parquet";
pub const INFO: &str = "meta/info.json";
pub const STATS: &str = "meta/stats.json";

/// An episode of this project: a few rows with one camera.
pub fn episode(index: u32) -> Episode {
    let mut e = Episode::new(Origin::demonstration("put it on", Direction::Easy, index, 7), &[]);
    for t in 0..3 {
        let state = std::array::from_fn(|i| (t * 15 + i) as f32 * 0.25 - index as f32);
        e.push(&Observation { state, frames: vec![] }, &std::array::from_fn(|i| i as f32 - t as f32))
            .expect("a row");
    }
    let bytes: Vec<u8> = (0..3 * 4 * 5 * 3).map(|i| (i * 7 % 251) as u8).collect();
    e.frames.push(Frames::new("table", 4, 5, &bytes));
    e
}

/// Two episodes of this project in one file and a third in another, with a matrix and a text besides.
fn dataset(root: &Path) {
    let mut features = features_of(&episode(0));
    features.push(("matrix".to_owned(), Feature { shape: vec![2, 2], ..Feature::scalar(Dtype::Float64) }));
    features.push(("note".to_owned(), Feature::scalar(Dtype::String)));
    let mut writer = Writer::create(root, 20.0, Some("arm"), features).expect("a dataset");
    for index in 0..3 {
        let mut table = to_table(&episode(index), &[]).expect("a table");
        table.columns.push(("matrix".to_owned(), Column::F64((0..12).map(f64::from).collect())));
        let notes = ["a", "", "long enough to matter"].map(str::to_owned).to_vec();
        table.columns.push(("note".to_owned(), Column::Text(notes)));
        writer.push(&table, if index == 1 { "take it off" } else { "put it on" }).expect("an episode");
        if index == 1 {
            writer.commit().expect("a commit");
        }
    }
    writer.finish().expect("a dataset");
}

/// Three episodes of a robot with few columns, of every kind of number: small, so that many inputs are tried.
fn small(root: &Path) {
    let features = vec![
        ("observation.state".to_owned(), Feature::vector(&["x", "y"])),
        ("camera".to_owned(), Feature::image(2, 3)),
        ("matrix".to_owned(), Feature { shape: vec![2, 1], ..Feature::scalar(Dtype::Float64) }),
        ("small".to_owned(), Feature::scalar(Dtype::Int8)),
        ("next.success".to_owned(), Feature::scalar(Dtype::Bool)),
        ("note".to_owned(), Feature::scalar(Dtype::String)),
    ];
    let mut writer = Writer::create(root, 20.0, Some("arm"), features).expect("a dataset");
    for index in 0..3_u8 {
        let png = |t: u8| encode_png(2, 3, &[t + index; 18]).expect("an image");
        let columns = vec![
            ("observation.state".to_owned(), Column::F32([0.5, -0.5, 1.5, f32::from(index)].to_vec())),
            ("camera".to_owned(), Column::Png(vec![png(1), png(2)])),
            ("matrix".to_owned(), Column::F64(vec![1.0, 2.0, 3.0, 4.0])),
            ("small".to_owned(), Column::I64(vec![-128, index.into()])),
            ("next.success".to_owned(), Column::Bool(vec![false, true])),
            ("note".to_owned(), Column::Text(vec!["a".to_owned(), "a longer note".to_owned()])),
        ];
        let task = if index == 1 { "take it off" } else { "put it on" };
        writer.push(&Table { rows: 2, columns }, task).expect("an episode");
        if index == 1 {
            writer.commit().expect("a commit");
        }
    }
    writer.finish().expect("a dataset");
}

/// A folder that is made whole again after every input.
pub struct Scratch {
    folder: TempDir,
    files: BTreeMap<PathBuf, Vec<u8>>,
}

impl Scratch {
    /// A folder that `make` fills.
    pub fn new(make: impl FnOnce(&Path)) -> Self {
        let folder = tempfile::Builder::new().prefix("e2h-fuzz-").tempdir().expect("a folder");
        let root = folder.path().join("set");
        std::fs::create_dir(&root).expect("a folder");
        make(&root);
        let files =
            files(&root).into_iter().map(|p| (p.clone(), std::fs::read(&p).expect("a file"))).collect();
        Self { folder, files }
    }

    /// Episodes of this project, with two further columns.
    pub fn dataset() -> Self {
        Self::new(dataset)
    }

    /// Few columns.
    pub fn small_dataset() -> Self {
        Self::new(small)
    }

    /// What LeRobot 0.4.4 wrote: `dataset`, or a policy, `state`.
    pub fn lerobot(name: &str) -> Self {
        let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../golden/lerobot").join(name);
        Self::new(|root| {
            for file in files(&golden) {
                let copy = root.join(file.strip_prefix(&golden).expect("a file below it"));
                std::fs::create_dir_all(copy.parent().expect("a folder")).expect("a folder");
                std::fs::copy(&file, copy).expect("a copy");
            }
        })
    }

    pub fn root(&self) -> PathBuf {
        self.folder.path().join("set")
    }

    /// The file as it was made.
    pub fn file(&self, name: &str) -> &[u8] {
        &self.files[&self.root().join(name)]
    }

    /// Runs `read` on the folder with some files replaced. `written` tells that it writes, and all has to be put back.
    pub fn with(&self, replaced: &[(&str, &[u8])], written: bool, read: impl FnOnce(&Path)) {
        let root = self.root();
        for (name, bytes) in replaced {
            std::fs::write(root.join(name), bytes).expect("a file");
        }
        read(&root);
        if written {
            for path in files(&root) {
                if !self.files.contains_key(&path) {
                    std::fs::remove_file(&path).expect("removed");
                }
            }
            self.files.iter().for_each(|(path, bytes)| std::fs::write(path, bytes).expect("a file"));
        } else {
            for (name, _) in replaced {
                std::fs::write(root.join(name), self.file(name)).expect("a file");
            }
        }
    }
}

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
        let path = entry.path();
        if path.is_dir() { found.extend(files(&path)) } else { found.push(path) }
    }
    found
}
