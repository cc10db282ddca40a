use super::auto_e2h::filter;
use crate::Result;
use crate::method::{Lesson, Method, Round, Tools};
use e2h_core::Episode;
use e2h_refine::rebuild_actions;

/// Direct-H: the hard policy learns from its own successes; the easy policy only resets the scene.
///
/// # Source
/// The paper's ablation of reversal. Labels are made as those of reversals are, from the path that was travelled.
#[derive(Debug, Clone, Copy, Default)]
pub struct DirectH;

impl Method for DirectH {
    fn name(&self) -> &str {
        "direct-h"
    }

    fn lesson(&self, round: &Round<'_>, tools: &Tools<'_>) -> Result<Lesson> {
        let own = round.rollouts.hard.iter().filter(|e| e.outcome.is_success());
        let relabel = |episode: &Episode| {
            let mut episode = episode.clone();
            rebuild_actions(&mut episode, &round.config.refine.reverse);
            episode
        };
        let candidates = own.map(relabel).collect();
        filter(round, tools, candidates, vec![])
    }
}
