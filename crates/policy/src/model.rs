//! Encoders, condition and U-Net: the network behind a policy.

use crate::{EncoderNorm, PolicyConfig, Result};
use candle_core::{Device, Tensor};
use e2h_core::{ACTION_DIM, Rng};
use e2h_nn::{Builder, Compute, ConditionalUnet1d, Mode, Params, RgbEncoder, UnetConfig, Weights};

/// Turns images and states into one vector an observation history.
pub(crate) struct ConditionEncoder {
    encoders: Vec<RgbEncoder>,
    config: PolicyConfig,
    /// Numbers of one state.
    state: usize,
}

impl ConditionEncoder {
    pub(crate) fn new(config: &PolicyConfig, state: usize, builder: &Builder) -> e2h_nn::Result<Self> {
        let encoder = config.encoder(config.crop_size, config.crop_size);
        let make = match config.encoder_norm {
            EncoderNorm::Group => RgbEncoder::new,
            EncoderNorm::Folded => RgbEncoder::folded,
        };
        let names: Vec<String> = match (config.cameras.len(), config.share_encoder) {
            (0, _) => vec![],
            (_, true) => vec!["rgb_encoder".to_owned()],
            (n, false) => (0..n).map(|i| format!("rgb_encoder.{i}")).collect(),
        };
        let encoders =
            names.iter().map(|name| make(&encoder, &builder.pp(name))).collect::<e2h_nn::Result<_>>()?;
        Ok(Self { encoders, config: config.clone(), state })
    }

    /// The condition vector, less the indicator.
    ///
    /// # Shapes
    /// `state` (B, To * S); `images` one tensor a camera, each (B * `n_image_steps`, H, W, 3) in [0, 1], the steps of one
    /// sample together, oldest first. Result (B, condition), one less with an indicator.
    ///
    /// # Source
    /// Order of LeRobot 0.4.4 `_prepare_global_conditioning`: for each step the state, then each camera's features.
    pub(crate) fn forward(&self, state: &Tensor, images: &[Tensor]) -> Result<Tensor> {
        let c = &self.config;
        if self.encoders.is_empty() || c.n_image_steps == 0 {
            return Ok(state.clone());
        }
        let b = state.dim(0)?;
        let features = images
            .iter()
            .enumerate()
            .map(|(camera, x)| {
                let encoder = &self.encoders[camera.min(self.encoders.len() - 1)];
                Ok(encoder.forward(x)?.reshape((b, c.n_image_steps, c.image_features))?)
            })
            .collect::<Result<Vec<_>>>()?;
        let features = Tensor::cat(&features, 2)?;
        if c.n_image_steps == c.n_obs_steps {
            let state = state.reshape((b, c.n_obs_steps, self.state))?;
            return Ok(Tensor::cat(&[&state, &features], 2)?.flatten_from(1)?);
        }
        // Differs: LeRobot pairs every state with images; with fewer image steps all states come first.
        Ok(Tensor::cat(&[state, &features.flatten_from(1)?], 1)?)
    }
}

/// The denoising network with its encoders and parameters.
///
/// # Source
/// LeRobot 0.4.4 `DiffusionModel`; parameter names are those of its `DiffusionPolicy` (prefix `diffusion.`).
pub struct DiffusionModel {
    pub(crate) params: Params,
    condition: ConditionEncoder,
    unet: ConditionalUnet1d,
}

/// Numbers of a state and of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Widths {
    pub(crate) state: usize,
    pub(crate) action: usize,
}

impl DiffusionModel {
    /// A network with freshly drawn weights, on the CPU.
    ///
    /// # Errors
    /// When the configuration does not fit together.
    pub fn new(config: &PolicyConfig, mode: Mode, rng: &mut Rng) -> Result<Self> {
        Self::new_on(&Compute::cpu(), config, mode, rng)
    }

    /// A network with freshly drawn weights, the same on every device.
    ///
    /// # Errors
    /// When the configuration does not fit together, or the device fails.
    pub fn new_on(compute: &Compute, config: &PolicyConfig, mode: Mode, rng: &mut Rng) -> Result<Self> {
        let widths = Widths { state: config.state_features(), action: ACTION_DIM };
        Self::of_widths(compute, config, widths, mode, rng)
    }

    /// The same for states and actions of other widths.
    pub(crate) fn of_widths(
        compute: &Compute,
        config: &PolicyConfig,
        widths: Widths,
        mode: Mode,
        rng: &mut Rng,
    ) -> Result<Self> {
        config.validate()?;
        let (params, (condition, unet)) =
            Params::build_on(compute, mode, rng, |b| Self::parts(config, widths, b))?;
        Ok(Self { params, condition, unet })
    }

    /// A network with given weights, on the CPU. Memory is taken only for a network that these weights are of.
    ///
    /// # Errors
    /// When the configuration does not fit together; otherwise lists every tensor that differs.
    pub(crate) fn with_weights(config: &PolicyConfig, widths: Widths, weights: &Weights) -> Result<Self> {
        config.validate()?;
        Params::check(weights, |b| Self::parts(config, widths, b))?;
        let mut rng = e2h_core::stream(0, "weights", 0, 0);
        let this = Self::of_widths(&Compute::cpu(), config, widths, Mode::Infer, &mut rng)?;
        this.params.import(weights)?;
        Ok(this)
    }

    /// The same network on another device, for inference.
    ///
    /// # Errors
    /// When the device fails.
    pub(crate) fn into_device(
        self,
        compute: &Compute,
        config: &PolicyConfig,
        widths: Widths,
    ) -> Result<Self> {
        if self.params.is_on(compute) {
            return Ok(self);
        }
        let mut rng = e2h_core::stream(0, "weights", 0, 0);
        let this = Self::of_widths(compute, config, widths, Mode::Infer, &mut rng)?;
        this.params.import(&self.params.export()?)?;
        Ok(this)
    }

    pub(crate) fn parts(
        config: &PolicyConfig,
        widths: Widths,
        b: &Builder<'_>,
    ) -> e2h_nn::Result<(ConditionEncoder, ConditionalUnet1d)> {
        let unet = UnetConfig {
            input_dim: widths.action,
            down_dims: config.down_dims.clone(),
            kernel_size: config.kernel_size,
            n_groups: config.n_groups,
            step_embed_dim: config.step_embed_dim,
            cond_dim: config.condition_width(widths.state),
        };
        let b = b.pp("diffusion");
        let condition = ConditionEncoder::new(config, widths.state, &b)?;
        Ok((condition, ConditionalUnet1d::new(&unet, &b.pp("unet"))?))
    }

    /// Names, shapes and values of the parameters.
    #[must_use]
    pub fn params(&self) -> &Params {
        &self.params
    }

    /// Where its inputs have to be.
    #[must_use]
    pub fn device(&self) -> &Device {
        self.params.compute().device()
    }

    /// The condition vector of observation histories, less the indicator, which [`DiffusionModel::indicate`] appends.
    ///
    /// # Shapes
    /// `state` (B, To * S) normalised; `images` one tensor a camera, (B * `n_image_steps`, H, W, 3) in [0, 1]. Result
    /// (B, condition), one less with an indicator.
    ///
    /// # Errors
    /// When shapes do not fit the configuration.
    pub fn condition(&self, state: &Tensor, images: &[Tensor]) -> Result<Tensor> {
        self.condition.forward(state, images)
    }

    /// Appends the indicators to a condition without them.
    ///
    /// # Shapes
    /// `condition` (B, condition - 1), `indicators` (B). Result (B, condition).
    ///
    /// # Errors
    /// When the shapes do not fit.
    pub fn indicate(&self, condition: &Tensor, indicators: &[f32]) -> Result<Tensor> {
        let column = Tensor::from_slice(indicators, (indicators.len(), 1), self.device())?;
        Ok(Tensor::cat(&[condition, &column], 1)?)
    }

    /// The network's answer to noisy actions.
    ///
    /// # Shapes
    /// `x` (B, T, 8), `timesteps` (B), `condition` (B, condition). Result (B, T, 8).
    ///
    /// # Errors
    /// When shapes do not fit the configuration.
    pub fn forward(&self, x: &Tensor, timesteps: &[f32], condition: &Tensor) -> Result<Tensor> {
        Ok(self.unet.forward(x, timesteps, condition)?)
    }
}

/// Weights of the network without an indicator as those of `config`, which has one: whatever reads the condition gets a last
/// column of zeros, so that the network answers as before to every c. Other weights stay as they are.
pub(crate) fn widened(config: &PolicyConfig, weights: &Weights) -> Weights {
    let before = (config.step_embed_dim + config.condition_dim()).saturating_sub(1).max(1);
    let mut weights = weights.clone();
    let reads = |name: &str| name.ends_with(".cond_encoder.1.weight");
    for (_, tensor) in weights.iter_mut().filter(|(name, t)| reads(name) && t.shape.get(1) == Some(&before)) {
        let rows = tensor.data.chunks_exact(before);
        tensor.data = rows.flat_map(|row| row.iter().copied().chain([0.0])).collect();
        tensor.shape[1] += 1;
    }
    weights
}
