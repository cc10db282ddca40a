//! Shows that a warm training step takes no more memory: resident set at step 200 and at the last.
//!
//! ```text
//! cargo run --release -p e2h-nn --example flat_memory -- 2000
//! ```

use candle_core::{Device, Tensor};
use clap::Parser;
use e2h_nn::{
    Adam, AdamConfig, ConditionalUnet1d, Ema, EmaConfig, Mode, Params, RgbEncoder, RgbEncoderConfig,
    UnetConfig, backward, mse, repeat_rows,
};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Resident set and page faults so far, from `/proc` (zero elsewhere).
fn memory() -> (f64, u64) {
    let pages = |f: &str, i: usize| -> u64 {
        let text = std::fs::read_to_string(f).unwrap_or_default();
        text.split_whitespace().nth(i).and_then(|v| v.parse().ok()).unwrap_or_default()
    };
    (pages("/proc/self/statm", 1) as f64 * 4096.0 / 1e6, pages("/proc/self/stat", 9))
}

/// Shows that a warm training step takes no more memory.
#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release -p e2h-nn --example flat_memory -- 2000")]
struct Arguments {
    /// Training steps.
    #[arg(default_value_t = 2000)]
    steps: usize,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    e2h_nn::tune_allocator();
    let Arguments { steps } = Arguments::parse();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let encoder = RgbEncoderConfig {
        height: 48,
        width: 48,
        base_width: 16,
        stage_blocks: vec![1, 1],
        keypoints: 16,
        feature_dim: 32,
    };
    let unet = UnetConfig {
        input_dim: 8,
        down_dims: vec![32, 64],
        kernel_size: 5,
        n_groups: 8,
        step_embed_dim: 32,
        cond_dim: 32,
    };
    let (params, (encoder, unet)) = Params::build(Mode::Train, &mut rng, |b| {
        Ok((RgbEncoder::new(&encoder, &b.pp("rgb_encoder"))?, ConditionalUnet1d::new(&unet, &b.pp("unet"))?))
    })?;
    let mut adam = Adam::new(&AdamConfig::default(), &params)?;
    let mut ema = Ema::new(&EmaConfig::default(), &params)?;
    let start = std::time::Instant::now();
    let mut random = |shape: &[usize]| {
        let data: Vec<f32> = (0..shape.iter().product()).map(|_| rng.random()).collect();
        Tensor::from_vec(data, shape, &Device::Cpu)
    };
    for step in 1..=steps {
        let (images, x) = (random(&[16, 48, 48, 3])?, random(&[64, 16, 8])?);
        let timesteps: Vec<f32> = (0..64).map(|i| ((i * 7 + step) % 100) as f32).collect();
        let cond = repeat_rows(&encoder.forward(&images)?, 4)?;
        let loss = mse(&unet.forward(&x, &timesteps, &cond)?, &x, None)?;
        adam.step(&params, &backward(&loss, &params)?, 1e-4)?;
        ema.update(&params)?;
        if step == 20 || step == 200 || step == steps {
            let (mb, faults) = memory();
            let each = start.elapsed().as_secs_f64() * 1e3 / step as f64;
            e2h_core::say(format_args!(
                "step {step}: {mb:.1} MB resident, {faults} page faults, {each:.1} ms a step"
            ))?;
        }
    }
    Ok(())
}
