use crate::file::{WHOLE, decode, encode, file_error, header};
use crate::{Error, Result};
use e2h_core::{Episode, Origin, Outcome};
use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use tempfile::NamedTempFile;

const SUFFIX: &str = ".safetensors";

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
        self.stage(name, episode)?.persist(&path).map_err(|e| io("replace", &path)(e.error))?;
        // The rename itself is safe only once the folder is.
        #[cfg(unix)]
        File::open(&self.folder).and_then(|f| f.sync_all()).map_err(io("sync the folder", &self.folder))?;
        Ok(())
    }

    /// The whole new file under a temporary name, synced.
    fn stage(&self, name: &str, episode: &Episode) -> Result<NamedTempFile> {
        let path = self.path(name)?;
        episode.validate().map_err(|source| Error::Episode { name: name.to_owned(), source })?;
        let bytes = encode(episode, &path)?;
        let mut builder = tempfile::Builder::new();
        builder.prefix(".new-");
        // Temporary files are private by default; an episode is as readable as any file of its user.
        #[cfg(unix)]
        builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o644));
        let mut file = builder.tempfile_in(&self.folder).map_err(io("write in", &self.folder))?;
        file.write_all(&bytes).and_then(|()| file.as_file().sync_all()).map_err(io("write", &path))?;
        Ok(file)
    }

    /// Reads an episode.
    ///
    /// # Errors
    /// When there is no such file, or it is not the whole file of an episode.
    pub fn read(&self, name: &str) -> Result<Episode> {
        let path = self.path(name)?;
        decode(&fs::read(&path).map_err(io("read", &path))?, &path)
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

    fn summary(&self, name: &str) -> Result<Summary> {
        let path = self.path(name)?;
        let read = io("read", &path);
        let mut file = File::open(&path).map_err(&read)?;
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

fn io(action: &'static str, path: &Path) -> impl Fn(std::io::Error) -> Error {
    let path = path.to_owned();
    move |source| Error::Io { action, path: path.clone(), source }
}
