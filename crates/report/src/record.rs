//! What a run measured: the rows of the success curve and everything that is written as `results.json`.

use e2h_core::Outcome;
use e2h_refine::{Fate, Refined};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Success over a number of trials.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// Trials that succeeded, k.
    pub successes: usize,
    /// Trials, n.
    pub trials: usize,
    /// 95 % Wilson interval of the success rate.
    pub wilson95: [f64; 2],
    /// Mean control steps of the successful trials; 0 without one.
    pub mean_steps: f64,
    /// Wall time, s.
    pub seconds: f64,
    /// Every trial, in order; trial i of two evaluations with the same seed has the same start. Empty in records from before they were kept.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub outcomes: Vec<Trial>,
}

impl Evaluation {
    /// The account of `outcomes`, which took `seconds` of wall time.
    #[must_use]
    pub fn new(outcomes: Vec<Trial>, seconds: f64) -> Self {
        let steps: Vec<usize> = outcomes.iter().filter(|t| t.outcome.is_success()).map(|t| t.steps).collect();
        let (successes, trials) = (steps.len(), outcomes.len());
        Self {
            successes,
            trials,
            wilson95: wilson95(successes, trials),
            mean_steps: steps.iter().sum::<usize>() as f64 / successes.max(1) as f64,
            seconds,
            outcomes,
        }
    }
}

/// How one trial went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Trial {
    /// How it ended.
    pub outcome: Outcome,
    /// Control steps it took.
    pub steps: usize,
}

/// One row of the success curve. Row 0 is the initial policy (the paper's "iteration 1").
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct IterationRecord {
    /// Number of updates behind this policy.
    pub iteration: u32,
    /// The hard policy after this iteration's update, from external resets at seeds that training never saw.
    pub evaluation: Evaluation,
    /// Minutes since the run started (its own time only, also across resumes).
    pub minutes: f64,
    /// Minutes by stage of this iteration: `collect`, `refine`, `critic`, `train`, `evaluate`, ...
    pub stage_minutes: BTreeMap<String, f64>,
    /// Closed-loop collection that fed this update; none for the initial policy.
    pub collection: Option<Collection>,
    /// Mean training loss over the last hundred steps.
    pub loss: f64,
    /// True when nothing was accepted and the update was skipped.
    pub skipped: bool,
    /// Training steps of the hard policy in this iteration; 0 in records from before they were counted.
    #[serde(default)]
    pub updates: usize,
}

/// What one round of closed-loop collection brought and what refinement made of it.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Collection {
    /// Cycles of a hard and an easy rollout.
    pub cycles: usize,
    /// Hard rollouts that succeeded, of `cycles`.
    pub hard_successes: usize,
    /// Easy rollouts that succeeded.
    pub easy_successes: usize,
    /// Easy rollouts started.
    pub easy_rollouts: usize,
    /// Control steps of all rollouts of both directions; 0 in records from before they were counted.
    #[serde(default)]
    pub steps: usize,
    /// External resets by cause.
    pub resets: BTreeMap<ResetCause, usize>,
    /// Cycles whose easy rollout explored; none in records from before there was exploration.
    #[serde(default)]
    pub explored: Automatic,
    /// The other cycles.
    #[serde(default)]
    pub plain: Automatic,
    /// Easy rollouts whose reversal passed the gripper gate and the goal gate.
    pub accepted: usize,
    /// Frames of the accepted reversals by fate; the values add up to the frames that went in.
    pub fates: BTreeMap<Fate, usize>,
    /// Segments that went into training from this round.
    pub segments: usize,
    /// Frames that went into training from this round.
    pub frames_kept: usize,
    /// Loss of the critic on the rollouts held out, or its training loss where none was; none when the critic stage was skipped.
    pub critic_loss: Option<f64>,
    /// Why a stage was skipped, in words; empty when none was.
    pub notes: Vec<String>,
}

/// Why the scene was reset from outside. In the order of the alphabet, which is the order in files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResetCause {
    /// The simulation diverged in a rollout.
    Diverged,
    /// The object was dropped in a task that must hold it throughout.
    Dropped,
    /// The easy rollout did not succeed.
    EasyFailed,
    /// A method without a loop begins every episode with one.
    Episode,
    /// The hard rollout did not succeed.
    HardFailed,
    /// The simulation diverged on the way home.
    HomingDiverged,
    /// The simulation diverged in a reset, which was drawn again.
    ResetDiverged,
    /// The first placement of each loop.
    Start,
}

impl ResetCause {
    /// What it is called in words.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Diverged => "diverged",
            Self::Dropped => "dropped",
            Self::EasyFailed => "easy failed",
            Self::Episode => "episode",
            Self::HardFailed => "hard failed",
            Self::HomingDiverged => "homing diverged",
            Self::ResetDiverged => "reset diverged",
            Self::Start => "start",
        }
    }
}

/// How one kind of cycle went on by itself.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Automatic {
    /// Cycles of this kind.
    pub cycles: usize,
    /// Easy rollouts that succeeded in them.
    pub easy_successes: usize,
    /// External resets that followed a rollout of theirs.
    pub resets: usize,
}

impl Automatic {
    /// Share of cycles that needed no external reset, in [0, 1]; none without cycles.
    #[must_use]
    pub fn rate(&self) -> Option<f64> {
        (self.cycles > 0).then(|| 1.0 - self.resets.min(self.cycles) as f64 / self.cycles as f64)
    }
}

impl std::ops::AddAssign for Automatic {
    fn add_assign(&mut self, other: Self) {
        self.cycles += other.cycles;
        self.easy_successes += other.easy_successes;
        self.resets += other.resets;
    }
}

impl Collection {
    /// Share of cycles that needed no external reset, in [0, 1] (the paper's automatic-reset rate).
    #[must_use]
    pub fn automatic_reset_rate(&self) -> f64 {
        let resets: usize =
            self.resets.iter().filter(|(cause, _)| **cause != ResetCause::Start).map(|(_, n)| n).sum();
        if self.cycles == 0 { 0.0 } else { 1.0 - (resets.min(self.cycles) as f64 / self.cycles as f64) }
    }
}

/// What the filters made of one reversed rollout, frame by frame. `iteration_NN/reversals.json` is a list of these.
///
/// # Shapes
/// Every list has one entry a frame of the reversed rollout.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reversal {
    /// Cycle whose easy rollout was reversed.
    pub episode: u32,
    /// Row of the rollout that each frame comes from.
    pub source: Vec<u32>,
    /// What became of each frame.
    pub fates: Vec<Fate>,
    /// Speed of the tool centre point, m/s.
    pub speed: Vec<f32>,
    /// The critic's value; none at frames that an earlier stage had removed.
    pub value: Option<Vec<Option<f32>>>,
    /// Smoothed advantage, likewise.
    pub advantage: Option<Vec<Option<f32>>>,
    /// Smoothed error of a dynamics model, where one judged; none in records from before there was one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dynamics_error: Option<Vec<Option<f32>>>,
    /// How far exploration had displaced the goal, mm; none where it had not, and in records from before there was any.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub excursion: Option<Vec<f32>>,
    /// Advantage below which frames were marked for removal.
    pub threshold: Option<f32>,
}

impl Reversal {
    /// The account of one reversed rollout.
    #[must_use]
    pub fn new(reversed: &e2h_core::Episode, refined: &Refined) -> Self {
        // JSON has no numbers that are not finite.
        let finite =
            |v: &Vec<f32>| v.iter().map(|&v| v.is_finite().then_some(v)).collect::<Vec<Option<f32>>>();
        Self {
            episode: reversed.origin.episode,
            source: reversed.source.clone(),
            fates: refined.fates.clone(),
            speed: refined.speed.clone(),
            excursion: crate::picture::excursions(reversed),
            dynamics_error: refined.dynamics_error.as_ref().map(finite),
            value: refined.value.as_ref().map(finite),
            advantage: refined.advantage.as_ref().map(finite),
            threshold: refined.threshold.filter(|t| t.is_finite()),
        }
    }
}

/// `results.json` of a run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct RunResults {
    /// Task pair.
    pub task: String,
    /// Variant of the task.
    pub variant: String,
    /// Preset name.
    pub preset: String,
    /// Method name; empty in results of version 0.1, which were all of `auto-e2h`.
    #[serde(default)]
    pub method: String,
    /// Run seed.
    pub seed: u64,
    /// Version of this library that made the run.
    pub version: String,
    /// Easy demonstrations that the run began with; 0 in results of version 0.1.
    #[serde(default)]
    pub demonstrations: usize,
    /// Where they came from, if the run was given them; none where its scripted demonstrator recorded them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub given: Option<crate::folder::Given>,
    /// Whether easy rollouts explored.
    #[serde(default)]
    pub explored: bool,
    /// What was laid over preset and task file, as `key.path=value`; with task, preset, seed and version it repeats the run.
    #[serde(default)]
    pub overrides: Vec<String>,
    /// Threads that ran, and the processor's name where the system tells it.
    pub machine: String,
    /// The success curve.
    pub iterations: Vec<IterationRecord>,
    /// Mean control steps of a demonstration, easy direction (the paper's cost table).
    pub demonstration_steps: f64,
    /// The same of the hard direction, in runs that begin with such demonstrations; none in others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub hard_demonstration_steps: Option<f64>,
}

/// The runs of a `results.json`: the one of a run directory, or several under `runs` beside a published policy.
///
/// # Errors
/// When the text is neither.
pub fn parse_results(text: &str) -> serde_json::Result<Vec<RunResults>> {
    #[derive(Deserialize)]
    struct Several {
        runs: Vec<RunResults>,
    }
    let value: serde_json::Value = serde_json::from_str(text)?;
    if value.get("runs").is_some() {
        return serde_json::from_value::<Several>(value).map(|several| several.runs);
    }
    serde_json::from_value(value).map(|run| vec![run])
}

/// The 95 % Wilson score interval of `k` successes in `n` trials; (0, 1) without trials.
#[must_use]
pub fn wilson95(k: usize, n: usize) -> [f64; 2] {
    if n == 0 {
        return [0.0, 1.0];
    }
    let (k, n, z) = (k as f64, n as f64, 1.959_963_984_540_054_f64);
    let p = k / n;
    let centre = (p + z * z / (2.0 * n)) / (1.0 + z * z / n);
    let half = z / (1.0 + z * z / n) * (p * (1.0 - p) / n + z * z / (4.0 * n * n)).sqrt();
    [(centre - half).max(0.0), (centre + half).min(1.0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilson_matches_published_intervals() {
        // 85 of 100 and 53 of 160 as the paper prints them.
        for (k, n, lo, hi) in [(85, 100, 0.767, 0.907), (53, 160, 0.263, 0.407)] {
            let [a, b] = wilson95(k, n);
            assert!((a - lo).abs() < 6e-4 && (b - hi).abs() < 6e-4, "{a} {b}");
        }
    }

    #[test]
    fn files_say_causes_and_fates_by_name() {
        let mut c = Collection::default();
        c.resets.extend([(ResetCause::HardFailed, 2), (ResetCause::Diverged, 1)]);
        c.fates.extend([(Fate::Kept, 5), (Fate::AfterGoal, 3)]);
        let text = serde_json::to_string(&c).unwrap();
        assert!(text.contains(r#""resets":{"diverged":1,"hard_failed":2}"#), "{text}");
        assert!(text.contains(r#""fates":{"after_goal":3,"kept":5}"#), "{text}");
        assert_eq!(serde_json::from_str::<Collection>(&text).unwrap(), c);
    }

    #[test]
    fn automatic_resets_leave_the_first_placement_out() {
        let mut c = Collection { cycles: 10, ..Collection::default() };
        c.resets.insert(ResetCause::Start, 8);
        c.resets.insert(ResetCause::EasyFailed, 2);
        assert!((c.automatic_reset_rate() - 0.8).abs() < 1e-12);
    }
}
