//! The folder of a training: LeRobot's layout, written so that a kill at any instant leaves it usable.

use super::{DatasetRecord, ImitationConfig, ImitationOptions};
use crate::directory::{TRAINING, io, lock, sync, write_atomic};
use crate::{Error, Result};
use e2h_report::folder::{read_json, sealed};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Version of the folder's layout.
const LAYOUT: u32 = 1;
const IDENTITY_FILE: &str = "training.json";
const CONFIG_FILE: &str = "config.toml";
const METRICS_FILE: &str = "metrics.jsonl";
const CHECKPOINTS: &str = "checkpoints";
const UNFINISHED: &str = ".unfinished";
/// Folder of a checkpoint that LeRobot opens.
pub(super) const POLICY: &str = "pretrained_model";
/// Folder of a checkpoint that a training goes on from.
pub(super) const STATE: &str = "training_state";

/// What a training is: `training.json`, written once.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Identity {
    format: u32,
    preset: String,
    seed: u64,
    datasets: Vec<DatasetRecord>,
}

impl Identity {
    pub(super) fn new(options: &ImitationOptions, datasets: Vec<DatasetRecord>) -> Self {
        Self { format: LAYOUT, preset: options.preset.clone(), seed: options.seed, datasets }
    }

    /// The first difference, in words.
    fn difference(&self, found: &Self) -> Option<(String, String, String)> {
        let same = |what: &str, a: String, b: String| (a != b).then(|| (what.to_owned(), a, b));
        let names = |i: &Self| {
            let one = |d: &DatasetRecord| format!("{}:{}", d.root, d.share);
            i.datasets.iter().map(one).collect::<Vec<_>>().join(" ")
        };
        same("layout version", self.format.to_string(), found.format.to_string())
            .or_else(|| same("preset", self.preset.clone(), found.preset.clone()))
            .or_else(|| same("seed", self.seed.to_string(), found.seed.to_string()))
            .or_else(|| same("datasets", names(self), names(found)))
            .or_else(|| {
                let mut pairs = self.datasets.iter().zip(&found.datasets);
                pairs.find_map(|(a, b)| {
                    let text = |d: &DatasetRecord| format!("{} episodes, SHA-256 {}", d.episodes, d.sha256);
                    same(&format!("dataset {}, which has changed", a.root), text(a), text(b))
                })
            })
            .or_else(|| (self != found).then(|| (IDENTITY_FILE.into(), "the same".into(), "another".into())))
    }
}

/// A line of `metrics.jsonl`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Metric {
    /// Steps done.
    pub(super) step: usize,
    /// Mean loss of the last hundred steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) loss: Option<f64>,
    /// Learning rate of the step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) lr: Option<f32>,
    /// Loss of the averaged weights on the held-out episodes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) validation_loss: Option<f64>,
}

/// A training's folder that is this process's own.
pub(super) struct Folder {
    path: PathBuf,
    _lock: Option<Arc<File>>,
}

impl Folder {
    pub(super) fn open(path: &Path, resume: bool, identity: &Identity, config: &str) -> Result<Self> {
        let file = path.join(IDENTITY_FILE);
        if resume && !file.exists() {
            return Err(Error::Nothing(path.to_owned()));
        }
        let occupied = path.exists()
            && std::fs::read_dir(path).map_err(io("reading", path))?.flatten().any(|e| {
                let name = e.file_name().to_string_lossy().into_owned();
                // What a process leaves that was killed at its first instant.
                !(name == "run.lock"
                    || name == CONFIG_FILE
                    || name.starts_with(".tmp")
                    || name.starts_with(".new-"))
            });
        if occupied && !resume {
            return Err(Error::Exists(path.to_owned()));
        }
        std::fs::create_dir_all(path).map_err(io("creating", path))?;
        let this = Self { path: path.to_owned(), _lock: lock(path)? };
        if let Some(found) = read_json::<Identity>(&file)? {
            if let Some((quantity, expected, found)) = identity.difference(&found) {
                return Err(Error::Foreign { path: path.to_owned(), quantity, expected, found });
            }
            let place = path.join(CONFIG_FILE);
            let text = e2h_data::read_text(&place).map_err(io("reading", &place))?;
            let (given, written) = (ImitationConfig::from_text(config)?, ImitationConfig::from_text(&text)?);
            if given != written {
                let line = config.lines().zip(text.lines()).find(|(a, b)| a != b);
                let (expected, found) = line.unwrap_or(("the configuration given", "another one"));
                return Err(Error::Foreign {
                    path: place,
                    quantity: "configuration".to_owned(),
                    expected: expected.to_owned(),
                    found: found.to_owned(),
                });
            }
        } else {
            write_atomic(&path.join(CONFIG_FILE), config.as_bytes())?;
            let text = serde_json::to_string_pretty(identity).map_err(|e| Error::Config(e.to_string()))?;
            write_atomic(&file, format!("{}\n", sealed(&text)).as_bytes())?;
        }
        this.sweep()?;
        Ok(this)
    }

    pub(super) fn join(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// The policy of `last` or `best`.
    pub(super) fn policy(&self, which: &str) -> PathBuf {
        self.path.join(CHECKPOINTS).join(which).join(POLICY)
    }

    /// Removes what killed processes left.
    fn sweep(&self) -> Result<()> {
        let folder = self.path.join(CHECKPOINTS);
        for (dir, depth) in [(&self.path, 0), (&folder, 1)] {
            let Ok(entries) = std::fs::read_dir(dir) else { continue };
            for entry in entries.flatten() {
                let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
                if depth == 1 && name.ends_with(UNFINISHED) && path.is_dir() {
                    std::fs::remove_dir_all(&path).map_err(io("removing", &path))?;
                } else if (name.starts_with(".tmp")
                    || name.starts_with(".new-")
                    || name.ends_with(UNFINISHED))
                    && !path.is_dir()
                {
                    std::fs::remove_file(&path).map_err(io("removing", &path))?;
                }
            }
        }
        Ok(())
    }

    /// Training state of the last checkpoint, and the metrics up to it.
    pub(super) fn last(&self) -> Result<Option<(PathBuf, Vec<Metric>)>> {
        let last = self.path.join(CHECKPOINTS).join("last");
        if !last.exists() {
            return Ok(None);
        }
        let path = last.join(METRICS_FILE);
        let text = e2h_data::read_text(&path).map_err(io("reading", &path))?;
        let parse = |line: &str| {
            serde_json::from_str(line).map_err(|e| Error::Foreign {
                path: path.clone(),
                quantity: "line".to_owned(),
                expected: "a metric".to_owned(),
                found: e2h_core::one_line(&format!("{line} ({e})")),
            })
        };
        let metrics = text.lines().map(parse).collect::<Result<_>>()?;
        Ok(Some((last.join(STATE).join(TRAINING), metrics)))
    }

    /// Puts a checkpoint of `step` that `write` makes in the folder it is given, and points `last` at it and `best` at that of its
    /// own step; others go.
    pub(super) fn put(
        &self,
        step: usize,
        best: usize,
        metrics: &[Metric],
        write: impl FnOnce(&Path) -> Result<()>,
    ) -> Result<()> {
        let root = self.path.join(CHECKPOINTS);
        std::fs::create_dir_all(&root).map_err(io("creating", &root))?;
        let name = |step: usize| format!("{step:06}");
        let mut lines = String::new();
        for metric in metrics {
            lines += &serde_json::to_string(metric).map_err(|e| Error::Config(e.to_string()))?;
            lines.push('\n');
        }
        let place = root.join(name(step));
        if place.exists() {
            // The best one, written a moment ago: only the metrics have grown.
            write_atomic(&place.join(METRICS_FILE), lines.as_bytes())?;
        } else {
            let beside = root.join(format!("{}{UNFINISHED}", name(step)));
            write(&beside)?;
            write_atomic(&beside.join(METRICS_FILE), lines.as_bytes())?;
            std::fs::rename(&beside, &place).map_err(io("renaming to", &place))?;
            sync(&root)?;
        }
        // A pointer is replaced in one go, and only ever points at a whole checkpoint.
        for (pointer, to) in [("best", best), ("last", step)] {
            let (to, pointer) = (name(to), root.join(pointer));
            if !root.join(&to).exists() {
                continue;
            }
            let beside = root.join(format!("{}{UNFINISHED}", to));
            if beside.symlink_metadata().is_ok() {
                std::fs::remove_file(&beside).map_err(io("removing", &beside))?;
            }
            std::os::unix::fs::symlink(&to, &beside).map_err(io("linking", &beside))?;
            std::fs::rename(&beside, &pointer).map_err(io("renaming to", &pointer))?;
        }
        sync(&root)?;
        write_atomic(&self.path.join(METRICS_FILE), lines.as_bytes())?;
        for entry in std::fs::read_dir(&root).map_err(io("reading", &root))?.flatten() {
            let (path, found) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
            let number = found.bytes().all(|b| b.is_ascii_digit());
            if number && ![name(step), name(best)].contains(&found) {
                std::fs::remove_dir_all(&path).map_err(io("removing", &path))?;
            }
        }
        Ok(())
    }
}
