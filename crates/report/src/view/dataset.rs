//! Episodes of a LeRobotDataset, whoever wrote it.

use super::page::Head;
use super::recording::{Account, Camera, Pictures, Recording, Series, kind_name, outcome_name, speeds};
use super::{Listed, Options};
use crate::error::io;
use crate::{Error, Result};
use e2h_core::{Kind, Outcome, one_line};
use e2h_data::lerobot::{Column, ColumnSlice, DEFAULT_FEATURES, Dataset, Feature, SOURCE_EXCURSION, Table};
use std::collections::BTreeMap;
use std::path::Path;

/// What the `refine` example leaves beside its dataset: the fate of every frame of every recording.
const FRAMES: &str = "report/frames.csv";
/// Bytes of that file: more than ten hours of frames at 20 Hz.
const LARGEST_FRAMES: u64 = 1 << 26;
/// Entries of a column that are drawn one by one; of others the least, the mean and the largest.
const WIDEST: usize = 64;
/// Different texts of a column that are shown.
const TEXTS: usize = 4;
/// What names of a tool's coordinates begin with, in the order they are looked for.
const TOOLS: [&str; 6] = ["eef_", "ee_", "tcp_", "ee.", "tcp.", ""];

pub(super) struct DatasetSource {
    pub(super) dataset: Dataset,
    pub(super) listed: Vec<Listed>,
    position: Option<Position>,
    /// What was made of each recording, by its index.
    accounts: BTreeMap<i64, Account>,
}

/// Three entries of a column.
struct Position {
    column: String,
    entries: [usize; 3],
}

impl DatasetSource {
    pub(super) fn open(dir: &Path, options: &Options) -> Result<Self> {
        let dataset = Dataset::open(dir)?;
        let position = match &options.position {
            Some(slice) => Some(given(slice, &dataset)?),
            None => found(&dataset),
        };
        let name = |i: usize| format!("episode {i}");
        let listed = dataset.episodes().iter().enumerate();
        let listed = listed.map(|(i, e)| Listed { name: name(i), rows: e.length }).collect();
        let accounts = accounts(&dir.join(FRAMES))?;
        Ok(Self { dataset, listed, position, accounts })
    }

    /// An episode, with its pictures or without.
    pub(super) fn read(&self, index: usize, pictures: bool) -> Result<Recording> {
        let info = self.dataset.info();
        let own = |name: &str| {
            let of_all = DEFAULT_FEATURES.iter().any(|(n, _)| *n == name);
            name == SOURCE_EXCURSION || !(of_all || name.starts_with("source."))
        };
        let small = |f: &Feature| !f.is_visual() && f.width() <= WIDEST;
        let tool = |name: &str| self.position.as_ref().is_some_and(|p| p.column == name);
        let read = info.features.iter().filter(|(n, f)| small(f) || tool(n));
        let names: Vec<&str> = read.map(|(n, _)| n.as_str()).collect();
        let table = self.dataset.read_columns(index, &names)?;
        let mut recording = Recording {
            name: self.listed[index].name.clone(),
            tasks: short(&self.dataset.episodes()[index].tasks),
            rows: table.rows,
            hz: info.fps,
            ..Recording::default()
        };
        for (name, feature) in info.features.iter().filter(|(n, f)| own(n) && !f.is_visual()) {
            if let Some(Column::Text(texts)) = table.column(name) {
                recording.facts.push((name.clone(), several(texts)));
                continue;
            }
            if !small(feature) {
                recording.columns.push(self.summary(index, name, feature)?);
                continue;
            }
            let Some(values) = table.column(name).and_then(Column::numbers) else { continue };
            if name == SOURCE_EXCURSION && values.iter().all(|&v| v == 0.0) {
                continue; // nothing displaced it
            }
            if feature.width() == 1 && (name == "value" || name.ends_with(".value")) {
                recording.value = Some(values);
            } else if feature.width() == 1 && values.iter().all(|v| Some(v) == values.first()) {
                let value = values.first().map_or(String::new(), ToString::to_string);
                recording.facts.push((name.clone(), format!("{value} in all rows")));
            } else {
                recording.columns.push(Series {
                    name: name.clone(),
                    entries: entries(name, feature),
                    values,
                });
            }
        }
        if let Some(p) = &self.position {
            let width = info.feature(&p.column).map_or(1, Feature::width);
            let values = table.column(&p.column).and_then(Column::numbers).unwrap_or_default();
            let rows = values.chunks_exact(width);
            let rows: Vec<[f64; 3]> = rows.map(|row| p.entries.map(|i| row[i])).collect();
            recording.speed = Some(speeds(&rows, info.fps));
        }
        self.origin(&table, &mut recording);
        if pictures {
            self.cameras(index, &mut recording);
        }
        Ok(recording)
    }

    /// A column of more entries than anybody tells apart, a map or a grid, by its least, mean and largest one.
    fn summary(&self, index: usize, name: &str, feature: &Feature) -> Result<Series> {
        // By itself: one such column of a long episode may be most of the memory.
        let table = self.dataset.read_columns(index, &[name])?;
        let values = table.column(name).and_then(Column::numbers).unwrap_or_default();
        let of_row = |row: &[f64]| {
            let mean = row.iter().sum::<f64>() / row.len().max(1) as f64;
            [
                row.iter().copied().fold(f64::INFINITY, f64::min),
                mean,
                row.iter().copied().fold(f64::NEG_INFINITY, f64::max),
            ]
        };
        Ok(Series {
            name: format!("{name}, {}", shape(feature)),
            entries: ["least", "mean", "largest"].map(str::to_owned).to_vec(),
            values: values.chunks_exact(feature.width()).flat_map(of_row).collect(),
        })
    }

    /// What `source.*`, `next.success` and the report beside the dataset say.
    fn origin(&self, table: &Table, recording: &mut Recording) {
        let integer = |name: &str| table.i64(name).ok()?.first().copied();
        let flag = |name: &str| table.bool(name).ok()?.first().copied();
        recording.origin = match integer("source.kind") {
            Some(0) => kind_name(Kind::Demonstration),
            Some(1) => kind_name(Kind::Rollout),
            Some(2) => kind_name(Kind::Refined),
            _ => "recording",
        }
        .to_owned();
        let reversed = if flag("source.reversed") == Some(true) { ", reversed" } else { "" };
        recording.direction = match integer("source.direction") {
            Some(0) => format!("hard{reversed}"),
            Some(1) => format!("easy{reversed}"),
            _ => String::new(),
        };
        recording.iteration = integer("source.iteration");
        let judged = table.bool("next.success").map(|s| s.contains(&true));
        recording.outcome = match (integer("source.outcome"), judged) {
            (Some(0), _) | (None, Ok(true)) => outcome_name(Outcome::Success { at: 0 }),
            (Some(1), _) => outcome_name(Outcome::Timeout),
            (Some(2), _) => outcome_name(Outcome::Dropped),
            (Some(3), _) => outcome_name(Outcome::Diverged),
            (None, Ok(false)) => "failure",
            _ => "not said",
        }
        .to_owned();
        for (name, what) in [("source.episode", "recording"), ("source.seed", "run seed")] {
            recording.facts.extend(integer(name).map(|v| (what.to_owned(), v.to_string())));
        }
        if let Ok(source) = table.i64("source.frame") {
            recording.source = source.iter().map(|&v| u32::try_from(v).unwrap_or(u32::MAX)).collect();
        }
        let codes = table.i64("source.fate").unwrap_or_default();
        if codes.iter().any(|&c| c != 0) {
            let fate = |&c: &i64| if c == 0 { "kept".to_owned() } else { format!("fate {c}") };
            recording.account = Some(Account {
                title: "Fates of its rows".to_owned(),
                source: recording.source.clone(),
                fates: codes.iter().map(fate).collect(),
                ..Account::default()
            });
            recording.own_account = true;
        } else {
            let account = integer("source.episode").and_then(|e| self.accounts.get(&e));
            recording.account = account.cloned();
        }
    }

    fn cameras(&self, index: usize, recording: &mut Recording) {
        for (name, feature) in &self.dataset.info().features {
            let Some((height, width)) = feature.image_size() else { continue };
            // A video without its decoder is no reason to show nothing at all.
            match self.dataset.read_columns(index, &[name.as_str()]).map(|t| t.columns) {
                Ok(mut columns) => {
                    if let Some((_, Column::Png(files))) = columns.pop() {
                        let short = name.strip_prefix("observation.").unwrap_or(name);
                        let short = short.strip_prefix("images.").unwrap_or(short).to_owned();
                        let pictures = Pictures::Png(files);
                        recording.cameras.push(Camera { name: short, height, width, pictures });
                    }
                }
                Err(e) => recording.problems.push(format!("{name}: {e}")),
            }
        }
    }

    pub(super) fn head(&self) -> Head {
        let info = self.dataset.info();
        let root = self.dataset.root();
        let folder = root.canonicalize().unwrap_or_else(|_| root.to_owned());
        let name = folder.file_name().unwrap_or(folder.as_os_str()).to_string_lossy().into_owned();
        let mut facts = vec![
            ("format".to_owned(), format!("LeRobotDataset {}", info.codebase_version)),
            ("robot".to_owned(), info.robot_type.clone().unwrap_or_else(|| "not said".to_owned())),
            ("rate".to_owned(), format!("{} Hz", info.fps)),
        ];
        let tasks = self.dataset.tasks();
        facts.push(("tasks".to_owned(), short(tasks).join("; ")));
        for (name, feature) in info.own_features() {
            let dtype = format!("{:?}", feature.dtype).to_lowercase();
            facts.push((name, format!("{dtype}, {}", shape(&feature))));
        }
        let kept: usize = self.accounts.values().flat_map(|a| &a.fates).filter(|f| *f == "kept").count();
        let of: usize = self.accounts.values().map(|a| a.fates.len()).sum();
        Head {
            kind: "LeRobot dataset",
            title: name,
            subtitle: format!("{} · {} Hz", info.robot_type.as_deref().unwrap_or("robot not said"), info.fps),
            frames: info.total_frames,
            hz: info.fps,
            kept: (of > 0).then_some((kept, of)),
            facts,
            ..Head::default()
        }
    }
}

/// Its sizes, for people.
fn shape(feature: &Feature) -> String {
    feature.shape.iter().map(ToString::to_string).collect::<Vec<_>>().join(" x ")
}

/// The different ones of some texts, in the order in which they come.
fn several(texts: &[String]) -> String {
    let mut seen: Vec<&String> = vec![];
    for text in texts.iter().filter(|t| !t.is_empty()) {
        if !seen.contains(&text) {
            seen.push(text);
        }
        if seen.len() > TEXTS {
            break;
        }
    }
    let more = if seen.len() > TEXTS { "; and others" } else { "" };
    seen.truncate(TEXTS);
    let some: Vec<String> = seen.into_iter().map(|t| e2h_core::one_line(t)).collect();
    format!("{}{more}", some.join("; "))
}

/// Names of the entries of a column; numbers where the dataset has none.
fn entries(name: &str, feature: &Feature) -> Vec<String> {
    let width = feature.width();
    let nested = || {
        // Older datasets name entries in a map with one list.
        let map = feature.names.as_object()?;
        let list = map.values().next()?.as_array().filter(|_| map.len() == 1)?;
        list.iter().map(|v| v.as_str().map(str::to_owned)).collect::<Option<Vec<_>>>()
    };
    let plain = feature.entry_names().map(|n| n.into_iter().map(str::to_owned).collect::<Vec<_>>());
    match plain.or_else(nested) {
        Some(names) if names.len() == width => names,
        _ if width == 1 => vec![name.to_owned()],
        _ => (0..width).map(|i| place(i, &feature.shape)).collect(),
    }
}

/// Where entry `i` stands in its row's shape: `2`, or `0,2` in a matrix.
fn place(i: usize, shape: &[usize]) -> String {
    let mut left = i;
    let mut at: Vec<String> = vec![];
    for size in shape.iter().rev() {
        at.push((left % size).to_string());
        left /= size;
    }
    at.reverse();
    at.join(",")
}

fn given(slice: &ColumnSlice, dataset: &Dataset) -> Result<Position> {
    let width = slice.width(dataset.info())?;
    if width != 3 {
        return Err(Error::Options(format!("position {slice}: expected 3 entries, found {width}")));
    }
    let entries = [slice.start, slice.start + 1, slice.start + 2];
    Ok(Position { column: slice.column.clone(), entries })
}

/// Coordinates by their names.
fn found(dataset: &Dataset) -> Option<Position> {
    let features = &dataset.info().features;
    let vectors = features.iter().filter(|(n, f)| n.starts_with("observation.") && !f.is_visual());
    for (column, feature) in vectors {
        let names = entries(column, feature);
        for tool in TOOLS {
            let at = |axis: &str| names.iter().position(|n| *n == format!("{tool}{axis}"));
            if let (Some(x), Some(y), Some(z)) = (at("x"), at("y"), at("z")) {
                return Some(Position { column: column.clone(), entries: [x, y, z] });
            }
        }
    }
    None
}

/// The first texts, each cut to what a message may have: a page of a hundred episodes says each of them a hundred times.
fn short(texts: &[String]) -> Vec<String> {
    let mut short: Vec<String> = texts.iter().take(5).map(|t| one_line(t)).collect();
    if texts.len() > 5 {
        short.push(format!("and {} more", texts.len() - 5));
    }
    short
}

/// Reads the report's table by the names of its columns; nothing where there is none.
fn accounts(path: &Path) -> Result<BTreeMap<i64, Account>> {
    if !path.try_exists().map_err(io("looking for", path))? {
        return Ok(BTreeMap::new());
    }
    let bytes = e2h_data::read_regular(path, LARGEST_FRAMES)?;
    let text = String::from_utf8_lossy(&bytes);
    let mut lines = text.lines();
    let head: Vec<&str> = lines.next().unwrap_or_default().split(',').collect();
    let column = |name: &str| head.iter().position(|h| *h == name);
    let (Some(episode), Some(source), Some(speed), Some(fate)) =
        (column("episode"), column("source_frame"), column("speed_m_s"), column("fate"))
    else {
        return Ok(BTreeMap::new());
    };
    let (value, advantage) = (column("value"), column("advantage"));
    let mut accounts: BTreeMap<i64, Account> = BTreeMap::new();
    for line in lines {
        let cells: Vec<&str> = line.split(',').collect();
        let cell = |i: usize| cells.get(i).copied().unwrap_or_default();
        let number = |i: usize| cell(i).parse::<f64>().unwrap_or(f64::NAN);
        let Ok(index) = cell(episode).parse::<i64>() else { continue };
        let account = accounts.entry(index).or_insert_with(|| Account {
            title: format!("Recording {index}, reversed: what the filters did"),
            value: value.map(|_| vec![]),
            advantage: advantage.map(|_| vec![]),
            ..Account::default()
        });
        account.source.push(cell(source).parse().unwrap_or(u32::MAX));
        account.fates.push(cell(fate).to_owned());
        account.speed.push(number(speed));
        if let (Some(values), Some(i)) = (&mut account.value, value) {
            values.push(number(i));
        }
        if let (Some(values), Some(i)) = (&mut account.advantage, advantage) {
            values.push(number(i));
        }
    }
    Ok(accounts)
}

#[cfg(test)]
mod tests {
    use super::short;

    #[test]
    fn texts_are_cut_to_what_a_page_has_room_for() {
        let long = vec!["x".repeat(5 << 20); 100];
        let short = short(&long);
        assert_eq!(short.len(), 6);
        assert!(short.concat().len() < 6000 && short[5] == "and 95 more", "{}", short[5]);
        assert_eq!(super::short(&["put it on".to_owned()]), ["put it on"]);
    }
}
