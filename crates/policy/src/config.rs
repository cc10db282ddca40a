//! Architecture and inference of a policy.

use crate::lerobot::Features;
use crate::model::Widths;
use crate::{DiffusionModel, Error, Result};
use e2h_nn::{Params, RgbEncoderConfig, UnetConfig};
use serde::{Deserialize, Serialize};

/// What the network is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Prediction {
    /// The noise (the paper's).
    Epsilon,
    /// The clean actions, which learns in far fewer steps.
    Sample,
}

/// How noise becomes actions.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SamplerKind {
    /// Deterministic steps; few are enough (the paper's).
    #[default]
    Ddim,
    /// Steps that add noise of their own (the default of LeRobot).
    Ddpm,
}

/// What follows the convolutions of the image encoder.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EncoderNorm {
    /// Group norm in groups of 16 channels.
    #[default]
    Group,
    /// Nothing: a batch norm was folded into them. For acting with policies from elsewhere, not for training.
    Folded,
}

/// Mean and standard deviation that the channels of one camera's images are brought from, in [0, 1].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageScaling {
    /// Subtracted; red, green, blue.
    pub mean: [f32; 3],
    /// Divided by; red, green, blue.
    pub std: [f32; 3],
}

/// Architecture and inference of a diffusion policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolicyConfig {
    /// Observation steps, To; oldest first.
    pub n_obs_steps: usize,
    /// Of those, how many of the newest bring images. LeRobot: as many as `n_obs_steps`.
    pub n_image_steps: usize,
    /// Predicted actions, T; a multiple of `2^(levels - 1)`.
    pub horizon: usize,
    /// Executed actions of each prediction, Ta.
    pub n_action_steps: usize,
    /// True when the first predicted action belongs to the oldest observation (LeRobot) instead of the newest (the paper).
    pub lerobot_alignment: bool,
    /// Names of the cameras; empty for a policy from state alone.
    pub cameras: Vec<String>,
    /// Side of the recorded images, pixels.
    pub image_size: usize,
    /// Side of the crop that the encoder sees, pixels: random in training, centred otherwise.
    pub crop_size: usize,
    /// One encoder for all cameras instead of one each.
    pub share_encoder: bool,
    /// Channels of the encoder's first stage (ResNet-18: 64).
    pub encoder_width: usize,
    /// Blocks in each stage of the encoder (ResNet-18: 2, 2, 2, 2).
    pub encoder_blocks: Vec<usize>,
    /// Keypoints of the spatial softmax.
    pub keypoints: usize,
    /// Features of one image.
    pub image_features: usize,
    /// Adds the object's position relative to the tool centre point, which the U-Net would have to learn to subtract.
    pub relative_features: bool,
    /// Channels of the U-Net's levels.
    pub down_dims: Vec<usize>,
    /// Kernel of the U-Net's convolutions.
    pub kernel_size: usize,
    /// Groups of its normalisations.
    pub n_groups: usize,
    /// Width of the embedding of the diffusion step.
    pub step_embed_dim: usize,
    /// What the network predicts.
    pub prediction: Prediction,
    /// Diffusion steps in training.
    pub train_timesteps: usize,
    /// DDIM steps in sampling.
    pub inference_steps: usize,
    /// Guidance weight: 1 is fully conditional sampling; others need `conditioning_dropout` in training, or with `indicator`
    /// `indicator_dropout`.
    pub guidance: f32,
    // What follows has come later: checkpoints from before say nothing of it, and those of today only where it matters.
    /// How noise becomes actions.
    #[serde(default, skip_serializing_if = "is_default")]
    pub sampler: SamplerKind,
    /// Normalised state entries are clamped to this; 0 for no limit (LeRobot has none).
    #[serde(default = "state_limit", skip_serializing_if = "is_state_limit")]
    pub state_limit: f32,
    /// True scales the quaternion of every action to length 1; false leaves it as predicted (LeRobot).
    #[serde(default = "yes", skip_serializing_if = "Clone::clone")]
    pub unit_quaternion: bool,
    /// Scaling of the images, one entry per camera; none leaves them in [0, 1].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub image_scaling: Vec<ImageScaling>,
    /// Adds the object's pose in the frame of the tool, position and rotation: a grasp looks the same at every yaw.
    #[serde(default, skip_serializing_if = "is_default")]
    pub tool_frame_features: bool,
    /// What follows the convolutions of the image encoder.
    #[serde(default, skip_serializing_if = "is_default")]
    pub encoder_norm: EncoderNorm,
    /// True: the condition's last entry c says what is known of a source of training data ([`Source::label`](e2h_data::Source),
    /// 0 where nothing is); in sampling c = 1. With it `guidance` is the weight of c alone: the unconditional pass sees the
    /// observation, with c = 0.
    ///
    /// # Source
    /// The improvement indicator of RECAP, pi*0.6, arXiv 2511.14759, section V; guidance in its appendix F.
    #[serde(default, skip_serializing_if = "is_default")]
    pub indicator: bool,
}

/// An object that rolled off the table would otherwise drive a network to where no data ever were.
const STATE_LIMIT: f32 = 4.0;

fn state_limit() -> f32 {
    STATE_LIMIT
}

// Serde's signature; an exact default.
fn is_state_limit(limit: &f32) -> bool {
    *limit == STATE_LIMIT
}

// Serde's signature; an exact default.
fn yes() -> bool {
    true
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// Numbers of a pose in the tool's frame: position, and two columns of the rotation matrix, which have no jump at any turn.
pub(crate) const TOOL_FRAME: usize = 9;

/// Levels of a U-Net; each halves the horizon.
pub(crate) const MOST_LEVELS: usize = 16;

impl PolicyConfig {
    /// A network for tests and examples: seconds to train, too small to learn much.
    #[must_use]
    pub fn tiny() -> Self {
        Self {
            n_obs_steps: 2,
            n_image_steps: 1,
            horizon: 16,
            n_action_steps: 16,
            lerobot_alignment: false,
            cameras: vec!["table".to_owned(), "wrist".to_owned()],
            image_size: 24,
            crop_size: 20,
            share_encoder: false,
            encoder_width: 16,
            encoder_blocks: vec![1],
            keypoints: 4,
            image_features: 8,
            relative_features: false,
            down_dims: vec![16, 16],
            kernel_size: 3,
            n_groups: 8,
            step_embed_dim: 16,
            prediction: Prediction::Sample,
            train_timesteps: 100,
            inference_steps: 4,
            guidance: 1.0,
            sampler: SamplerKind::Ddim,
            state_limit: STATE_LIMIT,
            unit_quaternion: true,
            image_scaling: vec![],
            tool_frame_features: false,
            encoder_norm: EncoderNorm::Group,
            indicator: false,
        }
    }

    /// Numbers a state row becomes for the network.
    #[must_use]
    pub fn state_features(&self) -> usize {
        let more = |on: bool, n: usize| if on { n } else { 0 };
        e2h_core::STATE_DIM + more(self.relative_features, 3) + more(self.tool_frame_features, TOOL_FRAME)
    }

    /// The same network for what `features` names: the sizes here are those of the crop's rows, which the layers do not ask for.
    pub(crate) fn seeing(&self, features: &Features) -> Self {
        Self {
            cameras: features.cameras.clone(),
            image_size: features.crop[0],
            crop_size: features.crop[0],
            ..self.clone()
        }
    }

    /// Width of the U-Net's global condition.
    #[must_use]
    pub fn condition_dim(&self) -> usize {
        self.condition_width(self.state_features())
    }

    /// The same for states of `state` numbers.
    pub(crate) fn condition_width(&self, state: usize) -> usize {
        let images = self.n_image_steps * self.cameras.len() * self.image_features;
        self.n_obs_steps * state + images + usize::from(self.indicator)
    }

    /// Sizes of an encoder for crops of `rows` by `columns`.
    pub(crate) fn encoder(&self, rows: usize, columns: usize) -> RgbEncoderConfig {
        RgbEncoderConfig {
            height: rows,
            width: columns,
            base_width: self.encoder_width,
            stage_blocks: self.encoder_blocks.clone(),
            keypoints: self.keypoints,
            feature_dim: self.image_features,
        }
    }

    /// Numbers in the weights of a policy; takes no memory for them.
    ///
    /// # Errors
    /// As [`PolicyConfig::validate`].
    pub fn count_parameters(&self) -> Result<u128> {
        self.validate()?;
        let widths = Widths { state: self.state_features(), action: e2h_core::ACTION_DIM };
        Ok(Params::count_of(|b| DiffusionModel::parts(self, widths, b))?)
    }

    /// Checks that the parts fit together.
    ///
    /// # Errors
    /// Lists every problem with the values found.
    pub fn validate(&self) -> Result<()> {
        let mut problems = vec![];
        let mut check = |ok: bool, text: String| {
            if !ok {
                problems.push(text);
            }
        };
        // A file may say anything; what is above these has no memory anywhere, and its products no number.
        for (name, value, least, most) in [
            ("n_obs_steps", self.n_obs_steps, 1, 1 << 7),
            ("horizon", self.horizon, 1, 1 << 12),
            ("train_timesteps", self.train_timesteps, 1, 1 << 12),
            ("image_size", self.image_size, 0, 1 << 12),
            ("cameras", self.cameras.len(), 0, 1 << 6),
            ("image_features", self.image_features, 0, 1 << 16),
            ("levels of down_dims", self.down_dims.len(), 1, MOST_LEVELS),
        ] {
            check(
                (least..=most).contains(&value),
                format!("{name}: expected {least} to {most}, got {value}"),
            );
        }
        check(
            self.n_image_steps <= self.n_obs_steps,
            format!(
                "n_image_steps: expected at most n_obs_steps ({}), got {}",
                self.n_obs_steps, self.n_image_steps
            ),
        );
        let multiple = 1 << self.down_dims.len().clamp(1, MOST_LEVELS).saturating_sub(1);
        check(
            self.horizon.is_multiple_of(multiple),
            format!(
                "horizon: expected a multiple of {multiple} for {} levels, got {}",
                self.down_dims.len(),
                self.horizon
            ),
        );
        let offset = if self.lerobot_alignment { self.n_obs_steps.saturating_sub(1) } else { 0 };
        check(
            self.n_action_steps > 0 && self.n_action_steps <= self.horizon.saturating_sub(offset),
            format!(
                "n_action_steps: expected 1 to {} in this alignment, got {}",
                self.horizon.saturating_sub(offset),
                self.n_action_steps
            ),
        );
        for d in &self.down_dims {
            check(
                self.n_groups > 0 && d.is_multiple_of(self.n_groups),
                format!("down_dims: expected multiples of n_groups ({}), got {d}", self.n_groups),
            );
        }
        check(
            self.kernel_size % 2 == 1,
            format!("kernel_size: expected an odd number, got {}", self.kernel_size),
        );
        check(
            self.step_embed_dim >= 4 && self.step_embed_dim.is_multiple_of(2),
            format!("step_embed_dim: expected an even number from 4, got {}", self.step_embed_dim),
        );
        check(
            self.inference_steps > 0 && self.inference_steps <= self.train_timesteps,
            format!("inference_steps: expected 1 to {}, got {}", self.train_timesteps, self.inference_steps),
        );
        check(
            (0.0..=100.0).contains(&self.guidance),
            format!("guidance: expected 0 to 100, got {}", self.guidance),
        );
        check(
            (0.0..=1e6).contains(&self.state_limit),
            format!("state_limit: expected 0 to 1e6, got {}", self.state_limit),
        );
        check(
            self.image_scaling.is_empty() || self.image_scaling.len() == self.cameras.len(),
            format!(
                "image_scaling: expected one entry for each of {} cameras or none, got {}",
                self.cameras.len(),
                self.image_scaling.len()
            ),
        );
        for scaling in &self.image_scaling {
            check(
                scaling.mean.iter().all(|v| (-100.0..=100.0).contains(v))
                    && scaling.std.iter().all(|v| (1e-6..=100.0).contains(v)),
                format!(
                    "image_scaling: expected means of -100 to 100 and deviations of 1e-6 to 100, got {scaling:?}"
                ),
            );
        }
        for (i, camera) in self.cameras.iter().enumerate() {
            check(
                !self.cameras[..i].contains(camera),
                format!("cameras: expected each name once, got `{}` twice", e2h_core::one_line(camera)),
            );
        }
        let unet = UnetConfig {
            input_dim: e2h_core::ACTION_DIM,
            down_dims: self.down_dims.clone(),
            kernel_size: self.kernel_size,
            n_groups: self.n_groups,
            step_embed_dim: self.step_embed_dim,
            cond_dim: 0,
        };
        // What is not said above, in the words of the layers.
        if let Err(e) = unet.validate() {
            check(false, e.to_string());
        }
        if !self.cameras.is_empty() {
            if let Err(e) = self.encoder(self.crop_size, self.crop_size).validate() {
                check(false, e.to_string());
            }
            check(
                self.crop_size > 0 && self.crop_size <= self.image_size,
                format!("crop_size: expected 1 to image_size ({}), got {}", self.image_size, self.crop_size),
            );
            check(
                (16..=1 << 16).contains(&self.encoder_width) && self.encoder_width.is_multiple_of(16),
                format!("encoder_width: expected a multiple of 16 up to 65536, got {}", self.encoder_width),
            );
            check(
                !self.encoder_blocks.is_empty() && self.encoder_blocks.iter().all(|n| (1..=64).contains(n)),
                format!("encoder_blocks: expected 1 to 64 blocks a stage, got {:?}", self.encoder_blocks),
            );
        }
        if problems.is_empty() { Ok(()) } else { Err(Error::Config(problems.join("; "))) }
    }
}
