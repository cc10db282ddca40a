//! What the rows of one episode, and their statistics, have to be.

use super::dataset::{Dataset, LARGEST_JSON};
use super::episodes::EpisodeSpan;
use super::info::Info;
use super::stats::{QUANTILES, Stats};
use super::table::{Column, Table};
use super::{picture, stats};
use crate::Result;
use crate::file::{file_error, read_regular};
use std::path::Path;

/// Times may differ from their row's by this much, s: LeRobot's own tolerance.
const TIME_TOLERANCE: f64 = 1e-4;

/// Types, ranges, times and images of one episode.
pub(super) fn check_rows(dataset: &Dataset, episode: usize, span: &EpisodeSpan, table: &Table) -> Result<()> {
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
pub(super) fn stale_rows(
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
pub(super) fn check_stats(
    table: &Table,
    info: &Info,
    noted: &Stats,
    path: &Path,
    episode: usize,
) -> Result<()> {
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
pub(super) fn check_totals(path: &Path, total: &Stats, info: &Info) -> Result<()> {
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
