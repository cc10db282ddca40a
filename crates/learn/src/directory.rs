//! The run directory: what is in it, and how it is written so that a kill at any instant leaves it usable.

use crate::config::{Resolved, RunConfig};
use crate::{Error, Result};
use e2h_core::{Episode, ImageStore};
use e2h_data::lerobot::{Dataset, Writer, features_of};
use e2h_env::Task;
use e2h_report::folder::{
    Given, IDENTITY_FILE, Identity, LAYOUT, SUMS_FILE, compare, read_json, sealed, sha256,
};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::borrow::Borrow;
use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::io::{Read as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The robot's name in datasets.
const ROBOT: &str = "panda";
/// Beside the folders of a dataset: what this project knows of it.
const NOTES: &str = "notes.json";
/// State of a training in progress, in the folder of its policy.
pub(crate) const TRAINING: &str = "training.safetensors";
/// Ends the name of a dataset that is being written.
const UNFINISHED: &str = ".unfinished";
/// Begin the names of files on their way to their place, of this crate and of e2h-data.
const TEMPORARY: [&str; 2] = [".tmp", ".new-"];
/// Folders below a run's that it writes into: `iteration_NN/segments/data/chunk-000`, and one more.
const DEEPEST: usize = 5;

/// A run directory that is this run's own.
#[derive(Debug, Clone)]
pub(crate) struct Directory {
    path: PathBuf,
    /// Images of all episodes that the run keeps: rounds of them are gigabytes, and training wants a few of them at a time.
    images: ImageStore,
    /// Held as long as this process works in it; none for one that only reads, and on file systems that have no locks.
    _lock: Option<Arc<File>>,
}

/// Names the process that works in the folder; locked, which ends with the process however it ends.
const LOCK: &str = "run.lock";

/// # Errors
/// [`Error::Busy`] names the process that works here already.
pub(crate) fn lock(folder: &Path) -> Result<Option<Arc<File>>> {
    let place = folder.join(LOCK);
    // Not truncated here: until the lock is ours the words are another's.
    let opened = File::options().read(true).write(true).create(true).truncate(false).open(&place);
    let mut file = opened.map_err(io("locking", &place))?;
    match file.try_lock() {
        Ok(()) => {}
        Err(TryLockError::WouldBlock) => {
            let mut owner = String::new();
            // Words that cannot be read leave the message without a number.
            let _ = (&file).take(200).read_to_string(&mut owner);
            let owner = if owner.trim().is_empty() { "another process" } else { owner.trim() };
            return Err(Error::Busy { path: folder.to_owned(), owner: e2h_core::one_line(owner) });
        }
        // Some network file systems have no locks; a run there is as safe as it was without.
        Err(TryLockError::Error(e)) if e.kind() == std::io::ErrorKind::Unsupported => return Ok(None),
        Err(TryLockError::Error(e)) => return Err(io("locking", &place)(e)),
    }
    file.set_len(0).map_err(io("writing", &place))?;
    writeln!(file, "process {}", std::process::id()).map_err(io("writing", &place))?;
    Ok(Some(Arc::new(file)))
}

/// Removes what killed processes of this run left: files on their way to their place, datasets on theirs, and training states of
/// stages that are done.
fn sweep(folder: &Path, depth: usize) -> Result<()> {
    for entry in std::fs::read_dir(folder).map_err(io("reading", folder))?.flatten() {
        let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
        let Ok(kind) = entry.file_type() else { continue };
        let done = || folder.join("notes.json").exists();
        if kind.is_file()
            && (TEMPORARY.iter().any(|p| name.starts_with(p))
                || ([TRAINING, "training.json"].contains(&&*name) && done()))
        {
            std::fs::remove_file(&path).map_err(io("removing", &path))?;
        } else if kind.is_dir() && name.ends_with(UNFINISHED) {
            std::fs::remove_dir_all(&path).map_err(io("removing", &path))?;
        } else if kind.is_dir() && depth > 0 {
            sweep(&path, depth - 1)?;
        }
    }
    Ok(())
}

pub(crate) fn io(doing: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { doing, path, source }
}

/// Writes beside the place, syncs, renames; makes the folder when it is not there.
pub(crate) fn write_atomic(path: &Path, bytes: &[u8]) -> Result<()> {
    Ok(e2h_data::write_atomic(path, bytes)?)
}

pub(crate) fn sync(dir: &Path) -> Result<()> {
    File::open(dir).and_then(|d| d.sync_all()).map_err(io("syncing", dir))
}

/// Regular files and folders of theirs, each synced; what else lies there, and what is on its way to its place, is left out.
fn copy_folder(from: &Path, to: &Path, depth: usize) -> Result<()> {
    std::fs::create_dir_all(to).map_err(io("creating", to))?;
    for entry in std::fs::read_dir(from).map_err(io("reading", from))?.flatten() {
        let (path, name) = (entry.path(), entry.file_name());
        let Ok(kind) = entry.file_type() else { continue };
        let own = name.to_string_lossy();
        if TEMPORARY.iter().any(|t| own.starts_with(t)) || own.ends_with(UNFINISHED) {
            continue;
        }
        let place = to.join(&name);
        if kind.is_file() {
            std::fs::copy(&path, &place).map_err(io("copying", &path))?;
            File::open(&place).and_then(|f| f.sync_all()).map_err(io("syncing", &place))?;
        } else if kind.is_dir() && depth > 0 {
            copy_folder(&path, &place, depth - 1)?;
        }
    }
    sync(to)
}

/// What a configuration of a run differs in from the one given; values count, not how they are written.
enum Difference {
    None,
    Iterations,
    More,
}

fn difference(written: &str, given: &Resolved, task: &dyn Task) -> Result<Difference> {
    let (mut a, b) = (RunConfig::from_text(&given.preset, written)?.config, &given.config);
    a.know(task);
    if a == *b {
        return Ok(Difference::None);
    }
    a.closed_loop.iterations = b.closed_loop.iterations;
    Ok(if a == *b { Difference::Iterations } else { Difference::More })
}

impl Directory {
    /// Makes a new run directory, or goes on with one of the same run.
    pub(crate) fn open(
        path: &Path,
        resume: bool,
        identity: &Identity,
        resolved: &Resolved,
        task: &dyn Task,
    ) -> Result<Self> {
        let file = path.join(IDENTITY_FILE);
        if resume && !path.exists() {
            return Err(Error::Nothing(path.to_owned()));
        }
        // A folder without run.json is a run that was killed at its first instant, or somebody else's.
        let temporary = |name: &str| TEMPORARY.iter().any(|t| name.starts_with(t));
        let ours = |name: &str| name == "config.toml" || name == LOCK || temporary(name);
        let foreign = path.exists()
            && !file.exists()
            && std::fs::read_dir(path)
                .map_err(io("reading", path))?
                .flatten()
                .any(|e| !ours(&e.file_name().to_string_lossy()));
        if foreign || (file.exists() && !resume) {
            return Err(Error::Exists(path.to_owned()));
        }
        std::fs::create_dir_all(path).map_err(io("creating", path))?;
        let lock = lock(path)?;
        let this = Self { path: path.to_owned(), images: ImageStore::create(path)?, _lock: lock };
        sweep(path, DEEPEST)?;
        if !file.exists() {
            write_atomic(&path.join("config.toml"), resolved.text.as_bytes())?;
            this.put(IDENTITY_FILE, identity)?;
            return Ok(this);
        }
        // Made by another process since it was looked for.
        if !resume {
            return Err(Error::Exists(path.to_owned()));
        }
        let found: Identity = this.get(IDENTITY_FILE)?.unwrap_or_else(|| identity.clone());
        let differs = |quantity: &str, expected: String, found: String| {
            Err(Error::Foreign { path: path.to_owned(), quantity: quantity.to_owned(), expected, found })
        };
        if found.format != LAYOUT {
            return differs("layout version", LAYOUT.to_string(), found.format.to_string());
        }
        if !found.same(identity) {
            let given = |i: &Identity| match &i.given {
                None => String::new(),
                Some(g) => format!(", demonstrations given: {} with SHA-256 {}", g.words(), g.sha256),
            };
            let text = |i: &Identity| {
                let run = format!("{} {} {} {} seed {}", i.task, i.preset, i.method, i.policy, i.seed);
                run + &given(i)
            };
            return differs("run.json", text(identity), text(&found));
        }
        let config = path.join("config.toml");
        let text = e2h_data::read_text(&config).map_err(io("reading", &config))?;
        // What later versions added has a default, which is what was done before. Where a key has none, or is gone, no value of
        // ours is what the run was begun with.
        let difference = difference(&text, resolved, task).map_err(|e| Error::Foreign {
            path: config.clone(),
            quantity: "configuration".to_owned(),
            expected: "one of this version (a run ends with the version that began it)".to_owned(),
            found: e.to_string(),
        })?;
        match difference {
            Difference::None if text == resolved.text => {}
            // A run can be made longer (or shorter): no stage that is done depends on how many follow.
            Difference::None | Difference::Iterations => write_atomic(&config, resolved.text.as_bytes())?,
            Difference::More => {
                let line = resolved.text.lines().zip(text.lines()).find(|(a, b)| a != b);
                let (expected, found) = line.unwrap_or(("the configuration given", "another one"));
                return differs("config.toml", expected.to_owned(), found.to_owned());
            }
        }
        Ok(this)
    }

    /// What the run in a folder was given, if one is there and was given any.
    pub(crate) fn given(path: &Path) -> Result<Option<Given>> {
        let found: Option<Identity> = read_json(&path.join(IDENTITY_FILE))?;
        Ok(found.and_then(|identity| identity.given))
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Where images of episodes go that the run keeps.
    pub(crate) fn images(&self) -> &ImageStore {
        &self.images
    }

    pub(crate) fn join(&self, name: impl AsRef<Path>) -> PathBuf {
        self.path.join(name)
    }

    /// SHA-256 of a file, to verify it with when it is read again.
    pub(crate) fn sha256(&self, name: &str) -> Result<String> {
        let path = self.join(name);
        Ok(sha256(&e2h_data::read_file(&path, e2h_data::MOST_WEIGHTS).map_err(io("reading", &path))?))
    }

    /// Refuses a file that is not the one that was written; without a checksum any is taken.
    pub(crate) fn verify(&self, name: &str, sha256: Option<&str>) -> Result<()> {
        let Some(expected) = sha256 else { return Ok(()) };
        Ok(compare(&self.join(name), expected, self.sha256(name)?)?)
    }

    /// SHA-256 of those of the files that are there, by their names.
    pub(crate) fn seals(&self, names: &[String]) -> Result<BTreeMap<String, String>> {
        let there = names.iter().filter(|name| self.join(name).exists());
        there.map(|name| Ok((name.clone(), self.sha256(name)?))).collect()
    }

    /// Refuses damage to files beside a result, such as pictures. No stage needs them, so one that was removed is no damage.
    pub(crate) fn verify_seals(&self, seals: &BTreeMap<String, String>) -> Result<()> {
        let mut there = seals.iter().filter(|(name, _)| self.join(name).exists());
        there.try_for_each(|(name, sum)| self.verify(name, Some(sum)))
    }

    /// SHA-256 of every file below a folder, by its path there.
    pub(crate) fn sums(&self, name: &str, below: &str, sums: &mut BTreeMap<String, String>) -> Result<()> {
        let folder = self.join(name).join(below);
        for entry in std::fs::read_dir(&folder).map_err(io("reading", &folder))?.flatten() {
            let file = entry.file_name().to_string_lossy().into_owned();
            let file = if below.is_empty() { file } else { format!("{below}/{file}") };
            if entry.path().is_dir() {
                self.sums(name, &file, sums)?;
            } else {
                let sum = self.sha256(&format!("{name}/{file}"))?;
                sums.insert(file, sum);
            }
        }
        Ok(())
    }

    /// Writes `value`, which has named fields, as JSON with the SHA-256 of its text, which [`Directory::get`] compares.
    pub(crate) fn put_sealed<T: Serialize>(&self, name: &str, value: &T) -> Result<()> {
        self.put_text(name, serde_json::to_string_pretty(value).map(|text| sealed(&text)))
    }

    /// Writes `value` as JSON.
    pub(crate) fn put<T: Serialize>(&self, name: &str, value: &T) -> Result<()> {
        self.put_text(name, serde_json::to_string_pretty(value))
    }

    /// Writes `value` as JSON on one line, for long lists of numbers.
    pub(crate) fn put_compact<T: Serialize>(&self, name: &str, value: &T) -> Result<()> {
        self.put_text(name, serde_json::to_string(value))
    }

    fn put_text(&self, name: &str, text: serde_json::Result<String>) -> Result<()> {
        let path = self.join(name);
        let text = text.map_err(|e| Error::Foreign {
            path: path.clone(),
            quantity: "value".to_owned(),
            expected: "JSON".to_owned(),
            found: e.to_string(),
        })?;
        write_atomic(&path, format!("{text}\n").as_bytes())
    }

    /// Reads JSON, sealed or not; none when the file is not there.
    pub(crate) fn get<T: DeserializeOwned>(&self, name: &str) -> Result<Option<T>> {
        Ok(read_json(&self.join(name))?)
    }

    /// Writes a LeRobot dataset and a JSON file beside its folders; it appears whole or not at all. Without episodes there is only
    /// the JSON file, for a dataset has no features then.
    pub(crate) fn put_episodes<T: Serialize>(
        &self,
        name: &str,
        episodes: &[impl Borrow<Episode>],
        notes: &T,
    ) -> Result<()> {
        let beside_name = format!("{name}{UNFINISHED}");
        let (beside, place) = (self.join(&beside_name), self.join(name));
        if beside.exists() {
            std::fs::remove_dir_all(&beside).map_err(io("removing", &beside))?;
        }
        let mut episodes = episodes.iter().map(Borrow::borrow).peekable();
        if let Some(first) = episodes.peek() {
            let mut writer = Writer::create(&beside, e2h_core::CONTROL_HZ, Some(ROBOT), features_of(first))?;
            for episode in episodes {
                writer.push_episode(episode)?;
            }
            writer.finish()?;
        }
        self.put(&format!("{beside_name}/{NOTES}"), notes)?;
        let mut sums = BTreeMap::new();
        self.sums(&beside_name, "", &mut sums)?;
        self.put_sealed(&format!("{beside_name}/{SUMS_FILE}"), &sums)?;
        std::fs::rename(&beside, &place).map_err(io("renaming to", &place))?;
        sync(place.parent().unwrap_or(Path::new(".")))
    }

    /// Copies a folder from elsewhere to `name`, whole or not at all.
    pub(crate) fn copy(&self, from: &Path, name: &str) -> Result<()> {
        let (beside, place) = (self.join(format!("{name}{UNFINISHED}")), self.join(name));
        if beside.exists() {
            std::fs::remove_dir_all(&beside).map_err(io("removing", &beside))?;
        }
        copy_folder(from, &beside, DEEPEST)?;
        std::fs::rename(&beside, &place).map_err(io("renaming to", &place))?;
        sync(place.parent().unwrap_or(Path::new(".")))
    }

    /// Reads what [`Directory::put_episodes`] wrote, every byte of it verified; none when it is not there.
    pub(crate) fn get_episodes<T: DeserializeOwned>(&self, name: &str) -> Result<Option<(Vec<Episode>, T)>> {
        // Runs of version 0.1 have no sums.
        let sums: Option<BTreeMap<String, String>> = self.get(&format!("{name}/{SUMS_FILE}"))?;
        for (file, sum) in sums.iter().flatten() {
            // Without its seal the list may be what is damaged.
            if !self.join(format!("{name}/{file}")).exists() {
                return Err(Error::Foreign {
                    path: self.join(format!("{name}/{SUMS_FILE}")),
                    quantity: "list".to_owned(),
                    expected: "files that are there".to_owned(),
                    found: e2h_core::one_line(file),
                });
            }
            self.verify(&format!("{name}/{file}"), Some(sum))?;
        }
        let Some(notes) = self.get(&format!("{name}/{NOTES}"))? else { return Ok(None) };
        let root = self.join(name);
        if !root.join("meta").exists() {
            return Ok(Some((vec![], notes)));
        }
        let dataset = Dataset::open(root)?;
        let read = |i| -> Result<Episode> {
            let mut episode = dataset.read_episode(i)?;
            episode.store_images(&self.images)?;
            Ok(episode)
        };
        Ok(Some(((0..dataset.len()).map(read).collect::<Result<_>>()?, notes)))
    }
}
