//! The values of the filters, and how `--set` changes them.

use anyhow::{Context, Result, bail};
use e2h_core::nearest;
use e2h_nn::AdamConfig;
use e2h_policy::{CriticConfig, PolicyConfig};
use e2h_refine::{AdvantageConfig, GateConfig, KinematicConfig, ReverseConfig, SuffixConfig};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

/// Everything that `--set` can change.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Config {
    pub(crate) reverse: ReverseConfig,
    pub(crate) kinematic: KinematicConfig,
    /// Off by default: how often a gripper should switch depends on the task.
    pub(crate) gate: GateConfig,
    /// Read where there is a critic; frames at 20 Hz.
    pub(crate) advantage: AdvantageConfig,
    /// Likewise. Off by default: letting go and moving away may be part of success.
    pub(crate) suffix: SuffixConfig,
    /// Read where a critic is trained.
    pub(crate) critic: CriticSettings,
    /// True when the reference quaternion was set by hand; otherwise it is the first orientation of the dataset.
    #[serde(skip)]
    pub(crate) reference_given: bool,
}

impl Config {
    pub(crate) fn resolve(set: &[String]) -> Result<Self> {
        let default = Self {
            reverse: ReverseConfig::default(),
            kinematic: KinematicConfig::default(),
            gate: GateConfig { enabled: false, ..GateConfig::default() },
            advantage: AdvantageConfig::default(),
            suffix: SuffixConfig::default(),
            critic: CriticSettings::default(),
            reference_given: false,
        };
        let mut table = serde_json::to_value(&default)?;
        for text in set {
            let (key, value) =
                text.split_once('=').with_context(|| format!("--set: expected key=value, got `{text}`"))?;
            let value: Value = serde_json::from_str(value).ok().with_context(|| {
                format!("--set {key}: expected a number, true, false or a list, got `{value}`")
            })?;
            *slot(&mut table, key.trim(), &value)? = value.clone();
            // One at a time, so that a value of the wrong kind is named with its key.
            serde_json::from_value::<Self>(table.clone()).with_context(|| format!("--set {key}"))?;
        }
        let mut config: Self = serde_json::from_value(table)?;
        config.reference_given =
            set.iter().any(|s| s.trim_start().starts_with("reverse.reference_quaternion"));
        let mut problems = config.reverse.validate();
        problems.extend(config.kinematic.validate());
        problems.extend(config.gate.validate());
        problems.extend(config.advantage.validate());
        problems.extend(config.suffix.validate());
        problems.extend(config.critic.validate());
        if !problems.is_empty() {
            bail!("{}", problems.join("; "));
        }
        Ok(config)
    }

    /// The advantage filter at another rate than 20 Hz.
    pub(crate) fn advantage_at(&self, fps: f64) -> AdvantageConfig {
        let a = &self.advantage;
        AdvantageConfig {
            // Odd, so that it has a middle.
            smooth: frames(a.smooth, fps) / 2 * 2 + 1,
            min_run: frames(a.min_run, fps),
            horizon: frames(a.horizon, fps).max(1),
            ..a.clone()
        }
    }

    /// The cut of the suffix at another rate than 20 Hz.
    pub(crate) fn suffix_at(&self, fps: f64) -> SuffixConfig {
        let s = &self.suffix;
        SuffixConfig { frames: frames(s.frames, fps).max(1), keep: frames(s.keep, fps), ..s.clone() }
    }
}

/// Frames at `fps` that take as long as `n` at 20 Hz.
// A positive number of frames.
fn frames(n: usize, fps: f64) -> usize {
    (n as f64 * fps / 20.0).round() as usize
}

/// The critic's network and training; sizes are those that two CPU cores train in minutes.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CriticSettings {
    /// Side that images are brought to, pixels.
    pub(crate) image_size: usize,
    /// Side of the crop that the encoder sees, pixels.
    crop_size: usize,
    encoder_width: usize,
    encoder_blocks: Vec<usize>,
    keypoints: usize,
    image_features: usize,
    hidden: Vec<usize>,
    dropout: f64,
    colour_jitter: f64,
    batch: usize,
    pub(crate) steps: usize,
    /// Share of the rollouts held out.
    validation: f64,
    lr: f64,
    weight_decay: f64,
    /// Part by which the ranges of the state are widened.
    pub(crate) margin: f64,
    pub(crate) seed: u64,
}

impl Default for CriticSettings {
    fn default() -> Self {
        Self {
            image_size: 72,
            crop_size: 64,
            encoder_width: 16,
            encoder_blocks: vec![1, 1],
            keypoints: 16,
            image_features: 32,
            hidden: vec![128, 128, 64, 64],
            dropout: 0.15,
            colour_jitter: 0.2,
            batch: 64,
            steps: 250,
            validation: 0.2,
            lr: 5e-4,
            weight_decay: 1e-4,
            margin: 0.1,
            seed: 0,
        }
    }
}

impl CriticSettings {
    fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        for (name, value) in [("batch", self.batch), ("steps", self.steps), ("image_size", self.image_size)] {
            if value == 0 {
                problems.push(format!("critic.{name}: expected at least 1, got 0"));
            }
        }
        if !(0.0..1.0).contains(&self.validation) {
            problems.push(format!("critic.validation: expected 0 to below 1, got {}", self.validation));
        }
        if !(0.0..1.0).contains(&self.dropout) {
            problems.push(format!("critic.dropout: expected 0 to below 1, got {}", self.dropout));
        }
        if let Err(e) = self.network(&["camera".to_owned()], false).validate() {
            problems.push(format!("critic: {e}"));
        }
        problems
    }

    /// The part of a policy's configuration that a critic shares.
    pub(crate) fn network(&self, cameras: &[String], object: bool) -> PolicyConfig {
        PolicyConfig {
            cameras: cameras.to_vec(),
            image_size: self.image_size,
            crop_size: self.crop_size,
            encoder_width: self.encoder_width,
            encoder_blocks: self.encoder_blocks.clone(),
            keypoints: self.keypoints,
            image_features: self.image_features,
            relative_features: object,
            ..PolicyConfig::tiny()
        }
    }

    // Small settings, kept as they are written.
    pub(crate) fn training(&self) -> CriticConfig {
        CriticConfig {
            crop_size: self.crop_size,
            hidden: self.hidden.clone(),
            dropout: self.dropout as f32,
            colour_jitter: self.colour_jitter as f32,
            batch: self.batch,
            steps: self.steps,
            validation: self.validation as f32,
            adam: AdamConfig {
                lr: self.lr as f32,
                weight_decay: self.weight_decay as f32,
                clip_norm: Some(1.0),
                ..AdamConfig::default()
            },
        }
    }
}

/// The entry that `key` names.
fn slot<'a>(table: &'a mut Value, key: &str, value: &Value) -> Result<&'a mut Value> {
    let (group, name) = key.split_once('.').unwrap_or((key, ""));
    let unknown = |known: &Map<String, Value>, word: &str, prefix: &str| {
        let near = nearest(word, known.keys().map(String::as_str));
        let near = near.map(|near| format!("; did you mean `{prefix}{near}`?")).unwrap_or_default();
        anyhow::anyhow!("--set: unknown key `{key}`{near}")
    };
    let groups = table.as_object_mut().context("the configuration is a table")?;
    if !groups.contains_key(group) {
        return Err(unknown(groups, group, ""));
    }
    let entries = groups.get_mut(group).and_then(Value::as_object_mut).context("a group is a table")?;
    if !entries.contains_key(name) {
        return Err(unknown(entries, name, &format!("{group}.")));
    }
    let old = entries.get_mut(name).context("the entry is there")?;
    if std::mem::discriminant(&*old) != std::mem::discriminant(value) {
        bail!("--set {key}: expected a value like {old}, got {value}");
    }
    Ok(old)
}
