//! Layers of candle-nn and of this crate in one network, under one optimiser: tells the frequency of a noisy wave.
//!
//! ```text
//! cargo run --release -p e2h-nn --example mixed_network      # a second
//! ```
//!
//! It ends with an error of about 0.06, of frequencies from 1 to 6. (candle-nn's own `Conv1d` would learn from a wrong gradient.)

use clap::Parser;
use e2h_nn::candle_core::{DType, Device, Module, Result, Tensor};
use e2h_nn::candle_nn::{self, VarBuilder, VarMap};
use e2h_nn::rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use e2h_nn::{Act, Adam, AdamConfig, Builder, Conv1d, GroupNorm, Mode, Params, backward, mse};
use rand::Rng;
use std::f32::consts::TAU;

/// Samples of a wave.
const LENGTH: usize = 48;

struct Net {
    conv: Conv1d,
    norm: GroupNorm,
    hidden: candle_nn::Linear,
    out: candle_nn::Linear,
}

impl Net {
    fn new(b: &Builder<'_>) -> e2h_nn::Result<Self> {
        let theirs = b.var_builder();
        Ok(Self {
            conv: Conv1d::new(1, 32, 7, 2, 3, &b.pp("conv"))?,
            norm: GroupNorm::new(8, 32, Act::Mish, &b.pp("norm"))?,
            hidden: candle_nn::linear(32 * LENGTH / 2, 32, theirs.pp("hidden"))?,
            out: candle_nn::linear(32, 1, theirs.pp("out"))?,
        })
    }
}

impl Module for Net {
    /// Shapes: (B, LENGTH, 1) to (B, 1).
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let h = self.norm.forward(&self.conv.forward(x)?, None)?;
        self.out.forward(&self.hidden.forward(&h.flatten_from(1)?)?.relu()?)
    }
}

/// Waves (n, LENGTH, 1) and their frequencies (n, 1).
fn waves(n: usize, rng: &mut ChaCha8Rng) -> Result<(Tensor, Tensor)> {
    let (mut x, mut y) = (vec![], vec![]);
    for _ in 0..n {
        let (frequency, phase) = (rng.random_range(1.0..6.0), rng.random_range(0.0..TAU));
        let at = |i: usize| (TAU * frequency * i as f32 / LENGTH as f32 + phase).sin();
        x.extend((0..LENGTH).map(|i| at(i) + rng.random_range(-0.1..0.1)));
        y.push(frequency);
    }
    Ok((Tensor::from_vec(x, (n, LENGTH, 1), &Device::Cpu)?, Tensor::from_vec(y, (n, 1), &Device::Cpu)?))
}

/// Trains layers of candle-nn and of this crate together.
#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release -p e2h-nn --example mixed_network")]
struct Arguments {}

fn main() -> std::result::Result<(), Box<dyn std::error::Error>> {
    let Arguments {} = Arguments::parse();
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let (params, net) = Params::build(Mode::Train, &mut rng, Net::new)?;
    let mut adam = Adam::new(&AdamConfig::default(), &params)?;
    for step in 0..=600 {
        let (x, y) = waves(64, &mut rng)?;
        let loss = mse(&net.forward(&x)?, &y, None)?;
        adam.step(&params, &backward(&loss, &params)?, 2e-3)?;
        if step % 200 == 0 {
            e2h_core::say(format_args!("step {step:3}  loss {:.4}", loss.to_scalar::<f32>()?))?;
        }
    }

    // Through Candle's store into a network that starts from other numbers.
    let map = VarMap::new();
    params.export_to(&map)?;
    let (copy, acting) = Params::build(Mode::Infer, &mut rng, Net::new)?;
    copy.import_from(&VarBuilder::from_varmap(&map, DType::F32, &Device::Cpu))?;
    let (x, y) = waves(256, &mut rng)?;
    let error = (acting.forward(&x)? - y)?.sqr()?.mean_all()?.sqrt()?.to_scalar::<f32>()?;
    e2h_core::say(format_args!("{} parameters, error {error:.3}", map.all_vars().len()))?;
    Ok(())
}
