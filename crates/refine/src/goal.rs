use crate::{limits, percentile};
use e2h_core::Episode;
use e2h_core::state::object_position;
use serde::{Deserialize, Serialize};

/// Whether a reversal may end further out than the demonstrations do.
///
/// Easy rollouts begin where hard rollouts ended, so reversals end where the policy's own successes did. A success at the
/// edge of the predicate teaches as much as one in its middle, and the policy may walk to the edge. This gate is what pulls
/// back.
///
/// # Source
/// Not in the paper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoalConfig {
    /// False accepts every goal, as the paper does.
    pub enabled: bool,
    /// A reversal must end at most as far from the mean demonstrated goal as this share of the demonstrations do; percent.
    pub percentile: f64,
    /// Nearer than this every goal is accepted, m: where a hole hardly lets the object move, the share alone would reject nearly
    /// all, and nothing can drift.
    pub least: f64,
}

impl Default for GoalConfig {
    fn default() -> Self {
        Self { enabled: false, percentile: 50.0, least: 0.005 }
    }
}

impl GoalConfig {
    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems: Vec<String> = limits::amount("least", self.least, true).into_iter().collect();
        if !(0.0..=100.0).contains(&self.percentile) {
            problems.push(format!("percentile: expected 0 to 100, got {}", self.percentile));
        }
        problems
    }
}

/// A place for the object, with the distance from it that still counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Goal {
    /// Mean position of the object at the demonstrations' ends, m.
    pub centre: [f32; 3],
    /// Largest distance from it that is accepted, m.
    pub radius: f64,
}

impl Goal {
    /// Fits the goal to what reversed demonstrations end in; none when none of them has a row.
    #[must_use]
    pub fn fit(demonstrations: &[impl AsRef<Episode>], config: &GoalConfig) -> Option<Self> {
        let ends: Vec<[f32; 3]> = demonstrations.iter().filter_map(|e| last_position(e.as_ref())).collect();
        let mean = |axis: usize| ends.iter().map(|e| e[axis]).sum::<f32>() / ends.len() as f32;
        let centre = [mean(0), mean(1), mean(2)];
        let distances: Vec<f64> = ends.iter().map(|e| distance(e, &centre)).collect();
        let radius = percentile(&distances, config.percentile)?.max(config.least);
        Some(Self { centre, radius })
    }

    /// How far from the centre `episode` leaves its object, m; none for an episode without rows.
    #[must_use]
    pub fn distance(&self, episode: &Episode) -> Option<f64> {
        last_position(episode).map(|end| distance(&end, &self.centre))
    }

    /// Whether `episode` leaves its object within the radius.
    #[must_use]
    pub fn accepts(&self, episode: &Episode) -> bool {
        self.distance(episode).is_some_and(|d| d <= self.radius)
    }
}

fn last_position(episode: &Episode) -> Option<[f32; 3]> {
    episode.state.last().map(object_position)
}

fn distance(a: &[f32; 3], b: &[f32; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::along;
    use std::sync::Arc;

    /// An episode whose object ends at `x`.
    fn ending(x: f32) -> Episode {
        let mut e = along(&[0.0, 0.1, 0.2]);
        e.state[2][7] = x;
        e
    }

    fn boxed(x: &[f32]) -> Vec<Arc<Episode>> {
        x.iter().map(|x| Arc::new(ending(*x))).collect()
    }

    #[test]
    fn goals_as_near_as_half_of_the_demonstrations_pass() {
        let config = GoalConfig { enabled: true, percentile: 50.0, least: 0.0 };
        let goal = Goal::fit(&boxed(&[0.1, 0.2, 0.3, 0.4, 0.5]), &config).unwrap();
        assert!((goal.centre[0] - 0.3).abs() < 1e-6 && (goal.radius - 0.1).abs() < 1e-6);
        assert!(goal.accepts(&ending(0.39)) && goal.accepts(&ending(0.21)));
        assert!(!goal.accepts(&ending(0.41)) && !goal.accepts(&ending(0.19)));
        assert!(!goal.accepts(&along(&[])), "an episode without rows ends nowhere");
    }

    #[test]
    fn a_hole_that_holds_the_object_does_not_starve_the_gate() {
        let config = GoalConfig { enabled: true, percentile: 50.0, least: 0.005 };
        let goal = Goal::fit(&boxed(&[0.1, 0.1001, 0.1002]), &config).unwrap();
        assert!(goal.accepts(&ending(0.1045)) && !goal.accepts(&ending(0.1055)));
    }

    #[test]
    fn all_demonstrations_pass_at_a_hundred_percent() {
        let all = boxed(&[0.1, 0.25, 0.9]);
        let goal = Goal::fit(&all, &GoalConfig { enabled: true, percentile: 100.0, least: 0.0 }).unwrap();
        assert!(all.iter().all(|e| goal.accepts(e)));
        let none: Vec<Arc<Episode>> = vec![];
        assert_eq!(Goal::fit(&none, &GoalConfig::default()), None);
    }
}
