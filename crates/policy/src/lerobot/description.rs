//! `config.json`, and what of a policy it can and cannot say.

use super::features::Features;
use super::{ACTION, ENVIRONMENT, STATE};
use crate::{EncoderNorm, PolicyConfig, Prediction, SamplerKind};
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::collections::BTreeMap;
use std::fmt;

/// A JSON object whose order matters: that of the cameras is that of their features.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct InOrder<T>(pub(super) Vec<(String, T)>);

impl<T: Serialize> Serialize for InOrder<T> {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        s.collect_map(self.0.iter().map(|(k, v)| (k, v)))
    }
}

impl<'de, T: Deserialize<'de>> Deserialize<'de> for InOrder<T> {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        struct Entries<T>(std::marker::PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Entries<T> {
            type Value = InOrder<T>;
            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<InOrder<T>, A::Error> {
                let mut entries = vec![];
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(InOrder(entries))
            }
        }
        d.deserialize_map(Entries(std::marker::PhantomData))
    }
}

/// Type and shape of an input or output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Feature {
    /// `STATE`, `ENV`, `VISUAL` or `ACTION`.
    #[serde(rename = "type")]
    pub(super) kind: String,
    /// Images: channels, rows, columns.
    pub(super) shape: Vec<usize>,
}

/// All of `config.json`: LeRobot 0.4.4 refuses unknown keys, and later versions have other defaults.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
#[allow(clippy::struct_excessive_bools, reason = "the file's own entries")]
pub(super) struct Description {
    #[serde(rename = "type")]
    pub(super) kind: String,
    pub(super) n_obs_steps: usize,
    pub(super) input_features: InOrder<Feature>,
    pub(super) output_features: InOrder<Feature>,
    #[serde(skip_deserializing)]
    device: String,
    #[serde(skip_deserializing)]
    use_amp: bool,
    #[serde(skip_deserializing)]
    use_peft: bool,
    #[serde(skip_deserializing)]
    push_to_hub: bool,
    #[serde(skip_deserializing)]
    repo_id: Option<String>,
    #[serde(skip_deserializing)]
    private: Option<bool>,
    #[serde(skip_deserializing)]
    tags: Option<Vec<String>>,
    #[serde(skip_deserializing)]
    license: Option<String>,
    #[serde(skip_deserializing)]
    pretrained_path: Option<String>,
    pub(super) horizon: usize,
    pub(super) n_action_steps: usize,
    pub(super) normalization_mapping: BTreeMap<String, String>,
    pub(super) drop_n_last_frames: usize,
    pub(super) vision_backbone: String,
    pub(super) resize_shape: Option<[usize; 2]>,
    #[serde(skip_deserializing)]
    crop_ratio: f64,
    pub(super) crop_shape: Option<[usize; 2]>,
    #[serde(skip_deserializing)]
    crop_is_random: bool,
    #[serde(skip_deserializing)]
    pretrained_backbone_weights: Option<String>,
    pub(super) use_group_norm: bool,
    pub(super) spatial_softmax_num_keypoints: usize,
    pub(super) use_separate_rgb_encoder_per_camera: bool,
    pub(super) down_dims: Vec<usize>,
    pub(super) kernel_size: usize,
    pub(super) n_groups: usize,
    pub(super) diffusion_step_embed_dim: usize,
    pub(super) use_film_scale_modulation: bool,
    pub(super) noise_scheduler_type: String,
    pub(super) num_train_timesteps: usize,
    pub(super) beta_schedule: String,
    #[serde(skip_deserializing)]
    beta_start: f64,
    #[serde(skip_deserializing)]
    beta_end: f64,
    pub(super) prediction_type: String,
    pub(super) clip_sample: bool,
    pub(super) clip_sample_range: f64,
    pub(super) num_inference_steps: Option<usize>,
    #[serde(skip_deserializing)]
    compile_model: bool,
    #[serde(skip_deserializing)]
    compile_mode: String,
    #[serde(skip_deserializing)]
    do_mask_loss_for_padding: bool,
    #[serde(skip_deserializing)]
    optimizer_lr: f64,
    #[serde(skip_deserializing)]
    optimizer_betas: [f64; 2],
    #[serde(skip_deserializing)]
    optimizer_eps: f64,
    #[serde(skip_deserializing)]
    optimizer_weight_decay: f64,
    #[serde(skip_deserializing)]
    scheduler_name: String,
    #[serde(skip_deserializing)]
    scheduler_warmup_steps: usize,
}

impl Default for Description {
    /// The defaults of LeRobot 0.4.4.
    fn default() -> Self {
        let owned = str::to_owned;
        Self {
            kind: String::new(),
            n_obs_steps: 2,
            input_features: InOrder(vec![]),
            output_features: InOrder(vec![]),
            device: owned("cpu"),
            use_amp: false,
            use_peft: false,
            push_to_hub: false,
            repo_id: None,
            private: None,
            tags: None,
            license: None,
            pretrained_path: None,
            horizon: 16,
            n_action_steps: 8,
            normalization_mapping: BTreeMap::new(),
            drop_n_last_frames: 7,
            vision_backbone: owned("resnet18"),
            resize_shape: None,
            crop_ratio: 1.0,
            crop_shape: None,
            crop_is_random: true,
            pretrained_backbone_weights: None,
            use_group_norm: true,
            spatial_softmax_num_keypoints: 32,
            use_separate_rgb_encoder_per_camera: false,
            down_dims: vec![512, 1024, 2048],
            kernel_size: 5,
            n_groups: 8,
            diffusion_step_embed_dim: 128,
            use_film_scale_modulation: true,
            noise_scheduler_type: owned("DDPM"),
            num_train_timesteps: 100,
            beta_schedule: owned("squaredcos_cap_v2"),
            beta_start: 0.0001,
            beta_end: 0.02,
            prediction_type: owned("epsilon"),
            clip_sample: true,
            clip_sample_range: 1.0,
            num_inference_steps: None,
            compile_model: false,
            compile_mode: owned("reduce-overhead"),
            do_mask_loss_for_padding: false,
            optimizer_lr: 1e-4,
            optimizer_betas: [0.95, 0.999],
            optimizer_eps: 1e-8,
            optimizer_weight_decay: 1e-6,
            scheduler_name: owned("cosine"),
            scheduler_warmup_steps: 500,
        }
    }
}

/// Something that the other side cannot express.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Obstacle {
    /// Name of the setting.
    pub setting: String,
    /// What it would have to be.
    pub expected: String,
    /// What it is.
    pub found: String,
}

impl Obstacle {
    pub(super) fn new(setting: &str, expected: impl fmt::Display, found: impl fmt::Display) -> Self {
        let (setting, expected) = (setting.to_owned(), expected.to_string());
        Self { setting, expected, found: found.to_string() }
    }
}

impl fmt::Display for Obstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: expected {}, found {}", self.setting, self.expected, self.found)
    }
}

/// Blocks of the ResNets that torchvision builds of the blocks that we have, with the names that LeRobot knows them by.
pub(super) const BACKBONES: [(&str, [usize; 4]); 2] =
    [("resnet18", [2, 2, 2, 2]), ("resnet34", [3, 4, 6, 3])];
/// Channels of their first stage.
pub(super) const BACKBONE_WIDTH: usize = 64;

/// Groups of the U-Net's normalisations: LeRobot's last block has always this many, whatever the others have.
pub(super) const GROUPS: usize = 8;

/// All that keeps a policy of this configuration from being written for LeRobot; empty when nothing does.
#[must_use]
pub fn obstacles(c: &PolicyConfig) -> Vec<Obstacle> {
    let mut found = network_obstacles(c);
    if c.cameras.is_empty() {
        found.insert(0, Obstacle::new("cameras", "at least one", "none"));
    }
    found
}

/// The same of the network alone, whatever goes into it.
#[must_use]
pub fn network_obstacles(c: &PolicyConfig) -> Vec<Obstacle> {
    let mut found = vec![];
    let mut ask = |ok: bool, setting: &str, expected: String, is: String| {
        if !ok {
            found.push(Obstacle::new(setting, expected, is));
        }
    };
    ask(
        c.lerobot_alignment,
        "lerobot_alignment",
        "true (the first action belongs to the oldest observation)".to_owned(),
        "false".to_owned(),
    );
    let (steps, images) = (c.n_obs_steps, c.n_image_steps);
    ask(images == steps, "n_image_steps", format!("{steps}, as n_obs_steps"), images.to_string());
    ask(!c.relative_features, "relative_features", "false".to_owned(), "true".to_owned());
    ask(!c.tool_frame_features, "tool_frame_features", "false".to_owned(), "true".to_owned());
    ask(!c.indicator, "indicator", "false".to_owned(), "true".to_owned());
    ask(
        c.encoder_width == BACKBONE_WIDTH,
        "encoder_width",
        BACKBONE_WIDTH.to_string(),
        c.encoder_width.to_string(),
    );
    let known = BACKBONES.iter().any(|(_, blocks)| c.encoder_blocks == blocks);
    let names = BACKBONES.map(|(name, blocks)| format!("{blocks:?} ({name})")).join(" or ");
    ask(known, "encoder_blocks", names, format!("{:?}", c.encoder_blocks));
    let folded = c.encoder_norm == EncoderNorm::Folded;
    ask(!folded, "encoder_norm", "group".to_owned(), "folded (a batch norm)".to_owned());
    let features = 2 * c.keypoints;
    ask(
        c.image_features == features,
        "image_features",
        format!("{features}, twice the keypoints"),
        c.image_features.to_string(),
    );
    ask(c.n_groups == GROUPS, "n_groups", GROUPS.to_string(), c.n_groups.to_string());
    let multiple = 1 << c.down_dims.len();
    ask(
        c.horizon.is_multiple_of(multiple),
        "horizon",
        format!("a multiple of {multiple} for {} levels", c.down_dims.len()),
        c.horizon.to_string(),
    );
    // Any other weight is guidance.
    let unguided = c.guidance == 1.0;
    ask(unguided, "guidance", "1".to_owned(), c.guidance.to_string());
    // torchvision rounds half a pixel to the even number, we round it down: every fourth difference has another centre.
    let border = c.image_size.saturating_sub(c.crop_size);
    ask(
        border % 4 != 3,
        "crop_size",
        "a crop with the same centre in both: image_size - crop_size not 3, 7, 11, ...".to_owned(),
        format!("{} in {}", c.crop_size, c.image_size),
    );
    found
}

impl Description {
    /// Of a policy without [`obstacles`].
    pub(super) fn of(c: &PolicyConfig, f: &Features, modes: BTreeMap<String, String>) -> Self {
        let feature = |kind: &str, shape: &[usize]| Feature { kind: kind.to_owned(), shape: shape.to_vec() };
        let mut inputs = vec![(STATE.to_owned(), feature("STATE", &[f.state]))];
        if f.environment > 0 {
            inputs.push((ENVIRONMENT.to_owned(), feature("ENV", &[f.environment])));
        }
        for camera in &f.cameras {
            inputs.push((camera.clone(), feature("VISUAL", &[3, f.size[0], f.size[1]])));
        }
        let backbone = BACKBONES.iter().find(|(_, blocks)| c.encoder_blocks == blocks);
        Self {
            kind: "diffusion".to_owned(),
            n_obs_steps: c.n_obs_steps,
            input_features: InOrder(inputs),
            output_features: InOrder(vec![(ACTION.to_owned(), feature("ACTION", &[f.action]))]),
            horizon: c.horizon,
            n_action_steps: c.n_action_steps,
            normalization_mapping: modes,
            drop_n_last_frames: (c.horizon + 1).saturating_sub(c.n_action_steps + c.n_obs_steps),
            vision_backbone: backbone.map_or("resnet18", |(name, _)| name).to_owned(),
            crop_shape: (!f.cameras.is_empty()).then_some(f.crop),
            spatial_softmax_num_keypoints: c.keypoints,
            use_separate_rgb_encoder_per_camera: !c.share_encoder,
            down_dims: c.down_dims.clone(),
            kernel_size: c.kernel_size,
            n_groups: c.n_groups,
            diffusion_step_embed_dim: c.step_embed_dim,
            noise_scheduler_type: match c.sampler {
                SamplerKind::Ddim => "DDIM",
                SamplerKind::Ddpm => "DDPM",
            }
            .to_owned(),
            num_train_timesteps: c.train_timesteps,
            prediction_type: match c.prediction {
                Prediction::Epsilon => "epsilon",
                Prediction::Sample => "sample",
            }
            .to_owned(),
            num_inference_steps: Some(c.inference_steps),
            ..Self::default()
        }
    }
}
