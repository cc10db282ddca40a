//! How policies and critics are trained.

use crate::PolicyConfig;
use crate::config::MOST_LEVELS;
use e2h_nn::{AdamConfig, EmaConfig, LrSchedule};
use serde::{Deserialize, Serialize};

/// How a policy is trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainConfig {
    /// Observations of a step.
    pub conditions: usize,
    /// (noise, diffusion step) pairs drawn for each of them, so that the costly image encoding is shared. Source: Mini
    /// Diffuser, arXiv 2505.09430.
    pub noises: usize,
    /// Equal parts of a step's observations whose gradients are computed each by itself and added in the order of a balanced tree; a
    /// power of two. So many ranks, or a divisor of it, may share a step ([`Trainer::step_with`](crate::Trainer::step_with)): it is
    /// the shards that results depend on, in their last bits, and not the ranks.
    #[serde(default = "one_shard", skip_serializing_if = "is_one_shard")]
    pub shards: usize,
    /// Probability that a sample's whole condition is zeroed.
    pub conditioning_dropout: f32,
    /// Probability that a sample's indicator is set to 0, apart from its observation; without effect on policies without
    /// [`PolicyConfig::indicator`]. Source: RECAP, arXiv 2511.14759, appendix F, 30 %.
    #[serde(default = "indicator_dropout", skip_serializing_if = "is_indicator_dropout")]
    pub indicator_dropout: f32,
    /// Standard deviation of the noise on normalised state entries in training.
    pub observation_noise: f32,
    /// Factor on the weights from which the keypoints' attention starts (the 1 x 1 convolution of the spatial softmax). At 1, as
    /// LeRobot's, every keypoint starts near the middle of the image and hardly moves with what is to be seen; larger, it starts on
    /// one spot. Initial policies of cube_stack at the laptop preset, 100 trials: 38 at 1, 55 at 8, 37 at 25.
    #[serde(default = "one", skip_serializing_if = "is_one")]
    pub keypoint_sharpness: f32,
    /// Optimiser.
    pub adam: ScheduledAdam,
    /// Learning rate over the steps.
    pub schedule: ScheduleConfig,
    /// Average of the weights that the policy acts with.
    pub ema: EmaConfig,
}

/// Most samples of a step, noises counted.
const MOST_SAMPLES: usize = 1 << 20;

impl TrainConfig {
    pub(crate) fn optimiser(&self) -> AdamConfig {
        let a = self.adam;
        without_zero_clip(AdamConfig {
            lr: self.schedule.lr,
            beta1: a.beta1,
            beta2: a.beta2,
            eps: a.eps,
            weight_decay: a.weight_decay,
            decoupled: a.decoupled,
            clip_norm: a.clip_norm,
        })
    }

    /// All problems with the values.
    #[must_use]
    pub fn validate(&self) -> Vec<String> {
        let mut problems = vec![];
        let mut check = |ok: bool, text: String| {
            if !ok {
                problems.push(text);
            }
        };
        let samples = self.conditions.saturating_mul(self.noises);
        check(
            self.conditions > 0 && self.noises > 0 && samples <= MOST_SAMPLES,
            format!(
                "conditions and noises: expected at least 1 and a product of at most {MOST_SAMPLES}, got {} and {}",
                self.conditions, self.noises
            ),
        );
        check(
            self.shards.is_power_of_two() && self.conditions.is_multiple_of(self.shards),
            format!(
                "shards: expected a power of two that divides conditions ({}), got {}",
                self.conditions, self.shards
            ),
        );
        check(
            (0.0..1.0).contains(&self.conditioning_dropout),
            format!("conditioning_dropout: expected 0 to below 1, got {}", self.conditioning_dropout),
        );
        check(
            (0.0..1.0).contains(&self.indicator_dropout),
            format!("indicator_dropout: expected 0 to below 1, got {}", self.indicator_dropout),
        );
        check(
            (0.0..=10.0).contains(&self.observation_noise),
            format!("observation_noise: expected 0 to 10, got {}", self.observation_noise),
        );
        check(
            self.keypoint_sharpness > 0.0 && self.keypoint_sharpness <= 1000.0,
            format!(
                "keypoint_sharpness: expected more than 0 and at most 1000, got {}",
                self.keypoint_sharpness
            ),
        );
        check(
            self.schedule.warmup <= LONGEST,
            format!("schedule.warmup: expected at most {LONGEST}, got {}", self.schedule.warmup),
        );
        if let Err(e) = self.optimiser().validate() {
            let part = if e.to_string().contains("lr:") { "schedule" } else { "adam" };
            check(false, format!("{part}.{e}"));
        }
        if let Err(e) = self.ema.validate() {
            check(false, format!("ema.{e}"));
        }
        problems
    }
}

/// Most steps of a training.
const LONGEST: usize = 100_000_000;

/// Adam whose learning rate is that of a [`ScheduleConfig`]; the fields of [`AdamConfig`] but the rate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(from = "WrittenAdam")]
pub struct ScheduledAdam {
    /// Decay of the mean of the gradients.
    pub beta1: f32,
    /// Decay of the mean of their squares.
    pub beta2: f32,
    /// Added to the root of the mean square.
    pub eps: f32,
    /// Weight decay.
    pub weight_decay: f32,
    /// Whether the decay acts on the weights (AdamW) or is added to the gradient (Adam with L2).
    pub decoupled: bool,
    /// Longest gradient, Euclidean norm over all parameters; none and 0 for no limit.
    pub clip_norm: Option<f32>,
}

impl Default for ScheduledAdam {
    fn default() -> Self {
        AdamConfig::default().into()
    }
}

impl From<AdamConfig> for ScheduledAdam {
    fn from(adam: AdamConfig) -> Self {
        let AdamConfig { lr: _, beta1, beta2, eps, weight_decay, decoupled, clip_norm } = adam;
        Self { beta1, beta2, eps, weight_decay, decoupled, clip_norm }
    }
}

/// As files have it: up to version 0.1 they had a rate too, without effect.
#[derive(Deserialize)]
#[serde(transparent)]
struct WrittenAdam(AdamConfig);

impl From<WrittenAdam> for ScheduledAdam {
    fn from(written: WrittenAdam) -> Self {
        written.0.into()
    }
}

/// A clip of 0 in a file means none: TOML has no way to say so.
pub(crate) fn without_zero_clip(adam: AdamConfig) -> AdamConfig {
    AdamConfig { clip_norm: adam.clip_norm.filter(|&c| c != 0.0), ..adam }
}

/// Shape of the learning rate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScheduleKind {
    /// The same rate after the warm-up (the paper's).
    Constant,
    /// Half a cosine down to 0 at the stage's end.
    Cosine,
}

/// Learning rate of a stage, whatever its length.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleConfig {
    /// Shape.
    pub kind: ScheduleKind,
    /// Highest rate.
    pub lr: f32,
    /// Steps over which it rises from 0.
    pub warmup: usize,
}

impl ScheduleConfig {
    /// The schedule of a stage of `steps` steps.
    #[must_use]
    pub fn over(&self, steps: usize) -> LrSchedule {
        let Self { kind, lr, warmup } = *self;
        match kind {
            ScheduleKind::Constant => LrSchedule::Constant { lr, warmup },
            ScheduleKind::Cosine => LrSchedule::Cosine { lr, warmup, steps },
        }
    }
}

/// The critic and its training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CriticConfig {
    /// Crop that the critic sees, pixels.
    pub crop_size: usize,
    /// Widths of the hidden layers.
    pub hidden: Vec<usize>,
    /// Dropout between them.
    pub dropout: f32,
    /// Half-width of the random factor on brightness and contrast of a training image.
    pub colour_jitter: f32,
    /// Frames of a step.
    pub batch: usize,
    /// Training steps.
    pub steps: usize,
    /// Share of the trajectories held out for validation.
    pub validation: f32,
    /// Optimiser.
    pub adam: AdamConfig,
}

impl CriticConfig {
    /// All problems with the values, for a critic of rollouts as `policy` sees them.
    #[must_use]
    pub fn validate(&self, policy: &PolicyConfig) -> Vec<String> {
        let mut problems = vec![];
        let mut check = |ok: bool, text: String| {
            if !ok {
                problems.push(text);
            }
        };
        for (name, value, most) in [("batch", self.batch, MOST_SAMPLES), ("steps", self.steps, LONGEST)] {
            check((1..=most).contains(&value), format!("{name}: expected 1 to {most}, got {value}"));
        }
        let most = policy.image_size;
        check(
            policy.cameras.is_empty() || (1..=most).contains(&self.crop_size),
            format!("crop_size: expected 1 to the images' {most}, got {}", self.crop_size),
        );
        check(
            self.hidden.len() <= MOST_LEVELS && self.hidden.iter().all(|n| (1..=1 << 16).contains(n)),
            format!("hidden: expected at most {MOST_LEVELS} widths of 1 to 65536, got {:?}", self.hidden),
        );
        for (name, value) in [("dropout", self.dropout), ("validation", self.validation)] {
            check((0.0..1.0).contains(&value), format!("{name}: expected 0 to below 1, got {value}"));
        }
        check(
            (0.0..=1.0).contains(&self.colour_jitter),
            format!("colour_jitter: expected 0 to 1, got {}", self.colour_jitter),
        );
        if let Err(e) = without_zero_clip(self.adam).validate() {
            check(false, format!("adam.{e}"));
        }
        problems
    }
}

fn one_shard() -> usize {
    1
}

// Serde's signature.
fn is_one_shard(shards: &usize) -> bool {
    *shards == 1
}

fn one() -> f32 {
    1.0
}

fn is_one(factor: &f32) -> bool {
    *factor == 1.0
}

/// RECAP's.
const INDICATOR_DROPOUT: f32 = 0.3;

fn indicator_dropout() -> f32 {
    INDICATOR_DROPOUT
}

fn is_indicator_dropout(probability: &f32) -> bool {
    *probability == INDICATOR_DROPOUT
}
