//! An episode as the page sees it, wherever it comes from.

use crate::Result;
use e2h_core::{Direction, Episode, Image, Kind, Origin, Outcome, Pixels};
use e2h_data::lerobot::{ACTION_NAMES, STATE_NAMES, decode_png};
use std::borrow::Cow;

/// One column over time.
pub(super) struct Series {
    /// Name of the column.
    pub(super) name: String,
    /// Names of its entries; made up where the source has none.
    pub(super) entries: Vec<String>,
    /// Row after row.
    pub(super) values: Vec<f64>,
}

/// The pictures of one camera.
pub(super) enum Pictures {
    /// The pixels of each row.
    Raw(Vec<Pixels>),
    /// A PNG file per row.
    Png(Vec<Vec<u8>>),
}

/// A camera of an episode.
pub(super) struct Camera {
    pub(super) name: String,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) pictures: Pictures,
}

impl Camera {
    /// The picture of a row.
    pub(super) fn image(&self, row: usize) -> Result<Image> {
        let (height, width) = (self.height, self.width);
        match &self.pictures {
            Pictures::Raw(images) => {
                let data = images.get(row).map(Pixels::read).transpose()?.map_or(vec![], Cow::into_owned);
                Ok(Image { height, width, data })
            }
            Pictures::Png(files) => {
                let file = files.get(row).map_or(&[][..], Vec::as_slice);
                Ok(decode_png(file, height, width, &format!("{}, row {row}", self.name))?)
            }
        }
    }
}

/// What the filters made of the path that an episode was cut out of, or of the episode itself. Columns have one entry a
/// frame of that path.
#[derive(Default, Clone)]
pub(super) struct Account {
    /// Whose frames these are, in words.
    pub(super) title: String,
    /// Row of the recording that each frame comes from.
    pub(super) source: Vec<u32>,
    /// Names of the fates.
    pub(super) fates: Vec<String>,
    /// m/s.
    pub(super) speed: Vec<f64>,
    pub(super) value: Option<Vec<f64>>,
    pub(super) advantage: Option<Vec<f64>>,
    /// How far exploration had displaced the goal, mm.
    pub(super) excursion: Option<Vec<f64>>,
    /// Frames below this advantage were dropped.
    pub(super) threshold: Option<f64>,
}

impl Account {
    /// Share of frames that were kept, in [0, 1].
    pub(super) fn kept(&self) -> f64 {
        self.fates.iter().filter(|f| *f == "kept").count() as f64 / self.fates.len().max(1) as f64
    }
}

/// An episode as the page sees it.
#[derive(Default)]
pub(super) struct Recording {
    pub(super) name: String,
    pub(super) tasks: Vec<String>,
    /// `demonstration`, `rollout`, `refined segment` or `recording`.
    pub(super) origin: String,
    /// `hard`, `easy` or `easy, reversed`; empty where nothing says it.
    pub(super) direction: String,
    pub(super) iteration: Option<i64>,
    /// `success`, `failure`, `timeout`, ...; `not said` where nothing says it.
    pub(super) outcome: String,
    pub(super) rows: usize,
    /// Rows a second.
    pub(super) hz: f64,
    pub(super) columns: Vec<Series>,
    /// Of every row, m/s.
    pub(super) speed: Option<Vec<f64>>,
    /// Of every row, where the source has it.
    pub(super) value: Option<Vec<f64>>,
    pub(super) account: Option<Account>,
    /// True when `account` is of the episode's own rows, one to one.
    pub(super) own_account: bool,
    /// Rows of the recording that the rows come from; empty where nothing says it.
    pub(super) source: Vec<u32>,
    pub(super) cameras: Vec<Camera>,
    /// Further things that are known, by name.
    pub(super) facts: Vec<(String, String)>,
    /// What could not be shown and why.
    pub(super) problems: Vec<String>,
}

pub(super) fn kind_name(kind: Kind) -> &'static str {
    match kind {
        Kind::Demonstration => "demonstration",
        Kind::Rollout => "rollout",
        Kind::Refined => "refined segment",
    }
}

pub(super) fn direction_name(direction: Direction, reversed: bool) -> String {
    if reversed { format!("{direction}, reversed") } else { direction.to_string() }
}

pub(super) fn outcome_name(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Success { .. } => "success",
        Outcome::Timeout => "timeout",
        Outcome::Dropped => "dropped",
        Outcome::Diverged => "diverged",
    }
}

/// Speed of the step ahead, m/s; the last row has that of the step before. `position` has three entries per row.
pub(super) fn speeds(position: &[[f64; 3]], hz: f64) -> Vec<f64> {
    let step = |w: &[[f64; 3]]| (0..3).map(|i| (w[1][i] - w[0][i]).powi(2)).sum::<f64>().sqrt() * hz;
    let mut speeds: Vec<f64> = position.windows(2).map(step).collect();
    speeds.extend(speeds.last().copied().or((!position.is_empty()).then_some(0.0)));
    speeds
}

impl Recording {
    /// An episode of this project, taken apart.
    pub(super) fn of_episode(name: String, episode: Episode, hz: f64) -> Self {
        let Origin { task, direction, kind, iteration, episode: index, seed, reversed } = &episode.origin;
        let series = |name: &str, entries: &[&str], values: Vec<f64>| Series {
            name: name.to_owned(),
            entries: entries.iter().map(|e| (*e).to_owned()).collect(),
            values,
        };
        let position: Vec<[f64; 3]> =
            episode.state.iter().map(|s| std::array::from_fn(|i| f64::from(s[i]))).collect();
        let mut facts = vec![
            ("index".to_owned(), index.to_string()),
            ("run seed".to_owned(), seed.to_string()),
            ("ends with the task".to_owned(), if episode.terminal { "yes" } else { "no, cut" }.to_owned()),
        ];
        if let Outcome::Success { at } = episode.outcome {
            facts.push(("success from row".to_owned(), format!("{at} of the recording")));
        }
        Self {
            name,
            tasks: vec![task.clone()],
            origin: kind_name(*kind).to_owned(),
            direction: direction_name(*direction, *reversed),
            iteration: Some((*iteration).into()),
            outcome: outcome_name(episode.outcome).to_owned(),
            rows: episode.len(),
            hz,
            columns: vec![
                series(
                    "observation.state",
                    &STATE_NAMES,
                    episode.state.iter().flatten().map(|&v| f64::from(v)).collect(),
                ),
                series(
                    "action",
                    &ACTION_NAMES,
                    episode.action.iter().flatten().map(|&v| f64::from(v)).collect(),
                ),
            ],
            speed: Some(speeds(&position, hz)),
            facts,
            source: episode.source,
            cameras: episode
                .frames
                .into_iter()
                .map(|f| Camera {
                    name: f.camera,
                    height: f.height,
                    width: f.width,
                    pictures: Pictures::Raw(f.images),
                })
                .collect(),
            ..Self::default()
        }
    }
}
