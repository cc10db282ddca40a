//! Our side of the comparison with PyTorch: the same network on the same data as `benches/peers/train_step.py`.
//!
//! ```text
//! cargo run --release --example peer -- --size laptop --json
//! ```

#[path = "../benches/peers/workload.rs"]
mod workload;

use anyhow::bail;
use auto_e2h::core::say;
use auto_e2h::nn::candle_core::Tensor;
use auto_e2h::nn::{Compute, Precision, candle_operations};
use clap::Parser;
use std::path::PathBuf;
use std::time::Instant;
use workload::{Size, Workload};

/// Times a training step, a forward pass and sampling.
#[derive(Parser)]
#[command(version, after_help = "Example:\n  cargo run --release --example peer -- --size laptop --json")]
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
    /// Where the networks are computed: cpu, cuda or cuda:N.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Products of f32 on tensor cores.
    #[arg(long)]
    tf32: bool,
    /// Factors of products in bf16.
    #[arg(long)]
    bf16: bool,
    /// Compute with Candle's operations instead of our kernels, whatever the device.
    #[arg(long)]
    candle: bool,
    /// Also time Candle's product of two 2048 x 2048 matrices, and say what share of its rate a training step reaches.
    #[arg(long, conflicts_with = "json")]
    roofline: bool,
    /// Print one JSON line and nothing else.
    #[arg(long)]
    json: bool,
}

/// Milliseconds, with what the device still has to do after a run.
fn median(
    repeats: usize,
    compute: &Compute,
    mut run: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<f64> {
    for _ in 0..3 {
        run()?;
    }
    compute.synchronize()?;
    let mut times = Vec::with_capacity(repeats);
    for _ in 0..repeats {
        let start = Instant::now();
        run()?;
        compute.synchronize()?;
        times.push(1e3 * start.elapsed().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    Ok((100.0 * times[times.len() / 2]).round() / 100.0)
}

/// Operations a second of a large matrix product.
fn product_rate(repeats: usize, compute: &Compute) -> anyhow::Result<f64> {
    const N: usize = 2048;
    let a = Tensor::rand(-1f32, 1., (N, N), compute.device())?;
    let b = Tensor::rand(-1f32, 1., (N, N), compute.device())?;
    let ms = median(repeats, compute, || {
        a.matmul(&b)?;
        Ok(())
    })?;
    Ok(2.0 * (N as f64).powi(3) / (1e-3 * ms))
}

/// Peak resident memory, MB; none where the system does not say.
fn peak_mb() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM"))?;
    Some(line.split_whitespace().nth(1)?.parse::<u64>().ok()? / 1024)
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    if a.candle { candle_operations(|| measure(&a)) } else { measure(&a) }
}

fn measure(a: &Arguments) -> anyhow::Result<()> {
    if a.repeats == 0 {
        bail!("--repeats: expected at least 1, got 0");
    }
    auto_e2h::nn::tune_allocator();
    auto_e2h::learn::set_threads(a.threads)?;
    let compute = Compute::open(&a.device, Precision { tf32: a.tf32, bf16: a.bf16 })?;
    let mut work = Workload::new(a.size, a.batch, a.data.as_deref(), &compute)?;

    let mut first = None;
    let step = median(a.repeats, &compute, || {
        let loss = work.step()?;
        first.get_or_insert(loss);
        Ok(())
    })?;
    let forward = median(a.repeats, &compute, || work.forward())?;
    let ddim1 = median(a.repeats, &compute, work.sampler(1)?)?;
    let ddim8 = median(a.repeats, &compute, work.sampler(8)?)?;

    let (size, batch, params) = (a.size.name(), work.batch(), work.parameters());
    let (loss, peak) = (first.unwrap_or(f32::NAN), peak_mb());
    if a.json {
        say(serde_json::json!({
                "peer": concat!("auto-e2h ", env!("CARGO_PKG_VERSION")), "variant": "default", "size": size,
                "device": compute.name(), "tf32": a.tf32, "bf16": a.bf16, "batch": batch, "threads": a.threads, "params": params, "forward": forward,
                "step": step, "ddim1": ddim1, "ddim8": ddim8, "rss_mb": peak, "loss": loss,
        }))?;
    } else {
        say(format_args!(
            "{size}: {params} parameters, batch {batch}, {} thread(s), {}",
            a.threads,
            compute.name()
        ))?;
        say(format_args!("  training step      {step:8.2} ms   (loss of the first {loss:.6})"))?;
        say(format_args!("  forward            {forward:8.2} ms"))?;
        say(format_args!("  sampling, 1        {ddim1:8.2} ms"))?;
        say(format_args!("  sampling, 8        {ddim8:8.2} ms"))?;
        say(format_args!("  peak memory        {:8} MB", peak.unwrap_or(0)))?;
        if a.roofline {
            let (product, reached) = (product_rate(a.repeats, &compute)?, work.step_flop() / (1e-3 * step));
            say(format_args!("  matrix product     {:8.1} GFLOP/s", 1e-9 * product))?;
            say(format_args!(
                "  training step      {:8.1} GFLOP/s, {:.0} % of it",
                1e-9 * reached,
                100.0 * reached / product
            ))?;
        }
    }
    Ok(())
}
