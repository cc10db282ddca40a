//! A run's configuration: preset < task file < `--set key=value`, checked before any work.

pub(crate) mod layers;
mod validate;

use crate::methods::{DynamicsStage, RecapConfig};
use crate::{Error, ExploreConfig, Result, TrDrlConfig};
use e2h_env::{DemonstratorConfig, EnvConfig, Task, TaskOptions};
use e2h_nn::Precision;
use e2h_policy::{CriticConfig, PolicyConfig, TrainConfig};
use e2h_refine::{AdvantageConfig, GateConfig, GoalConfig, KinematicConfig, ReverseConfig, SuffixConfig};
use serde::{Deserialize, Serialize};
use toml::{Table, Value};

pub(crate) use layers::suggestion;
use layers::{find, inner, layer, merge, parse, typed};

const PRESETS: [(&str, &str); 3] = [
    ("smoke", include_str!("../../../configs/presets/smoke.toml")),
    ("laptop", include_str!("../../../configs/presets/laptop.toml")),
    ("paper", include_str!("../../../configs/presets/paper.toml")),
];

/// Everything that a run depends on besides its seed. Each preset file states every entry; see there for the reasons.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// The task pair, its variant and its demonstrator.
    pub task: TaskConfig,
    /// Simulation and cameras.
    pub env: EnvConfig,
    /// The closed loop.
    #[serde(rename = "loop")]
    pub closed_loop: LoopConfig,
    /// Architecture of both policies.
    pub policy: PolicyConfig,
    /// Their training.
    pub train: PolicyTraining,
    /// What becomes of reversed episodes.
    pub refine: RefineConfig,
    /// The critic.
    pub critic: CriticStage,
    /// The method `recap`; without effect on others. Checkpoints say it where it differs from the default.
    #[serde(default, skip_serializing_if = "is_default")]
    pub recap: RecapConfig,
    /// The method `tr-drl-dp`, likewise.
    #[serde(default, skip_serializing_if = "is_default")]
    pub dynamics: DynamicsStage,
    /// The method `tr-drl`, likewise.
    #[serde(default, skip_serializing_if = "is_default")]
    pub tr_drl: TrDrlConfig,
    /// Measuring success.
    pub evaluation: EvaluationConfig,
    /// How exact a GPU multiplies; without effect on the CPU. Checkpoints from before it have none.
    #[serde(default)]
    pub device: Precision,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// The task pair of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskConfig {
    /// Name in the registry.
    pub name: String,
    /// Variant of the scene.
    pub variant: String,
    /// Free space round what goes into a hole, m a side; 0 for the task's default. Checkpoints from before it have none.
    #[serde(default)]
    pub clearance: f64,
    /// How human the scripted demonstrators are.
    pub demonstrator: DemonstratorConfig,
}

impl TaskConfig {
    /// What the registry is asked with.
    #[must_use]
    pub fn options(&self) -> TaskOptions {
        TaskOptions {
            variant: self.variant.clone(),
            clearance: self.clearance,
            demonstrator: self.demonstrator.clone(),
        }
    }
}

/// What follows a failed hard rollout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AfterFailure {
    /// An external reset to the easy task's start, counted.
    Assembled,
    /// The easy policy goes on from wherever the hard one ended (the paper's literal loop).
    Continue,
}

/// The closed loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LoopConfig {
    /// Easy demonstrations at the start.
    pub demonstrations: usize,
    /// Updates of the hard policy, N.
    pub iterations: u32,
    /// Cycles of a hard and an easy rollout before each update, C.
    pub cycles: usize,
    /// Loops side by side. Part of the configuration, not of the machine: results do not depend on the threads.
    pub loops: usize,
    /// What follows a failed hard rollout.
    pub after_failure: AfterFailure,
    /// True: the arm goes home by itself between rollouts (not recorded). False: the literal loop.
    pub homing: bool,
    /// True: an update sees everything accepted so far. False: this iteration's alone (the paper's).
    pub accumulate: bool,
    /// Share of every batch that is drawn from the initial demonstrations (the paper's: a half).
    pub base_share: f32,
    /// True: the initial demonstrations pass the kinematic filter too. False: the paper's algorithm 1.
    pub refine_demonstrations: bool,
    /// True: the easy policy learns from demonstrations that passed the kinematic filter.
    pub refine_easy_demonstrations: bool,
    /// True keeps every rollout of the loop with its images, successes and failures of both policies, as a LeRobot dataset in
    /// `iteration_NN/rollouts`. False keeps what is learned from. Checkpoints from before it have none.
    #[serde(default)]
    pub keep_rollouts: bool,
    /// Exploration of easy rollouts. Checkpoints from before it have none.
    #[serde(default)]
    pub explore: ExploreConfig,
}

/// What an update of the hard policy begins with.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UpdateFrom {
    /// The policy before it (the paper's).
    #[default]
    Policy,
    /// Fresh weights: it learns all data of the loop anew.
    Scratch,
}

/// Training steps and how a step looks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyTraining {
    /// Steps of the easy policy.
    pub easy_steps: usize,
    /// Steps of the initial hard policy.
    pub initial_steps: usize,
    /// Steps of each update.
    pub update_steps: usize,
    /// What an update begins with. Checkpoints from before it have none.
    #[serde(default)]
    pub update_from: UpdateFrom,
    /// Steps of each update of the easy policy on its own successes; 0 leaves it as it is (the paper's). Checkpoints from before
    /// it have none.
    #[serde(default)]
    pub easy_update_steps: usize,
    /// Steps between two saved training states, for `--resume`.
    pub save_every: usize,
    /// Fraction by which the ranges of the normaliser are widened.
    pub normaliser_margin: f32,
    /// A step. The schedule's length is that of the stage.
    pub step: TrainConfig,
}

/// Reversal and the filters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RefineConfig {
    /// Equations 3 and 4.
    pub reverse: ReverseConfig,
    /// Equation 7; without it reversals stay as they are (`no-kinematic`).
    pub kinematic_enabled: bool,
    /// Thresholds of the kinematic filter.
    pub kinematic: KinematicConfig,
    /// A valid reversal grasps once and lets go once.
    pub gate: GateConfig,
    /// A reversal ends no further out than demonstrations do.
    pub goal: GoalConfig,
    /// Equation 10.
    pub advantage: AdvantageConfig,
    /// Optional cut of the suffix.
    pub suffix: SuffixConfig,
}

/// The critic's stage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CriticStage {
    /// False skips the critic and its filter (`no-critic`).
    pub enabled: bool,
    /// Network and training.
    pub network: CriticConfig,
}

/// Measuring success.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EvaluationConfig {
    /// Trials for each point of the curve.
    pub trials: usize,
    /// Seed of the trials, apart from every training seed.
    pub seed: u64,
    /// Simulations side by side.
    pub parallel: usize,
    /// Trials in the rollout animation of the report; 0 for none.
    pub filmed: usize,
}

/// A configuration and where it came from.
#[derive(Debug, Clone, PartialEq)]
pub struct Resolved {
    /// The preset's name.
    pub preset: String,
    /// The values.
    pub config: RunConfig,
    /// The same as text, complete: what is written into the run.
    pub text: String,
}

impl RunConfig {
    /// Reads preset, task file and overrides (`key.path=value`), later ones winning.
    ///
    /// # Errors
    /// Unknown preset, task or key (the nearest known one is named), a value of the wrong type, or values that do not fit
    /// together (all of them are listed).
    pub fn resolve(preset: &str, task: &str, overrides: &[String]) -> Result<Resolved> {
        Self::resolve_with(preset, task, None, &Table::new(), overrides)
    }

    /// The same with the text of a task file of one's own in place of the registry's, and with the values of a method, which
    /// win over the task file's.
    pub(crate) fn resolve_with(
        preset: &str,
        task: &str,
        own: Option<&str>,
        method: &Table,
        overrides: &[String],
    ) -> Result<Resolved> {
        let mut table = parse(preset, find("preset", preset, &PRESETS)?)?;
        let of_task = parse(task, own.map_or_else(|| of_registry(task), Ok)?)?;
        let overrides = overrides.iter().map(|text| layer(text)).collect::<Result<Vec<Table>>>()?;
        // A task file has entries for all presets, may have some for one alone, and some for one variant in one preset.
        let mut common = of_task;
        let (of_preset, of_variant) = (common.remove("preset"), common.remove("variant"));
        let of_preset = inner(of_preset.as_ref(), preset);
        merge(&mut table, &common, "")?;
        if let Some(special) = of_preset {
            merge(&mut table, special, "")?;
        }
        let variant = |layer: &Table| layer.get("task")?.get("variant")?.as_str().map(str::to_owned);
        let chosen = overrides.iter().rev().find_map(variant).or_else(|| variant(&table)).unwrap_or_default();
        if let Some(special) = inner(of_variant.as_ref(), &chosen).and_then(|v| v.get(preset)?.as_table()) {
            merge(&mut table, special, "")?;
        }
        merge(&mut table, method, "")?;
        for layer in &overrides {
            merge(&mut table, layer, "")?;
        }
        let found = table.get("task").and_then(|t| t.get("name")).and_then(Value::as_str).unwrap_or_default();
        if found != task {
            let found = e2h_core::one_line(found);
            let text = format!("task.name: expected `{task}`, got `{found}`; each pair has its own program");
            return Err(Error::Config(text));
        }
        let resolved = Self::from_table(preset, table);
        match own {
            Some(_) => resolved,
            None => resolved.and_then(|r| r.config.check_registry().map(|()| r)),
        }
    }

    /// Fills in what the task knows and nobody chooses.
    pub(crate) fn know(&mut self, task: &dyn Task) {
        let r = &mut self.refine;
        r.reverse.reference_quaternion = task.eef_reference();
        r.reverse.object_reference = Some(task.object_reference());
        // What is held throughout is neither grasped nor let go.
        let switches = usize::from(task.homes());
        (r.gate.closings, r.gate.openings) = (switches, switches);
        r.advantage.horizon = self.env.horizon_hard;
    }

    /// Whether demonstrations are recorded alike with both.
    pub(crate) fn demonstrates_like(&self, other: &Self) -> bool {
        self.task == other.task
            && self.env == other.env
            && self.policy.cameras == other.policy.cameras
            && self.closed_loop.demonstrations == other.closed_loop.demonstrations
    }

    /// Whether a loop begins alike with both: the same demonstrations, policies before the first update, and trials of theirs. What only
    /// the rounds depend on may differ.
    pub(crate) fn begins_like(&self, other: &Self) -> bool {
        let mut same = other.clone();
        let (l, mine) = (&mut same.closed_loop, &self.closed_loop);
        (l.iterations, l.cycles, l.loops) = (mine.iterations, mine.cycles, mine.loops);
        (l.after_failure, l.homing, l.accumulate) = (mine.after_failure, mine.homing, mine.accumulate);
        (l.base_share, l.keep_rollouts) = (mine.base_share, mine.keep_rollouts);
        l.explore = mine.explore.clone();
        let (t, mine) = (&mut same.train, &self.train);
        (t.update_steps, t.update_from) = (mine.update_steps, mine.update_from);
        t.easy_update_steps = mine.easy_update_steps;
        t.step.indicator_dropout = mine.step.indicator_dropout;
        same.recap = self.recap.clone();
        same.dynamics = self.dynamics.clone();
        same.tr_drl = self.tr_drl.clone();
        let (r, mine) = (&mut same.refine, &self.refine);
        r.kinematic_enabled = mine.kinematic_enabled;
        (r.gate, r.goal) = (mine.gate.clone(), mine.goal.clone());
        (r.advantage, r.suffix) = (mine.advantage.clone(), mine.suffix.clone());
        same.critic = self.critic.clone();
        same == *self
    }

    /// Reads a resolved configuration that a run wrote.
    ///
    /// # Errors
    /// As [`RunConfig::resolve`].
    pub fn from_text(preset: &str, text: &str) -> Result<Resolved> {
        Self::from_table(preset, parse(preset, text)?)
    }

    fn from_table(preset: &str, table: Table) -> Result<Resolved> {
        let (config, text): (Self, String) = typed(table)?;
        config.validate()?;
        Ok(Resolved { preset: preset.to_owned(), config, text })
    }
}

/// Whether an override says `table.key`.
pub(crate) fn sets(overrides: &[String], table: &str, key: &str) -> bool {
    let says = |text: &String| {
        let layer = layer(text).ok()?;
        layer.get(table)?.get(key).map(|_| ())
    };
    overrides.iter().any(|text| says(text).is_some())
}

/// Text of a built-in pair's configuration file.
fn of_registry(task: &str) -> Result<&'static str> {
    e2h_env::configuration(task).ok_or_else(|| {
        Error::Config(format!("unknown task `{task}`; {}", suggestion(task, "", e2h_env::registry())))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keys(table: &Table, path: &str, out: &mut Vec<String>) {
        for (k, v) in table {
            match v {
                Value::Table(t) => keys(t, &format!("{path}{k}."), out),
                _ => out.push(format!("{path}{k}")),
            }
        }
    }

    #[test]
    fn every_preset_states_every_key_and_resolves_for_every_task() {
        let mut all = vec![];
        for (name, text) in PRESETS {
            let mut found = vec![];
            keys(&parse(name, text).unwrap(), "", &mut found);
            found.sort();
            all.push(found);
            for task in e2h_env::registry() {
                let resolved = RunConfig::resolve(name, task, &[]).unwrap();
                let again = RunConfig::from_text(name, &resolved.text).unwrap();
                assert_eq!(resolved.config, again.config);
            }
        }
        assert!(all.windows(2).all(|w| w[0] == w[1]), "presets differ in their keys");
    }

    #[test]
    fn task_files_agree_with_their_tasks() {
        for name in e2h_env::registry() {
            let config = RunConfig::resolve("paper", name, &[]).unwrap().config;
            let task = e2h_env::task(name, &config.task.options()).unwrap();
            assert_eq!(config.refine.suffix.enabled, !task.homes(), "{name}");
            // Names in a task file are names of presets and variants, or nobody would ever see its values.
            let file = parse(name, of_registry(name).unwrap()).unwrap();
            let tables = |v: Option<&Value>| v.and_then(Value::as_table).cloned().unwrap_or_default();
            let mut presets: Vec<String> = tables(file.get("preset")).keys().cloned().collect();
            for (variant, values) in tables(file.get("variant")) {
                for preset in tables(Some(&values)).keys() {
                    let set = [format!("task.variant={variant}")];
                    let config = RunConfig::resolve(preset, name, &set).unwrap().config;
                    e2h_env::task(name, &config.task.options()).unwrap();
                    presets.push(preset.clone());
                }
            }
            assert!(presets.iter().all(|p| PRESETS.iter().any(|(n, _)| n == p)), "{name}: {presets:?}");
        }
    }

    #[test]
    fn overrides_win_and_keep_types() {
        let set = [
            "loop.cycles=7".to_owned(),
            "train.step.schedule.lr = 1".to_owned(),
            "task.variant=square".to_owned(),
        ];
        let r = RunConfig::resolve("smoke", "nut_assembly", &set).unwrap().config;
        assert_eq!(r.closed_loop.cycles, 7);
        assert!((r.train.step.schedule.lr - 1.0).abs() < 1e-9);
        assert_eq!(r.task.variant, "square");
    }

    #[test]
    fn a_variant_has_values_of_its_own_in_a_preset_and_overrides_win_over_them() {
        let resolve = |preset: &str, set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
            RunConfig::resolve(preset, "nut_assembly", &set).unwrap().config
        };
        let (loose, square) = (resolve("laptop", &[]), resolve("laptop", &["task.variant=square"]));
        assert!(loose.critic.enabled && !square.critic.enabled);
        assert_eq!((square.closed_loop.cycles, square.train.update_from), (300, UpdateFrom::Scratch));
        // In whatever order they are given.
        let few = resolve("laptop", &["loop.cycles=7", "task.variant=square"]);
        assert_eq!((few.closed_loop.cycles, few.train.easy_steps), (7, square.train.easy_steps));
        let last = resolve("laptop", &["task.variant=square", "task.variant=loose"]);
        assert_eq!(last, loose);
        assert_eq!(resolve("smoke", &["task.variant=square"]).train, resolve("smoke", &[]).train);
    }

    #[test]
    fn unknown_names_are_answered_with_the_nearest() {
        let text = |r: Result<Resolved>| r.unwrap_err().to_string();
        assert!(text(RunConfig::resolve("lapto", "nut_assembly", &[])).contains("did you mean `laptop`"));
        assert!(
            text(RunConfig::resolve("smoke", "nut_asembly", &[])).contains("did you mean `nut_assembly`")
        );
        let set = |s: &str| text(RunConfig::resolve("smoke", "nut_assembly", &[s.to_owned()]));
        assert!(set("loop.cycle=3").contains("did you mean `loop.cycles`"));
        assert!(set("train.step.adam.lr=1").contains("did you mean `train.step.schedule.lr`"));
        assert!(set("loop.cycles=many").contains("expected a value of type integer"));
        assert!(set("loop.cycles").contains("expected key=value"));
        assert!(set("policy.horizon=15").contains("horizon"));
    }
}
