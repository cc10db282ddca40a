use super::episodes::{self, EpisodeSpan};
use super::feature::{DEFAULT_FEATURES, Dtype, Feature, INSIDE, Info};
use super::parquet_file::ParquetFile;
use super::table::{Column, Table};
use super::{tasks, video};
use crate::atomic::io;
use crate::file::file_error;
use crate::{Error, Result};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// A dataset on disk. What is in memory are the places of its episodes; rows are read when they are asked for.
///
/// ```no_run
/// use e2h_data::lerobot::Dataset;
///
/// let dataset = Dataset::open("recordings/unplug")?;
/// for i in 0..dataset.len() {
///     let table = dataset.read(i)?;
///     println!("{}: {} rows, {:?}", i, table.rows, dataset.episodes()[i].tasks);
/// }
/// # Ok::<(), e2h_data::Error>(())
/// ```
#[derive(Debug)]
pub struct Dataset {
    root: PathBuf,
    info: Info,
    tasks: Vec<String>,
    episodes: Vec<EpisodeSpan>,
    /// The file that was read last: neighbours mostly share one.
    open: Mutex<Option<Arc<ParquetFile>>>,
}

impl std::fmt::Debug for ParquetFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ParquetFile({})", self.path.display())
    }
}

pub(crate) fn info_path(root: &Path) -> PathBuf {
    root.join("meta/info.json")
}

pub(crate) fn read_info(root: &Path) -> Result<Info> {
    let path = info_path(root);
    Info::parse(&std::fs::read(&path).map_err(io("read", &path))?, &path)
}

impl Dataset {
    /// Opens a dataset: reads its description and the places of its episodes, and checks that they agree.
    ///
    /// What a killed writer left behind the last counted episode is not part of the dataset.
    ///
    /// # Errors
    /// When a file is missing or is not what it should be, by its name; videos are looked for when they are read.
    pub fn open(root: impl AsRef<Path>) -> Result<Self> {
        let root = root.as_ref().to_owned();
        let info = read_info(&root)?;
        let tasks = if info.total_episodes == 0 { vec![] } else { tasks::read(&root)? };
        let mut episodes = vec![];
        for path in episodes::files(&episodes::folder(&root))? {
            if episodes.len() == info.total_episodes {
                break;
            }
            episodes::read_file(&path, &info, &mut episodes)?;
        }
        let counted = |what, expected: usize, found: usize| {
            let path = info_path(&root);
            if expected == found {
                Ok(())
            } else {
                Err(file_error(&path, what, found.to_string(), expected.to_string()))
            }
        };
        counted("total_episodes", info.total_episodes, episodes.len())?;
        let frames = episodes.last().map_or(0, |e| e.from + e.length);
        counted("total_frames", info.total_frames, frames)?;
        Ok(Self::with_spans(&root, info, tasks, episodes))
    }

    /// A dataset of episodes whose places have been read already.
    pub(crate) fn with_spans(
        root: &Path,
        info: Info,
        tasks: Vec<String>,
        episodes: Vec<EpisodeSpan>,
    ) -> Self {
        Self { root: root.to_owned(), info, tasks, episodes, open: Mutex::new(None) }
    }

    /// Its folder.
    #[must_use]
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// What it says of itself.
    #[must_use]
    pub fn info(&self) -> &Info {
        &self.info
    }

    /// Its tasks, by index.
    #[must_use]
    pub fn tasks(&self) -> &[String] {
        &self.tasks
    }

    /// Where its episodes lie.
    #[must_use]
    pub fn episodes(&self) -> &[EpisodeSpan] {
        &self.episodes
    }

    /// Episodes.
    #[must_use]
    pub fn len(&self) -> usize {
        self.episodes.len()
    }

    /// True without episodes.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.episodes.is_empty()
    }

    /// All columns of an episode, videos included.
    ///
    /// # Errors
    /// As [`Dataset::read_columns`].
    pub fn read(&self, episode: usize) -> Result<Table> {
        let names: Vec<&str> = self.info.features.iter().map(|(n, _)| n.as_str()).collect();
        self.read_columns(episode, &names)
    }

    /// Some columns of an episode. Frames of videos come as PNG files, as images do.
    ///
    /// # Errors
    /// When there is no such episode or column, when a file is not what it should be (file, row and column are named), or
    /// when a video is asked for and there is no `ffmpeg` to decode it.
    pub fn read_columns(&self, episode: usize, names: &[&str]) -> Result<Table> {
        let span = self.span(episode)?;
        let mut features: Vec<(&str, &Feature)> = vec![];
        for name in names {
            let found = self.info.features.iter().find(|(n, _)| n == name).ok_or_else(|| Error::Column {
                column: (*name).to_owned(),
                expected: "a column of the dataset".to_owned(),
                found: format!("only {:?}", self.info.features.iter().map(|(n, _)| n).collect::<Vec<_>>()),
            })?;
            features.push((&found.0, &found.1));
        }
        let file = self.file(span)?;
        let rows = self.rows_in_file(episode, span);
        self.check_place(&file, episode, span, rows.clone())?;
        let stored: Vec<(&str, &Feature)> =
            features.iter().filter(|(_, f)| f.dtype != Dtype::Video).copied().collect();
        let mut stored = file.read(&stored, rows)?.into_iter();
        let mut columns = vec![];
        for (name, feature) in features {
            if feature.dtype == Dtype::Video {
                columns.push((name.to_owned(), Column::Png(self.video(span, name, feature)?)));
            } else {
                columns.extend(stored.next());
            }
        }
        Ok(Table { rows: span.length, columns })
    }

    /// The tasks of an episode's rows, in words.
    ///
    /// # Errors
    /// As [`Dataset::read_columns`].
    pub fn row_tasks(&self, episode: usize) -> Result<Vec<&str>> {
        let table = self.read_columns(episode, &["task_index"])?;
        let path = self.data_path(self.span(episode)?.file)?;
        let task = |(row, &i): (usize, &i64)| {
            let found = usize::try_from(i).ok().and_then(|i| self.tasks.get(i));
            found.map(String::as_str).ok_or_else(|| {
                let what = format!("column `task_index`, row {row} of episode {episode}");
                file_error(&path, &what, format!("below {}", self.tasks.len()), i.to_string())
            })
        };
        table.i64("task_index")?.iter().enumerate().map(task).collect()
    }

    fn span(&self, episode: usize) -> Result<&EpisodeSpan> {
        self.episodes.get(episode).ok_or_else(|| Error::Column {
            column: "episode_index".to_owned(),
            expected: format!("below {}", self.episodes.len()),
            found: episode.to_string(),
        })
    }

    pub(crate) fn data_path(&self, file: (usize, usize)) -> Result<PathBuf> {
        let path = self.info.data_file(file.0, file.1);
        path.map(|p| self.root.join(p))
            .map_err(|found| file_error(&info_path(&self.root), "data_path", INSIDE, found))
    }

    fn file(&self, span: &EpisodeSpan) -> Result<Arc<ParquetFile>> {
        let path = self.data_path(span.file)?;
        // A thread that panicked while it held the lock has left a whole file or none behind.
        let mut open = self.open.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(file) = open.as_ref().filter(|f| f.path == path) {
            return Ok(file.clone());
        }
        let file = Arc::new(ParquetFile::open(&path)?);
        *open = Some(file.clone());
        Ok(file)
    }

    /// Rows of an episode in its file: episodes follow each other there.
    pub(crate) fn rows_in_file(&self, episode: usize, span: &EpisodeSpan) -> std::ops::Range<usize> {
        let before = self.episodes[..episode].iter().rev().take_while(|e| e.file == span.file);
        let start: usize = before.map(|e| e.length).sum();
        start..start + span.length
    }

    /// The rows are the episode's: their indices say so.
    pub(crate) fn check_place(
        &self,
        file: &ParquetFile,
        episode: usize,
        span: &EpisodeSpan,
        rows: std::ops::Range<usize>,
    ) -> Result<()> {
        let features: Vec<(&str, Feature)> =
            DEFAULT_FEATURES[1..4].iter().map(|(n, dtype)| (*n, Feature::scalar(*dtype))).collect();
        let features: Vec<(&str, &Feature)> = features.iter().map(|(n, f)| (*n, f)).collect();
        let columns = file.read(&features, rows.clone())?;
        for (name, column) in &columns {
            let Column::I64(values) = column else { continue };
            for (row, &found) in values.iter().enumerate() {
                let expected = match name.as_str() {
                    "frame_index" => row,
                    "episode_index" => episode,
                    _ => span.from + row,
                };
                if usize::try_from(found).ok() != Some(expected) {
                    let what = format!("column `{name}`, row {}", rows.start + row);
                    return Err(file_error(&file.path, &what, expected.to_string(), found.to_string()));
                }
            }
        }
        Ok(())
    }

    fn video(&self, span: &EpisodeSpan, name: &str, feature: &Feature) -> Result<Vec<Vec<u8>>> {
        let place = span.videos.get(name).ok_or_else(|| {
            file_error(&episodes::path(&self.root, span.listed_in), name, "a place in a video", "none")
        })?;
        let path = self.info.video_file(name, place.file.0, place.file.1);
        let path = path.map_err(|found| file_error(&info_path(&self.root), "video_path", INSIDE, found))?;
        let fps = self.info.fps;
        video::read(&self.root.join(path), place.from, span.length, fps, feature)
    }
}
