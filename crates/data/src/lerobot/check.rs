//! Looks for what is not as it should be in a dataset: cuts off what is damaged, and takes anew what is only out of date.

use super::dataset::{Dataset, LARGEST_JSON, info_path, read_info};
use super::episodes::{self, EpisodeSpan};
use super::feature::{DEFAULT_FEATURES, Dtype, Features, Info};
use super::mp4::Times;
use super::parquet_file::{ParquetFile, plain, replace_columns};
use super::stats::{self, QUANTILES, Stats};
use super::table::{Column, Table};
use super::{picture, tasks, writer};
use crate::atomic::{self, io};
use crate::file::{file_error, read_regular, unsupported};
use crate::{Error, Result};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Where [`repair`] puts what it cuts off, below the dataset's folder. Neither reader looks there.
pub const REMOVED: &str = "removed";
/// Times may differ from their row's by this much, s: LeRobot's own tolerance.
const TIME_TOLERANCE: f64 = 1e-4;
/// Passes of a repair. Rows, lists of episodes and totals follow from each other in this order, after what is cut off.
const PASSES: usize = 4;

/// What a finding means for the rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum FaultKind {
    /// The rows are whole; what is noted of them beside is missing or out of date. [`repair`] takes it anew from the rows.
    Stale,
    /// Not read here, which says nothing of the rows. As long as there is one, [`repair`] touches nothing.
    Unsupported,
    /// Lost. [`repair`] cuts it off.
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
    /// Whether [`repair`] can do something about it.
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

/// As [`check`]; then cuts the dataset off after its last whole episode and removes files that nothing counts, where there is
/// damage, and takes anew from the rows what is stale: places, times, statistics. What was there before lies in [`REMOVED`].
/// Killed at any instant it can be run again. Where anything is not supported here, it does nothing at all.
///
/// # Errors
/// When nothing is left to keep, when a symbolic link leads out of the dataset, or when the file system refuses.
pub fn repair(root: impl AsRef<Path>) -> Result<Report> {
    let root = root.as_ref();
    let mut repairs = vec![];
    for _ in 0..PASSES {
        let (report, todo) = look(root)?;
        if report.has(FaultKind::Unsupported) || !report.faults.iter().any(|f| f.repairable) {
            return Ok(Report { repairs, ..report });
        }
        refuse_links(root)?;
        if report.faults.iter().any(|f| f.kind == FaultKind::Damage && f.repairable) {
            if report.whole == 0 {
                return Err(file_error(
                    &info_path(root),
                    "episodes",
                    "at least one whole one to keep",
                    "none",
                ));
            }
            repairs.extend(cut(root, report.whole)?);
        } else if report.has(FaultKind::Damage) {
            // What can be neither read nor cut off is not to be written over.
            return Ok(Report { repairs, ..report });
        } else {
            repairs.extend(renew(root, &todo)?);
        }
    }
    Ok(Report { repairs, ..check(root)? })
}

/// What is stale.
#[derive(Debug, Default)]
struct Todo {
    /// Data files whose places or times are.
    data: BTreeSet<(usize, usize)>,
    /// Lists of episodes.
    lists: bool,
    /// `info.json` counts other rows.
    frames: bool,
}

fn look(root: &Path) -> Result<(Report, Todo)> {
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
fn stored(info: &Info) -> Features {
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

/// Nothing is changed through a symbolic link: what it leads to may be another's.
fn refuse_links(root: &Path) -> Result<()> {
    let mut folders = vec![root.to_owned()];
    while let Some(folder) = folders.pop() {
        for path in atomic::names(&folder)? {
            let found = std::fs::symlink_metadata(&path).map_err(io("look at", &path))?;
            if found.is_symlink() && !path.starts_with(root.join("videos")) {
                return Err(unsupported(&path, "repair", "a file of the dataset's own", "a symbolic link"));
            }
            // Videos are never changed.
            if found.is_dir() && path != root.join("videos") {
                folders.push(path);
            }
        }
    }
    Ok(())
}

/// Parquet files that hold none of the dataset's episodes.
fn uncounted(root: &Path, dataset: &Dataset, lists: &[PathBuf]) -> Result<Vec<PathBuf>> {
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

/// Types, ranges, times and images of one episode.
fn check_rows(dataset: &Dataset, episode: usize, span: &EpisodeSpan, table: &Table) -> Result<()> {
    let info = dataset.info();
    let path = dataset.data_path(span.file)?;
    let first = dataset.rows_in_file(episode, span).start;
    let place = |name: &str, row: usize| format!("column `{name}`, row {}", first + row);
    for (row, &task) in table.i64("task_index")?.iter().enumerate() {
        if !dataset.tasks().is_empty() && usize::try_from(task).map_or(true, |t| t >= dataset.tasks().len()) {
            let expected = format!("below {}", dataset.tasks().len());
            return Err(file_error(&path, &place("task_index", row), expected, task.to_string()));
        }
    }
    for (name, feature) in &info.features {
        let Some(column) = table.column(name) else { continue };
        let width = if feature.is_visual() { 1 } else { feature.width() };
        if let (Column::Png(files), Some((height, width))) = (column, feature.image_size()) {
            for (row, file) in files.iter().enumerate() {
                picture::decode(file, height, width, &path, &place(name, row))?;
            }
        }
        if let Some(numbers) = column.numbers()
            && let Some(i) = numbers.iter().position(|v| !v.is_finite())
        {
            let what = place(name, i / width);
            return Err(file_error(&path, &what, "a finite number", numbers[i].to_string()));
        }
    }
    for (row, &time) in table.f32("timestamp")?.iter().enumerate() {
        let expected = row as f64 / info.fps;
        if (f64::from(time) - expected).abs() >= 0.5 / info.fps {
            return Err(file_error(&path, &place("timestamp", row), expected.to_string(), time.to_string()));
        }
    }
    Ok(())
}

/// The first place or time that the rows' order says better.
fn stale_rows(
    dataset: &Dataset,
    episode: usize,
    span: &EpisodeSpan,
    table: &Table,
    path: &Path,
) -> Option<String> {
    let fps = dataset.info().fps;
    let first = dataset.rows_in_file(episode, span).start;
    let says = |name: &str, row: usize, expected: String, found: String| {
        let what = format!("column `{name}`, row {}", first + row);
        Some(file_error(path, &what, expected, found).to_string())
    };
    for (row, &time) in table.f32("timestamp").ok()?.iter().enumerate() {
        let expected = row as f64 / fps;
        if (f64::from(time) - expected).abs() > TIME_TOLERANCE + expected * f64::from(f32::EPSILON) {
            return says("timestamp", row, expected.to_string(), time.to_string());
        }
    }
    for (name, begin, step) in [("index", span.from, 1), ("episode_index", episode, 0)] {
        for (row, &found) in table.i64(name).ok()?.iter().enumerate() {
            let expected = begin + step * row;
            if usize::try_from(found).ok() != Some(expected) {
                return says(name, row, expected.to_string(), found.to_string());
            }
        }
    }
    None
}

/// The least and the largest number of every column, and the count, are those that were noted when it was written.
fn check_stats(table: &Table, info: &Info, noted: &Stats, path: &Path, episode: usize) -> Result<()> {
    for (name, feature) in info.features.iter().filter(|(_, f)| !f.is_visual()) {
        let Some(numbers) = table.column(name).and_then(Column::numbers) else { continue };
        let Some((_, noted)) = noted.iter().find(|(n, _)| n == name) else { continue };
        let width = feature.shape.last().copied().unwrap_or(1);
        for entry in 0..width {
            let column = || numbers.iter().skip(entry).step_by(width).copied();
            let bounds = [column().fold(f64::INFINITY, f64::min), column().fold(f64::NEG_INFINITY, f64::max)];
            for (what, expected, found) in
                [("min", noted.min[entry], bounds[0]), ("max", noted.max[entry], bounds[1])]
            {
                // LeRobot notes times before they become 32-bit numbers.
                if (expected - found).abs() > 1e-5 * expected.abs().max(found.abs()).max(1.0) {
                    let what = format!("column `stats/{name}/{what}`, episode {episode}, entry {entry}");
                    return Err(file_error(path, &what, found.to_string(), expected.to_string()));
                }
            }
        }
        if noted.count != table.rows as u64 {
            let what = format!("column `stats/{name}/count`, episode {episode}");
            return Err(file_error(path, &what, table.rows.to_string(), noted.count.to_string()));
        }
    }
    Ok(())
}

/// `stats.json` is the sum over the episodes.
fn check_totals(path: &Path, total: &Stats, info: &Info) -> Result<()> {
    let text = read_regular(path, LARGEST_JSON)?;
    let found: serde_json::Value =
        serde_json::from_slice(&text).map_err(|e| file_error(path, "JSON", "statistics", e.to_string()))?;
    let expected = stats::to_json(total, &info.features);
    for (name, _) in total {
        for key in ["count", "min", "max", "mean"] {
            let (want, got) = (&expected[name][key], &found[name][key]);
            if !close(want, got) {
                let what = format!("`{name}`, {key}");
                return Err(file_error(path, &what, want.to_string(), got.to_string()));
            }
        }
        // Of others that took them by another rule, but there.
        for key in QUANTILES.iter().map(|q| q.0).chain(["std"]) {
            let (want, got) = (&expected[name][key], &found[name][key]);
            if want.as_array().map(Vec::len) != got.as_array().map(Vec::len) {
                let what = format!("`{name}`, {key}");
                return Err(file_error(path, &what, want.to_string(), got.to_string()));
            }
        }
    }
    Ok(())
}

/// Same shape, and numbers equal to a hundred-thousandth: sums of others may have been taken in 32 bits.
fn close(a: &serde_json::Value, b: &serde_json::Value) -> bool {
    match (a.as_array(), b.as_array()) {
        (Some(a), Some(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| close(a, b)),
        (None, None) => match (a.as_f64(), b.as_f64()) {
            (Some(a), Some(b)) => (a - b).abs() <= 1e-5 * a.abs().max(b.abs()).max(1.0),
            _ => a == b,
        },
        _ => false,
    }
}

/// Cuts the dataset off after `whole` episodes; says what was done.
fn cut(root: &Path, whole: usize) -> Result<Vec<String>> {
    let mut done = vec![];
    let mut info = read_info(root)?;
    let mut spans = vec![];
    let mut lists = vec![];
    let mut listed = info.clone();
    listed.total_episodes = whole;
    for path in episodes::files(&episodes::folder(root))? {
        if spans.len() == whole {
            break;
        }
        let before = spans.len();
        episodes::read_file(&path, &listed, &mut spans, &mut vec![])?;
        lists.push((path, spans.len() - before));
    }
    let frames = spans.last().map_or(0, |e| e.from + e.length);
    // The count first: from here on nobody reads what is cut off below, and a kill leaves only files that nothing counts.
    if (info.total_episodes, info.total_frames) != (whole, frames) {
        done.push(format!("kept the first {whole} of {} episodes", info.total_episodes));
        (info.total_episodes, info.total_frames) = (whole, frames);
        info.splits.insert("train".to_owned(), format!("0:{whole}").into());
        writer::write_json(&info_path(root), &info)?;
    }
    renew_totals(root, &info, spans.len(), &mut done)?;

    let dataset = Dataset::with_spans(root, info, vec![], spans);
    if let Some(last) = dataset.episodes().last() {
        let path = dataset.data_path(last.file)?;
        let first = dataset.rows_in_file(whole - 1, last).end;
        let in_file = dataset.episodes().iter().filter(|e| e.file == last.file);
        let ends: Vec<usize> = in_file
            .scan(0, |end, e| {
                *end += e.length;
                Some(*end)
            })
            .collect();
        shorten(root, &path, first, &ends, &mut done)?;
    }
    if let Some((path, rows)) = lists.last() {
        shorten(root, path, *rows, &[*rows], &mut done)?;
    }
    let lists: Vec<PathBuf> = lists.into_iter().map(|(p, _)| p).collect();
    for path in uncounted(root, &dataset, &lists)? {
        set_aside(root, &path)?;
        std::fs::remove_file(&path).map_err(io("remove", &path))?;
        atomic::sync(path.parent().unwrap_or(root))?;
        done.push(format!("removed {}", path.display()));
    }
    for path in writer::unfinished(root)? {
        std::fs::remove_file(&path).map_err(io("remove", &path))?;
        done.push(format!("removed {}", path.display()));
    }
    Ok(done)
}

/// Takes anew what is stale: rows first, then the lists of episodes, then the totals. What follows from what was written is
/// stale only then, and is left to the next pass.
fn renew(root: &Path, todo: &Todo) -> Result<Vec<String>> {
    let mut done = vec![];
    let mut info = read_info(root)?;
    let (mut spans, mut lists) = (vec![], vec![]);
    for path in episodes::files(&episodes::folder(root))? {
        if spans.len() == info.total_episodes {
            break;
        }
        let before = spans.len();
        episodes::read_file(&path, &info, &mut spans, &mut vec![])?;
        lists.push((path, before..spans.len()));
    }
    if todo.frames {
        info.total_frames = spans.last().map_or(0, |e| e.from + e.length);
        writer::write_json(&info_path(root), &info)?;
        done.push(format!("counted {} rows in meta/info.json", info.total_frames));
    }
    let dataset = Dataset::with_spans(root, info, vec![], spans);
    for &file in &todo.data {
        renew_rows(&dataset, file, &mut done)?;
    }
    if todo.data.is_empty() && todo.lists {
        for (path, listed) in &lists {
            renew_list(&dataset, path, listed.clone(), &mut done)?;
        }
    }
    if todo.data.is_empty() {
        renew_totals(root, dataset.info(), dataset.len(), &mut done)?;
    }
    Ok(done)
}

/// Places and times of the rows of one data file, by their order.
fn renew_rows(dataset: &Dataset, file: (usize, usize), done: &mut Vec<String>) -> Result<()> {
    let path = dataset.data_path(file)?;
    let fps = dataset.info().fps;
    let (mut ends, mut end) = (vec![], 0);
    let (mut times, mut index, mut number) = (vec![], vec![], vec![]);
    for (episode, span) in dataset.episodes().iter().enumerate().filter(|(_, e)| e.file == file) {
        end += span.length;
        ends.push(end);
        #[allow(clippy::cast_possible_truncation, reason = "LeRobot keeps times as f32")]
        times.extend((0..span.length).map(|row| (row as f64 / fps) as f32));
        index.extend((0..span.length).map(|row| i64::try_from(span.from + row).unwrap_or(i64::MAX)));
        number.extend(std::iter::repeat_n(i64::try_from(episode).unwrap_or(i64::MAX), span.length));
    }
    set_aside(dataset.root(), &path)?;
    ParquetFile::open(&path)?.rewrite(&ends, &|_| true, &mut |batch, first| {
        let rows = first..first + batch.num_rows();
        let wrong = || file_error(&path, "file", format!("{end} rows"), "others");
        let columns = vec![
            ("timestamp".to_owned(), Column::F32(times.get(rows.clone()).ok_or_else(wrong)?.to_vec())),
            ("index".to_owned(), Column::I64(index.get(rows.clone()).ok_or_else(wrong)?.to_vec())),
            ("episode_index".to_owned(), Column::I64(number.get(rows).ok_or_else(wrong)?.to_vec())),
        ];
        replace_columns(batch, columns.into_iter().map(|(name, c)| (name, plain(&c))).collect(), &path)
    })?;
    done.push(format!("took places and times anew in {}", path.display()));
    Ok(())
}

/// Places and statistics of the episodes of one list, from their rows. Statistics of videos stay as they are.
fn renew_list(
    dataset: &Dataset,
    path: &Path,
    listed: std::ops::Range<usize>,
    done: &mut Vec<String>,
) -> Result<()> {
    let info = dataset.info();
    let stored = stored(info);
    let names: Vec<&str> = stored.iter().map(|(n, _)| n.as_str()).collect();
    let mut entries = vec![];
    for episode in listed.clone() {
        let stats = stats::of_table(&dataset.read_columns(episode, &names)?, &stored)?;
        entries.push(episodes::Entry { index: episode, span: dataset.episodes()[episode].clone(), stats });
    }
    let anew = |column: &str| {
        let of_rows = column.strip_prefix("stats/").and_then(|c| c.rsplit_once('/'));
        !of_rows.is_some_and(|(name, _)| names.contains(&name))
    };
    set_aside(dataset.root(), path)?;
    ParquetFile::open(path)?.rewrite(&[listed.len()], &anew, &mut |batch, first| {
        let entries = &entries[first..first + batch.num_rows()];
        replace_columns(batch, episodes::renewed(entries, info, path)?, path)
    })?;
    done.push(format!("took places and statistics anew in {}", path.display()));
    Ok(())
}

/// `stats.json` from the lists of episodes. What it says of videos is kept where the lists say nothing of them.
fn renew_totals(root: &Path, info: &Info, episodes: usize, done: &mut Vec<String>) -> Result<()> {
    let path = root.join("meta/stats.json");
    let mut total = match writer::total_stats(root, &stored(info), episodes) {
        Ok(total) => total,
        Err(e) => {
            done.push(format!("left meta/stats.json as it is: {e}"));
            return Ok(());
        }
    };
    for feature in info.features.iter().filter(|(_, f)| f.dtype == Dtype::Video) {
        total.extend(writer::total_stats(root, &vec![feature.clone()], episodes).unwrap_or_default());
    }
    let before = read_regular(&path, LARGEST_JSON).ok().and_then(|t| serde_json::from_slice(&t).ok());
    let mut whole: serde_json::Map<String, serde_json::Value> = before.unwrap_or_default();
    if let serde_json::Value::Object(new) = stats::to_json(&total, &info.features) {
        whole.extend(new);
    }
    writer::write_json(&path, &whole)?;
    done.push("took the statistics anew".to_owned());
    Ok(())
}

/// Leaves the first `rows` rows of a file.
fn shorten(root: &Path, path: &Path, rows: usize, ends: &[usize], done: &mut Vec<String>) -> Result<()> {
    let file = ParquetFile::open(path)?;
    if file.rows() == rows {
        return Ok(());
    }
    set_aside(root, path)?;
    file.rewrite(ends, &|_| true, &mut |batch, _| Ok(batch.clone()))?;
    done.push(format!("cut {} off after row {rows}", path.display()));
    Ok(())
}

/// Keeps a second name for a file below [`REMOVED`], or a copy where there can be no second name.
fn set_aside(root: &Path, path: &Path) -> Result<()> {
    let place = root.join(REMOVED).join(path.strip_prefix(root).unwrap_or(Path::new("file")));
    atomic::make_folder(place.parent().unwrap_or(root))?;
    if place.exists() {
        std::fs::remove_file(&place).map_err(io("remove", &place))?;
    }
    if std::fs::hard_link(path, &place).is_err() {
        std::fs::copy(path, &place).map_err(io("copy to", &place))?;
    }
    Ok(())
}
