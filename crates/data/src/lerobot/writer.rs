use super::arrow::{batch, to_arrow};
use super::dataset::{Dataset, info_path};
use super::episodes::{self, Entry, EpisodeSpan};
use super::feature::{DEFAULT_FEATURES, Dtype, Features};
use super::info::{INSIDE, Info};
use super::parquet_writer::ParquetWriter;
use super::stats::{self, Stats};
use super::table::{Column, Table, column_error};
use super::tasks;
use crate::Result;
use crate::atomic::{self, UNFINISHED, io};
use crate::file::{file_error, unsupported};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Writes a dataset, episode by episode.
///
/// Episodes become part of the dataset with [`Writer::commit`], which is called by itself whenever a data file is full.
/// A commit writes the rows, then where they lie, then tasks and statistics, and `meta/info.json` last; each file is
/// written beside its place, synced and renamed. A process that is killed at any instant leaves the dataset as it was
/// after the last commit, for [`Dataset::open`], which goes by `info.json`. LeRobot goes by the files that it finds; killed
/// between two renames of one commit, `dataset check --repair` removes what is not counted.
///
/// ```
/// use e2h_data::lerobot::{Column, Dataset, Dtype, Feature, Table, Writer};
///
/// let folder = tempfile::tempdir()?;
/// let root = folder.path().join("waving");
/// let mut features = vec![("observation.state".to_owned(), Feature::vector(&["x", "y"]))];
/// features.push(("next.success".to_owned(), Feature::scalar(Dtype::Bool)));
/// let mut writer = Writer::create(&root, 20.0, Some("my_robot"), features)?;
/// let columns = vec![
///     ("observation.state".to_owned(), Column::F32(vec![0.0, 0.1, 0.2, 0.3])),
///     ("next.success".to_owned(), Column::Bool(vec![false, true])),
/// ];
/// writer.push(&Table { rows: 2, columns }, "wave")?;
/// writer.finish()?;
/// assert_eq!(Dataset::open(&root)?.read(0)?.f32("timestamp")?, [0.0, 0.05]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct Writer {
    root: PathBuf,
    info: Info,
    own: Features,
    tasks: Vec<String>,
    total: Stats,
    /// Where the next data file and the next list of episodes go.
    next: (usize, usize),
    next_list: (usize, usize),
    open: Option<ParquetWriter>,
    pending: Vec<Entry>,
}

impl std::fmt::Debug for ParquetWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ParquetWriter({} bytes)", self.len())
    }
}

impl Writer {
    /// Begins a dataset. `features` are those beside [`DEFAULT_FEATURES`], which are filled in by themselves.
    ///
    /// # Errors
    /// When there is a dataset already, a feature cannot be, or the file system refuses.
    pub fn create(
        root: impl AsRef<Path>,
        fps: f64,
        robot_type: Option<&str>,
        features: Features,
    ) -> Result<Self> {
        let root = root.as_ref().to_owned();
        let info = Info::new(fps, robot_type, features)?;
        if info_path(&root).exists() {
            return Err(file_error(&info_path(&root), "file", "none: a new dataset", "one"));
        }
        let this = Self::at(root, info)?;
        clear_unfinished(&this.root)?;
        // The first file of each kind may be that of a writer that was killed in its first commit, and will be replaced.
        // Others are somebody's, and LeRobot would read them with ours.
        for (folder, ours) in [
            (episodes::folder(&this.root), episodes::path(&this.root, (0, 0))),
            (this.root.join("data"), this.data_path()?),
        ] {
            if let Some(found) = episodes::files(&folder)?.into_iter().find(|p| *p != ours) {
                return Err(file_error(&found, "file", "none: a new dataset", "one"));
            }
        }
        Ok(this)
    }

    /// Goes on with a dataset, whoever began it.
    ///
    /// # Errors
    /// When it is not whole, has videos (which are not written here), or its statistics by episode are not complete.
    pub fn append(root: impl AsRef<Path>) -> Result<Self> {
        let dataset = Dataset::open(root)?;
        let root = dataset.root().to_owned();
        let mut this = Self::at(root, dataset.info().clone())?;
        this.tasks = dataset.tasks().to_vec();
        this.total = total_stats(&this.root, &this.info.features, dataset.len())?;
        if let Some(last) = dataset.episodes().last() {
            this.next = this.info.next_file(last.file);
            this.next_list = this.info.next_file(last.listed_in);
        }
        clear_unfinished(&this.root)?;
        Ok(this)
    }

    fn at(root: PathBuf, info: Info) -> Result<Self> {
        if let Some((name, _)) = info.features.iter().find(|(_, f)| f.dtype == Dtype::Video) {
            return Err(column_error(name, "images: videos are read, not written", "video"));
        }
        if let Some(skipped) = info.skipped.first() {
            let what = format!("feature `{}`", skipped.name);
            return Err(unsupported(&info_path(&root), &what, &skipped.expected, &skipped.found));
        }
        let own = info.own_features();
        Ok(Self {
            root,
            info,
            own,
            tasks: vec![],
            total: vec![],
            next: (0, 0),
            next_list: (0, 0),
            open: None,
            pending: vec![],
        })
    }

    /// What the dataset says of itself, as of the last commit.
    #[must_use]
    pub fn info(&self) -> &Info {
        &self.info
    }

    /// Adds an episode. It is part of the dataset after the next commit.
    ///
    /// # Errors
    /// When the table does not fit the features, a number is not finite, an image cannot be decoded, or the file system
    /// refuses. The episode is then not part of the dataset, and the writer can go on.
    pub fn push(&mut self, table: &Table, task: &str) -> Result<()> {
        table.validate(&self.own)?;
        let index = self.info.total_episodes + self.pending.len();
        let from = self.pending.last().map_or(self.info.total_frames, |e| e.span.from + e.span.length);
        let known = self.tasks.iter().position(|t| t == task);
        let task_index = known.unwrap_or(self.tasks.len());
        let table = self.with_defaults(table, index, from, task_index)?;
        let stats = stats::of_table(&table, &self.info.features)?;
        let columns = self.info.features.iter().filter_map(|(name, feature)| {
            table.column(name).map(|column| (name.clone(), to_arrow(feature, column)))
        });
        let path = self.data_path()?;
        let rows = batch(columns.collect(), &path)?;
        let open = match &mut self.open {
            Some(open) => open,
            None => self.open.insert(ParquetWriter::create(&path, rows.schema())?),
        };
        if let Err(e) = open.write(&rows) {
            // What is half in the file cannot be taken out again; the episodes before it go with it.
            (self.open, self.pending) = (None, vec![]);
            return Err(e);
        }
        let full = open.len() >= (self.info.data_files_size_in_mb as u64) << 20;
        if known.is_none() {
            self.tasks.push(task.to_owned());
        }
        let span = EpisodeSpan {
            length: table.rows,
            from,
            tasks: vec![task.to_owned()],
            file: self.next,
            listed_in: self.next_list,
            videos: [].into(),
        };
        self.pending.push(Entry { index, span, stats });
        if full { self.commit() } else { Ok(()) }
    }

    /// Makes all episodes pushed so far part of the dataset. After each episode it costs a file per episode, which is what
    /// recording on a robot wants; otherwise files fill up first.
    ///
    /// # Errors
    /// When the file system refuses; the dataset is then as it was after the commit before.
    pub fn commit(&mut self) -> Result<()> {
        let Some(open) = self.open.take() else { return Ok(()) };
        let entries = std::mem::take(&mut self.pending);
        open.finish()?;
        let path = episodes::path(&self.root, self.next_list);
        let list = episodes::to_batch(&entries, &self.info.features, &path)?;
        let mut writer = ParquetWriter::create(&path, list.schema())?;
        writer.write(&list)?;
        writer.finish()?;
        tasks::write(&self.root, &self.tasks)?;
        let mut info = self.info.clone();
        let mut total = self.total.clone();
        for entry in &entries {
            stats::add(&mut total, &entry.stats);
            info.total_episodes += 1;
            info.total_frames += entry.span.length;
        }
        write_json(&self.root.join("meta/stats.json"), &stats::to_json(&total, &info.features))?;
        info.total_tasks = self.tasks.len();
        info.splits.insert("train".to_owned(), format!("0:{}", info.total_episodes).into());
        write_json(&info_path(&self.root), &info)?;
        (self.next, self.next_list) = (info.next_file(self.next), info.next_file(self.next_list));
        (self.info, self.total) = (info, total);
        Ok(())
    }

    /// Commits, and says what the dataset became.
    ///
    /// # Errors
    /// As [`Writer::commit`]; and when nothing was ever pushed, since a dataset without episodes cannot be opened.
    pub fn finish(mut self) -> Result<Info> {
        self.commit()?;
        if self.info.total_episodes == 0 {
            return Err(column_error("(all)", "at least one episode", "none"));
        }
        Ok(self.info)
    }

    fn data_path(&self) -> Result<PathBuf> {
        let path = self.info.data_file(self.next.0, self.next.1);
        path.map(|p| self.root.join(p))
            .map_err(|found| file_error(&info_path(&self.root), "data_path", INSIDE, found))
    }

    fn with_defaults(&self, table: &Table, index: usize, from: usize, task: usize) -> Result<Table> {
        let rows = table.rows;
        let count =
            |n: usize| i64::try_from(n).map_err(|_| column_error("index", "below 2^63", n.to_string()));
        let (first, index, task) = (count(from)?, count(index)?, count(task)?);
        // The format says 32 bits.
        let time = |t: usize| (t as f64 / self.info.fps) as f32;
        let mut columns = table.columns.clone();
        for (name, _) in DEFAULT_FEATURES {
            let column = match name {
                "timestamp" => Column::F32((0..rows).map(time).collect()),
                "frame_index" => Column::I64((0..).take(rows).collect()),
                "index" => Column::I64((first..).take(rows).collect()),
                "episode_index" => Column::I64(vec![index; rows]),
                _ => Column::I64(vec![task; rows]),
            };
            columns.push((name.to_owned(), column));
        }
        Ok(Table { rows, columns })
    }
}

/// Statistics over all counted episodes, from those of each: `stats.json` may be ahead where a commit was cut off.
pub(crate) fn total_stats(root: &Path, features: &Features, episodes: usize) -> Result<Stats> {
    let mut total = vec![];
    let mut left = episodes;
    for path in episodes::files(&episodes::folder(root))? {
        if left == 0 {
            break;
        }
        let rows = super::parquet_file::ParquetFile::open(&path)?.rows().min(left);
        for stats in episodes::read_stats(&path, features, rows)? {
            stats::add(&mut total, &stats);
        }
        left -= rows;
    }
    Ok(total)
}

/// Writes JSON as LeRobot does, indented by four.
pub(crate) fn write_json<T: Serialize>(path: &Path, value: &T) -> Result<()> {
    let mut bytes = vec![];
    let formatter = serde_json::ser::PrettyFormatter::with_indent(b"    ");
    value
        .serialize(&mut serde_json::Serializer::with_formatter(&mut bytes, formatter))
        .map_err(|e| file_error(path, "JSON", "a value", e.to_string()))?;
    atomic::write(path, &bytes)
}

/// Folders that may hold files of a writer that was killed.
fn folders(root: &Path) -> Result<Vec<PathBuf>> {
    let mut found = vec![root.join("meta")];
    for parent in [episodes::folder(root), root.join("data")] {
        found.extend(atomic::names(&parent)?.into_iter().filter(|p| p.is_dir()));
    }
    Ok(found)
}

/// Unfinished files of a writer that was killed.
pub(crate) fn unfinished(root: &Path) -> Result<Vec<PathBuf>> {
    let mut found = vec![];
    for folder in folders(root)? {
        found.extend(atomic::names(&folder)?.into_iter().filter(|p| {
            p.is_file() && p.file_name().is_some_and(|n| n.to_string_lossy().starts_with(UNFINISHED))
        }));
    }
    Ok(found)
}

pub(crate) fn clear_unfinished(root: &Path) -> Result<()> {
    for path in unfinished(root)? {
        std::fs::remove_file(&path).map_err(io("remove", &path))?;
    }
    Ok(())
}
