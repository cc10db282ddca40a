use crate::motion::episode_speeds;
use crate::series::{moving_average, percentile, runs};
use crate::{Error, Fate, Refined, Result, limits};
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
        for (name, value, least) in
            [("smooth", self.smooth, 1), ("min_run", self.min_run, 0), ("horizon", self.horizon, 1)]
        {
            problems.extend(limits::frames(name, value, least));
        }
        if self.smooth > 0 && self.smooth.is_multiple_of(2) {
            problems.push(format!("smooth: expected an odd number of frames, got {}", self.smooth));
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
// Computed in f64, kept as values are.
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

/// One finite value per frame.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{along, walk};

    fn bumpy(rows: usize) -> Vec<f32> {
        (0..rows).map(|t| (t as f32 * 0.37).sin() * 0.2 + t as f32 * 0.003).collect()
    }

    #[test]
    fn one_step_ahead_smoothed_is_the_slope_of_the_value() {
        let (values, config) = (bumpy(80), AdvantageConfig { horizon: 100, ..AdvantageConfig::default() });
        let a = advantages(&values, &config);
        for t in 15..=80 - 17 {
            let slope = (values[t + 16] - values[t - 15]) / 31.0;
            assert!((a[t] - (slope - 0.005)).abs() < 1e-6, "row {t}");
        }
    }

    #[test]
    fn lambda_one_is_the_sum_of_all_that_follows() {
        let values = bumpy(20);
        let config =
            AdvantageConfig { gamma: 0.9, lambda: 1.0, smooth: 1, horizon: 10, ..AdvantageConfig::default() };
        let a = advantages(&values, &config);
        for (t, got) in a.into_iter().enumerate() {
            let v = |i: usize| f64::from(values[i.min(19)]);
            let brute: f64 =
                (t..20).map(|i| 0.9_f64.powi((i - t) as i32) * (-0.05 + 0.9 * v(i + 1) - v(i))).sum();
            assert!((f64::from(got) - brute).abs() < 1e-6, "row {t}");
        }
    }

    #[test]
    fn short_runs_are_joined_first_to_what_is_kept_then_to_what_is_dropped() {
        let scores = |pieces: &[(usize, f64)]| -> Vec<f64> {
            pieces.iter().flat_map(|&(n, v)| std::iter::repeat_n(v, n)).collect()
        };
        let count = |fates: &[Fate], fate| fates.iter().filter(|&&f| f == fate).count();
        // 29 low frames are too few to drop, 30 are not.
        let fates = judge(&scores(&[(40, 1.0), (29, -1.0), (40, 1.0)]), 0.0, 30);
        assert_eq!(count(&fates, Fate::Kept), 109);
        let fates = judge(&scores(&[(40, 1.0), (30, -1.0), (29, 1.0)]), 0.0, 30);
        assert_eq!((count(&fates, Fate::LowAdvantage), count(&fates, Fate::TooShort)), (30, 29));
        // The short drop is kept before keeps are measured: 20 + 10 + 20 is long enough.
        let fates = judge(&scores(&[(30, -1.0), (20, 1.0), (10, -1.0), (20, 1.0)]), 0.0, 30);
        assert_eq!(count(&fates, Fate::Kept), 50);
        // Under 60 frames the mean decides.
        assert_eq!(count(&judge(&scores(&[(40, 1.0), (19, -1.0)]), 0.0, 30), Fate::Kept), 59);
        assert_eq!(count(&judge(&scores(&[(40, -1.0), (19, 1.0)]), 0.0, 30), Fate::LowAdvantage), 59);
    }

    #[test]
    fn the_threshold_is_pooled_and_segments_keep_their_actions() {
        let mut long = along(&walk(&[(199, 0.01)]));
        long.action.iter_mut().enumerate().for_each(|(t, a)| a[0] = t as f32);
        let stalls: Vec<f32> =
            (0..200_i16).map(|t| 0.005 * f32::from(t.min(70) + (t - 130).max(0))).collect();
        let steady: Vec<f32> = (0..200_i16).map(|t| 0.005 * f32::from(t)).collect();
        let refined = advantage_filter(
            &[&long, &long],
            &[stalls, steady],
            &AdvantageConfig { percentile: 10.0, ..AdvantageConfig::default() },
        )
        .unwrap();
        assert_eq!(refined[1].report.kept, 200);
        assert_eq!(refined[0].segments.len(), 2);
        let [a, b] = &refined[0].segments[..] else { panic!("two segments") };
        assert!(!a.terminal && b.terminal);
        assert_eq!(a.action[a.len() - 1][0] as usize, a.len() - 1);
        assert_eq!(refined[0].report.kept, a.len() + b.len());
        assert_eq!(refined[0].threshold, refined[1].threshold);
        assert!(
            refined.iter().all(|r| r.value.is_some() && r.advantage.as_ref().is_some_and(|a| a.len() == 200))
        );
    }

    #[test]
    fn about_the_percentile_of_frames_lies_below_the_threshold() {
        let values: Vec<Vec<f32>> = (0..5).map(|i| bumpy(100 + 40 * i)).collect();
        let episodes: Vec<Episode> = values.iter().map(|v| along(&vec![0.0; v.len()])).collect();
        let refined = advantage_filter(&episodes, &values, &AdvantageConfig::default()).unwrap();
        let all: Vec<f32> = refined.iter().flat_map(|r| r.advantage.clone().unwrap()).collect();
        let below = all.iter().filter(|&&a| a < refined[0].threshold.unwrap()).count();
        assert!((below as f64 / all.len() as f64 - 0.3).abs() < 0.005, "{below} of {}", all.len());
    }

    #[test]
    fn values_that_do_not_fit_are_refused() {
        let e = along(&[0.0; 3]);
        let config = AdvantageConfig::default();
        let refuse = |values: &[Vec<f32>]| advantage_filter(&[&e], values, &config).unwrap_err();
        assert!(matches!(refuse(&[]), Error::Episodes { expected: 1, found: 0, .. }));
        assert!(matches!(refuse(&[vec![0.0; 2]]), Error::Frames { expected: 3, found: 2, .. }));
        assert!(matches!(refuse(&[vec![0.0, f32::NAN, 0.0]]), Error::NotFinite { row: 1, .. }));
        assert!(advantage_filter::<Episode>(&[], &[], &config).unwrap().is_empty());
    }
}
