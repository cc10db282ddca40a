//! A folder of LeRobot's as a policy.

use super::description::{BACKBONE_WIDTH, BACKBONES, Description, GROUPS, Obstacle};
use super::export::{HEADER, Header};
use super::features::Features;
use super::fold;
use super::policy::LerobotPolicy;
use super::processors::{POSTPROCESSOR, PREPROCESSOR, Statistics};
use super::{ACTION, CONFIG_FILE, ENVIRONMENT, POSITION_GRID, STATE, WEIGHTS_FILE};
use crate::folder::read_weights_without;
use crate::model::{DiffusionModel, Widths};
use crate::{Ddim, EncoderNorm, Error, ImageScaling, PolicyConfig, Prediction, Result, SamplerKind};
use e2h_nn::{SpatialSoftmax, Weights};
use std::path::Path;

/// Opens a diffusion policy that LeRobot from 0.4 on or [`super::export`] wrote.
///
/// Weights of 16 bits are read as the same numbers in 32. A batch norm, which LeRobot 0.6 has by default, is folded into the
/// convolution before it.
///
/// # Errors
/// When a file is missing or is not what it should be; [`Error::Lerobot`] lists everything in it that this version does not
/// compute; weights that are not those of the architecture are listed by name; a folder from before LeRobot 0.4 is told how
/// to become one of today.
pub fn import(dir: &Path) -> Result<LerobotPolicy> {
    let path = dir.join(CONFIG_FILE);
    let bytes = e2h_data::read_file(&path, e2h_data::MOST_TEXT).map_err(|source| Error::Io {
        doing: "reading LeRobot checkpoint",
        path: path.clone(),
        source,
    })?;
    let fail = |problem: String| Error::Checkpoint { path: path.clone(), problem };
    let d: Description = serde_json::from_slice(&bytes).map_err(|e| fail(e.to_string()))?;
    if d.kind.is_empty() {
        return Err(fail(UNTYPED.to_owned()));
    }
    if d.kind == "diffusion" && !dir.join(format!("{PREPROCESSOR}.json")).exists() {
        return Err(Error::Checkpoint { path: dir.to_owned(), problem: MIGRATE.to_owned() });
    }
    let mut problems = vec![];
    let features = Features::of(&d, &mut problems);
    let config = network(&d, &features, &mut problems);
    if d.kind != "diffusion" {
        // Nothing else of another kind of policy means what it means here.
        problems = vec![Obstacle::new("type", "diffusion", &d.kind)];
    }
    let refuse =
        |obstacles| Error::Lerobot { doing: "reading LeRobot checkpoint", path: dir.to_owned(), obstacles };
    if !problems.is_empty() {
        return Err(refuse(problems));
    }

    let before = Statistics::read(dir, PREPROCESSOR, &mut problems)?;
    let after = Statistics::read(dir, POSTPROCESSOR, &mut problems)?;
    let (s, e, a) = (features.state, features.environment, features.action);
    let state = before.scaling(STATE, "STATE", s, &mut problems);
    let environment = before.scaling(ENVIRONMENT, "ENV", e, &mut problems);
    let action = after.scaling(ACTION, "ACTION", a, &mut problems);
    let mut cameras = vec![];
    for name in &features.cameras {
        let scaling = before.scaling(name, "VISUAL", 3, &mut problems);
        let moments = [0, 1, 2].map(|i| scaling.moments(i));
        cameras.push((name.clone(), ImageScaling { mean: moments.map(|m| m.0), std: moments.map(|m| m.1) }));
    }
    if !problems.is_empty() {
        return Err(refuse(problems));
    }

    let widths = Widths { state: s + e, action: a };
    config.validate().map_err(|e| fail(e.to_string()))?;
    let weights_path = dir.join(WEIGHTS_FILE);
    let (mut weights, metadata) = read_weights_without(&weights_path, |name| name.ends_with(BATCHES))?;
    let unfit = |problem: String| Error::Checkpoint { path: weights_path.clone(), problem };
    if !features.cameras.is_empty() {
        let [rows, columns] = features.crop;
        check_grids(&mut weights, config.encoder(rows, columns).map_size(), &mut problems);
    }
    if config.encoder_norm == EncoderNorm::Folded {
        fold::batch_norms(&mut weights).map_err(unfit)?;
    }
    if !problems.is_empty() {
        return Err(refuse(problems));
    }
    let model = DiffusionModel::with_weights(&config, widths, &weights).map_err(|e| unfit(e.to_string()))?;
    let header = metadata.get(HEADER).and_then(|text| serde_json::from_str::<Header>(text).ok());
    Ok(LerobotPolicy {
        path: dir.to_owned(),
        model,
        ddim: Ddim::new(config.train_timesteps, config.inference_steps, config.prediction)?,
        config,
        state: (s, state),
        environment: (e, environment),
        action: (a, action),
        cameras,
        size: features.size,
        crop: features.crop,
        provenance: header.map(|h| h.provenance),
    })
}

/// Counts of the batches that a batch norm saw in training: integers, and of no use to act with.
const BATCHES: &str = ".num_batches_tracked";

/// What a folder without a preprocessor is told.
const MIGRATE: &str = "expected policy_preprocessor.json, found none: LeRobot before 0.4 kept the normalisation among the weights. \
    With LeRobot 0.4 installed, `python -m lerobot.processor.migrate_policy_normalization --pretrained-path FOLDER` writes \
    FOLDER_migrated; open that";
/// What a `config.json` without a type is told.
const UNTYPED: &str = "expected the `type` of the policy, found none: the file is of a LeRobot that did not write it yet, or of \
    another program. LeRobot's own migration asks for it too: add `\"type\": \"diffusion\"` where it is a diffusion policy, with \
    `input_features` and `output_features` in the place of its `input_shapes` and `output_shapes`, or train it anew";

/// Takes the buffers of the spatial softmax out of `weights`. They are computed here, for a map of `size`: what differs from
/// that by more than the rounding of its numbers is an obstacle.
fn check_grids(weights: &mut Weights, size: (usize, usize), problems: &mut Vec<Obstacle>) {
    let names: Vec<String> = weights.keys().filter(|n| n.ends_with(POSITION_GRID)).cloned().collect();
    for name in names {
        let Some(found) = weights.remove(&name) else { continue };
        let expected = SpatialSoftmax::position_grid(size.0, size.1);
        let differs = |(a, b): (&f32, &f32)| (a - b).abs() > rounding(*a);
        let at = found.data.iter().zip(&expected.data).position(differs);
        let problem = match at {
            _ if found.shape != expected.shape => format!("{:?}", found.shape),
            Some(i) => format!("{} in the place of {}, entry {i}", found.data[i], expected.data[i]),
            None => continue,
        };
        let (h, w) = size;
        let expected = format!("{:?}, from -1 to 1 over a map of {h} x {w}", expected.shape);
        problems.push(Obstacle::new(&name, expected, problem));
    }
}

/// How far from what was meant a position in [-1, 1] may be: half a unit in the last place of the shortest kind of number
/// that has this value.
fn rounding(v: f32) -> f32 {
    // Bits of the fraction that are not zero: bf16 has 7, f16 has 10.
    match 23 - v.to_bits().trailing_zeros().min(23) {
        0..=7 => 1.0 / 256.0,
        8..=10 => 1.0 / 2048.0,
        _ => 1e-6,
    }
}

/// The network in our words.
fn network(d: &Description, features: &Features, problems: &mut Vec<Obstacle>) -> PolicyConfig {
    let mut ask = |ok: bool, setting: &str, expected: &str, found: String| {
        if !ok {
            problems.push(Obstacle::new(setting, expected, found));
        }
    };
    let blocks = BACKBONES.iter().find(|(name, _)| *name == d.vision_backbone).map(|(_, blocks)| *blocks);
    if !features.cameras.is_empty() {
        let names = BACKBONES.map(|b| b.0).join(" or ");
        ask(blocks.is_some(), "vision_backbone", &names, d.vision_backbone.clone());
        ask(d.resize_shape.is_none(), "resize_shape", "null", format!("{:?}", d.resize_shape));
    }
    ask(d.n_groups == GROUPS, "n_groups", &GROUPS.to_string(), d.n_groups.to_string());
    ask(d.use_film_scale_modulation, "use_film_scale_modulation", "true", "false".to_owned());
    let schedule = "squaredcos_cap_v2";
    ask(d.beta_schedule == schedule, "beta_schedule", schedule, d.beta_schedule.clone());
    // Any other limit clips elsewhere.
    let clipped = d.clip_sample && d.clip_sample_range == 1.0;
    let found = format!("{} and {}", d.clip_sample, d.clip_sample_range);
    ask(clipped, "clip_sample and clip_sample_range", "true and 1", found);
    let (kind, predicts) = (d.noise_scheduler_type.as_str(), d.prediction_type.as_str());
    ask(["DDIM", "DDPM"].contains(&kind), "noise_scheduler_type", "DDIM or DDPM", kind.to_owned());
    ask(
        ["epsilon", "sample"].contains(&predicts),
        "prediction_type",
        "epsilon or sample",
        predicts.to_owned(),
    );
    PolicyConfig {
        n_obs_steps: d.n_obs_steps,
        n_image_steps: d.n_obs_steps,
        horizon: d.horizon,
        n_action_steps: d.n_action_steps,
        lerobot_alignment: true,
        cameras: features.cameras.clone(),
        image_size: features.crop[0],
        crop_size: features.crop[0],
        share_encoder: !d.use_separate_rgb_encoder_per_camera,
        encoder_width: BACKBONE_WIDTH,
        encoder_blocks: blocks.unwrap_or([2; 4]).to_vec(),
        keypoints: d.spatial_softmax_num_keypoints,
        image_features: d.spatial_softmax_num_keypoints.saturating_mul(2),
        relative_features: false,
        tool_frame_features: false,
        down_dims: d.down_dims.clone(),
        kernel_size: d.kernel_size,
        n_groups: d.n_groups,
        step_embed_dim: d.diffusion_step_embed_dim,
        prediction: if predicts == "sample" { Prediction::Sample } else { Prediction::Epsilon },
        train_timesteps: d.num_train_timesteps,
        inference_steps: d.num_inference_steps.unwrap_or(d.num_train_timesteps),
        guidance: 1.0,
        sampler: if kind == "DDPM" { SamplerKind::Ddpm } else { SamplerKind::Ddim },
        state_limit: 0.0,
        unit_quaternion: false,
        image_scaling: vec![],
        encoder_norm: if d.use_group_norm || features.cameras.is_empty() {
            EncoderNorm::Group
        } else {
            EncoderNorm::Folded
        },
        indicator: false,
    }
}
