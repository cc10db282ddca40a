//! How a policy is trained on recordings: preset < `--set key=value`, checked before any work.

use crate::config::layers::{find, layer, merge, parse, typed};
use crate::{Error, Result};
use e2h_policy::lerobot::{Features, network_obstacles};
use e2h_policy::{EncoderNorm, PolicyConfig, Prediction, SamplerKind, TrainConfig};
use serde::{Deserialize, Serialize};
use toml::Table;

const PRESETS: [(&str, &str); 3] = [
    ("smoke", include_str!("../../../../configs/train/smoke.toml")),
    ("laptop", include_str!("../../../../configs/train/laptop.toml")),
    ("paper", include_str!("../../../../configs/train/paper.toml")),
];

/// Everything that such a training depends on besides its seed and its datasets. Each file of `configs/train` states every entry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImitationConfig {
    /// What is taken from the datasets.
    pub data: DataConfig,
    /// Architecture and inference.
    pub policy: NetworkConfig,
    /// The training.
    pub train: ImitationTraining,
}

/// How images are scaled before the encoder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ImageStatistics {
    /// By mean and deviation of each camera's images.
    Dataset,
    /// By those of ImageNet (LeRobot's default).
    Imagenet,
    /// Not beyond [0, 1].
    None,
}

/// What is taken from the datasets.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Cameras, by their feature or by what follows its last dot; none takes all.
    pub cameras: Vec<String>,
    /// Rows and columns that all images are brought to; empty leaves them as they are.
    pub resize: Vec<usize>,
    /// Rows and columns that the encoder sees; empty: whole images.
    pub crop: Vec<usize>,
    /// Share of the episodes of each dataset that is held out.
    pub validation: f32,
    /// Scaling of the images.
    pub image_scaling: ImageStatistics,
    /// True: the last rows of an episode, whose windows would mostly repeat its last action, are the newest of no window.
    pub drop_last: bool,
}

/// LeRobot's diffusion policy, in the sizes that it can have there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Observation steps.
    pub n_obs_steps: usize,
    /// Predicted actions.
    pub horizon: usize,
    /// Executed actions of each prediction.
    pub n_action_steps: usize,
    /// `resnet18` or `resnet34`.
    pub vision_backbone: String,
    /// One encoder for each camera instead of one for all.
    pub separate_encoders: bool,
    /// Keypoints of the spatial softmax.
    pub keypoints: usize,
    /// Channels of the U-Net's levels.
    pub down_dims: Vec<usize>,
    /// Kernel of the U-Net's convolutions.
    pub kernel_size: usize,
    /// Width of the embedding of the diffusion step.
    pub step_embed_dim: usize,
    /// What the network predicts.
    pub prediction: Prediction,
    /// How noise becomes actions.
    pub sampler: SamplerKind,
    /// Diffusion steps in training.
    pub train_timesteps: usize,
    /// Steps in sampling.
    pub inference_steps: usize,
}

/// The training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImitationTraining {
    /// Steps in all.
    pub steps: usize,
    /// Steps between two checkpoints.
    pub save_every: usize,
    /// Steps between two looks at the held-out episodes.
    pub validate_every: usize,
    /// Batches of each look.
    pub validation_batches: usize,
    /// A step.
    pub step: TrainConfig,
}

/// Groups of the U-Net's normalisations, which LeRobot's last block always has.
const GROUPS: usize = 8;

impl NetworkConfig {
    /// The network for what goes in and comes out.
    #[must_use]
    pub fn policy(&self, features: &Features) -> PolicyConfig {
        let blocks = if self.vision_backbone == "resnet34" { vec![3, 4, 6, 3] } else { vec![2; 4] };
        PolicyConfig {
            n_obs_steps: self.n_obs_steps,
            n_image_steps: self.n_obs_steps,
            horizon: self.horizon,
            n_action_steps: self.n_action_steps,
            lerobot_alignment: true,
            cameras: features.cameras.clone(),
            image_size: features.crop[0],
            crop_size: features.crop[0],
            share_encoder: !self.separate_encoders,
            encoder_width: 64,
            encoder_blocks: blocks,
            keypoints: self.keypoints,
            image_features: self.keypoints.saturating_mul(2),
            relative_features: false,
            tool_frame_features: false,
            down_dims: self.down_dims.clone(),
            kernel_size: self.kernel_size,
            n_groups: GROUPS,
            step_embed_dim: self.step_embed_dim,
            prediction: self.prediction,
            train_timesteps: self.train_timesteps,
            inference_steps: self.inference_steps,
            guidance: 1.0,
            sampler: self.sampler,
            state_limit: 0.0,
            unit_quaternion: false,
            image_scaling: vec![],
            encoder_norm: EncoderNorm::Group,
            indicator: false,
        }
    }
}

impl ImitationConfig {
    /// Reads a preset and overrides (`key.path=value`), later ones winning. With the configuration comes its text.
    ///
    /// # Errors
    /// Unknown preset or key (the nearest known one is named), a value of the wrong type, or values that cannot be (all of
    /// them are listed).
    pub fn resolve(preset: &str, overrides: &[String]) -> Result<(Self, String)> {
        let mut table = parse(preset, find("preset", preset, &PRESETS)?)?;
        for text in overrides {
            merge(&mut table, &layer(text)?, "")?;
        }
        Self::from_table(table)
    }

    /// Reads a resolved configuration that a training wrote.
    ///
    /// # Errors
    /// As [`ImitationConfig::resolve`].
    pub fn from_text(text: &str) -> Result<Self> {
        Ok(Self::from_table(parse("config.toml", text)?)?.0)
    }

    fn from_table(table: Table) -> Result<(Self, String)> {
        let (config, text): (Self, String) = typed(table)?;
        let problems = config.problems();
        if problems.is_empty() { Ok((config, text)) } else { Err(Error::Config(problems.join("; "))) }
    }

    /// Rows that are dropped at the end of each episode.
    ///
    /// # Source
    /// LeRobot 0.4.4, `drop_n_last_frames` of `DiffusionConfig`.
    #[must_use]
    pub fn drop_last(&self) -> usize {
        let p = &self.policy;
        if self.data.drop_last { (p.horizon + 1).saturating_sub(p.n_action_steps + p.n_obs_steps) } else { 0 }
    }

    /// What can be said without the datasets.
    fn problems(&self) -> Vec<String> {
        let (d, p, t) = (&self.data, &self.policy, &self.train);
        let mut problems = vec![];
        let mut check = |ok: bool, text: String| {
            if !ok {
                problems.push(text);
            }
        };
        for (name, size) in [("data.resize", &d.resize), ("data.crop", &d.crop)] {
            let fits = size.is_empty() || size.len() == 2 && size.iter().all(|n| (1..=4096).contains(n));
            check(fits, format!("{name}: expected [rows, columns] of 1 to 4096 pixels, or [], got {size:?}"));
        }
        check(
            (0.0..=0.9).contains(&d.validation),
            format!("data.validation: expected 0 to 0.9, got {}", d.validation),
        );
        let backbones = ["resnet18", "resnet34"];
        check(
            backbones.contains(&p.vision_backbone.as_str()),
            format!("policy.vision_backbone: expected one of {backbones:?}, got `{}`", p.vision_backbone),
        );
        for (name, value) in [
            ("train.steps", t.steps),
            ("train.save_every", t.save_every),
            ("train.validate_every", t.validate_every),
            ("train.validation_batches", t.validation_batches),
        ] {
            check(
                (1..=100_000_000).contains(&value),
                format!("{name}: expected 1 to 100000000, got {value}"),
            );
        }
        problems.extend(t.step.validate().into_iter().map(|p| format!("train.step.{p}")));
        problems
    }

    /// What can be said of the network once its inputs are known.
    ///
    /// # Errors
    /// Lists all that does not fit.
    pub(super) fn check_network(&self, features: &Features) -> Result<PolicyConfig> {
        let policy = self.policy.policy(features);
        let mut problems: Vec<String> =
            network_obstacles(&policy).iter().map(|o| format!("policy.{o}")).collect();
        problems.extend(features.problems(&policy));
        if let Err(e) = policy.validate() {
            problems.push(e.to_string());
        }
        if problems.is_empty() { Ok(policy) } else { Err(Error::Config(problems.join("; "))) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use toml::Value;

    fn keys(table: &Table, path: &str, out: &mut Vec<String>) {
        for (k, v) in table {
            match v {
                Value::Table(t) => keys(t, &format!("{path}{k}."), out),
                _ => out.push(format!("{path}{k}")),
            }
        }
    }

    #[test]
    fn every_preset_states_every_key_and_makes_a_network() {
        let features = Features {
            state: 6,
            environment: 0,
            action: 6,
            cameras: vec!["observation.images.front".to_owned()],
            size: [72, 96],
            crop: [64, 84],
        };
        let mut all = vec![];
        for (name, text) in PRESETS {
            let mut found = vec![];
            keys(&parse(name, text).unwrap(), "", &mut found);
            found.sort();
            all.push(found);
            let (config, text) = ImitationConfig::resolve(name, &[]).unwrap();
            assert_eq!(ImitationConfig::from_text(&text).unwrap(), config);
            config.check_network(&features).unwrap();
        }
        assert!(all.windows(2).all(|w| w[0] == w[1]), "presets differ in their keys");
    }

    #[test]
    fn every_problem_is_told_at_once() {
        let text = |set: &[&str]| {
            let set: Vec<String> = set.iter().map(|s| (*s).to_owned()).collect();
            ImitationConfig::resolve("smoke", &set).unwrap_err().to_string()
        };
        let all =
            text(&["data.resize=[3]", "data.validation=1.5", "policy.vision_backbone=vgg", "train.steps=0"]);
        for part in ["data.resize", "data.validation", "vision_backbone", "train.steps"] {
            assert!(all.contains(part), "{all}");
        }
        assert!(text(&["train.step.schedule.rate=1"]).contains("unknown key"));
        assert!(text(&["data.camera=[]"]).contains("did you mean `data.cameras`"));
    }
}
