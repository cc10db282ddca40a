//! Repairs what [`super::check()`] finds: cuts damage off, and takes anew what is stale.

use super::arrow::{plain, replace_columns};
use super::check::{FaultKind, Report, Todo, check, look, stored, uncounted};
use super::dataset::{Dataset, LARGEST_JSON, info_path, read_info};
use super::feature::Dtype;
use super::info::Info;
use super::parquet_file::ParquetFile;
use super::table::Column;
use super::{episodes, stats, writer};
use crate::Result;
use crate::atomic::{self, io};
use crate::file::{file_error, read_regular, unsupported};
use std::path::{Path, PathBuf};

/// Where [`repair`] puts what it cuts off, below the dataset's folder. Neither reader looks there.
pub const REMOVED: &str = "removed";

/// Passes of a repair. Rows, lists of episodes and totals follow from each other in this order, after what is cut off.
const PASSES: usize = 4;

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
        // LeRobot keeps times as f32.
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
