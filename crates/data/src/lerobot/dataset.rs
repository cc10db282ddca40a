use super::episodes::{self, EpisodeSpan};
use super::feature::{DEFAULT_FEATURES, Dtype, Feature};
use super::info::{INSIDE, Info};
use super::parquet_file::ParquetFile;
use super::table::{Column, Table};
use super::{mp4, tasks, video};
use crate::file::{file_error, read_regular, unsupported};
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

/// Size of `info.json` and `stats.json`, bytes: a hundred times what a large robot's take.
pub(crate) const LARGEST_JSON: u64 = 1 << 26;

pub(crate) fn info_path(root: &Path) -> PathBuf {
    root.join("meta/info.json")
}

pub(crate) fn read_info(root: &Path) -> Result<Info> {
    let path = info_path(root);
    Info::parse(&read_regular(&path, LARGEST_JSON)?, &path)
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
            episodes::read_file(&path, &info, &mut episodes, &mut vec![])?;
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

    /// All columns of an episode, videos included; those of [`Info::skipped`] are not among them.
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
            if let Some(skipped) = self.info.skipped.iter().find(|s| s.name == *name) {
                let what = format!("feature `{name}`");
                return Err(unsupported(&info_path(&self.root), &what, &skipped.expected, &skipped.found));
            }
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
        if features.iter().any(|(_, f)| f.dtype == Dtype::Video) {
            self.check_times(&file, rows.clone())?;
        }
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

    /// Rows and frames of a video belong together by their number, which they do only where the rows keep to the grid.
    fn check_times(&self, file: &ParquetFile, rows: std::ops::Range<usize>) -> Result<()> {
        let time = Feature::scalar(Dtype::Float32);
        let columns = file.read(&[("timestamp", &time)], rows.clone())?;
        let [(_, Column::F32(times))] = &columns[..] else { return Ok(()) };
        for (row, &found) in times.iter().enumerate() {
            let expected = row as f64 / self.info.fps;
            let off = (f64::from(found) - expected).abs();
            if off.is_nan() || off >= 0.5 / self.info.fps {
                let what = format!("column `timestamp`, row {}", rows.start + row);
                let expected = format!("within half a frame of {expected} s");
                return Err(file_error(&file.path, &what, expected, found.to_string()));
            }
        }
        Ok(())
    }

    /// The rows are the episode's: their numbers within the episode say so, and that of the episode, which may count from the
    /// beginning of the file. What `index` says is not asked: merging and splitting leave it as it was.
    pub(crate) fn check_place(
        &self,
        file: &ParquetFile,
        episode: usize,
        span: &EpisodeSpan,
        rows: std::ops::Range<usize>,
    ) -> Result<()> {
        let features: Vec<(&str, Feature)> =
            DEFAULT_FEATURES[1..3].iter().map(|(n, dtype)| (*n, Feature::scalar(*dtype))).collect();
        let features: Vec<(&str, &Feature)> = features.iter().map(|(n, f)| (*n, f)).collect();
        let columns = file.read(&features, rows.clone())?;
        let in_file = self.episodes[..episode].iter().rev().take_while(|e| e.file == span.file).count();
        for (name, column) in &columns {
            let Column::I64(values) = column else { continue };
            let restarts = values.iter().all(|&v| usize::try_from(v).ok() == Some(in_file));
            for (row, &found) in values.iter().enumerate() {
                let expected = match name.as_str() {
                    "frame_index" => row,
                    _ if restarts => in_file,
                    _ => episode,
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
        let path = self.video_path(name, place.file)?;
        let fps = self.info.fps;
        mp4::Times::read(&path)?.check(&path, place.from, span.length, fps)?;
        video::read(&path, place.from, span.length, fps, feature)
    }

    pub(crate) fn video_path(&self, name: &str, file: (usize, usize)) -> Result<PathBuf> {
        let path = self.info.video_file(name, file.0, file.1);
        path.map(|p| self.root.join(p))
            .map_err(|found| file_error(&info_path(&self.root), "video_path", INSIDE, found))
    }
}
