//! Datasets as a training takes them: opened, compared, split, read.

use super::config::{DataConfig, ImageStatistics};
use crate::{Error, Result};
use e2h_core::{ImageStore, stream};
use e2h_data::lerobot::Dataset;
use e2h_data::{Layout, RecordedSource, Recording};
use e2h_policy::ImageScaling;
use e2h_policy::lerobot::IMAGENET;
use rand::seq::SliceRandom as _;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::Arc;

/// A dataset and its share of every batch, written `DIR` or `DIR:SHARE`.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetShare {
    /// Its folder.
    pub root: PathBuf,
    /// Share of every batch, relative to those of the others.
    pub share: f32,
}

impl FromStr for DatasetShare {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        // A folder may have a colon in its name; what follows the last one is a share only where it is a number.
        let split = text.rsplit_once(':').and_then(|(root, share)| Some((root, share.parse::<f32>().ok()?)));
        let (root, share) = split.filter(|_| !Path::new(text).exists()).unwrap_or((text, 1.0));
        if !(share > 0.0 && share.is_finite()) {
            return Err(Error::Config(format!("--dataset {text}: expected a share above 0, got {share}")));
        }
        Ok(Self { root: PathBuf::from(root), share })
    }
}

/// What a training says of a dataset that it learned from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DatasetRecord {
    /// Its folder, as it was given.
    pub root: String,
    /// Its share of every batch, relative to those of the others.
    pub share: f32,
    /// Episodes.
    pub episodes: usize,
    /// Rows.
    pub rows: usize,
    /// SHA-256 of the names and the contents of its files.
    pub sha256: String,
    /// Episodes that nothing is learned from.
    pub held_out: Vec<usize>,
}

/// Datasets that one policy can learn from.
pub(super) struct Opened {
    datasets: Vec<(Dataset, DatasetRecord)>,
    pub(super) layout: Arc<Layout>,
}

impl Opened {
    /// Opens all and compares them.
    pub(super) fn open(given: &[DatasetShare], config: &DataConfig, seed: u64) -> Result<Self> {
        if given.is_empty() {
            return Err(Error::Config("--dataset: expected at least one, got none".to_owned()));
        }
        let mut datasets = vec![];
        let mut layouts: Vec<Layout> = vec![];
        let mut problems = vec![];
        for (index, d) in given.iter().enumerate() {
            let name = d.root.display();
            let dataset = Dataset::open(&d.root)?;
            let layout = match Layout::of(dataset.info(), &config.cameras) {
                Ok(layout) => layout,
                Err(e2h_data::Error::Misfit { problems: found, .. }) => {
                    problems.extend(found.into_iter().map(|p| format!("{name}: {p}")));
                    continue;
                }
                Err(e) => return Err(e.into()),
            };
            let layout = match config.resize[..] {
                [rows, columns] => layout.resized((rows, columns)),
                _ => layout,
            };
            if let Some(first) = layouts.first() {
                let found = first.differences(&layout);
                problems.extend(
                    found.into_iter().map(|p| format!("{name} beside {}: {p}", given[0].root.display())),
                );
            }
            layouts.push(layout);
            let held_out = held_out(dataset.len(), config.validation, seed, index);
            if held_out.len() >= dataset.len() {
                problems.push(format!(
                    "{name}: expected at least {} episodes for data.validation {}, found {}",
                    1 + held_out.len().max(1),
                    config.validation,
                    dataset.len()
                ));
            }
            let record = DatasetRecord {
                root: name.to_string(),
                share: d.share,
                episodes: dataset.len(),
                rows: dataset.info().total_frames,
                sha256: String::new(),
                held_out,
            };
            datasets.push((dataset, record));
        }
        if !problems.is_empty() {
            return Err(Error::Config(problems.join("; ")));
        }
        for (dataset, record) in &mut datasets {
            record.sha256 = crate::digest::of_dataset(dataset.root())?;
        }
        let layout = Arc::new(layouts.swap_remove(0));
        Ok(Self { datasets, layout })
    }

    pub(super) fn records(&self) -> Vec<DatasetRecord> {
        self.datasets.iter().map(|(_, r)| r.clone()).collect()
    }

    /// Episodes in all.
    pub(super) fn episodes(&self) -> usize {
        self.datasets.iter().map(|(d, _)| d.len()).sum()
    }

    /// All tasks, once each.
    pub(super) fn tasks(&self) -> Vec<String> {
        let mut all: Vec<String> = vec![];
        for task in self.datasets.iter().flat_map(|(d, _)| d.tasks()) {
            if !all.contains(task) {
                all.push(task.clone());
            }
        }
        all
    }

    /// Reads all episodes, images into `store`: what is learned from, and what is held out. `read` hears of each.
    pub(super) fn read(
        &self,
        store: &ImageStore,
        mut read: impl FnMut() -> Result<()>,
    ) -> Result<(Vec<RecordedSource>, Vec<RecordedSource>)> {
        let (mut learned, mut held) = (vec![], vec![]);
        for (dataset, record) in &self.datasets {
            let (mut mine, mut kept) = (vec![], vec![]);
            for episode in 0..dataset.len() {
                let recording = Arc::new(Recording::read(dataset, episode, &self.layout, store)?);
                if record.held_out.contains(&episode) { &mut kept } else { &mut mine }.push(recording);
                read()?;
            }
            learned.push(RecordedSource { recordings: mine, share: record.share });
            held.push(RecordedSource { recordings: kept, share: record.share });
        }
        Ok((learned, held))
    }
}

/// Episodes that are held out, drawn from the run's seed.
fn held_out(episodes: usize, share: f32, seed: u64, dataset: usize) -> Vec<usize> {
    if share <= 0.0 {
        return vec![];
    }
    let mut all: Vec<usize> = (0..episodes).collect();
    all.shuffle(&mut stream(seed, "held out", 0, dataset as u64));
    // Far below 2^24 episodes.
    let count = ((episodes as f32 * share).round() as usize).max(1);
    all.truncate(count);
    all.sort_unstable();
    all
}

/// Images of each camera that the statistics are of.
const SAMPLED: usize = 200;

/// Scaling of each camera's images.
pub(super) fn image_scaling(
    sources: &[RecordedSource],
    layout: &Layout,
    kind: ImageStatistics,
) -> Result<Vec<ImageScaling>> {
    match kind {
        ImageStatistics::None => return Ok(vec![]),
        ImageStatistics::Imagenet => return Ok(vec![IMAGENET; layout.cameras.len()]),
        ImageStatistics::Dataset => {}
    }
    let rows: Vec<(&Recording, usize)> = sources
        .iter()
        .flat_map(|s| &s.recordings)
        .flat_map(|r| (0..r.len()).map(move |t| (&**r, t)))
        .collect();
    let every = rows.len().div_ceil(SAMPLED).max(1);
    let one = |camera: usize| -> Result<ImageScaling> {
        let (mut n, mut sum, mut squares) = (0.0_f64, [0.0_f64; 3], [0.0_f64; 3]);
        for (recording, row) in rows.iter().step_by(every) {
            for pixel in recording.frames()[camera].image(*row)?.as_chunks::<3>().0 {
                n += 1.0;
                for c in 0..3 {
                    let v = f64::from(pixel[c]) / 255.0;
                    (sum[c], squares[c]) = (sum[c] + v, squares[c] + v * v);
                }
            }
        }
        let mean = sum.map(|s| s / n.max(1.0));
        // A camera that sees one colour is shifted and not blown up.
        let std = [0, 1, 2].map(|c| (squares[c] / n.max(1.0) - mean[c] * mean[c]).max(0.0).sqrt().max(0.01));
        Ok(ImageScaling { mean: mean.map(|v| v as f32), std: std.map(|v| v as f32) })
    };
    (0..layout.cameras.len()).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_follows_the_last_colon_where_it_is_a_number() {
        let parse = |text: &str| text.parse::<DatasetShare>();
        assert_eq!(parse("a/b").unwrap(), DatasetShare { root: "a/b".into(), share: 1.0 });
        assert_eq!(parse("a/b:0.5").unwrap(), DatasetShare { root: "a/b".into(), share: 0.5 });
        assert_eq!(parse("a:b").unwrap().root, PathBuf::from("a:b"));
        for bad in ["a:0", "a:-1", "a:NaN", "a:inf"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn held_out_episodes_are_the_same_for_a_seed_and_at_least_one() {
        assert_eq!(held_out(50, 0.1, 3, 0).len(), 5);
        assert_eq!(held_out(50, 0.1, 3, 0), held_out(50, 0.1, 3, 0));
        assert_ne!(held_out(50, 0.1, 3, 0), held_out(50, 0.1, 4, 0));
        assert_eq!(held_out(3, 0.1, 0, 0).len(), 1);
        assert!(held_out(3, 0.0, 0, 0).is_empty());
    }
}
