use super::auto_e2h::candidates;
use crate::Result;
use crate::method::{Lesson, Method, Round, Tools};
use e2h_core::Episode;
use e2h_policy::{DynamicsConfig, DynamicsReport};
use e2h_refine::{DynamicsFilterConfig, dynamics_filter, reverse};
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Settings of [`TrDrlDp`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DynamicsStage {
    /// True: only reversals that pass the gates of `auto-e2h` are looked at. False: all (the paper's).
    pub gates: bool,
    /// The dynamics models.
    pub network: DynamicsConfig,
    /// Which transitions they have to confirm.
    pub filter: DynamicsFilterConfig,
}

/// TR-DRL-DP: easy rollouts turned round, kept where a forward model confirms the action of an inverse model, and labelled with that action.
/// Neither kinematic filter nor critic.
///
/// # Source
/// The paper's baseline, TR-DRL (arXiv 2505.13925) with a diffusion policy in place of reinforcement learning.
#[derive(Debug, Clone, Copy, Default)]
pub struct TrDrlDp;

impl Method for TrDrlDp {
    fn name(&self) -> &str {
        "tr-drl-dp"
    }

    fn lesson(&self, round: &Round<'_>, tools: &Tools<'_>) -> Result<Lesson> {
        let c = &round.config.dynamics;
        let reversed: Vec<Episode> =
            round.rollouts.easy.iter().map(|e| reverse(e, &round.config.refine.reverse)).collect();
        let mut notes = vec![];
        let mut looked_at = if c.gates { candidates(round, reversed, &mut notes) } else { reversed };
        if looked_at.is_empty() || round.rollouts.hard.iter().all(|e| e.len() < 2) {
            notes.push("dynamics: skipped, nothing to learn from or to judge".to_owned());
            return Ok(Lesson { notes, ..Lesson::default() });
        }
        let clock = Instant::now();
        let (dynamics, report) = tools.dynamics(round)?;
        notes.push(words(&report));
        let mut errors = Vec::with_capacity(looked_at.len());
        for episode in &mut looked_at {
            let (error, labels) = dynamics.judge(episode)?;
            errors.push(error);
            episode.action = labels;
        }
        let refined = dynamics_filter(&looked_at, &errors, &c.filter)?;
        Ok(Lesson { candidates: looked_at, refined, critic: None, critic_time: clock.elapsed(), notes })
    }
}

fn words(r: &DynamicsReport) -> String {
    let held = |v: Option<f64>| v.map_or_else(|| "none".to_owned(), |v| format!("{v:.4}"));
    format!(
        "dynamics: forward {:.4}, held out {}; inverse {:.4}, held out {}; its goals are {} mm from the next poses (median)",
        r.forward,
        held(r.forward_held_out),
        r.inverse,
        held(r.inverse_held_out),
        r.label_mm.map_or_else(|| "unknown".to_owned(), |v| format!("{v:.1}"))
    )
}
