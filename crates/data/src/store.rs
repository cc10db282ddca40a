use crate::atomic::{io, persist, unfinished};
use crate::file::{WHOLE, decode, encode, file_error, header, open_regular, read_regular};
use crate::{Error, Result};
use e2h_core::{Episode, Origin, Outcome};
use std::fs;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

const SUFFIX: &str = ".safetensors";
/// Size of one episode, bytes: an hour of two cameras of 480 x 640.
const LARGEST: u64 = 1 << 38;

/// A folder of episodes, one safetensors file each.
///
/// A file is written beside its place, synced and then renamed: at any instant the old file or the new one is there, whole.
#[derive(Debug, Clone)]
pub struct EpisodeStore {
    folder: PathBuf,
}

/// What a file says of its episode.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Name of the episode.
    pub name: String,
    /// Its rows.
    pub rows: usize,
    /// How it ended.
    pub outcome: Outcome,
    /// Where it comes from.
    pub origin: Origin,
    /// Names of its cameras.
    pub cameras: Vec<String>,
}

impl EpisodeStore {
    /// Opens the folder, and makes it where it is not there.
    ///
    /// # Errors
    /// When the folder can be neither found nor made.
    pub fn open(folder: impl AsRef<Path>) -> Result<Self> {
        let folder = folder.as_ref().to_owned();
        fs::create_dir_all(&folder).map_err(io("make the folder", &folder))?;
        Ok(Self { folder })
    }

    /// The file of an episode.
    ///
    /// # Errors
    /// When `name` is not a plain file name.
    pub fn path(&self, name: &str) -> Result<PathBuf> {
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
        if name.is_empty() || name.starts_with('.') || !name.chars().all(plain) {
            return Err(Error::Name { found: name.to_owned() });
        }
        Ok(self.folder.join(format!("{name}{SUFFIX}")))
    }

    /// Writes or replaces an episode. The same episode gives the same bytes.
    ///
    /// # Errors
    /// When the episode contradicts itself or the file system refuses; the file of that name is then what it was.
    pub fn write(&self, name: &str, episode: &Episode) -> Result<()> {
        let path = self.path(name)?;
        persist(self.stage(name, episode)?, &path)
    }

    /// The whole new file under a temporary name, synced.
    fn stage(&self, name: &str, episode: &Episode) -> Result<NamedTempFile> {
        let path = self.path(name)?;
        episode.validate().map_err(|source| Error::Episode { name: name.to_owned(), source })?;
        let bytes = encode(episode, &path)?;
        let mut file = unfinished(&self.folder)?;
        file.write_all(&bytes).and_then(|()| file.as_file().sync_all()).map_err(io("write", &path))?;
        Ok(file)
    }

    /// Reads an episode.
    ///
    /// # Errors
    /// When there is no such file, or it is not the whole file of an episode.
    pub fn read(&self, name: &str) -> Result<Episode> {
        let path = self.path(name)?;
        decode(&read_regular(&path, LARGEST)?, &path)
    }

    /// Names of the episodes, sorted. Unfinished files of a killed writer are not among them.
    ///
    /// # Errors
    /// When the folder cannot be read.
    pub fn names(&self) -> Result<Vec<String>> {
        let read = io("read the folder", &self.folder);
        let mut names = vec![];
        for entry in fs::read_dir(&self.folder).map_err(&read)? {
            let file = entry.map_err(&read)?.file_name();
            let name = file.to_str().and_then(|f| f.strip_suffix(SUFFIX));
            names.extend(name.filter(|n| !n.starts_with('.')).map(str::to_owned));
        }
        names.sort();
        Ok(names)
    }

    /// Looks at the header and the length of every file, so that a bad one is found before any work; sorted by name.
    ///
    /// # Errors
    /// Lists every file that is not the whole file of an episode.
    pub fn check(&self) -> Result<Vec<Summary>> {
        let (mut good, mut problems) = (vec![], vec![]);
        for name in self.names()? {
            match self.summary(&name) {
                Ok(summary) => good.push(summary),
                Err(e) => problems.push(e.to_string()),
            }
        }
        if problems.is_empty() { Ok(good) } else { Err(Error::Store { problems }) }
    }

    /// What the header of one file says, without its rows.
    ///
    /// # Errors
    /// When there is no such file, or it is not the whole file of an episode.
    pub fn summary(&self, name: &str) -> Result<Summary> {
        let path = self.path(name)?;
        let read = io("read", &path);
        let mut file = open_regular(&path)?;
        let length = file.metadata().map_err(&read)?.len();
        // Eight bytes of length, then the header: all that has to be read.
        let mut bytes = vec![0; 8];
        let short = |found| file_error(&path, "file", WHOLE, found);
        file.read_exact(&mut bytes).map_err(|_| short(format!("{length} bytes")))?;
        let size = bytes.first_chunk().map_or(0, |b| u64::from_le_bytes(*b));
        if size > length.saturating_sub(8) {
            return Err(short(format!("a header of {size} bytes in a file of {length}")));
        }
        (&file).take(size).read_to_end(&mut bytes).map_err(&read)?;
        let found = header(&bytes, &path)?;
        if length != found.length as u64 {
            return Err(file_error(&path, "file", format!("{} bytes", found.length), format!("{length}")));
        }
        Ok(Summary {
            name: name.to_owned(),
            rows: found.rows,
            outcome: found.header.outcome,
            origin: found.header.origin,
            cameras: found.header.cameras,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::episode;
    use proptest::prelude::*;

    fn store() -> (tempfile::TempDir, EpisodeStore) {
        let folder = tempfile::tempdir().unwrap();
        let store = EpisodeStore::open(folder.path().join("episodes")).unwrap();
        (folder, store)
    }

    /// The message of what `name` is refused with, once it holds `bytes`; reading and checking agree that it is bad.
    fn refusal(bytes: &[u8]) -> String {
        let (_folder, store) = store();
        fs::write(store.path("a").unwrap(), bytes).unwrap();
        assert!(matches!(store.check(), Err(Error::Store { problems }) if problems.len() == 1));
        let message = store.read("a").unwrap_err().to_string();
        assert!(message.contains("a.safetensors"), "{message}");
        message
    }

    fn bytes(rows: usize) -> Vec<u8> {
        encode(&episode(rows), Path::new("a")).unwrap()
    }

    #[test]
    fn names_are_sorted_and_summaries_read_headers() {
        let (_folder, store) = store();
        for (name, rows) in [("b", 3), ("a", 5), ("empty", 0)] {
            store.write(name, &episode(rows)).unwrap();
        }
        assert_eq!(store.names().unwrap(), ["a", "b", "empty"]);
        let summaries = store.check().unwrap();
        assert_eq!(summaries.iter().map(|s| s.rows).collect::<Vec<_>>(), [5, 3, 0]);
        assert_eq!(summaries[0].cameras, ["wrist", "table"]);
        assert_eq!(summaries[0].outcome, Outcome::Success { at: 2 });
        assert_eq!(store.read("empty").unwrap(), episode(0));
    }

    #[test]
    fn the_same_episode_gives_the_same_bytes() {
        assert_eq!(bytes(4), bytes(4));
    }

    #[test]
    fn a_writer_killed_before_the_rename_leaves_the_old_file() {
        let (_folder, store) = store();
        store.write("a", &episode(3)).unwrap();
        // What a killed process leaves: the new file under its temporary name, never removed.
        let (_, left) = store.stage("a", &episode(9)).unwrap().keep().unwrap();
        assert!(left.exists());
        assert_eq!(store.read("a").unwrap(), episode(3));
        assert_eq!(store.names().unwrap(), ["a"]);
        store.write("a", &episode(9)).unwrap();
        assert_eq!(store.read("a").unwrap(), episode(9));
    }

    #[test]
    fn truncated_files_are_refused_at_every_length() {
        let whole = bytes(2);
        for length in (0..whole.len()).step_by(17).chain([whole.len() - 1]) {
            refusal(&whole[..length]);
        }
        let mut longer = whole;
        longer.push(0);
        refusal(&longer);
    }

    #[test]
    fn foreign_files_are_refused_by_what_they_lack() {
        assert!(refusal(b"not safetensors at all").contains("expected a whole safetensors file"));
        let foreign =
            safetensors::serialize(Vec::<(String, safetensors::tensor::TensorView)>::new(), None).unwrap();
        assert!(refusal(&foreign).contains("expected key `auto_e2h.episode`"));
        let text = |from: &str, to: &str| {
            assert_eq!(from.len(), to.len());
            let whole = bytes(2);
            let at = whole.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
            [&whole[..at], to.as_bytes(), &whole[at + from.len()..]].concat()
        };
        let message = refusal(&text("format\\\":1", "format\\\":7"));
        assert!(message.contains("format: expected 1, found 7"), "{message}");
        assert!(refusal(&text("\"action\"", "\"aktion\"")).contains("aktion"));
        let message = refusal(&text("\"shape\":[2,15]", "\"shape\":[15,2]"));
        assert!(message.contains("expected F32"), "{message}");
    }

    #[test]
    fn an_episode_that_contradicts_itself_is_not_written() {
        let (_folder, store) = store();
        store.write("a", &episode(3)).unwrap();
        let mut bad = episode(4);
        bad.action.pop();
        assert!(matches!(store.write("a", &bad), Err(Error::Episode { .. })));
        bad = episode(4);
        bad.state[1][2] = f32::INFINITY;
        assert!(store.write("a", &bad).is_err());
        assert_eq!(store.read("a").unwrap(), episode(3));
        assert_eq!(fs::read_dir(&store.folder).unwrap().count(), 1, "nothing half-written is left");
    }

    #[test]
    fn names_stay_in_the_folder() {
        let (_folder, store) = store();
        for name in ["", "../a", ".a", "a/b", "a b"] {
            assert!(matches!(store.write(name, &episode(1)), Err(Error::Name { .. })), "{name}");
        }
        assert!(matches!(store.read("missing"), Err(Error::Io { action: "open", .. })));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn what_is_written_is_read(
            numbers in prop::collection::vec(-1e30_f32..1e30, 1..12), terminal: bool, reversed: bool, task in ".{0,12}",
        ) {
            let (_folder, store) = store();
            let mut e = episode(numbers.len());
            for (t, v) in numbers.iter().enumerate() {
                (e.state[t][14], e.action[t][0], e.source[t]) = (*v, -v, u32::MAX - t as u32);
            }
            (e.terminal, e.origin.reversed, e.origin.task) = (terminal, reversed, task);
            store.write("a-1.b_c", &e).unwrap();
            prop_assert_eq!(store.read("a-1.b_c").unwrap(), e);
            prop_assert_eq!(store.check().unwrap().len(), 1);
        }
    }
}
