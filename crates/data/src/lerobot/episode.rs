//! Episodes as tables and back, with all that is known of where they come from.

use super::feature::{Dtype, Feature, Features};
use super::table::{Column, Table, column_error};
use super::{Dataset, Writer, picture};
use crate::file::file_error;
use crate::{Error, Result};
use e2h_core::{ACTION_DIM, Direction, Episode, Excursion, Frames, Kind, Origin, Outcome, STATE_DIM};
use std::path::Path;

/// Names of the entries of `observation.state`; metres, unit quaternions (wxyz), metres of gripper opening.
pub const STATE_NAMES: [&str; STATE_DIM] = [
    "eef_x",
    "eef_y",
    "eef_z",
    "eef_qw",
    "eef_qx",
    "eef_qy",
    "eef_qz",
    "object_x",
    "object_y",
    "object_z",
    "object_qw",
    "object_qx",
    "object_qy",
    "object_qz",
    "gripper",
];
/// Names of the entries of `action`: the goal pose in the robot's base frame and the gripper command, 1 open, 0 closed.
pub const ACTION_NAMES: [&str; ACTION_DIM] =
    ["goal_x", "goal_y", "goal_z", "goal_qw", "goal_qx", "goal_qy", "goal_qz", "gripper"];
/// What the column of a camera is called before its name.
const IMAGES: &str = "observation.images.";
/// Row of the original recording.
pub const SOURCE_FRAME: &str = "source.frame";
/// What refinement made of the row: 0 kept; the other codes are those of the writer's filter.
pub const SOURCE_FATE: &str = "source.fate";

/// By how much exploration displaced the goal: x, y, z in m, yaw in rad.
pub const SOURCE_EXCURSION: &str = "source.excursion";
/// Names of the entries of [`SOURCE_EXCURSION`].
pub const EXCURSION_NAMES: [&str; 4] = ["x", "y", "z", "yaw"];

/// See [`source_columns`].
const SOURCE: [(&str, Dtype); 11] = [
    ("source.kind", Dtype::Int64),
    ("source.direction", Dtype::Int64),
    ("source.iteration", Dtype::Int64),
    ("source.episode", Dtype::Int64),
    ("source.seed", Dtype::Int64),
    ("source.reversed", Dtype::Bool),
    ("source.terminal", Dtype::Bool),
    ("source.outcome", Dtype::Int64),
    ("source.success_at", Dtype::Int64),
    (SOURCE_FRAME, Dtype::Int64),
    (SOURCE_FATE, Dtype::Int64),
];

/// The columns that say where rows come from. See [`source_columns`] for their values.
#[must_use]
pub fn source_features() -> Features {
    SOURCE.iter().map(|(name, dtype)| ((*name).to_owned(), Feature::scalar(*dtype))).collect()
}

/// The columns of [`source_features`] for an episode: numbers, because LeRobot takes averages of every column, and named
/// `source.`, which no policy takes for an input.
///
/// | column | value |
/// |---|---|
/// | `source.kind` | 0 demonstration, 1 rollout, 2 refined segment |
/// | `source.direction` | task that was done while recording: 0 hard, 1 easy |
/// | `source.iteration` | iteration of the loop, 0 for demonstrations |
/// | `source.episode` | index of the recording within its kind and iteration |
/// | `source.seed` | run seed; its 64 bits read as a signed number |
/// | `source.reversed` | time runs backwards against the recording |
/// | `source.terminal` | the last row is the end of the task, not a cut |
/// | `source.outcome` | of the recording: 0 success, 1 timeout, 2 dropped, 3 diverged |
/// | `source.success_at` | row of the recording at which success began, -1 without |
/// | `source.frame` | row of the recording |
/// | `source.fate` | what refinement made of the row: 0 kept; other codes are those of the filter that wrote them |
///
/// # Shapes
/// `frames` and `fates` have one entry per row.
#[must_use]
pub fn source_columns(
    origin: &Origin,
    outcome: Outcome,
    terminal: bool,
    frames: &[u32],
    fates: &[i64],
) -> Vec<(String, Column)> {
    let rows = frames.len();
    let kind = match origin.kind {
        Kind::Demonstration => 0,
        Kind::Rollout => 1,
        Kind::Refined => 2,
    };
    let (outcome, at) = match outcome {
        Outcome::Success { at } => (0, i64::try_from(at).unwrap_or(i64::MAX)),
        Outcome::Timeout => (1, -1),
        Outcome::Dropped => (2, -1),
        Outcome::Diverged => (3, -1),
    };
    let value = |name: &str| match name {
        "source.kind" => Column::I64(vec![kind; rows]),
        "source.direction" => Column::I64(vec![i64::from(origin.direction == Direction::Easy); rows]),
        "source.iteration" => Column::I64(vec![origin.iteration.into(); rows]),
        "source.episode" => Column::I64(vec![origin.episode.into(); rows]),
        "source.seed" => Column::I64(vec![origin.seed.cast_signed(); rows]),
        "source.reversed" => Column::Bool(vec![origin.reversed; rows]),
        "source.terminal" => Column::Bool(vec![terminal; rows]),
        "source.outcome" => Column::I64(vec![outcome; rows]),
        "source.success_at" => Column::I64(vec![at; rows]),
        SOURCE_FRAME => Column::I64(frames.iter().map(|&f| f.into()).collect()),
        _ => Column::I64(fates.to_vec()),
    };
    SOURCE.iter().map(|(name, _)| ((*name).to_owned(), value(name))).collect()
}

/// The features of a dataset of episodes.
///
/// # Shapes
/// `cameras` (name, height, width).
#[must_use]
pub fn features(cameras: &[(String, usize, usize)]) -> Features {
    let mut features = vec![("observation.state".to_owned(), Feature::vector(&STATE_NAMES))];
    let image = |(name, height, width): &(String, usize, usize)| {
        (format!("{IMAGES}{name}"), Feature::image(*height, *width))
    };
    features.extend(cameras.iter().map(image));
    features.push(("action".to_owned(), Feature::vector(&ACTION_NAMES)));
    features.push(("next.success".to_owned(), Feature::scalar(Dtype::Bool)));
    features.extend(source_features());
    features.push((SOURCE_EXCURSION.to_owned(), Feature::vector(&EXCURSION_NAMES)));
    features
}

/// The features that fit an episode.
#[must_use]
pub fn features_of(episode: &Episode) -> Features {
    let camera = |f: &Frames| (f.camera.clone(), f.height, f.width);
    features(&episode.frames.iter().map(camera).collect::<Vec<_>>())
}

/// An episode as a table. `next.success` is true in the last row of a task that was recorded to its successful end.
///
/// # Shapes
/// `fates` (T), or empty: then all rows are kept ones.
///
/// # Errors
/// When the episode contradicts itself or has no rows.
pub fn to_table(episode: &Episode, fates: &[i64]) -> Result<Table> {
    let bad = |source| Error::Episode { name: episode.origin.task.clone(), source };
    episode.validate().map_err(bad)?;
    let rows = episode.len();
    let zeros = vec![0; rows];
    let fates = if fates.is_empty() { &zeros } else { fates };
    let mut success = vec![false; rows];
    if let Some(last) = success.last_mut() {
        *last = episode.terminal && episode.outcome.is_success();
    }
    let mut columns = vec![("observation.state".to_owned(), Column::F32(episode.state.concat()))];
    for frames in &episode.frames {
        let png = |t| picture::encode(frames.height, frames.width, &frames.image(t).map_err(bad)?);
        let files = (0..rows).map(png).collect::<Result<_>>()?;
        columns.push((format!("{IMAGES}{}", frames.camera), Column::Png(files)));
    }
    columns.push(("action".to_owned(), Column::F32(episode.action.concat())));
    columns.push(("next.success".to_owned(), Column::Bool(success)));
    let (outcome, terminal) = (episode.outcome, episode.terminal);
    columns.extend(source_columns(&episode.origin, outcome, terminal, &episode.source, fates));
    columns.push((SOURCE_EXCURSION.to_owned(), Column::F32(episode.excursion.concat())));
    Ok(Table { rows, columns })
}

/// The episode of a table that [`to_table`] made, and the fates of its rows.
///
/// # Errors
/// When a column is missing or holds what no episode has.
pub fn from_table(table: &Table, features: &Features, task: &str) -> Result<(Episode, Vec<i64>)> {
    let integer = |name: &str| -> Result<i64> {
        let values = table.i64(name)?;
        match values.first() {
            Some(&first) if values.iter().all(|&v| v == first) => Ok(first),
            _ => Err(column_error(name, "one value in all rows", "several")),
        }
    };
    let flag = |name: &str| -> Result<bool> {
        let values = table.bool(name)?;
        match values.first() {
            Some(&first) if values.iter().all(|&v| v == first) => Ok(first),
            _ => Err(column_error(name, "one value in all rows", "several")),
        }
    };
    let small = |name: &str| -> Result<u32> {
        let v = integer(name)?;
        u32::try_from(v).map_err(|_| column_error(name, "0 to 2^32 - 1", v.to_string()))
    };
    let code = |name: &str, known: i64| -> Result<i64> {
        let v = integer(name)?;
        if (0..known).contains(&v) {
            Ok(v)
        } else {
            Err(column_error(name, format!("below {known}"), v.to_string()))
        }
    };
    let at = integer("source.success_at")?;
    let outcome = match code("source.outcome", 4)? {
        0 => Outcome::Success {
            at: usize::try_from(at)
                .map_err(|_| column_error("source.success_at", "a row", at.to_string()))?,
        },
        1 => Outcome::Timeout,
        2 => Outcome::Dropped,
        _ => Outcome::Diverged,
    };
    let origin = Origin {
        task: task.to_owned(),
        direction: if code("source.direction", 2)? == 0 { Direction::Hard } else { Direction::Easy },
        kind: [Kind::Demonstration, Kind::Rollout, Kind::Refined]
            [usize::try_from(code("source.kind", 3)?).unwrap_or(0)],
        iteration: small("source.iteration")?,
        episode: small("source.episode")?,
        seed: integer("source.seed")?.cast_unsigned(),
        reversed: flag("source.reversed")?,
    };
    let source = table.i64(SOURCE_FRAME)?.iter().enumerate().map(|(row, &v)| {
        let what = format!("{SOURCE_FRAME}, row {row}");
        u32::try_from(v).map_err(|_| column_error(&what, "0 to 2^32 - 1", v.to_string()))
    });
    let mut frames = vec![];
    for (name, feature) in features {
        let (Some(camera), Some((height, width))) = (name.strip_prefix(IMAGES), feature.image_size()) else {
            continue;
        };
        let mut images = Vec::with_capacity(table.rows);
        for (row, file) in table.png(name)?.iter().enumerate() {
            let what = format!("column `{name}`, row {row}");
            images.push(picture::decode(file, height, width, Path::new("(episode)"), &what)?.into());
        }
        frames.push(Frames { camera: camera.to_owned(), height, width, images });
    }
    let episode = Episode {
        state: rows(table, "observation.state")?,
        action: rows(table, "action")?,
        frames,
        source: source.collect::<Result<_>>()?,
        // Datasets from before have no such column: nothing displaced them.
        excursion: if features.iter().any(|(name, _)| name == SOURCE_EXCURSION) {
            rows(table, SOURCE_EXCURSION)?
        } else {
            vec![Excursion::default(); table.rows]
        },
        outcome,
        terminal: flag("source.terminal")?,
        origin,
    };
    episode.validate().map_err(|source| Error::Episode { name: task.to_owned(), source })?;
    Ok((episode, table.i64(SOURCE_FATE)?.to_vec()))
}

fn rows<const N: usize>(table: &Table, name: &str) -> Result<Vec<[f32; N]>> {
    let values = table.f32(name)?;
    if values.len() != table.rows * N {
        return Err(column_error(name, format!("{N} numbers per row"), format!("{} in all", values.len())));
    }
    Ok(values.as_chunks().0.to_vec())
}

impl Writer {
    /// Adds an episode; its task is what the dataset says was to be done.
    ///
    /// # Errors
    /// As [`to_table`] and [`Writer::push`].
    pub fn push_episode(&mut self, episode: &Episode) -> Result<()> {
        self.push(&to_table(episode, &[])?, &episode.origin.task)
    }
}

impl Dataset {
    /// An episode as it was written with [`Writer::push_episode`].
    ///
    /// # Errors
    /// When it cannot be read, or is not an episode of this project.
    pub fn read_episode(&self, index: usize) -> Result<Episode> {
        let table = self.read(index)?;
        let task = self.episodes()[index].tasks.first().map_or("", String::as_str);
        let path = self.data_path(self.episodes()[index].file)?;
        let named = |e| match e {
            Error::Column { column, expected, found } => {
                file_error(&path, &format!("episode {index}, column `{column}`"), expected, found)
            }
            Error::File { what, expected, found, .. } => {
                file_error(&path, &format!("episode {index}, {what}"), expected, found)
            }
            Error::Episode { source, .. } => {
                let what = format!("episode {index}");
                file_error(&path, &what, "an episode of this project", source.to_string())
            }
            other => other,
        };
        Ok(from_table(&table, &self.info().features, task).map_err(named)?.0)
    }
}
