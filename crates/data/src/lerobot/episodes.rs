//! `meta/episodes`: where each episode lies, and its statistics.

use super::arrow::{batch, lists, texts};
use super::feature::{Dtype, Feature, Features};
use super::info::Info;
use super::parquet_file::ParquetFile;
use super::stats::{Bounds, FeatureStats, QUANTILES, Stats, bounds};
use super::table::Column;
use crate::Result;
use crate::atomic::names;
use crate::file::file_error;
use arrow_array::cast::AsArray;
use arrow_array::{Array, ArrayRef, BooleanArray, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_schema::DataType;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// A stretch of a video file.
#[derive(Debug, Clone, PartialEq)]
pub struct VideoSpan {
    /// Folder and file.
    pub file: (usize, usize),
    /// Where it begins, s.
    pub from: f64,
    /// Where it ends, s.
    pub to: f64,
}

/// Where one episode lies.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeSpan {
    /// Rows.
    pub length: usize,
    /// Index of its first row over all episodes.
    pub from: usize,
    /// What was to be done; several where it changed on the way.
    pub tasks: Vec<String>,
    /// Folder and file of its rows.
    pub file: (usize, usize),
    /// Folder and file of this entry.
    pub listed_in: (usize, usize),
    /// Videos by feature.
    pub videos: BTreeMap<String, VideoSpan>,
}

pub(crate) fn folder(root: &Path) -> PathBuf {
    root.join("meta/episodes")
}

pub(crate) fn path(root: &Path, (chunk, file): (usize, usize)) -> PathBuf {
    folder(root).join(format!("chunk-{chunk:03}/file-{file:03}.parquet"))
}

/// Files `chunk-*/*.parquet` below a folder in the order of their names, which is LeRobot's.
pub(crate) fn files(folder: &Path) -> Result<Vec<PathBuf>> {
    let mut found = vec![];
    for chunk in names(folder)?.into_iter().filter(|p| p.is_dir()) {
        found.extend(names(&chunk)?.into_iter().filter(|p| {
            let hidden = p.file_name().is_some_and(|n| n.to_string_lossy().starts_with('.'));
            !hidden && p.extension().is_some_and(|e| e == "parquet")
        }));
    }
    Ok(found)
}

/// The entries of one file, as many as `info` counts: what a killed writer left behind them is not part of the dataset.
/// What the rows say better, as where an episode begins among all rows, is counted anew; where the file says otherwise, a line
/// is added to `stale`.
pub(crate) fn read_file(
    path: &Path,
    info: &Info,
    out: &mut Vec<EpisodeSpan>,
    stale: &mut Vec<String>,
) -> Result<()> {
    let file = ParquetFile::open(path)?;
    let rows = file.rows().min(info.total_episodes.saturating_sub(out.len()));
    if rows == 0 {
        return Ok(());
    }
    let (integer, float) = (Feature::scalar(Dtype::Int64), Feature::scalar(Dtype::Float64));
    let integers = [
        "episode_index",
        "length",
        "dataset_from_index",
        "dataset_to_index",
        "data/chunk_index",
        "data/file_index",
        "meta/episodes/chunk_index",
        "meta/episodes/file_index",
    ];
    let read = |names: &[&str]| -> Result<std::vec::IntoIter<Vec<usize>>> {
        let features: Vec<(&str, &Feature)> = names.iter().map(|n| (*n, &integer)).collect();
        let counts = file.read(&features, 0..rows)?.into_iter().map(|(name, column)| {
            let Column::I64(values) = column else { return Ok(vec![]) };
            let unsigned = |(row, v): (usize, i64)| {
                usize::try_from(v).map_err(|_| {
                    let what = format!("column `{name}`, row {row}");
                    file_error(path, &what, "a count", v.to_string())
                })
            };
            values.into_iter().enumerate().map(unsigned).collect()
        });
        Ok(counts.collect::<Result<Vec<_>>>()?.into_iter())
    };
    let [index, length, from, to, chunk, data_file, listed_chunk, listed_file] = {
        let mut found = read(&integers)?;
        std::array::from_fn(|_| found.next().unwrap_or_default())
    };
    let tasks = read_tasks(&file, rows)?;
    let mut videos: Vec<BTreeMap<String, VideoSpan>> = vec![BTreeMap::new(); rows];
    for (key, _) in info.features.iter().filter(|(_, f)| f.dtype == Dtype::Video) {
        let names = ["chunk_index", "file_index"].map(|n| format!("videos/{key}/{n}"));
        let mut found = read(&names.each_ref().map(String::as_str))?;
        let (c, f) = (found.next().unwrap_or_default(), found.next().unwrap_or_default());
        let (start, end) = (format!("videos/{key}/from_timestamp"), format!("videos/{key}/to_timestamp"));
        let times = file.read(&[(&start, &float), (&end, &float)], 0..rows)?;
        let [(_, Column::F64(start)), (_, Column::F64(end))] = &times[..] else { continue };
        for (row, spans) in videos.iter_mut().enumerate() {
            spans.insert(key.clone(), VideoSpan { file: (c[row], f[row]), from: start[row], to: end[row] });
        }
    }
    for (row, (tasks, videos)) in tasks.into_iter().zip(videos).enumerate() {
        let expected_from = out.last().map_or(0, |e| e.from + e.length);
        for (name, expected, found) in [
            ("episode_index", out.len(), index[row]),
            ("length", length[row].max(1), length[row]),
            // What no data file can have; a sum of such lengths might not fit.
            ("length", length[row].min(1 << 40), length[row]),
        ] {
            if expected != found {
                let what = format!("column `{name}`, row {row}");
                return Err(file_error(path, &what, expected.to_string(), found.to_string()));
            }
        }
        for (name, expected, found) in [
            ("dataset_from_index", expected_from, from[row]),
            ("dataset_to_index", expected_from + length[row], to[row]),
        ] {
            if expected != found {
                let what = format!("column `{name}`, row {row}");
                stale.push(file_error(path, &what, expected.to_string(), found.to_string()).to_string());
            }
        }
        out.push(EpisodeSpan {
            length: length[row],
            from: expected_from,
            tasks,
            file: (chunk[row], data_file[row]),
            listed_in: (listed_chunk[row], listed_file[row]),
            videos,
        });
    }
    Ok(())
}

fn read_tasks(file: &ParquetFile, rows: usize) -> Result<Vec<Vec<String>>> {
    let mut out = vec![];
    file.batches(&["tasks"], 0..rows, &mut |batch, first| {
        let column = batch.column(0);
        let DataType::List(_) = column.data_type() else {
            let found = column.data_type().to_string();
            return Err(file_error(&file.path, "column `tasks`", "lists of text", found));
        };
        let list = column.as_list::<i32>();
        for row in 0..list.len() {
            let inner = list.value(row);
            if !matches!(inner.data_type(), DataType::Utf8 | DataType::LargeUtf8) {
                let what = format!("column `tasks`, row {}", first + row);
                return Err(file_error(&file.path, &what, "a list of text", inner.data_type().to_string()));
            }
            out.push(texts(&inner));
        }
        Ok(())
    })?;
    Ok(out)
}

/// One entry in the making.
#[derive(Debug)]
pub(crate) struct Entry {
    pub(crate) index: usize,
    pub(crate) span: EpisodeSpan,
    pub(crate) stats: Stats,
}

/// The entries as one batch, with all the columns that LeRobot writes: it appends only to a file that has them all.
pub(crate) fn to_batch(entries: &[Entry], features: &Features, path: &Path) -> Result<RecordBatch> {
    let integers = |f: &dyn Fn(&Entry) -> usize| -> ArrayRef {
        Arc::new(Int64Array::from_iter_values(
            entries.iter().map(|e| i64::try_from(f(e)).unwrap_or(i64::MAX)),
        ))
    };
    let tasks = StringArray::from_iter_values(entries.iter().flat_map(|e| e.span.tasks.first()));
    let mut columns: Vec<(String, ArrayRef)> = vec![
        ("episode_index".into(), integers(&|e| e.index)),
        ("tasks".into(), lists(Arc::new(tasks), 1)),
        ("length".into(), integers(&|e| e.span.length)),
        ("data/chunk_index".into(), integers(&|e| e.span.file.0)),
        ("data/file_index".into(), integers(&|e| e.span.file.1)),
        ("dataset_from_index".into(), integers(&|e| e.span.from)),
        ("dataset_to_index".into(), integers(&|e| e.span.from + e.span.length)),
    ];
    for (name, feature) in features.iter().filter(|(_, f)| f.dtype != Dtype::String) {
        let stats: Vec<&FeatureStats> =
            entries.iter().filter_map(|e| e.stats.iter().find(|(n, _)| n == name).map(|(_, s)| s)).collect();
        if stats.len() != entries.len() {
            let what = format!("statistics of `{name}`");
            return Err(file_error(path, &what, entries.len().to_string(), stats.len().to_string()));
        }
        columns.extend(stat_columns(name, bounds(feature), &stats));
    }
    columns.push(("meta/episodes/chunk_index".into(), integers(&|e| e.span.listed_in.0)));
    columns.push(("meta/episodes/file_index".into(), integers(&|e| e.span.listed_in.1)));
    batch(columns, path)
}

/// The columns of some entries that follow from the rows: places, ends of videos, statistics.
pub(crate) fn renewed(entries: &[Entry], info: &Info, path: &Path) -> Result<Vec<(String, ArrayRef)>> {
    let counts = |f: &dyn Fn(&Entry) -> usize| -> ArrayRef {
        Arc::new(Int64Array::from_iter_values(
            entries.iter().map(|e| i64::try_from(f(e)).unwrap_or(i64::MAX)),
        ))
    };
    let mut columns = vec![
        ("dataset_from_index".to_owned(), counts(&|e| e.span.from)),
        ("dataset_to_index".to_owned(), counts(&|e| e.span.from + e.span.length)),
    ];
    for (name, feature) in &info.features {
        if feature.dtype == Dtype::Video {
            let end =
                |e: &Entry| e.span.videos.get(name).map_or(0.0, |v| v.from + e.span.length as f64 / info.fps);
            let ends: ArrayRef = Arc::new(Float64Array::from_iter_values(entries.iter().map(end)));
            columns.push((format!("videos/{name}/to_timestamp"), ends));
        } else if feature.dtype != Dtype::String {
            let stats: Vec<&FeatureStats> = entries
                .iter()
                .filter_map(|e| e.stats.iter().find(|(n, _)| n == name).map(|(_, s)| s))
                .collect();
            if stats.len() != entries.len() {
                let what = format!("statistics of `{name}`");
                return Err(file_error(path, &what, entries.len().to_string(), stats.len().to_string()));
            }
            columns.extend(stat_columns(name, bounds(feature), &stats));
        }
    }
    Ok(columns)
}

fn stat_columns(name: &str, kind: Bounds, stats: &[&FeatureStats]) -> Vec<(String, ArrayRef)> {
    let mut columns = vec![];
    let Some(first) = stats.first() else { return columns };
    for (i, (key, list)) in first.lists().enumerate() {
        let values: Vec<f64> =
            stats.iter().flat_map(|s| s.lists().nth(i).map(|(_, v)| v.clone()).unwrap_or_default()).collect();
        let bound = i < 2;
        let leaf: ArrayRef = match kind {
            // Came from an integer.
            Bounds::Integer if bound => {
                Arc::new(Int64Array::from_iter_values(values.iter().map(|&v| v as i64)))
            }
            Bounds::Bool if bound => {
                Arc::new(BooleanArray::from_iter(values.iter().map(|&v| Some(v != 0.0))))
            }
            _ => Arc::new(Float64Array::from(values)),
        };
        let leaf = if kind == Bounds::Image { lists(lists(leaf, 1), 1) } else { leaf };
        columns.push((format!("stats/{name}/{key}"), lists(leaf, list.len())));
        if i == 3 {
            let counts = stats.iter().map(|s| i64::try_from(s.count).unwrap_or(i64::MAX));
            let counts: ArrayRef = Arc::new(Int64Array::from_iter_values(counts));
            columns.push((format!("stats/{name}/count"), lists(counts, 1)));
        }
    }
    columns
}

/// The statistics of the first `rows` entries of a file.
pub(crate) fn read_stats(path: &Path, features: &Features, rows: usize) -> Result<Vec<Stats>> {
    let file = ParquetFile::open(path)?;
    let features = features.iter().filter(|(_, f)| f.dtype != Dtype::String);
    let keys = || ["min", "max", "mean", "std"].into_iter().chain(QUANTILES.map(|q| q.0)).chain(["count"]);
    let width = |f: &Feature| if f.is_visual() { 3 } else { f.shape.last().copied().unwrap_or(1) };
    let names: Vec<(String, usize)> = features
        .clone()
        .flat_map(|(name, f)| keys().map(move |key| (format!("stats/{name}/{key}"), width(f))))
        .collect();
    // All columns at once: each pass over a file looks at all of them, whichever it reads.
    let mut lists = numbers(&file, &names, rows)?.into_iter();
    let mut out: Vec<Stats> = vec![vec![]; rows];
    for (name, feature) in features {
        let mut lists: Vec<Vec<Vec<f64>>> = lists.by_ref().take(keys().count()).collect();
        let width = width(feature);
        for (row, stats) in out.iter_mut().enumerate() {
            let mut found: Vec<Vec<f64>> =
                lists.iter_mut().map(|l| l.get_mut(row).map(std::mem::take).unwrap_or_default()).collect();
            let count = found.pop().and_then(|c| c.first().copied()).unwrap_or(0.0);
            if let Some(bad) = found.iter().find(|l| l.len() != width) {
                let what = format!("column `stats/{name}`, row {row}");
                return Err(file_error(path, &what, format!("{width} numbers"), bad.len().to_string()));
            }
            let mut found = found.into_iter();
            let mut next = || found.next().unwrap_or_default();
            stats.push((
                name.clone(),
                FeatureStats {
                    min: next(),
                    max: next(),
                    mean: next(),
                    std: next(),
                    // A count.
                    count: count.max(0.0) as u64,
                    quantiles: std::array::from_fn(|_| next()),
                },
            ));
        }
    }
    Ok(out)
}

/// Every row's numbers of some columns, however deep its lists are; of each column also how many there may be in a row.
///
/// # Shapes
/// (columns, rows, numbers)
fn numbers(file: &ParquetFile, columns: &[(String, usize)], rows: usize) -> Result<Vec<Vec<Vec<f64>>>> {
    let names: Vec<&str> = columns.iter().map(|(name, _)| name.as_str()).collect();
    let mut out = vec![vec![]; columns.len()];
    file.batches(&names, 0..rows, &mut |batch, first| {
        for ((column, most), out) in columns.iter().zip(&mut out) {
            let bad = |row: usize, found: String| {
                file_error(&file.path, &format!("column `{column}`, row {row}"), "numbers", found)
            };
            let array =
                batch.column_by_name(column).ok_or_else(|| bad(first, "no such column".to_owned()))?;
            for row in 0..array.len() {
                let mut value = array.slice(row, 1);
                while let DataType::List(_) = value.data_type() {
                    let list = value.as_list::<i32>();
                    let (start, end) = (list.value_offsets()[0], list.value_offsets()[list.len()]);
                    value = list.values().slice(start as usize, (end - start) as usize);
                }
                // Before they are kept: all columns of all rows are, for a while.
                if value.len() > *most {
                    return Err(bad(first + row, format!("{}, more than {most}", value.len())));
                }
                out.push(match value.data_type() {
                    DataType::Float64 => {
                        value.as_primitive::<arrow_array::types::Float64Type>().values().to_vec()
                    }
                    DataType::Int64 => {
                        let values = value.as_primitive::<arrow_array::types::Int64Type>().values();
                        values.iter().map(|&v| v as f64).collect()
                    }
                    DataType::Boolean => {
                        value.as_boolean().values().iter().map(|v| f64::from(u8::from(v))).collect()
                    }
                    other => return Err(bad(first + row, other.to_string())),
                });
            }
        }
        Ok(())
    })?;
    Ok(out)
}
