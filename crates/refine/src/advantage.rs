use crate::motion::episode_speeds;
use crate::series::{moving_average, percentile, runs};
use crate::{Error, Fate, Refined, Result};
use e2h_core::Episode;
use serde::{Deserialize, Serialize};
use std::borrow::Borrow;

/// How progress is measured and how little of it is too little.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdvantageConfig {
    /// Discount. Paper: 1.
    pub gamma: f64,
    /// Weight of later steps. Paper: 0, one step ahead.
    pub lambda: f64,
    /// Centred moving average, frames. Paper: 31.
    pub smooth: usize,
    /// Frames below this percentile of all frames of the iteration are marked for removal. Paper: 30.
    pub percentile: f64,
    /// Shorter runs of marked frames are kept, then shorter runs of unmarked ones dropped, frames. Paper: 30.
    pub min_run: usize,
    /// Horizon H of the hard task, control steps; a step costs 1/(2H). Moves all advantages alike, so it changes pictures and
    /// no fate.
    pub horizon: usize,
}

impl Default for AdvantageConfig {
    fn default() -> Self {
        Self { gamma: 1.0, lambda: 0.0, smooth: 31, percentile: 30.0, min_run: 30, horizon: 500 }
    }
}

impl AdvantageConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        for (name, value, most) in
            [("gamma", self.gamma, 1.0), ("lambda", self.lambda, 1.0), ("percentile", self.percentile, 100.0)]
        {
            if !(0.0..=most).contains(&value) {
                problems.push(format!("{name}: expected 0 to {most}, got {value}"));
            }
        }
        if self.smooth.is_multiple_of(2) {
            problems.push(format!("smooth: expected an odd number of frames, got {}", self.smooth));
        }
        if self.horizon == 0 {
            problems.push("horizon: expected at least 1 control step, got 0".to_owned());
        }
        problems
    }

    /// Reward of one step: -1/(2H).
    fn step_reward(&self) -> f64 {
        -0.5 / self.horizon.max(1) as f64
    }
}

/// Smoothed advantages of an episode, from the values of its rows. Shapes: (T) to (T).
///
/// # Source
/// Eq. 10 and its appendix. Eq. 10 asks for the value after the last row, which there is not: it counts as equal to the last.
#[must_use]
#[allow(clippy::cast_possible_truncation, reason = "computed in f64, kept as values are")]
pub fn advantages(values: &[f32], config: &AdvantageConfig) -> Vec<f32> {
    smoothed(values, config).into_iter().map(|a| a as f32).collect()
}

fn smoothed(values: &[f32], config: &AdvantageConfig) -> Vec<f64> {
    let mut sums = vec![0.0; values.len()];
    let mut later = 0.0;
    for t in (0..values.len()).rev() {
        let (now, next) = (f64::from(values[t]), f64::from(*values.get(t + 1).unwrap_or(&values[t])));
        let delta = config.step_reward() + config.gamma * next - now;
        later = delta + config.gamma * config.lambda * later;
        sums[t] = later;
    }
    moving_average(&sums, config.smooth)
}

/// Removes what makes too little progress and splits the episodes there. `values[i]` are those of the rows of `episodes[i]`;
/// `episodes` are all of one iteration, because the threshold is a percentile over all their frames.
///
/// Segments keep the actions that they came with: at a cut end the last goal is still the pose that really came next, and
/// [`Episode::terminal`] says that nothing is known of what follows.
///
/// # Errors
/// When values and frames do not agree in number, or a value is not finite.
///
/// # Source
/// Section "Critic-Guided Advantage Filtering" and the filtering parameters of the appendix.
pub fn advantage_filter<E: Borrow<Episode>>(
    episodes: &[E],
    values: &[Vec<f32>],
    config: &AdvantageConfig,
) -> Result<Vec<Refined>> {
    if episodes.len() != values.len() {
        return Err(Error::Episodes { what: "values", expected: episodes.len(), found: values.len() });
    }
    for (i, (episode, values)) in episodes.iter().zip(values).enumerate() {
        check_values(i, episode.borrow().len(), values)?;
    }
    let scores: Vec<Vec<f64>> = values.iter().map(|v| smoothed(v, config)).collect();
    let Some(threshold) = percentile(&scores.concat(), config.percentile) else {
        return Ok(episodes.iter().map(|e| Refined::untouched(e.borrow())).collect());
    };
    let refine = |((episode, values), scores): ((&E, &Vec<f32>), &Vec<f64>)| {
        let fates = judge(scores, threshold, config.min_run);
        let mut refined = split(episode.borrow(), fates);
        refined.value = Some(values.clone());
        refined.advantage = Some(crate::motion::narrow(scores));
        refined.threshold = crate::motion::narrow(&[threshold]).pop();
        refined
    };
    Ok(episodes.iter().zip(values).zip(&scores).map(refine).collect())
}

/// One finite value a frame.
pub(crate) fn check_values(episode: usize, rows: usize, values: &[f32]) -> Result<()> {
    if rows != values.len() {
        return Err(Error::Frames { what: "values", episode, expected: rows, found: values.len() });
    }
    match values.iter().position(|v| !v.is_finite()) {
        Some(row) => Err(Error::NotFinite { what: "value", episode, row, found: values[row] }),
        None => Ok(()),
    }
}

/// Fates of the frames of one episode from their scores.
fn judge(scores: &[f64], threshold: f64, min_run: usize) -> Vec<Fate> {
    // Too short to hold a run of each kind, so that the order of the two rules below would decide: its mean does.
    if !scores.is_empty() && scores.len() < 2 * min_run {
        let mean = scores.iter().sum::<f64>() / scores.len() as f64;
        let fate = if mean < threshold { Fate::LowAdvantage } else { Fate::Kept };
        return vec![fate; scores.len()];
    }
    let mut low: Vec<bool> = scores.iter().map(|&a| a < threshold).collect();
    for run in runs(&low, true).into_iter().filter(|r| r.len() < min_run) {
        low[run].fill(false);
    }
    let mut fates: Vec<Fate> =
        low.iter().map(|&low| if low { Fate::LowAdvantage } else { Fate::Kept }).collect();
    for run in runs(&low, false).into_iter().filter(|r| r.len() < min_run) {
        fates[run].fill(Fate::TooShort);
    }
    fates
}

/// One segment a run of kept frames.
pub(crate) fn split(episode: &Episode, fates: Vec<Fate>) -> Refined {
    let kept: Vec<bool> = fates.iter().map(|&f| f == Fate::Kept).collect();
    let segment = |run: std::ops::Range<usize>| episode.select(&run.collect::<Vec<_>>());
    let segments = runs(&kept, true).into_iter().map(segment).collect();
    Refined::new(segments, fates, episode_speeds(episode))
}
