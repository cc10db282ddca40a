//! Times of the networks, in milliseconds.
//!
//! ```text
//! cargo run --release -p e2h-nn --example speed -- 2 encoder
//! ```

use candle_core::{Device, Tensor};
use clap::Parser;
use e2h_nn::{
    Adam, AdamConfig, Builder, ConditionalUnet1d, Ema, EmaConfig, Mode, Params, Result, RgbEncoder,
    RgbEncoderConfig, UnetConfig, backward, mse,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::sync::OnceLock;
use std::time::Instant;

/// Milliseconds that all threads of this process were on a processor, from `/proc` (zero elsewhere).
fn cpu_ms() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let stats = tasks.filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok());
    stats.filter_map(|s| s.split_whitespace().next()?.parse::<f64>().ok()).sum::<f64>() / 1e6
}

/// Least and middle of some runs, after two that warm up, and their mean processor time.
fn time(what: &str, runs: usize, mut f: impl FnMut() -> Result<()>) -> Result<()> {
    if PART.get().is_some_and(|part| !what.contains(part.as_str())) {
        return Ok(());
    }
    let mut all = Vec::with_capacity(runs);
    let mut cpu = 0.0;
    for i in 0..runs + 2 {
        if i == 2 {
            cpu = cpu_ms();
        }
        let start = Instant::now();
        f()?;
        if i > 1 {
            all.push(start.elapsed().as_secs_f64() * 1e3);
        }
    }
    let cpu = (cpu_ms() - cpu) / runs as f64;
    all.sort_by(f64::total_cmp);
    e2h_core::say(format_args!(
        "{what:<60} least {:8.2}  middle {:8.2}  processor {cpu:8.2}",
        all[0],
        all[all.len() / 2]
    ))
    .map_err(candle_core::Error::from)?;
    Ok(())
}

fn random(shape: &[usize], rng: &mut ChaCha8Rng) -> Result<Tensor> {
    let data: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random::<f32>()).collect();
    Ok(Tensor::from_vec(data, shape, &Device::Cpu)?)
}

fn unet(dims: &[usize]) -> UnetConfig {
    UnetConfig {
        input_dim: 8,
        down_dims: dims.to_vec(),
        kernel_size: 5,
        n_groups: 8,
        step_embed_dim: 64,
        cond_dim: 160,
    }
}

fn all() -> Result<()> {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    for blocks in [vec![2, 2], vec![2, 2, 2, 2]] {
        let config = RgbEncoderConfig {
            height: 64,
            width: 64,
            base_width: 16,
            stage_blocks: blocks.clone(),
            keypoints: 32,
            feature_dim: 64,
        };
        let x = random(&[64, 64, 64, 3], &mut rng)?;
        let target = random(&[64, 64], &mut rng)?;
        let build = |b: &Builder<'_>| RgbEncoder::new(&config, b);
        let (params, net) = Params::build(Mode::Train, &mut rng, build)?;
        time(&format!("encoder 16 {blocks:?}, 64 images of 64x64, both passes"), 15, || {
            backward(&mse(&net.forward(&x)?, &target, None)?, &params).map(drop)
        })?;
        let (_, net) = Params::build(Mode::Infer, &mut rng, build)?;
        for n in [2, 16, 64] {
            let x = x.narrow(0, 0, n)?;
            time(&format!("encoder 16 {blocks:?}, {n} images, inference"), 30, || net.forward(&x).map(drop))?;
        }
    }
    for dims in [[64, 128, 256], [32, 64, 128]] {
        let config = unet(&dims);
        let build = |b: &Builder<'_>| ConditionalUnet1d::new(&config, b);
        let (params, net) = Params::build(Mode::Train, &mut rng, build)?;
        let b = 128;
        let x = random(&[b, 16, 8], &mut rng)?;
        let cond = random(&[b, 160], &mut rng)?;
        let steps: Vec<f32> = (0..b).map(|i| (i % 100) as f32).collect();
        e2h_core::say(format_args!("u-net {dims:?}: {} parameters", params.count()))
            .map_err(candle_core::Error::from)?;
        time(&format!("u-net {dims:?}, batch {b}, both passes"), 15, || {
            backward(&mse(&net.forward(&x, &steps, &cond)?, &x, None)?, &params).map(drop)
        })?;
        let grads = backward(&mse(&net.forward(&x, &steps, &cond)?, &x, None)?, &params)?;
        let mut adam = Adam::new(&AdamConfig::default(), &params)?;
        let mut ema = Ema::new(&EmaConfig::default(), &params)?;
        time(&format!("u-net {dims:?}, Adam and average"), 30, || {
            adam.step(&params, &grads, 0.0)?;
            ema.update(&params)
        })?;
        let (_, net) = Params::build(Mode::Infer, &mut rng, build)?;
        for n in [1, 8, 16] {
            let (x, cond) = (x.narrow(0, 0, n)?, cond.narrow(0, 0, n)?);
            time(&format!("u-net {dims:?}, batch {n}, inference"), 60, || {
                net.forward(&x, &steps[..n], &cond).map(drop)
            })?;
        }
    }
    Ok(())
}

/// Times the networks.
#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release -p e2h-nn --example speed -- 2 encoder")]
struct Arguments {
    /// Threads (by default one per core).
    threads: Option<usize>,
    /// Times only what has this in its name.
    part: Option<String>,
}

/// What is timed.
static PART: OnceLock<String> = OnceLock::new();

fn main() -> std::result::Result<(), Box<dyn std::error::Error>> {
    e2h_nn::tune_allocator();
    let Arguments { threads, part } = Arguments::parse();
    if let Some(n) = threads {
        rayon::ThreadPoolBuilder::new().num_threads(n).build_global()?;
    }
    PART.get_or_init(|| part.unwrap_or_default());
    e2h_core::say(format_args!("{} threads", rayon::current_num_threads()))?;
    Ok(all()?)
}
