//! Demonstrations that a run is given: a dataset of the easy task in place of what the scripted demonstrator would record.

use crate::config::RunConfig;
use crate::{Error, Result};
use e2h_core::{CONTROL_HZ, Direction, Episode, Image, ImageStore, Kind};
use e2h_data::HandRecording;
use e2h_data::lerobot::{Dataset, misfits};
use e2h_env::Task;
use e2h_report::folder::Given;
use std::borrow::Cow;
use std::path::{Path, PathBuf};

/// Problems of single episodes that are listed; more are counted.
const MOST_LISTED: usize = 12;
/// How far the length of a quaternion may be from 1.
const UNIT: f32 = 1e-2;

/// A dataset that fits the run, and which of its episodes the run takes.
pub(super) struct GivenDataset {
    root: PathBuf,
    dataset: Dataset,
    chosen: Vec<usize>,
    cameras: Vec<String>,
    side: usize,
    pub(super) given: Given,
}

impl GivenDataset {
    /// Looks at every byte of the dataset at `root`: does it fit this configuration, with what these cameras see? Of `asked` successful
    /// episodes the first are taken; of none, all.
    ///
    /// # Errors
    /// [`Error::Given`] lists all that does not fit.
    pub(super) fn open(
        root: &Path,
        config: &RunConfig,
        task: &dyn Task,
        cameras: &[String],
        asked: Option<usize>,
    ) -> Result<Self> {
        let refused = |problems| Error::Given { path: root.to_owned(), problems };
        let dataset = Dataset::open(root).map_err(|e| refused(vec![e.to_string()]))?;
        let recording = HandRecording::read(root).map_err(|e| refused(vec![e.to_string()]))?;
        let side = config.env.image_size;
        let sizes: Vec<_> = cameras.iter().map(|name| (name.clone(), side, side)).collect();
        let mut problems = misfits(dataset.info(), CONTROL_HZ, &sizes, true);
        problems.extend(recording.iter().flat_map(|r| other_scene(r, config, task)));
        let mut chosen = vec![];
        if dataset.is_empty() {
            problems.push("no episodes".to_owned());
        } else if problems.is_empty() {
            // Of another layout no episode can be read.
            chosen = successes(&dataset, config, &mut problems);
            let wanted = asked.unwrap_or(1);
            if chosen.len() < wanted && problems.is_empty() {
                problems.push(format!("successful episodes: expected {wanted}, found {}", chosen.len()));
            }
        }
        if !problems.is_empty() {
            return Err(refused(problems));
        }
        let successful = chosen.len();
        chosen.truncate(asked.unwrap_or(successful));
        let larger = sizes.iter().any(|(name, ..)| {
            let feature = dataset.info().features.iter().find(|(n, _)| n.strip_prefix(IMAGES) == Some(name));
            feature.and_then(|(_, f)| f.image_size()).is_some_and(|size| size != (side, side))
        });
        // Of a person's, where all of their times are known.
        let seconds = recording.and_then(|r| {
            let of = |i: &usize| r.takes.iter().find(|t| t.episode == *i).map(|t| t.seconds);
            chosen.iter().map(of).sum::<Option<f64>>()
        });
        let given = Given {
            from: e2h_core::one_line(&root.display().to_string()),
            sha256: crate::digest::of_dataset(root)?,
            episodes: chosen.len(),
            of: dataset.len(),
            resized: larger,
            seconds,
        };
        Ok(Self { root: root.to_owned(), dataset, chosen, cameras: cameras.to_vec(), side, given })
    }

    /// The episodes, with the images that the run's cameras would have.
    ///
    /// # Errors
    /// When they cannot be read, or the dataset is no longer what it was.
    pub(super) fn read(&self, images: &ImageStore) -> Result<Vec<Episode>> {
        let mut episodes = vec![];
        for &i in &self.chosen {
            let mut episode = self.dataset.read_episode(i)?;
            self.fit_images(&mut episode)?;
            episode.store_images(images)?;
            episodes.push(episode);
        }
        let found = crate::digest::of_dataset(&self.root)?;
        if found != self.given.sha256 {
            let (expected, quantity) = (self.given.sha256.clone(), "SHA-256 of the dataset".to_owned());
            return Err(Error::Foreign { path: self.root.clone(), quantity, expected, found });
        }
        Ok(episodes)
    }

    /// The run's cameras in their order, in the run's size.
    fn fit_images(&self, episode: &mut Episode) -> Result<()> {
        let mut all = std::mem::take(&mut episode.frames);
        for camera in &self.cameras {
            let Some(at) = all.iter().position(|f| f.camera == *camera) else { continue };
            let mut frames = all.swap_remove(at);
            let side = self.side;
            if (frames.height, frames.width) != (side, side) {
                for pixels in &mut frames.images {
                    let data = pixels.read().map(Cow::into_owned)?;
                    let whole = Image { height: frames.height, width: frames.width, data };
                    *pixels = e2h_data::resize_image(&whole, side, side)?.data.into();
                }
                (frames.height, frames.width) = (side, side);
            }
            episode.frames.push(frames);
        }
        Ok(())
    }
}

/// What the column of a camera is called before its name.
const IMAGES: &str = "observation.images.";

/// In what the scene of a recording differs from the run's.
fn other_scene(recording: &HandRecording, config: &RunConfig, task: &dyn Task) -> Vec<String> {
    let mut problems = vec![];
    let mut same = |what: &str, expected: String, found: String| {
        if expected != found {
            problems
                .push(format!("recorded {what}: expected {expected}, found {}", e2h_core::one_line(&found)));
        }
    };
    same("task", task.name().to_owned(), recording.task.clone());
    same("variant", task.variant().to_owned(), recording.variant.clone());
    same("clearance", config.task.clearance.to_string(), recording.clearance.to_string());
    same("direction", Direction::Easy.to_string(), recording.direction.to_string());
    problems
}

/// Episodes that succeeded; what is wrong with any is added to the problems.
fn successes(dataset: &Dataset, config: &RunConfig, problems: &mut Vec<String>) -> Vec<usize> {
    let mut found: Vec<(String, Vec<usize>)> = vec![];
    let mut chosen = vec![];
    for i in 0..dataset.len() {
        let wrong = match dataset.read_episode(i) {
            Err(e) => vec![e.to_string()],
            Ok(episode) => {
                if episode.outcome.is_success() {
                    chosen.push(i);
                }
                faults(&episode, &config.task.name)
            }
        };
        for problem in wrong {
            match found.iter_mut().find(|(p, _)| *p == problem) {
                Some((_, episodes)) => episodes.push(i),
                None => found.push((problem, vec![i])),
            }
        }
    }
    let more = found.len().saturating_sub(MOST_LISTED);
    for (problem, episodes) in found.iter().take(MOST_LISTED) {
        problems.push(match &episodes[..] {
            [i] => format!("episode {i}: {problem}"),
            [first, .., last] => format!("{} episodes from {first} to {last}: {problem}", episodes.len()),
            [] => continue,
        });
    }
    if more > 0 {
        problems.push(format!("and {more} more problems of episodes"));
    }
    chosen
}

/// What keeps an episode from being a demonstration of the easy task of `task`.
fn faults(episode: &Episode, task: &str) -> Vec<String> {
    let mut faults = vec![];
    let origin = &episode.origin;
    if origin.task != task {
        faults.push(format!("task: expected `{task}`, found `{}`", e2h_core::one_line(&origin.task)));
    }
    if (origin.direction, origin.reversed) != (Direction::Easy, false) {
        let turned = if origin.reversed { "reversed " } else { "" };
        faults.push(format!("direction: expected easy, found {turned}{}", origin.direction));
    }
    if origin.kind != Kind::Demonstration || !episode.terminal {
        let found = if episode.terminal {
            format!("{:?}", origin.kind).to_lowercase()
        } else {
            "a piece of one".to_owned()
        };
        faults.push(format!("kind: expected a whole demonstration, found {found}"));
    }
    let unit = |q: &[f32]| (q.iter().map(|v| v * v).sum::<f32>().sqrt() - 1.0).abs() < UNIT;
    if episode.state.iter().any(|s| !unit(&s[3..7]) || !unit(&s[10..14])) {
        faults.push("observation.state: expected quaternions of length 1, found others".to_owned());
    }
    if episode.action.iter().any(|a| !unit(&a[3..7])) {
        faults.push("action: expected quaternions of length 1, found others".to_owned());
    }
    if episode.action.iter().any(|a| !(0.0..=1.0).contains(&a[7])) {
        faults.push("action: expected gripper commands of 0 to 1, found others".to_owned());
    }
    faults
}
