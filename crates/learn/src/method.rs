//! What differs between methods that share the loop: what the hard policy begins with, and what a round teaches it.
//!
//! ```
//! # use e2h_learn::methods;
//! // What `--method` can name: code, and values that are laid over preset and task file.
//! let names: Vec<&str> = methods::registry().iter().map(|m| m.name).collect();
//! assert!(names.contains(&"auto-e2h") && names.contains(&"no-critic"));
//! ```

use crate::collect::Collected;
use crate::policy_class::PolicyClass;
use crate::record::RunResults;
use crate::run::Toolbox;
use crate::{Demonstrations, Result, Run, RunConfig, Trained};
use e2h_core::{Direction, Episode};
use e2h_data::Source;
use e2h_policy::{Critic, CriticReport, Dynamics, DynamicsReport};
use e2h_refine::Refined;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

/// A round of the loop, after collection.
pub struct Round<'a> {
    /// The run's configuration.
    pub config: &'a RunConfig,
    /// Number of the round, from 1.
    pub iteration: u32,
    /// What the loop began with.
    pub demonstrations: &'a Demonstrations,
    /// What collection brought.
    pub rollouts: &'a Collected,
    /// The hard policy that collected.
    pub policy: &'a dyn Trained,
}

/// What a round teaches, and how it came about.
#[derive(Debug, Default)]
pub struct Lesson {
    /// Episodes that were looked at, in the direction of the hard task.
    pub candidates: Vec<Episode>,
    /// What is kept of each: segments, and the fate of every frame. As many as there are candidates.
    pub refined: Vec<Refined>,
    /// How the critic learned; none where none did.
    pub critic: Option<CriticReport>,
    /// Time in which the critic learned and judged.
    pub critic_time: Duration,
    /// What to tell in the report, in words.
    pub notes: Vec<String>,
}

/// What a method may use: it knows the run's seed, device and progress bars.
pub struct Tools<'a> {
    run: &'a dyn Toolbox,
}

impl<'a> Tools<'a> {
    pub(crate) fn new(run: &'a dyn Toolbox) -> Self {
        Self { run }
    }

    /// Trains the round's critic on hard rollouts, failures included.
    ///
    /// # Errors
    /// When the loss is not finite, or somebody asked the program to stop.
    pub fn critic(&self, round: &Round<'_>) -> Result<(Critic, CriticReport)> {
        self.run.critic(round)
    }

    /// Trains the round's dynamics models on hard rollouts, on features of the policy that collected them.
    ///
    /// # Errors
    /// When the policy has no image encoders, the loss is not finite, or somebody asked the program to stop.
    pub fn dynamics(&self, round: &Round<'_>) -> Result<(Dynamics, DynamicsReport)> {
        self.run.dynamics(round)
    }

    /// Successful scripted demonstrations, recorded once a run.
    ///
    /// # Errors
    /// When the demonstrator fails more often than it succeeds, or the folder cannot be written.
    pub fn demonstrations(&self, direction: Direction) -> Result<Vec<Episode>> {
        self.run.demonstrate(direction)
    }
}

/// One way to learn from the loop.
pub trait Method: Send + Sync {
    /// Its name, for example `auto-e2h`.
    fn name(&self) -> &str;

    /// Refuses what it cannot run on, before any work; by default nothing.
    ///
    /// # Errors
    /// Says what was expected and found.
    fn check(&self, config: &RunConfig) -> Result<()> {
        let _ = config;
        Ok(())
    }

    /// The class of policies that it trains, where it is not the run's choice.
    fn policies(&self) -> Option<Arc<dyn PolicyClass>> {
        None
    }

    /// All of the run, for a method whose loop is not the shared one; by default none.
    fn learn(&self, run: &Run) -> Option<Result<(RunResults, PathBuf)>> {
        let _ = run;
        None
    }

    /// What the initial hard policy learns from; by default the reversed demonstrations.
    ///
    /// # Errors
    /// When its data cannot be made.
    fn initial(
        &self,
        demonstrations: &Demonstrations,
        config: &RunConfig,
        tools: &Tools<'_>,
    ) -> Result<Vec<Source>> {
        let _ = (config, tools);
        Ok(vec![Source::whole(demonstrations.hard.clone())])
    }

    /// What a round teaches.
    ///
    /// # Errors
    /// When the critic's training diverges.
    fn lesson(&self, round: &Round<'_>, tools: &Tools<'_>) -> Result<Lesson>;

    /// What an update learns from, given what the rounds so far have taught, the newest last; by default the initial
    /// demonstrations and the segments, with the shares and the memory that the configuration says.
    fn sources(
        &self,
        demonstrations: &Demonstrations,
        segments: &[&[Arc<Episode>]],
        config: &RunConfig,
    ) -> Vec<Source> {
        let share = config.closed_loop.base_share;
        let first = if config.closed_loop.accumulate { 0 } else { segments.len().saturating_sub(1) };
        let episodes = segments[first..].iter().flat_map(|s| s.iter().cloned()).collect();
        vec![Source::new(demonstrations.hard.clone(), share), Source::new(episodes, 1.0 - share)]
    }
}
