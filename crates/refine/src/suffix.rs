use crate::advantage::{check_values, split};
use crate::series::runs;
use crate::{Fate, Refined, Result, limits};
use e2h_core::Episode;
use serde::{Deserialize, Serialize};

/// Whether and where an episode ends early because its goal is reached.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SuffixConfig {
    /// For pairs that need no release only: elsewhere letting go and moving away is part of success. Optional in the paper.
    pub enabled: bool,
    /// The goal counts as reached at this value and above.
    pub value: f32,
    /// For this many frames in a row.
    pub frames: usize,
    /// Frames kept after those.
    pub keep: usize,
    /// With fewer successful hard rollouts in the iteration the value is not trusted, and nothing is cut; for the caller, who
    /// counts them ([`SuffixConfig::trusting`]).
    pub min_successes: usize,
}

impl Default for SuffixConfig {
    fn default() -> Self {
        Self { enabled: false, value: 0.9, frames: 5, keep: 20, min_successes: 3 }
    }
}

impl SuffixConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        if !(-1.0..=1.0).contains(&self.value) {
            problems.push(format!("value: expected -1 to 1, as values are, got {}", self.value));
        }
        for (name, value, least) in
            [("frames", self.frames, 1), ("keep", self.keep, 0), ("min_successes", self.min_successes, 0)]
        {
            problems.extend(limits::frames(name, value, least));
        }
        problems
    }

    /// The same for a critic that learned from so many successful hard rollouts: off where they are too few to trust it.
    #[must_use]
    pub fn trusting(&self, successes: usize) -> Self {
        Self { enabled: self.enabled && successes >= self.min_successes, ..self.clone() }
    }
}

/// Cuts what follows once the goal is reached. The cut end counts as the end of the task.
///
/// # Errors
/// When values and frames do not agree in number, or a value is not finite.
///
/// # Source
/// "We optionally truncate the suffix after it enters a high-value region"; the numbers are ours.
pub fn cut_suffix(episode: &Episode, values: &[f32], config: &SuffixConfig) -> Result<Refined> {
    check_values(0, episode.len(), values)?;
    let high: Vec<bool> = values.iter().map(|&v| v >= config.value).collect();
    let goal = runs(&high, true).into_iter().find(|run| run.len() >= config.frames);
    let end = match goal {
        Some(run) if config.enabled => (run.start + config.frames + config.keep).min(episode.len()),
        _ => episode.len(),
    };
    let mut fates = vec![Fate::Kept; episode.len()];
    fates[end..].fill(Fate::AfterGoal);
    let mut refined = split(episode, fates);
    for segment in &mut refined.segments {
        segment.terminal = episode.terminal;
    }
    refined.value = Some(values.to_vec());
    Ok(refined)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::along;

    #[test]
    fn the_suffix_goes_20_frames_after_the_value_has_stayed_high() {
        let e = along(&[0.0; 60]);
        let mut values = vec![0.0; 60];
        values[5..9].fill(0.95); // four in a row are one too few
        values[20..30].fill(0.9);
        let on = SuffixConfig { enabled: true, ..SuffixConfig::default() };
        let refined = cut_suffix(&e, &values, &on).unwrap();
        assert_eq!((refined.report.kept, refined.report.after_goal), (45, 15));
        assert!(refined.segments[0].terminal);
        assert_eq!(cut_suffix(&e, &values, &SuffixConfig::default()).unwrap().report.kept, 60);
        assert_eq!(cut_suffix(&e, &values, &on.trusting(3)).unwrap().report.after_goal, 15);
        assert_eq!(cut_suffix(&e, &values, &on.trusting(2)).unwrap().report.after_goal, 0);
        values[54..].fill(1.0);
        values[20..30].fill(0.0);
        assert_eq!(cut_suffix(&e, &values, &on).unwrap().report.kept, 60);
    }
}
