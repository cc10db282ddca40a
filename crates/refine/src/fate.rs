use crate::{Error, Result};
use e2h_core::{Episode, Kind};
use serde::{Deserialize, Serialize};

/// What became of one input frame. In the order of the alphabet, which is the order in files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Fate {
    /// After the value said that the goal was reached.
    AfterGoal,
    /// A dynamics model could not confirm the reversed transition.
    DynamicsError,
    /// It is a row of a segment, with its own images.
    Kept,
    /// The critic saw too little progress.
    LowAdvantage,
    /// Inside a slow run, skipped when that was re-timed.
    Resampled,
    /// Inside a run that stood still.
    Static,
    /// In a remainder too short to be a segment.
    TooShort,
}

impl Fate {
    /// What files call it; its JSON is the same.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Kept => "kept",
            Self::Static => "static",
            Self::Resampled => "resampled",
            Self::LowAdvantage => "low_advantage",
            Self::TooShort => "too_short",
            Self::AfterGoal => "after_goal",
            Self::DynamicsError => "dynamics_error",
        }
    }
}

/// How many frames met which fate. The fates add up to `frames`.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RefineReport {
    /// Frames that came in.
    pub frames: usize,
    /// [`Fate::Kept`].
    pub kept: usize,
    /// [`Fate::Static`].
    pub still: usize,
    /// [`Fate::Resampled`].
    pub resampled: usize,
    /// [`Fate::LowAdvantage`].
    pub low_advantage: usize,
    /// [`Fate::TooShort`].
    pub too_short: usize,
    /// [`Fate::AfterGoal`].
    pub after_goal: usize,
    /// [`Fate::DynamicsError`].
    pub dynamics_error: usize,
    /// Segments that came out.
    pub segments: usize,
}

impl RefineReport {
    /// Counts fates.
    #[must_use]
    pub fn new(fates: &[Fate], segments: usize) -> Self {
        let mut report = Self { frames: fates.len(), segments, ..Self::default() };
        for fate in fates {
            *report.count_mut(*fate) += 1;
        }
        report
    }

    /// Frames that met `fate`.
    #[must_use]
    pub fn count(&self, fate: Fate) -> usize {
        *self.clone().count_mut(fate)
    }

    /// Sum over several reports.
    #[must_use]
    pub fn sum<'a>(reports: impl IntoIterator<Item = &'a Self>) -> Self {
        reports.into_iter().fold(Self::default(), |a, b| Self {
            frames: a.frames + b.frames,
            kept: a.kept + b.kept,
            still: a.still + b.still,
            resampled: a.resampled + b.resampled,
            low_advantage: a.low_advantage + b.low_advantage,
            too_short: a.too_short + b.too_short,
            after_goal: a.after_goal + b.after_goal,
            dynamics_error: a.dynamics_error + b.dynamics_error,
            segments: a.segments + b.segments,
        })
    }

    fn count_mut(&mut self, fate: Fate) -> &mut usize {
        match fate {
            Fate::Kept => &mut self.kept,
            Fate::Static => &mut self.still,
            Fate::Resampled => &mut self.resampled,
            Fate::LowAdvantage => &mut self.low_advantage,
            Fate::TooShort => &mut self.too_short,
            Fate::AfterGoal => &mut self.after_goal,
            Fate::DynamicsError => &mut self.dynamics_error,
        }
    }
}

/// What a stage made of one episode.
///
/// The frames whose fate is [`Fate::Kept`] are, in order, the rows of `segments`, one to one; that is what lets stages be
/// chained with [`Refined::then`].
#[derive(Debug, Clone, PartialEq)]
pub struct Refined {
    /// What is left, in order of time. Without empty ones.
    pub segments: Vec<Episode>,
    /// Fate of every input frame.
    pub fates: Vec<Fate>,
    /// The fates, counted.
    pub report: RefineReport,
    /// Speed of the tool centre point at every input frame, m/s.
    pub speed: Vec<f32>,
    /// Value of every input frame, where a critic was asked; NaN at frames that an earlier stage had removed.
    pub value: Option<Vec<f32>>,
    /// Smoothed advantage of every input frame, likewise.
    pub advantage: Option<Vec<f32>>,
    /// Advantage below which frames were marked for removal.
    pub threshold: Option<f32>,
    /// Smoothed error of a dynamics model at every input frame, where one was asked.
    pub dynamics_error: Option<Vec<f32>>,
    /// Error above which frames were removed.
    pub dynamics_threshold: Option<f32>,
}

impl Refined {
    /// Everything kept: what a stage that is switched off returns.
    #[must_use]
    pub fn untouched(episode: &Episode) -> Self {
        let speed = crate::motion::episode_speeds(episode);
        let segments = if episode.is_empty() { vec![] } else { vec![episode.clone()] };
        Self::new(segments, vec![Fate::Kept; episode.len()], speed)
    }

    pub(crate) fn new(mut segments: Vec<Episode>, fates: Vec<Fate>, speed: Vec<f32>) -> Self {
        for segment in &mut segments {
            segment.origin.kind = Kind::Refined;
        }
        let report = RefineReport::new(&fates, segments.len());
        Self {
            segments,
            fates,
            report,
            speed,
            value: None,
            advantage: None,
            threshold: None,
            dynamics_error: None,
            dynamics_threshold: None,
        }
    }

    /// This stage followed by another: `later[i]` is what the later stage made of `segments[i]`. Fates, values and
    /// advantages of the result belong to the frames that this stage was given.
    ///
    /// # Errors
    /// When `later` does not account for exactly the frames kept here.
    pub fn then(self, later: Vec<Self>) -> Result<Self> {
        let fates = merge_fates(&self, &later)?;
        let value = self.scatter(&later, |r| r.value.as_ref());
        let advantage = self.scatter(&later, |r| r.advantage.as_ref());
        let dynamics_error = self.scatter(&later, |r| r.dynamics_error.as_ref());
        let threshold = later.iter().find_map(|r| r.threshold).or(self.threshold);
        let dynamics_threshold = later.iter().find_map(|r| r.dynamics_threshold).or(self.dynamics_threshold);
        let segments = later.into_iter().flat_map(|r| r.segments).collect();
        let new = Self::new(segments, fates, self.speed);
        Ok(Self { value, advantage, threshold, dynamics_error, dynamics_threshold, ..new })
    }

    /// A column of the later stage, brought to the frames of this one.
    fn scatter(&self, later: &[Self], column: fn(&Self) -> Option<&Vec<f32>>) -> Option<Vec<f32>> {
        let own = column(self);
        if later.iter().all(|r| column(r).is_none()) {
            return own.cloned();
        }
        let mut out = own.cloned().unwrap_or_else(|| vec![f32::NAN; self.fates.len()]);
        let mut kept = out.iter_mut().zip(&self.fates).filter(|(_, f)| **f == Fate::Kept).map(|(v, _)| v);
        for refined in later {
            let places = kept.by_ref().take(refined.fates.len());
            match column(refined) {
                Some(values) => places.zip(values).for_each(|(place, v)| *place = *v),
                None => places.for_each(drop),
            }
        }
        Some(out)
    }
}

/// Fates of the frames that `first` was given, after a later stage: `later[i]` is what that made of `first.segments[i]`.
///
/// # Errors
/// When `later` does not account for exactly the frames that `first` kept.
pub fn merge_fates(first: &Refined, later: &[Refined]) -> Result<Vec<Fate>> {
    let expected = first.fates.iter().filter(|&&f| f == Fate::Kept).count();
    let found = later.iter().map(|r| r.fates.len()).sum();
    if expected != found {
        return Err(Error::Fates { expected, found });
    }
    let mut next = later.iter().flat_map(|r| r.fates.iter().copied());
    let merge = |&fate: &Fate| if fate == Fate::Kept { next.next().unwrap_or(fate) } else { fate };
    Ok(first.fates.iter().map(merge).collect())
}
