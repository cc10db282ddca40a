//! Looks for what is not as it should be in a dataset: cuts off what is damaged, and takes anew what is only out of date.

use super::check_rows::{check_rows, check_stats, check_totals, stale_rows};
use super::dataset::{Dataset, info_path, read_info};
use super::episodes::{self, EpisodeSpan};
use super::feature::{DEFAULT_FEATURES, Dtype, Features};
use super::info::Info;
use super::mp4::Times;
use super::parquet_file::ParquetFile;
use super::stats::Stats;
use super::table::Table;
use super::{tasks, writer};
use crate::atomic;
use crate::file::{file_error, unsupported};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// What a finding means for the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultKind {
    /// The rows are whole; what is noted of them beside is missing or out of date. [`repair`](super::repair()) takes it anew from the rows.
    Stale,
    /// Not read here, which says nothing of the rows. As long as there is one, [`repair`](super::repair()) touches nothing.
    Unsupported,
    /// Lost. [`repair`](super::repair()) cuts it off.
    Damage,
}

impl std::fmt::Display for FaultKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Stale => "stale",
            Self::Unsupported => "unsupported",
            Self::Damage => "damage",
        })
    }
}

/// Something that is not as it should be.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fault {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it, with row and column where there are such.
    pub message: String,
    /// What that means for the rows.
    pub kind: FaultKind,
    /// The first episode that it is found in; none where it is none's.
    pub episode: Option<usize>,
    /// Whether [`repair`](super::repair()) can do something about it.
    pub repairable: bool,
}

/// What [`check`] found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The dataset's folder.
    pub root: PathBuf,
    /// Episodes that `info.json` counts.
    pub episodes: usize,
    /// Rows that it counts.
    pub frames: usize,
    /// Episodes before the first that is damaged: what a repair leaves.
    pub whole: usize,
    /// Data files whose checksums were compared.
    pub verified_files: usize,
    /// Data files without checksums, written by others: their rows were decoded, but a changed digit goes unseen there.
    pub unverified_files: usize,
    /// All findings, damage first, in the order of the episodes.
    pub faults: Vec<Fault>,
    /// What a repair did, a line each.
    pub repairs: Vec<String>,
}

impl Report {
    /// True without findings of any kind.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.faults.is_empty()
    }

    /// The worst kind of finding; none for a sound dataset.
    #[must_use]
    pub fn worst(&self) -> Option<FaultKind> {
        self.faults.iter().map(|f| f.kind).max()
    }

    /// True when there is a finding of that kind.
    #[must_use]
    pub fn has(&self, kind: FaultKind) -> bool {
        self.faults.iter().any(|f| f.kind == kind)
    }
}

/// Reads every row and every image of a dataset and the tables of its videos, and compares counts, types, ranges, times and
/// checksums. Finds all faults, not only the first. Changes nothing.
///
/// # Errors
/// When the folder itself cannot be read; what is found in it is part of the report.
pub fn check(root: impl AsRef<Path>) -> Result<Report> {
    Ok(look(root.as_ref())?.0)
}

/// What is stale.
#[derive(Debug, Default)]
pub(super) struct Todo {
    /// Data files whose places or times are.
    pub(super) data: BTreeSet<(usize, usize)>,
    /// Lists of episodes.
    pub(super) lists: bool,
    /// `info.json` counts other rows.
    pub(super) frames: bool,
}

pub(super) fn look(root: &Path) -> Result<(Report, Todo)> {
    let mut checker = Checker::new(root);
    atomic::names(&root.join("meta"))?;
    checker.run()?;
    checker.report.faults.sort_by_key(|f| (std::cmp::Reverse(f.kind), f.episode.is_none(), f.episode));
    Ok((checker.report, checker.todo))
}

struct Checker {
    root: PathBuf,
    report: Report,
    todo: Todo,
    /// Tables of videos that were read already.
    videos: BTreeMap<PathBuf, Times>,
    /// Columns that are known not to be supported: said once, not once an episode.
    unsupported: BTreeSet<String>,
}

/// Features whose numbers lie in the data files.
pub(super) fn stored(info: &Info) -> Features {
    info.features.iter().filter(|(_, f)| f.dtype != Dtype::Video).cloned().collect()
}

impl Checker {
    fn new(root: &Path) -> Self {
        let report = Report {
            root: root.to_owned(),
            episodes: 0,
            frames: 0,
            whole: 0,
            verified_files: 0,
            unverified_files: 0,
            faults: vec![],
            repairs: vec![],
        };
        let (todo, videos, unsupported) = (Todo::default(), BTreeMap::new(), BTreeSet::new());
        Self { root: root.to_owned(), report, todo, videos, unsupported }
    }

    fn damage(&mut self, path: &Path, message: String, episode: Option<usize>, repairable: bool) {
        let kind = FaultKind::Damage;
        self.report.faults.push(Fault { path: path.to_owned(), message, kind, episode, repairable });
    }

    fn stale(&mut self, path: &Path, message: String, episode: Option<usize>) {
        let kind = FaultKind::Stale;
        let fault = Fault { path: path.to_owned(), message, kind, episode, repairable: true };
        self.report.faults.push(fault);
    }

    /// What a reader said: damage, or what is not supported here.
    fn error(&mut self, path: &Path, error: &Error, episode: Option<usize>, repairable: bool) {
        if error.is_unsupported() {
            let (kind, message) = (FaultKind::Unsupported, error.to_string());
            let fault = Fault { path: path.to_owned(), message, kind, episode, repairable: false };
            self.report.faults.push(fault);
        } else {
            self.damage(path, error.to_string(), episode, repairable);
        }
    }

    fn run(&mut self) -> Result<()> {
        let path = info_path(&self.root);
        let info = match read_info(&self.root) {
            Ok(info) => info,
            Err(e) => {
                self.error(&path, &e, None, false);
                return Ok(());
            }
        };
        (self.report.episodes, self.report.frames) = (info.total_episodes, info.total_frames);
        for skipped in &info.skipped {
            let what = format!("feature `{}`, which was not looked at", skipped.name);
            self.error(&path, &unsupported(&path, &what, &skipped.expected, &skipped.found), None, false);
        }
        let (spans, lists) = self.lists(&info)?;
        self.report.whole = spans.len();
        if spans.len() < info.total_episodes && self.report.has(FaultKind::Unsupported) {
            // Which files are whose is not known.
            return Ok(());
        }
        let tasks = self.tasks(&info);
        let dataset = Dataset::with_spans(&self.root, info, tasks.unwrap_or_default(), spans);
        self.checksums(&dataset);
        let statistics = self.statistics(&dataset, &lists);
        for episode in 0..dataset.len() {
            self.episode(&dataset, episode, statistics.get(episode));
        }
        let damaged = self.report.faults.iter().filter(|f| f.kind == FaultKind::Damage);
        let broken = damaged.filter_map(|f| f.episode).min();
        self.report.whole = broken.unwrap_or(dataset.len()).min(dataset.len());
        self.totals(&dataset);
        self.leftovers(&dataset, &lists)
    }

    /// The places of episodes, as far as they can be read, and the files that they are listed in.
    fn lists(&mut self, info: &Info) -> Result<(Vec<EpisodeSpan>, Vec<PathBuf>)> {
        let (mut spans, mut lists) = (vec![], vec![]);
        let mut readable = true;
        for path in episodes::files(&episodes::folder(&self.root))? {
            if spans.len() == info.total_episodes {
                break;
            }
            let before = spans.len();
            let mut stale = vec![];
            let result = episodes::read_file(&path, info, &mut spans, &mut stale);
            lists.push(path.clone());
            for message in stale {
                self.todo.lists = true;
                self.stale(&path, message, Some(before));
            }
            if let Err(e) = result {
                self.error(&path, &e, Some(spans.len()), true);
                readable = false;
                break;
            }
            if let Ok(file) = ParquetFile::open(&path) {
                self.groups(&file, &|rows| Some(before + rows.start).filter(|&e| e < spans.len()));
            }
        }
        if spans.len() < info.total_episodes && readable {
            let message = format!("expected {} episodes, found {} listed", info.total_episodes, spans.len());
            self.damage(&info_path(&self.root), message, Some(spans.len()), true);
        }
        Ok((spans, lists))
    }

    fn tasks(&mut self, info: &Info) -> Option<Vec<String>> {
        let path = tasks::path(&self.root);
        match tasks::read(&self.root) {
            Ok(tasks) => {
                // More are left where a commit was cut off, and do no harm.
                if tasks.len() < info.total_tasks {
                    let message = format!("expected {} tasks, found {}", info.total_tasks, tasks.len());
                    self.damage(&path, message, None, false);
                }
                Some(tasks)
            }
            Err(e) => {
                self.error(&path, &e, None, false);
                None
            }
        }
    }

    /// Compares the checksums of one file; `episode` says which is the first in given rows.
    fn groups(&mut self, file: &ParquetFile, episode: &dyn Fn(std::ops::Range<usize>) -> Option<usize>) {
        match file.damaged_groups() {
            Ok(None) => self.report.unverified_files += 1,
            Ok(Some(damaged)) => {
                self.report.verified_files += 1;
                for group in damaged {
                    let rows = file.group_rows(group);
                    let message = format!(
                        "{}: rows {} to {}: expected the checksum in the footer, found another",
                        file.path.display(),
                        rows.start,
                        rows.end.saturating_sub(1)
                    );
                    let first = episode(rows);
                    self.damage(&file.path, message, first, first.is_some());
                }
            }
            Err(e) => {
                let first = episode(0..1);
                self.error(&file.path, &e, first, first.is_some());
            }
        }
    }

    fn checksums(&mut self, dataset: &Dataset) {
        let mut first = 0;
        while let Some(span) = dataset.episodes().get(first) {
            let in_file = dataset.episodes()[first..].iter().take_while(|e| e.file == span.file).count();
            let spans = &dataset.episodes()[first..first + in_file];
            let opened = dataset.data_path(span.file).and_then(|p| ParquetFile::open(&p));
            match opened {
                Ok(file) => {
                    let rows: usize = spans.iter().map(|e| e.length).sum();
                    let at = |rows: std::ops::Range<usize>| {
                        let mut end = 0;
                        let holds = spans.iter().position(|e| {
                            end += e.length;
                            end > rows.start
                        });
                        holds.map(|i| first + i)
                    };
                    self.groups(&file, &at);
                    if file.rows() > rows {
                        let message = format!(
                            "{}: expected {rows} rows, found {}: some that no episode counts",
                            file.path.display(),
                            file.rows()
                        );
                        self.damage(&file.path, message, None, true);
                    }
                }
                Err(e) => {
                    let path = dataset.data_path(span.file).unwrap_or_default();
                    self.error(&path, &e, Some(first), true);
                }
            }
            first += in_file;
        }
    }

    /// The statistics of each episode, as far as they can be read.
    fn statistics(&mut self, dataset: &Dataset, lists: &[PathBuf]) -> Vec<Stats> {
        let mut found = vec![];
        for path in lists {
            let left = dataset.len().saturating_sub(found.len());
            let rows = ParquetFile::open(path).map_or(0, |f| f.rows()).min(left);
            match episodes::read_stats(path, &stored(dataset.info()), rows) {
                Ok(stats) => found.extend(stats),
                Err(e) => {
                    self.todo.lists = true;
                    self.stale(path, e.to_string(), Some(found.len()));
                    break;
                }
            }
        }
        found
    }

    /// Reads one episode whole: types, ranges, times, images and videos, and that its statistics are its own.
    fn episode(&mut self, dataset: &Dataset, episode: usize, stats: Option<&Stats>) {
        let span = &dataset.episodes()[episode];
        let path = dataset.data_path(span.file).unwrap_or_default();
        let stored = stored(dataset.info());
        let names: Vec<&str> = stored.iter().map(|(n, _)| n.as_str()).collect();
        let table = dataset.read_columns(episode, &names).or_else(|e| {
            // The file as a whole: said once.
            if e.is_unsupported() && dataset.read_columns(episode, &["timestamp"]).is_err() {
                return Err(e);
            }
            // Each by itself: what is damaged in one column is to be found beside what is not supported in another.
            let mut table = Table { rows: span.length, columns: vec![] };
            let mut blamed = false;
            for name in &names {
                match dataset.read_columns(episode, &[name]) {
                    Ok(found) => table.columns.extend(found.columns),
                    Err(e) => {
                        blamed = true;
                        if !e.is_unsupported() {
                            return Err(e);
                        }
                        if self.unsupported.insert((*name).to_owned()) {
                            self.error(&path, &e, Some(episode), false);
                        }
                    }
                }
            }
            if blamed { Ok(table) } else { Err(e) }
        });
        let table = match table {
            Ok(table) => table,
            Err(e) if e.is_unsupported() && !self.unsupported.insert(e.to_string()) => return,
            Err(e) => return self.error(&path, &e, Some(episode), true),
        };
        // Said already.
        if DEFAULT_FEATURES.iter().any(|(name, _)| table.column(name).is_none()) {
            return;
        }
        if let Err(e) = check_rows(dataset, episode, span, &table) {
            if !e.is_unsupported() || self.unsupported.insert(e.to_string()) {
                self.error(&path, &e, Some(episode), true);
            }
            return;
        }
        if let Some(message) = stale_rows(dataset, episode, span, &table, &path) {
            self.todo.data.insert(span.file);
            self.stale(&path, message, Some(episode));
        }
        let list = episodes::path(dataset.root(), span.listed_in);
        if let Some(stats) = stats
            && let Err(e) = check_stats(&table, dataset.info(), stats, &list, episode)
        {
            self.todo.lists = true;
            self.stale(&list, e.to_string(), Some(episode));
        }
        self.videos(dataset, episode, span);
    }

    /// Every frame is there, at its time.
    fn videos(&mut self, dataset: &Dataset, episode: usize, span: &EpisodeSpan) {
        let fps = dataset.info().fps;
        for (name, video) in &span.videos {
            let path = match dataset.video_path(name, video.file) {
                Ok(path) => path,
                Err(e) => {
                    self.error(&info_path(&self.root), &e, Some(episode), false);
                    continue;
                }
            };
            if !self.videos.contains_key(&path) {
                match Times::read(&path) {
                    Ok(times) => drop(self.videos.insert(path.clone(), times)),
                    Err(e) => {
                        self.error(&path, &e, Some(episode), true);
                        continue;
                    }
                }
            }
            let Some(times) = self.videos.get(&path) else { continue };
            if let Err(e) = times.check(&path, video.from, span.length, fps) {
                self.error(&path, &e, Some(episode), true);
            } else if (video.to - video.from - span.length as f64 / fps).abs() > 1.5 / fps {
                let list = episodes::path(dataset.root(), span.listed_in);
                let what = format!("column `videos/{name}/to_timestamp`, episode {episode}");
                let expected = video.from + span.length as f64 / fps;
                let e = file_error(&list, &what, expected.to_string(), video.to.to_string());
                self.todo.lists = true;
                self.stale(&list, e.to_string(), Some(episode));
            }
        }
    }

    /// Counts and statistics over all episodes.
    fn totals(&mut self, dataset: &Dataset) {
        let path = info_path(&self.root);
        let frames = dataset.episodes().last().map_or(0, |e| e.from + e.length);
        if dataset.len() == dataset.info().total_episodes && frames != dataset.info().total_frames {
            let message = format!("total_frames: expected {frames}, found {}", dataset.info().total_frames);
            self.todo.frames = true;
            self.stale(&path, message, None);
        }
        let path = self.root.join("meta/stats.json");
        if let Ok(total) = writer::total_stats(&self.root, &stored(dataset.info()), dataset.len())
            && let Err(e) = check_totals(&path, &total, dataset.info())
        {
            self.stale(&path, e.to_string(), None);
        }
    }

    /// Files that nothing counts: LeRobot reads every Parquet file that it finds.
    fn leftovers(&mut self, dataset: &Dataset, lists: &[PathBuf]) -> Result<()> {
        for path in uncounted(&self.root, dataset, lists)? {
            let message = format!("{}: expected no file, found one that nothing counts", path.display());
            self.damage(&path, message, None, true);
        }
        for path in writer::unfinished(&self.root)? {
            let message = format!("{}: left behind by a writer that was killed", path.display());
            self.damage(&path, message, None, true);
        }
        Ok(())
    }
}

/// Parquet files that hold none of the dataset's episodes.
pub(super) fn uncounted(root: &Path, dataset: &Dataset, lists: &[PathBuf]) -> Result<Vec<PathBuf>> {
    let mut counted: BTreeSet<PathBuf> = lists.iter().cloned().collect();
    for span in dataset.episodes() {
        counted.extend(dataset.data_path(span.file));
    }
    let folders: BTreeSet<PathBuf> =
        counted.iter().filter_map(|p| Some(p.parent()?.parent()?.to_owned())).collect();
    let all = folders.into_iter().chain([episodes::folder(root), root.join("data")]).collect::<BTreeSet<_>>();
    let mut found = vec![];
    for folder in all {
        found.extend(episodes::files(&folder)?.into_iter().filter(|p| !counted.contains(p)));
    }
    Ok(found)
}
