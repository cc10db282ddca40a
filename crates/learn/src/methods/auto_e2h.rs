use crate::Result;
use crate::method::{Lesson, Method, Round, Tools};
use e2h_core::Episode;
use e2h_refine::{Goal, Refined, critic_filter, gate, held_on, kinematic_filter, reverse};
use std::time::Instant;

/// Auto-E2H: easy rollouts, turned round and filtered, teach the hard policy.
///
/// # Source
/// The paper's algorithm 1, lines 4 to 7, and equations 3 to 10. The gates are ours.
#[derive(Debug, Clone, Copy, Default)]
pub struct AutoE2h;

impl Method for AutoE2h {
    fn name(&self) -> &str {
        "auto-e2h"
    }

    fn lesson(&self, round: &Round<'_>, tools: &Tools<'_>) -> Result<Lesson> {
        let reverse_config = &round.config.refine.reverse;
        let reversed = round.rollouts.easy.iter().map(|e| reverse(e, reverse_config)).collect();
        let mut notes = vec![];
        let candidates = candidates(round, reversed, &mut notes);
        filter(round, tools, candidates, notes)
    }
}

/// What passes the gates: one grasp and one release, and an end no further out than the demonstrations'.
pub fn candidates(round: &Round<'_>, reversed: Vec<Episode>, notes: &mut Vec<String>) -> Vec<Episode> {
    let r = &round.config.refine;
    let mut candidates: Vec<Episode> =
        reversed.into_iter().filter(|e| gate(e, &r.gate, &r.reverse)).collect();
    if let Some(goal) = Goal::fit(&round.demonstrations.hard, &r.goal) {
        let before = candidates.len();
        if r.goal.enabled {
            candidates.retain(|e| goal.accepts(e));
        }
        notes.push(goal_note(&goal, &round.rollouts.hard, candidates.len(), before));
    }
    if r.gate.loose_m > 0.0 {
        let (all, mut loose) = (candidates.len(), 0);
        candidates = candidates
            .into_iter()
            .map(|e| {
                let before = e.len();
                let e = held_on(e, &r.gate, &r.reverse);
                loose += usize::from(e.len() < before);
                e
            })
            .collect();
        notes.push(format!(
            "release: {loose} of {all} reversals begin in the hand, as the object was dropped or pushed"
        ));
    }
    candidates
}

/// The kinematic filter, then the critic's, each as the configuration says.
///
/// # Errors
/// When the critic's training diverges.
pub fn filter(
    round: &Round<'_>,
    tools: &Tools<'_>,
    candidates: Vec<Episode>,
    mut notes: Vec<String>,
) -> Result<Lesson> {
    let (c, r) = (round.config, &round.config.refine);
    let kinematic: Vec<Refined> = candidates
        .iter()
        .map(|e| {
            if r.kinematic_enabled {
                kinematic_filter(e, &r.kinematic, &r.reverse)
            } else {
                Refined::untouched(e)
            }
        })
        .collect();
    let clock = Instant::now();
    let successes = round.rollouts.hard.iter().filter(|e| e.outcome.is_success()).count();
    let skipped = if !c.critic.enabled {
        Some("critic: switched off")
    } else if successes == 0 {
        Some("critic: skipped, no hard rollout succeeded")
    } else if candidates.is_empty() {
        Some("critic: skipped, nothing to filter")
    } else {
        None
    };
    if let Some(why) = skipped {
        notes.push(why.to_owned());
        let critic_time = clock.elapsed();
        return Ok(Lesson { candidates, refined: kinematic, critic: None, critic_time, notes });
    }
    let (critic, report) = tools.critic(round)?;
    let values = kinematic
        .iter()
        .flat_map(|k| &k.segments)
        .map(|segment| critic.evaluate(segment))
        .collect::<std::result::Result<Vec<_>, _>>()?;
    let suffix = r.suffix.trusting(successes);
    if suffix.enabled != r.suffix.enabled {
        let needed = r.suffix.min_successes;
        notes.push(format!("suffix: not cut, the critic has seen {successes} successes of {needed}"));
    }
    let refined = critic_filter(kinematic, &values, &suffix, &r.advantage)?;
    Ok(Lesson { candidates, refined, critic: Some(report), critic_time: clock.elapsed(), notes })
}

/// Where successes leave the object: what tells a loop that walks to the edge of its goal from one that does not.
fn goal_note(goal: &Goal, hard: &[Episode], kept: usize, of: usize) -> String {
    let successes = hard.iter().filter(|e| e.outcome.is_success());
    let mut ends: Vec<f64> = successes.filter_map(|e| goal.distance(e)).collect();
    ends.sort_by(f64::total_cmp);
    let median = ends.get(ends.len() / 2).map_or_else(|| "no".to_owned(), |d| format!("{:.1}", 1000.0 * d));
    format!(
        "goals: successes end {median} mm from the mean demonstrated goal (median), the gate is at {:.1} mm; {kept} of {of} \
         reversals kept",
        1000.0 * goal.radius
    )
}
