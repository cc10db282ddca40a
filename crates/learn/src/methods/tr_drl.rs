use crate::method::{Lesson, Method, Round, Tools};
use crate::policy_class::{PolicyClass, States};
use crate::record::RunResults;
use crate::{Error, Result, Run, RunConfig};
use std::path::PathBuf;
use std::sync::Arc;

/// Pairs that agents have actions for, each with the variants.
const PAIRS: [(&str, &[&str]); 2] = [("nut_assembly", &["loose"]), ("peg_insertion", &[])];

/// TR-DRL: reinforcement learning from states in both directions, each learning from the other's reversed transitions as well, with rewards
/// from potentials that successes teach. Neither images nor a diffusion policy; every episode begins with an external reset.
///
/// # Source
/// arXiv 2505.13925, in the form of `jyp9961/TR-DRL e56d60e`. Differs: by default successes end an episode, critics have layer norms, and the
/// networks are smaller; `tr_drl.reward`, `tr_drl.agent` and the preset `paper` have the release's.
#[derive(Debug, Clone, Copy, Default)]
pub struct TrDrl;

impl Method for TrDrl {
    fn name(&self) -> &str {
        "tr-drl"
    }

    fn check(&self, config: &RunConfig) -> Result<()> {
        let (task, variant) = (&config.task.name, &config.task.variant);
        let known = PAIRS.iter().any(|(t, v)| t == task && (v.is_empty() || v.contains(&variant.as_str())));
        if known {
            return Ok(());
        }
        let pairs: Vec<String> = PAIRS
            .iter()
            .map(|(t, v)| if v.is_empty() { (*t).to_owned() } else { format!("{t} ({})", v.join(", ")) })
            .collect();
        let found = if variant.is_empty() { task.clone() } else { format!("{task} ({variant})") };
        Err(Error::Config(format!(
            "method tr-drl: expected one of {}, whose states and actions its agents know; found {}",
            pairs.join(", "),
            e2h_core::one_line(&found)
        )))
    }

    fn policies(&self) -> Option<Arc<dyn PolicyClass>> {
        Some(Arc::new(States))
    }

    fn learn(&self, run: &Run) -> Option<Result<(RunResults, PathBuf)>> {
        Some(run.learn_tr_drl())
    }

    fn lesson(&self, _: &Round<'_>, _: &Tools<'_>) -> Result<Lesson> {
        Err(Error::Config(
            "method tr-drl: expected its own loop, Run::learn; found a round of the shared one".to_owned(),
        ))
    }
}
