//! Looks for damage in a dataset, and cuts it off.

use super::dataset::{Dataset, info_path, read_info};
use super::episodes::{self, EpisodeSpan};
use super::feature::{Dtype, Info};
use super::parquet_file::ParquetFile;
use super::stats::{self, Stats};
use super::table::{Column, Table};
use super::{picture, tasks, writer};
use crate::atomic::{self, io};
use crate::file::file_error;
use crate::{Error, Result};
use serde::Serialize;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Where [`repair`] puts what it cuts off, below the dataset's folder. Neither reader looks there.
pub const REMOVED: &str = "removed";
/// Times may differ from their row's by this much, s: LeRobot's own tolerance.
const TIME_TOLERANCE: f64 = 1e-4;

/// Something that is not as it should be.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Fault {
    /// The file.
    pub path: PathBuf,
    /// What is wrong with it, with row and column where there are such.
    pub message: String,
    /// The first episode that is not whole because of it; none where all are.
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
    /// Episodes before the first that is not whole: what a repair leaves.
    pub whole: usize,
    /// Data files whose checksums were compared.
    pub verified_files: usize,
    /// Data files without checksums, written by others: their rows were decoded, but a changed digit goes unseen there.
    pub unverified_files: usize,
    /// All faults, in the order of the files.
    pub faults: Vec<Fault>,
    /// What a repair did, a line each.
    pub repairs: Vec<String>,
}

impl Report {
    /// True without faults.
    #[must_use]
    pub fn is_sound(&self) -> bool {
        self.faults.is_empty()
    }
}

/// Reads every row and every image of a dataset and compares counts, types, ranges and checksums. Finds all faults, not only
/// the first. Changes nothing.
///
/// # Errors
/// When the folder itself cannot be read; damage is part of the report.
pub fn check(root: impl AsRef<Path>) -> Result<Report> {
    let root = root.as_ref();
    let mut checker = Checker::new(root);
    atomic::names(&root.join("meta"))?;
    checker.run()?;
    checker.report.faults.sort_by_key(|f| (f.episode.is_none(), f.episode));
    Ok(checker.report)
}

/// As [`check`], then cuts the dataset off after its last whole episode where that is needed, removes files that nothing
/// counts, and takes the statistics anew. What is removed lies in [`REMOVED`]. Killed at any instant it can be run again.
///
/// # Errors
/// When nothing is left to keep, or the file system refuses.
pub fn repair(root: impl AsRef<Path>) -> Result<Report> {
    let root = root.as_ref();
    let mut report = check(root)?;
    if report.is_sound() || !report.faults.iter().any(|f| f.repairable) {
        return Ok(report);
    }
    if report.whole == 0 {
        return Err(file_error(&info_path(root), "episodes", "at least one whole one to keep", "none"));
    }
    let repairs = cut(root, report.whole)?;
    report = check(root)?;
    report.repairs = repairs;
    Ok(report)
}

struct Checker {
    root: PathBuf,
    report: Report,
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
        Self { root: root.to_owned(), report }
    }

    fn fault(&mut self, path: &Path, message: String, episode: Option<usize>, repairable: bool) {
        self.report.faults.push(Fault { path: path.to_owned(), message, episode, repairable });
    }

    fn error(&mut self, path: &Path, error: &Error, episode: Option<usize>, repairable: bool) {
        self.fault(path, error.to_string(), episode, repairable);
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
        let (spans, lists) = self.lists(&info)?;
        self.report.whole = spans.len();
        let tasks = self.tasks(&info);
        let dataset = Dataset::with_spans(&self.root, info, tasks.unwrap_or_default(), spans);
        self.checksums(&dataset);
        let statistics = self.statistics(&dataset, &lists);
        for (episode, span) in dataset.episodes().iter().enumerate() {
            let found = statistics.get(episode);
            if let Err(e) = check_episode(&dataset, episode, span, found) {
                let path = dataset.data_path(span.file).unwrap_or_default();
                self.error(&path, &e, Some(episode), true);
            }
        }
        let broken = self.report.faults.iter().filter_map(|f| f.episode).min();
        self.report.whole = broken.unwrap_or(dataset.len()).min(dataset.len());
        self.totals(&dataset);
        self.leftovers(&dataset, &lists)
    }

    /// The places of episodes, as far as they can be read, and the files that they are listed in.
    fn lists(&mut self, info: &Info) -> Result<(Vec<EpisodeSpan>, Vec<PathBuf>)> {
        let (mut spans, mut lists) = (vec![], vec![]);
        for path in episodes::files(&episodes::folder(&self.root))? {
            if spans.len() == info.total_episodes {
                break;
            }
            let before = spans.len();
            let result = episodes::read_file(&path, info, &mut spans);
            lists.push(path.clone());
            if let Err(e) = result {
                self.error(&path, &e, Some(spans.len()), true);
                break;
            }
            if let Ok(file) = ParquetFile::open(&path) {
                self.groups(&file, &|rows| Some(before + rows.start).filter(|&e| e < spans.len()));
            }
        }
        if spans.len() < info.total_episodes && self.report.faults.is_empty() {
            let message = format!("expected {} episodes, found {} listed", info.total_episodes, spans.len());
            self.fault(&info_path(&self.root), message, Some(spans.len()), true);
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
                    self.fault(&path, message, None, false);
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
                    self.fault(&file.path, message, first, first.is_some());
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
                        self.fault(&file.path, message, None, true);
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
            match episodes::read_stats(path, &dataset.info().features, rows) {
                Ok(stats) => found.extend(stats),
                Err(e) => {
                    self.error(path, &e, None, false);
                    break;
                }
            }
        }
        found
    }

    /// Counts and statistics over all episodes.
    fn totals(&mut self, dataset: &Dataset) {
        let path = info_path(&self.root);
        let frames = dataset.episodes().last().map_or(0, |e| e.from + e.length);
        if dataset.len() == dataset.info().total_episodes && frames != dataset.info().total_frames {
            let message = format!("total_frames: expected {frames}, found {}", dataset.info().total_frames);
            self.fault(&path, message, None, true);
        }
        let path = self.root.join("meta/stats.json");
        if let Ok(total) = writer::total_stats(&self.root, dataset.info(), dataset.episodes())
            && let Err(e) = check_totals(&path, &total, dataset.info())
        {
            self.error(&path, &e, None, true);
        }
    }

    /// Files that nothing counts: LeRobot reads every Parquet file that it finds.
    fn leftovers(&mut self, dataset: &Dataset, lists: &[PathBuf]) -> Result<()> {
        for path in uncounted(&self.root, dataset, lists)? {
            let message = format!("{}: expected no file, found one that nothing counts", path.display());
            self.fault(&path, message, None, true);
        }
        for path in writer::unfinished(&self.root)? {
            let message = format!("{}: left behind by a writer that was killed", path.display());
            self.fault(&path, message, None, true);
        }
        Ok(())
    }
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

/// Reads one episode whole: types, ranges, times, images, and that its statistics are its own.
fn check_episode(dataset: &Dataset, episode: usize, span: &EpisodeSpan, stats: Option<&Stats>) -> Result<()> {
    let info = dataset.info();
    let stored: Vec<&str> =
        info.features.iter().filter(|(_, f)| f.dtype != Dtype::Video).map(|(n, _)| n.as_str()).collect();
    let table = dataset.read_columns(episode, &stored)?;
    let path = dataset.data_path(span.file)?;
    let first = dataset.rows_in_file(episode, span).start;
    let place = |name: &str, row: usize| format!("column `{name}`, row {}", first + row);
    for (row, &time) in table.f32("timestamp")?.iter().enumerate() {
        let expected = row as f64 / info.fps;
        if (f64::from(time) - expected).abs() > TIME_TOLERANCE + expected * f64::from(f32::EPSILON) {
            return Err(file_error(&path, &place("timestamp", row), expected.to_string(), time.to_string()));
        }
    }
    for (row, &task) in table.i64("task_index")?.iter().enumerate() {
        if !dataset.tasks().is_empty() && usize::try_from(task).map_or(true, |t| t >= dataset.tasks().len()) {
            let expected = format!("below {}", dataset.tasks().len());
            return Err(file_error(&path, &place("task_index", row), expected, task.to_string()));
        }
    }
    for (name, feature) in &info.features {
        let Some(column) = table.column(name) else { continue };
        let width = if feature.is_visual() { 1 } else { feature.width() };
        if let (Column::Png(files), [height, width, _]) = (column, &feature.shape[..]) {
            for (row, file) in files.iter().enumerate() {
                picture::decode(file, *height, *width, &path, &place(name, row))?;
            }
        }
        if let Some(numbers) = column.numbers()
            && let Some(i) = numbers.iter().position(|v| !v.is_finite())
        {
            return Err(file_error(
                &path,
                &place(name, i / width),
                "a finite number",
                numbers[i].to_string(),
            ));
        }
    }
    if let Some(stats) = stats {
        check_stats(&table, info, stats, &episodes::path(dataset.root(), span.listed_in), episode)?;
    }
    for (name, video) in &span.videos {
        let file = info.video_file(name, video.file.0, video.file.1).unwrap_or_default();
        let file = dataset.root().join(file);
        let expected = span.length as f64 / info.fps;
        if !file.is_file() {
            return Err(file_error(&file, "video", "a file", "none"));
        }
        if (video.to - video.from - expected).abs() > 1.5 / info.fps {
            let found = format!("{} s to {} s", video.from, video.to);
            return Err(file_error(&file, &format!("episode {episode}"), format!("{expected} s"), found));
        }
    }
    Ok(())
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
    let text = std::fs::read(path).map_err(io("read", path))?;
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
        episodes::read_file(&path, &listed, &mut spans)?;
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
    match writer::total_stats(root, &info, &spans) {
        Ok(total) => {
            writer::write_json(&root.join("meta/stats.json"), &stats::to_json(&total, &info.features))?;
            done.push("took the statistics anew".to_owned());
        }
        Err(e) => done.push(format!("left meta/stats.json as it is: {e}")),
    }

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

/// Leaves the first `rows` rows of a file.
fn shorten(root: &Path, path: &Path, rows: usize, ends: &[usize], done: &mut Vec<String>) -> Result<()> {
    let file = ParquetFile::open(path)?;
    if file.rows() == rows {
        return Ok(());
    }
    set_aside(root, path)?;
    file.truncate(ends)?;
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
