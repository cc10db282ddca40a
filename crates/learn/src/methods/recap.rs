use crate::method::{Lesson, Method, Round, Tools};
use crate::{Demonstrations, Result, RunConfig};
use e2h_core::Episode;
use e2h_data::Source;
use e2h_refine::{Refined, rebuild_actions};
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Label of what the policy shall do.
const POSITIVE: f32 = 1.0;
/// Label of what it shall not.
const NEGATIVE: f32 = -1.0;

/// What a label says of a hard rollout; demonstrations are always positive.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Indicator {
    /// Whether it succeeded.
    #[default]
    Outcome,
    /// That it is one, whatever came of it: the paper's own words on its baseline ("to identify rollout source").
    Source,
}

/// Settings of [`Recap`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecapConfig {
    /// What the labels say.
    pub indicator: Indicator,
    /// Guidance weight of policies that learned from labels, beta: 1 asks for positive actions alone, others need
    /// `train.step.indicator_dropout`. Policies without labels have `policy.guidance`.
    pub guidance: f32,
}

impl Default for RecapConfig {
    fn default() -> Self {
        Self { indicator: Indicator::Outcome, guidance: 1.0 }
    }
}

/// RECAP: the hard policy learns from all its rollouts, good or bad, is told which is which, and is asked for good ones. The easy
/// policy only resets the scene.
///
/// # Source
/// pi*0.6, arXiv 2511.14759, as the paper's baseline has it: one number in the condition, no advantage.
/// Differs: labels are outcomes by default, because a policy that is asked for demonstrations alone can only repeat them.
#[derive(Debug, Clone, Copy, Default)]
pub struct Recap;

/// Label of a hard rollout, from what is stored with it: a resumed run reads it back.
fn label(episode: &Episode, indicator: Indicator) -> f32 {
    match indicator {
        Indicator::Outcome if episode.outcome.is_success() => POSITIVE,
        Indicator::Outcome | Indicator::Source => NEGATIVE,
    }
}

impl Method for Recap {
    fn name(&self) -> &str {
        "recap"
    }

    fn lesson(&self, round: &Round<'_>, _: &Tools<'_>) -> Result<Lesson> {
        let relabel = |episode: &Episode| {
            let mut episode = episode.clone();
            rebuild_actions(&mut episode, &round.config.refine.reverse);
            // What follows the horizon is not known; to stand still there is nothing to learn.
            episode.terminal &= episode.outcome.is_success();
            episode
        };
        let candidates: Vec<Episode> = round.rollouts.hard.iter().map(relabel).collect();
        let refined = candidates.iter().map(Refined::untouched).collect();
        let indicator = round.config.recap.indicator;
        let notes = vec![share_of_positives(&candidates, indicator)];
        Ok(Lesson { candidates, refined, notes, ..Lesson::default() })
    }

    fn sources(
        &self,
        demonstrations: &Demonstrations,
        segments: &[&[Arc<Episode>]],
        config: &RunConfig,
    ) -> Vec<Source> {
        let share = config.closed_loop.base_share;
        let first = if config.closed_loop.accumulate { 0 } else { segments.len().saturating_sub(1) };
        let rollouts = segments[first..].iter().flat_map(|s| s.iter().cloned());
        let (good, bad): (Vec<_>, Vec<_>) =
            rollouts.partition(|e| label(e, config.recap.indicator) == POSITIVE);
        // A window is a row: by rows, all rollouts' windows have equal chances.
        let rows = |some: &[Arc<Episode>]| some.iter().map(|e| e.len()).sum::<usize>() as f32;
        let each = (1.0 - share) / (rows(&good) + rows(&bad)).max(1.0);
        let (of_good, of_bad) = (each * rows(&good), each * rows(&bad));
        vec![
            Source::new(demonstrations.hard.clone(), share).labelled(POSITIVE),
            Source::new(good, of_good).labelled(POSITIVE),
            Source::new(bad, of_bad).labelled(NEGATIVE),
        ]
    }
}

/// A note for the report: next to no positives, or nothing else, and the label says nothing.
fn share_of_positives(rollouts: &[Episode], indicator: Indicator) -> String {
    let rows = |some: &mut dyn Iterator<Item = &Episode>| some.map(Episode::len).sum::<usize>();
    let positive = || rollouts.iter().filter(|e| label(e, indicator) == POSITIVE);
    let share = 100.0 * rows(&mut positive()) as f64 / rows(&mut rollouts.iter()).max(1) as f64;
    format!(
        "recap: {} of {} rollouts are positive, {share:.0} % of their frames",
        positive().count(),
        rollouts.len()
    )
}
