//! The dataset that takes go into: each is whole on the disk before the next begins.

use crate::{Error, Result};
use e2h_core::{CONTROL_HZ, Direction, Episode};
use e2h_data::lerobot::{Dataset, Features, Writer, features, misfits};
use e2h_data::{HandRecording, RECORDING_FILE, Take};
use e2h_env::Task;
use std::fs::File;
use std::path::{Path, PathBuf};

/// The robot's name in datasets.
const ROBOT: &str = "panda";
/// Held by the process that records.
const LOCK: &str = "recording.lock";
/// Begins the name of a file on its way to its place.
const UNFINISHED: &str = ".new-";

/// A dataset of takes, new or gone on with.
#[derive(Debug)]
pub struct Store {
    root: PathBuf,
    features: Features,
    recording: HandRecording,
    episodes: usize,
    next: u32,
    /// Held as long as the store is there; none on file systems without locks.
    _lock: Option<File>,
}

impl Store {
    /// Makes the folder, or goes on with the dataset in it, which has to be of the same task, direction, scene and layout.
    ///
    /// # Errors
    /// [`Error::Folder`] lists all that does not fit. Nothing has changed then.
    pub fn open(
        root: &Path,
        task: &dyn Task,
        clearance: f64,
        direction: Direction,
        cameras: &[(String, usize, usize)],
    ) -> Result<Self> {
        let recording = HandRecording {
            task: task.name().to_owned(),
            variant: task.variant().to_owned(),
            clearance,
            direction,
            takes: vec![],
        };
        let features = features(cameras);
        let mut this = Self { root: root.to_owned(), features, recording, episodes: 0, next: 0, _lock: None };
        let problems = if this.has_dataset() { this.go_on(cameras)? } else { foreign(root) };
        if !problems.is_empty() {
            return Err(Error::Folder { path: root.to_owned(), problems });
        }
        std::fs::create_dir_all(root).map_err(io(root))?;
        this._lock = lock(root)?;
        Ok(this)
    }

    fn has_dataset(&self) -> bool {
        self.root.join("meta/info.json").exists()
    }

    /// Takes up what is there; what does not fit.
    fn go_on(&mut self, cameras: &[(String, usize, usize)]) -> Result<Vec<String>> {
        let dataset = match Dataset::open(&self.root) {
            Ok(dataset) => dataset,
            Err(e) => return Ok(vec![e.to_string()]),
        };
        let mut problems = misfits(dataset.info(), CONTROL_HZ, cameras, false);
        for (name, _) in dataset.info().own_features() {
            if !self.features.iter().any(|(n, _)| *n == name) {
                problems.push(format!("feature `{}`: expected none, found one", e2h_core::one_line(&name)));
            }
        }
        let wanted = &self.recording;
        let mut same = |what: &str, expected: &str, found: &str| {
            if expected != found {
                problems.push(format!("{what}: expected {expected}, found {}", e2h_core::one_line(found)));
            }
        };
        for task in dataset.tasks() {
            same("task", &wanted.task, task);
        }
        let mut takes = vec![];
        if let Some(found) = HandRecording::read(&self.root)? {
            same("recorded task", &wanted.task, &found.task);
            same("variant", &wanted.variant, &found.variant);
            same("clearance", &wanted.clearance.to_string(), &found.clearance.to_string());
            same("direction", wanted.direction.name(), found.direction.name());
            takes = found.takes;
        }
        if problems.is_empty()
            && let Some(last) = dataset.len().checked_sub(1)
        {
            let origin = dataset.read_episode(last)?.origin;
            if origin.direction != self.recording.direction {
                let expected = self.recording.direction;
                problems.push(format!("direction: expected {expected}, found {}", origin.direction));
            }
            self.next = origin.episode + 1;
        }
        // What a killed process had noted of an episode that did not come about.
        takes.retain(|t| t.episode < dataset.len());
        (self.episodes, self.recording.takes) = (dataset.len(), takes);
        Ok(problems)
    }

    /// Episodes in the dataset.
    #[must_use]
    pub fn episodes(&self) -> usize {
        self.episodes
    }

    /// The number of the first take that is not in the dataset.
    #[must_use]
    pub fn next(&self) -> u32 {
        self.next
    }

    /// What is known of the takes.
    #[must_use]
    pub fn takes(&self) -> &[Take] {
        &self.recording.takes
    }

    /// Where it is.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Makes an episode part of the dataset. `take` says how long it took; its number is filled in.
    ///
    /// # Errors
    /// When the file system refuses. The dataset is then as it was, and the same episode can be saved again.
    pub fn save(&mut self, episode: &Episode, take: Take) -> Result<()> {
        // First, so that a dataset never lacks the scene that it was recorded in.
        self.recording.write(&self.root)?;
        // Anew each time: a writer that failed half way is not gone on with.
        let mut writer = if self.has_dataset() {
            Writer::append(&self.root)?
        } else {
            Writer::create(&self.root, CONTROL_HZ, Some(ROBOT), self.features.clone())?
        };
        writer.push_episode(episode)?;
        writer.commit()?;
        let take = Take { episode: self.episodes, ..take };
        self.episodes += 1;
        self.next = self.next.max(episode.origin.episode + 1);
        self.recording.takes.push(take);
        // The episode is safe by now; times that could not be written go with the next ones.
        drop(self.recording.write(&self.root));
        Ok(())
    }
}

/// What lies in a folder without a dataset that no recording has left there.
fn foreign(root: &Path) -> Vec<String> {
    let ours =
        |name: &str| ["meta", "data", RECORDING_FILE, LOCK].contains(&name) || name.starts_with(UNFINISHED);
    let entries = match std::fs::read_dir(root) {
        Ok(entries) => entries,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return vec![],
        Err(e) => return vec![e.to_string()],
    };
    let names = entries.flatten().map(|e| e.file_name().to_string_lossy().into_owned());
    let found = names
        .filter(|n| !ours(n))
        .map(|n| format!("expected a new folder or a dataset, found `{}`", e2h_core::one_line(&n)));
    found.take(1).collect()
}

fn lock(root: &Path) -> Result<Option<File>> {
    let path = root.join(LOCK);
    let file = File::options().write(true).create(true).truncate(false).open(&path).map_err(io(&path))?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(std::fs::TryLockError::WouldBlock) => Err(Error::Busy(root.to_owned())),
        Err(std::fs::TryLockError::Error(e)) if e.kind() == std::io::ErrorKind::Unsupported => Ok(None),
        Err(std::fs::TryLockError::Error(e)) => Err(io(&path)(e)),
    }
}

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { path, source }
}
