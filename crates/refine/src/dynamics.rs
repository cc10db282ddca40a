use crate::advantage::{check_values, split};
use crate::series::{moving_average, percentile, runs};
use crate::{Error, Fate, Refined, Result, limits};
use e2h_core::Episode;
use serde::{Deserialize, Serialize};
use std::borrow::Borrow;

/// Which reversed transitions a dynamics model has to confirm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DynamicsFilterConfig {
    /// Centred moving average of the error, frames; shorter at the ends.
    pub smooth: usize,
    /// Frames above this percentile of all frames of the iteration go. A percentile always drops as many.
    pub percentile: f64,
    /// Shorter runs of what is left go too, frames.
    pub min_run: usize,
}

impl Default for DynamicsFilterConfig {
    /// The paper's values for its baseline TR-DRL-DP.
    fn default() -> Self {
        Self { smooth: 31, percentile: 80.0, min_run: 16 }
    }
}

impl DynamicsFilterConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems: Vec<String> = [("smooth", self.smooth, 1), ("min_run", self.min_run, 0)]
            .into_iter()
            .filter_map(|(name, n, least)| limits::frames(name, n, least))
            .collect();
        if !(0.0..=100.0).contains(&self.percentile) {
            problems.push(format!("percentile: expected 0 to 100, got {}", self.percentile));
        }
        if self.smooth > 0 && self.smooth.is_multiple_of(2) {
            problems.push(format!("smooth: expected an odd number of frames, got {}", self.smooth));
        }
        problems
    }
}

/// Removes frames whose reversed transition a dynamics model could not confirm, and splits the episodes there. `errors[i]` are those of
/// the rows of `episodes[i]`; `episodes` are all of one iteration, because the threshold is a percentile over all their frames.
///
/// # Errors
/// When errors and frames do not agree in number, or an error is not finite.
///
/// # Source
/// The paper's baseline TR-DRL-DP, after the dynamics-consistency filter of TR-DRL (arXiv 2505.13925).
pub fn dynamics_filter<E: Borrow<Episode>>(
    episodes: &[E],
    errors: &[Vec<f32>],
    config: &DynamicsFilterConfig,
) -> Result<Vec<Refined>> {
    if episodes.len() != errors.len() {
        return Err(Error::Episodes { what: "errors", expected: episodes.len(), found: errors.len() });
    }
    for (i, (episode, errors)) in episodes.iter().zip(errors).enumerate() {
        check_values(i, episode.borrow().len(), errors)?;
    }
    let smooth =
        |e: &Vec<f32>| moving_average(&e.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(), config.smooth);
    let smoothed: Vec<Vec<f64>> = errors.iter().map(smooth).collect();
    let Some(threshold) = percentile(&smoothed.concat(), config.percentile) else {
        return Ok(episodes.iter().map(|e| Refined::untouched(e.borrow())).collect());
    };
    let refine = |(episode, errors): (&E, &Vec<f64>)| {
        let sound: Vec<bool> = errors.iter().map(|e| *e <= threshold).collect();
        let mut fates: Vec<Fate> =
            sound.iter().map(|&s| if s { Fate::Kept } else { Fate::DynamicsError }).collect();
        for run in runs(&sound, true).into_iter().filter(|r| r.len() < config.min_run) {
            fates[run].fill(Fate::TooShort);
        }
        let mut refined = split(episode.borrow(), fates);
        refined.dynamics_error = Some(crate::motion::narrow(errors));
        refined.dynamics_threshold = crate::motion::narrow(&[threshold]).pop();
        refined
    };
    Ok(episodes.iter().zip(&smoothed).map(refine).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{along, walk};

    fn episode(rows: usize) -> Episode {
        along(&walk(&[(rows - 1, 0.01)]))
    }

    fn count(r: &Refined, fate: Fate) -> usize {
        r.fates.iter().filter(|f| **f == fate).count()
    }

    #[test]
    fn a_fifth_of_all_frames_goes_and_short_rests_with_it() {
        let config = DynamicsFilterConfig { smooth: 1, ..DynamicsFilterConfig::default() };
        // One bad stretch of 40 in 200 frames; it leaves 10 frames before it in the second episode, which are too short.
        let mut bad = vec![0.1; 100];
        bad[10..50].fill(0.9);
        let refined =
            dynamics_filter(&[episode(100), episode(100)], &[vec![0.1; 100], bad], &config).unwrap();
        assert_eq!(refined[0].segments.len(), 1);
        assert_eq!(count(&refined[0], Fate::Kept), 100);
        assert_eq!((count(&refined[1], Fate::DynamicsError), count(&refined[1], Fate::TooShort)), (40, 10));
        assert_eq!(refined[1].segments.len(), 1);
        assert_eq!(refined[1].segments[0].source[0], 50);
        assert!((0.1..0.9).contains(&refined[1].dynamics_threshold.unwrap()));
        assert_eq!(refined[1].dynamics_error.as_ref().unwrap()[20], 0.9);
        assert!(refined[1].value.is_none());
    }

    #[test]
    fn errors_are_smoothed_before_they_are_judged() {
        // A single spike is spread over 31 frames, and is no higher than a plateau then.
        let mut errors = vec![0.0; 200];
        errors[50] = 3.1;
        errors[120..160].fill(1.0);
        let refined =
            dynamics_filter(&[episode(200)], &[errors], &DynamicsFilterConfig::default()).unwrap().remove(0);
        let smoothed = refined.dynamics_error.as_ref().unwrap();
        assert!((smoothed[50] - 0.1).abs() < 1e-6 && (smoothed[140] - 1.0).abs() < 1e-6);
        assert_eq!(refined.fates[50], Fate::Kept);
        assert_eq!(refined.fates[140], Fate::DynamicsError);
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let config = DynamicsFilterConfig::default();
        let refuse = |errors: &[Vec<f32>]| dynamics_filter(&[episode(4)], errors, &config).unwrap_err();
        assert!(matches!(refuse(&[]), Error::Episodes { expected: 1, found: 0, .. }));
        assert!(matches!(refuse(&[vec![0.0; 3]]), Error::Frames { expected: 4, found: 3, .. }));
        assert!(matches!(refuse(&[vec![0.0, f32::NAN, 0.0, 0.0]]), Error::NotFinite { row: 1, .. }));
        let none: [Episode; 0] = [];
        assert!(dynamics_filter(&none, &[], &config).unwrap().is_empty());
        for (bad, word) in [
            (DynamicsFilterConfig { smooth: 4, ..config.clone() }, "smooth"),
            (DynamicsFilterConfig { percentile: 101.0, ..config.clone() }, "percentile"),
        ] {
            assert!(bad.validate()[0].contains(word));
        }
        assert!(config.validate().is_empty());
    }
}
