//! The work that is compared with PyTorch: LeRobot's network at two sizes, with the data of `train_step.py` or random data
//! of the same shapes. Part of `examples/peer.rs` and of `benches/train_step.rs`.

use anyhow::Context;
use auto_e2h::core::stream;
use auto_e2h::nn::candle_core::{Device, Tensor};
use auto_e2h::nn::{
    Adam, AdamConfig, Compute, Ema, EmaConfig, Mode, Weights, backward, load_weights, mse, no_grad,
};
use auto_e2h::policy::{Ddim, DiffusionModel, PolicyConfig, Prediction};
use rand::Rng;
use std::path::Path;

/// Which network.
#[derive(Clone, Copy, Debug, clap::ValueEnum)]
pub(crate) enum Size {
    /// ResNet-18 of width 16 on 64 x 64 pixels, U-Net 64, 128, 256, batch 32.
    Laptop,
    /// ResNet-18 of width 64 on 128 x 128 pixels, U-Net 256, 512, 1024, batch 4.
    Paper,
}

impl Size {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Size::Laptop => "laptop",
            Size::Paper => "paper",
        }
    }

    /// Floating-point operations of a training step at the size's batch, forward and backward, counted by torch's
    /// `FlopCounterMode`.
    fn flop(self) -> f64 {
        match self {
            Size::Laptop => 11.7e9,
            Size::Paper => 62.8e9,
        }
    }

    fn batch(self) -> usize {
        match self {
            Size::Laptop => 32,
            Size::Paper => 4,
        }
    }

    fn config(self) -> PolicyConfig {
        let (encoder_width, pixels, down_dims) = match self {
            Size::Laptop => (16, 64, vec![64, 128, 256]),
            Size::Paper => (64, 128, vec![256, 512, 1024]),
        };
        PolicyConfig {
            n_obs_steps: 2,
            n_image_steps: 2,
            cameras: vec!["table".to_owned(), "wrist".to_owned()],
            image_size: pixels,
            crop_size: pixels,
            share_encoder: true,
            encoder_width,
            encoder_blocks: vec![2, 2, 2, 2],
            keypoints: 32,
            image_features: 64,
            relative_features: false,
            down_dims,
            kernel_size: 5,
            n_groups: 8,
            step_embed_dim: 128,
            prediction: Prediction::Epsilon,
            train_timesteps: 100,
            inference_steps: 10,
            ..PolicyConfig::tiny()
        }
    }
}

/// Numbers in an action and in an observed state.
const ACTION: usize = 8;
const STATE: usize = 30;

/// What a step needs; vectors on the host.
struct Data {
    images: [Tensor; 2],
    state: Tensor,
    actions: Vec<f32>,
    noise: Vec<f32>,
    timesteps: Vec<f32>,
}

impl Data {
    /// Random data like PyTorch's.
    fn random(c: &PolicyConfig, b: usize, device: &Device) -> anyhow::Result<Self> {
        let mut rng = stream(0, "peer", 0, 0);
        let n = b * 2 * c.crop_size * c.crop_size * 3;
        let mut image = || {
            Tensor::from_vec(
                (0..n).map(|_| rng.random::<f32>()).collect::<Vec<_>>(),
                (b * 2, c.crop_size, c.crop_size, 3),
                device,
            )
        };
        let images = [image()?, image()?];
        let mut normal =
            |n: usize| -> Vec<f32> { (0..n).map(|_| rng.sample(rand_distr::StandardNormal)).collect() };
        let state = Tensor::from_vec(normal(b * STATE), (b, STATE), device)?;
        let (actions, noise) = (normal(b * c.horizon * ACTION), normal(b * c.horizon * ACTION));
        let timesteps = (0..b).map(|i| (i * 37 % 100) as f32).collect();
        Ok(Self { images, state, actions, noise, timesteps })
    }

    /// The data among dumped tensors; what is left of them are the weights.
    fn dumped(c: &PolicyConfig, all: &mut Weights, device: &Device) -> anyhow::Result<Self> {
        let mut take = |name: &str| {
            all.remove(name).with_context(|| format!("expected tensor `{name}` in the file, found none"))
        };
        let (images, state) = (take("images")?, take("state")?);
        let b = *state.shape.first().context("expected `state` of shape (B, 30), found a scalar")?;
        // The file has a sample's images in the order (step, camera).
        let one = c.crop_size * c.crop_size * 3;
        let camera = |camera: usize| {
            let data = images
                .data
                .chunks_exact(one)
                .skip(camera)
                .step_by(2)
                .flatten()
                .copied()
                .collect::<Vec<f32>>();
            Tensor::from_vec(data, (b * 2, c.crop_size, c.crop_size, 3), device)
        };
        Ok(Self {
            images: [camera(0)?, camera(1)?],
            state: Tensor::from_vec(state.data, (b, STATE), device)?,
            actions: take("actions")?.data,
            noise: take("noise")?.data,
            timesteps: take("timesteps")?.data,
        })
    }
}

/// A network, its optimiser and a batch.
pub(crate) struct Workload {
    size: Size,
    config: PolicyConfig,
    model: DiffusionModel,
    ddim: Ddim,
    adam: Adam,
    ema: Ema,
    data: Data,
    target: Tensor,
}

impl Workload {
    /// With the weights and data that `train_step.py --dump` wrote, or random ones.
    pub(crate) fn new(
        size: Size,
        batch: Option<usize>,
        dump: Option<&Path>,
        compute: &Compute,
    ) -> anyhow::Result<Self> {
        let (config, device) = (size.config(), compute.device());
        let model = DiffusionModel::new_on(compute, &config, Mode::Train, &mut stream(0, "weights", 0, 0))?;
        let data = match dump {
            Some(file) => {
                let (mut all, _) = load_weights(file)?;
                let data = Data::dumped(&config, &mut all, device)?;
                model.params().import(&all)?;
                data
            }
            None => Data::random(&config, batch.unwrap_or(size.batch()), device)?,
        };
        let ddim = Ddim::new(config.train_timesteps, config.inference_steps, config.prediction)?;
        let adam =
            AdamConfig { beta1: 0.9, weight_decay: 0.0, clip_norm: Some(1.0), ..AdamConfig::default() };
        let adam = Adam::new(&adam, model.params())?;
        // At this power the average moves by a thousandth from the second step on, as PyTorch's does.
        let ema = Ema::new(&EmaConfig { power: 20.0, max: 0.999 }, model.params())?;
        let shape = (data.timesteps.len(), config.horizon, ACTION);
        let target = Tensor::from_slice(&data.noise, shape, device)?;
        Ok(Self { size, config, model, ddim, adam, ema, data, target })
    }

    /// How many numbers the network has.
    pub(crate) fn parameters(&self) -> usize {
        self.model.params().count()
    }

    /// Observations in the batch.
    pub(crate) fn batch(&self) -> usize {
        self.data.timesteps.len()
    }

    /// Floating-point operations of [`Workload::step`].
    pub(crate) fn step_flop(&self) -> f64 {
        self.size.flop() * self.batch() as f64 / self.size.batch() as f64
    }

    /// Loss, gradients, Adam, moving average; returns the loss.
    pub(crate) fn step(&mut self) -> anyhow::Result<f32> {
        let (model, data) = (&self.model, &self.data);
        let mut noisy = data.actions.clone();
        let one = self.config.horizon * ACTION;
        let samples = noisy.chunks_exact_mut(one).zip(data.noise.chunks_exact(one));
        for ((x, e), t) in samples.zip(&data.timesteps) {
            self.ddim.add_noise(x, e, *t as usize);
        }
        let noisy = Tensor::from_vec(noisy, self.target.dims(), model.device())?;
        let condition = model.condition(&data.state, &data.images)?;
        let loss = mse(&model.forward(&noisy, &data.timesteps, &condition)?, &self.target, None)?;
        let grads = backward(&loss, model.params())?;
        self.adam.step(model.params(), &grads, 2e-4)?;
        self.ema.update(model.params())?;
        Ok(loss.to_scalar()?)
    }

    /// Encoder and U-Net once, nothing kept.
    pub(crate) fn forward(&self) -> anyhow::Result<()> {
        no_grad(|| {
            let condition = self.model.condition(&self.data.state, &self.data.images)?;
            self.model.forward(&self.target, &self.data.timesteps, &condition)?;
            Ok(())
        })
    }

    /// A sampler of `b` chunks of actions: encoder once, U-Net once a DDIM step.
    pub(crate) fn sampler(&self, b: usize) -> anyhow::Result<impl FnMut() -> anyhow::Result<()>> {
        let d = Data::random(&self.config, b, self.model.device())?;
        let shape = (b, self.config.horizon, ACTION);
        Ok(move || {
            let condition = no_grad(|| self.model.condition(&d.state, &d.images))?;
            let mut x = d.actions.clone();
            for s in self.ddim.steps() {
                let input = Tensor::from_slice(&x, shape, self.model.device())?;
                let timesteps = vec![s.timestep as f32; b];
                let output = no_grad(|| self.model.forward(&input, &timesteps, &condition))?;
                self.ddim.step(s, &output.flatten_all()?.to_vec1::<f32>()?, &mut x);
            }
            Ok(())
        })
    }
}
