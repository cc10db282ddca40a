//! Our side of the comparison with PyTorch: the same network on the same data as `benches/peers/train_step.py`.
//!
//! ```text
//! cargo run --release --example peer -- --size laptop --json
//! ```

#![allow(clippy::print_stdout, reason = "what an example is for")]

use anyhow::{Context, bail};
use auto_e2h::core::stream;
use auto_e2h::nn::candle_core::{Device, Tensor};
use auto_e2h::nn::{Adam, AdamConfig, Ema, EmaConfig, Mode, Weights, backward, load_weights, mse, no_grad};
use auto_e2h::policy::{Ddim, DiffusionModel, PolicyConfig, Prediction};
use clap::{Parser, ValueEnum};
use rand::Rng;
use std::path::PathBuf;
use std::time::Instant;

/// Times a training step, a forward pass and sampling.
#[derive(Parser)]
struct Arguments {
    /// Which network.
    #[arg(long, value_enum, default_value = "laptop")]
    size: Size,
    /// Observations in a training batch (by default the size's).
    #[arg(long)]
    batch: Option<usize>,
    /// Threads.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// Runs of which the median is taken.
    #[arg(long, default_value_t = 15)]
    repeats: usize,
    /// Weights and data that `train_step.py --dump` wrote.
    #[arg(long, value_name = "FILE")]
    data: Option<PathBuf>,
    /// Print one JSON line and nothing else.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, ValueEnum)]
enum Size {
    /// ResNet-18 of width 16 on 64 x 64 pixels, U-Net 64, 128, 256, batch 32.
    Laptop,
    /// ResNet-18 of width 64 on 128 x 128 pixels, U-Net 256, 512, 1024, batch 4.
    Paper,
}

fn config(size: Size) -> (PolicyConfig, usize) {
    let (encoder_width, pixels, down_dims, batch) = match size {
        Size::Laptop => (16, 64, vec![64, 128, 256], 32),
        Size::Paper => (64, 128, vec![256, 512, 1024], 4),
    };
    let config = PolicyConfig {
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
    };
    (config, batch)
}

/// What a step needs, on the host.
struct Data {
    images: [Tensor; 2],
    state: Tensor,
    actions: Vec<f32>,
    noise: Vec<f32>,
    timesteps: Vec<f32>,
}

/// Random data like PyTorch's.
fn random(c: &PolicyConfig, b: usize) -> anyhow::Result<Data> {
    let mut rng = stream(0, "peer", 0, 0);
    let n = b * 2 * c.crop_size * c.crop_size * 3;
    let mut image = || {
        Tensor::from_vec(
            (0..n).map(|_| rng.random::<f32>()).collect::<Vec<_>>(),
            (b * 2, c.crop_size, c.crop_size, 3),
            &Device::Cpu,
        )
    };
    let images = [image()?, image()?];
    let mut normal =
        |n: usize| -> Vec<f32> { (0..n).map(|_| rng.sample(rand_distr::StandardNormal)).collect() };
    let state = Tensor::from_vec(normal(b * 30), (b, 30), &Device::Cpu)?;
    let (actions, noise) = (normal(b * 128), normal(b * 128));
    let timesteps = (0..b).map(|i| (i * 37 % 100) as f32).collect();
    Ok(Data { images, state, actions, noise, timesteps })
}

/// The data among dumped tensors; what is left of them are the weights.
fn dumped(c: &PolicyConfig, all: &mut Weights) -> anyhow::Result<Data> {
    let mut take = |name: &str| {
        all.remove(name).with_context(|| format!("expected tensor `{name}` in the file, found none"))
    };
    let (images, state) = (take("images")?, take("state")?);
    let b = state.shape[0];
    // The file has a sample's images in the order (step, camera).
    let one = c.crop_size * c.crop_size * 3;
    let camera = |camera: usize| {
        let data =
            images.data.chunks_exact(one).skip(camera).step_by(2).flatten().copied().collect::<Vec<f32>>();
        Tensor::from_vec(data, (b * 2, c.crop_size, c.crop_size, 3), &Device::Cpu)
    };
    Ok(Data {
        images: [camera(0)?, camera(1)?],
        state: Tensor::from_vec(state.data, (b, 30), &Device::Cpu)?,
        actions: take("actions")?.data,
        noise: take("noise")?.data,
        timesteps: take("timesteps")?.data,
    })
}

fn median(repeats: usize, mut run: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    for _ in 0..3 {
        run()?;
    }
    let mut times = Vec::with_capacity(repeats);
    for _ in 0..repeats {
        let start = Instant::now();
        run()?;
        times.push(1e3 * start.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    Ok((100.0 * times[times.len() / 2]).round() / 100.0)
}

/// Peak resident memory, MB; none where the system does not say.
fn peak_mb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? / 1024)
}

fn main() -> anyhow::Result<()> {
    let a = Arguments::parse();
    if a.repeats == 0 {
        bail!("--repeats: expected at least 1, got 0");
    }
    auto_e2h::nn::tune_allocator();
    auto_e2h::learn::set_threads(a.threads)?;
    let (config, batch) = config(a.size);
    let batch = a.batch.unwrap_or(batch);
    let model = DiffusionModel::new(&config, Mode::Train, &mut stream(0, "weights", 0, 0))?;
    let data = match &a.data {
        Some(file) => {
            let (mut all, _) = load_weights(file)?;
            let data = dumped(&config, &mut all)?;
            model.params().import(&all)?;
            data
        }
        None => random(&config, batch)?,
    };
    let b = data.timesteps.len();
    let shape = (b, config.horizon, 8);
    let ddim = Ddim::new(config.train_timesteps, config.inference_steps, config.prediction)?;
    let mut adam = Adam::new(
        &AdamConfig { beta1: 0.9, weight_decay: 0.0, clip_norm: Some(1.0), ..AdamConfig::default() },
        model.params(),
    )?;
    // At this power the average moves by a thousandth from the second step on, as PyTorch's does.
    let mut ema = Ema::new(&EmaConfig { power: 20.0, max: 0.999 }, model.params())?;
    let noisy = || {
        let mut noisy = data.actions.clone();
        for ((x, e), t) in noisy.chunks_exact_mut(128).zip(data.noise.chunks_exact(128)).zip(&data.timesteps)
        {
            ddim.add_noise(x, e, *t as usize);
        }
        Tensor::from_vec(noisy, shape, &Device::Cpu)
    };
    let target = Tensor::from_slice(&data.noise, shape, &Device::Cpu)?;
    let mut first = None;
    let mut step = || -> anyhow::Result<()> {
        let condition = model.condition(&data.state, &data.images)?;
        let loss = mse(&model.forward(&noisy()?, &data.timesteps, &condition)?, &target, None)?;
        first.get_or_insert(loss.to_scalar::<f32>()?);
        let grads = backward(&loss, model.params())?;
        adam.step(model.params(), &grads, 2e-4)?;
        Ok(ema.update(model.params())?)
    };
    let step_ms = median(a.repeats, &mut step)?;

    let actions = Tensor::from_slice(&data.actions, shape, &Device::Cpu)?;
    let forward_ms = median(a.repeats, || {
        no_grad(|| {
            let condition = model.condition(&data.state, &data.images)?;
            model.forward(&actions, &data.timesteps, &condition)?;
            Ok(())
        })
    })?;
    let sample_ms = |b: usize| -> anyhow::Result<f64> {
        let d = random(&config, b)?;
        median(a.repeats, || {
            let condition = no_grad(|| model.condition(&d.state, &d.images))?;
            let mut x = d.actions.clone();
            for s in ddim.steps() {
                let input = Tensor::from_slice(&x, (b, config.horizon, 8), &Device::Cpu)?;
                let output = no_grad(|| model.forward(&input, &vec![s.timestep as f32; b], &condition))?;
                ddim.step(s, &output.flatten_all()?.to_vec1::<f32>()?, &mut x);
            }
            Ok(())
        })
    };
    let (ddim1, ddim8) = (sample_ms(1)?, sample_ms(8)?);
    let size = if matches!(a.size, Size::Laptop) { "laptop" } else { "paper" };
    let (params, loss, peak) = (model.params().count(), first.unwrap_or(f32::NAN), peak_mb());
    if a.json {
        println!(
            "{}",
            serde_json::json!({
                "peer": concat!("auto-e2h ", env!("CARGO_PKG_VERSION")), "variant": "default", "size": size,
                "device": "cpu", "batch": b, "threads": a.threads, "params": params, "forward": forward_ms,
                "step": step_ms, "ddim1": ddim1, "ddim8": ddim8, "rss_mb": peak, "loss": loss,
            })
        );
    } else {
        println!("{size}: {params} parameters, batch {b}, {} thread(s)", a.threads);
        println!("  training step      {step_ms:8.2} ms   (loss of the first {loss:.6})");
        println!("  forward            {forward_ms:8.2} ms");
        println!("  sampling, 1        {ddim1:8.2} ms");
        println!("  sampling, 8        {ddim8:8.2} ms");
        println!("  peak memory        {:8} MB", peak.unwrap_or(0));
    }
    Ok(())
}
