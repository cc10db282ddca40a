//! Draws every task pair: at a start of the hard task, just before the decisive moment, and at the goal; the table camera
//! above, the wrist camera below.
//!
//! ```text
//! cargo run --release --example gallery                               # into runs/gallery
//! cargo run --release --example gallery -- --out crates/env/pictures  # what the README shows
//! ```

use anyhow::{Context, Result};
use clap::Parser;
use e2h_core::{Direction, Image, say, stream};
use e2h_env::{DemonstratorConfig, Env, EnvConfig, MOST_PIXELS, Style, TaskOptions, registry, task};
use std::path::{Path, PathBuf};

/// Draws every task pair.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example gallery\n  cargo run --release --example gallery -- --out crates/env/pictures"
)]
struct Arguments {
    /// Folder for one PNG per pair.
    #[arg(long, value_name = "DIR", default_value = "runs/gallery")]
    out: PathBuf,
    /// One pair instead of all.
    #[arg(long)]
    task: Option<String>,
    /// Side of each picture, pixels.
    #[arg(long, default_value_t = 144, value_parser = side)]
    size: usize,
    /// Seed of the start.
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

fn side(text: &str) -> Result<usize, String> {
    let side = text.parse::<usize>().ok().filter(|side| (1..=MOST_PIXELS).contains(side));
    side.ok_or_else(|| format!("expected 1 to {MOST_PIXELS} pixels"))
}

/// Control steps before the release, or before success where nothing is released.
const BEFORE: usize = 16;
const GAP: usize = 3;

fn main() -> Result<(), e2h_core::Failure> {
    Ok(program()?)
}

fn program() -> Result<()> {
    let arguments = Arguments::parse();
    std::fs::create_dir_all(&arguments.out).with_context(|| format!("making {}", arguments.out.display()))?;
    let names: Vec<&str> = match &arguments.task {
        Some(name) => vec![name],
        None => registry().to_vec(),
    };
    let mut written = vec![];
    for name in names {
        let path = arguments.out.join(format!("{name}.png"));
        let columns = draw(name, arguments.size, arguments.seed)?;
        write(&path, &columns).with_context(|| format!("writing {}", path.display()))?;
        written.push(path);
    }
    for path in written {
        say(path.display())?;
    }
    Ok(())
}

/// Pictures of a demonstration: one column per moment, one row per camera.
fn draw(name: &str, size: usize, seed: u64) -> Result<Vec<[Image; 2]>> {
    let task = task(name, &TaskOptions::default())?;
    let mut env = Env::new(task.clone(), &EnvConfig::physics(&*task))?;
    let mut rng = stream(seed, "gallery", 0, 0);
    env.reset(Direction::Hard, &mut rng)?;
    let mut expert = task.expert(Direction::Hard, &DemonstratorConfig::clean(), &mut rng);
    let mut states = vec![env.save()];
    let (mut closed, mut succeeded) = (None, None);
    while !expert.done() && states.len() < env.horizon(Direction::Hard) {
        let action = expert.act(env.sim());
        env.step(&action)?;
        if !env.sim().opens() {
            closed = Some(states.len());
        }
        if env.success(Direction::Hard) {
            succeeded.get_or_insert(states.len());
        }
        states.push(env.save());
    }
    let decisive = closed.filter(|_| task.homes()).or(succeeded).unwrap_or(0).saturating_sub(BEFORE);
    let shadows = Style { shadows: true };
    [0, decisive, states.len() - 1]
        .into_iter()
        .map(|moment| {
            env.restore(&states[moment])?;
            let table = env.render_styled("table", size, size, shadows)?;
            Ok([table, env.render_styled("wrist", size, size, shadows)?])
        })
        .collect()
}

fn write(path: &Path, columns: &[[Image; 2]]) -> Result<()> {
    let size = columns.first().map_or(0, |c| c[0].width);
    let pitch = size + GAP;
    let (width, height) = (columns.len() * pitch - GAP, 2 * pitch - GAP);
    let mut data = vec![255; width * height * 3];
    for (x, column) in columns.iter().enumerate() {
        for (y, image) in column.iter().enumerate() {
            for (row, pixels) in image.data.chunks_exact(size * 3).enumerate() {
                let at = ((y * pitch + row) * width + x * pitch) * 3;
                data[at..at + size * 3].copy_from_slice(pixels);
            }
        }
    }
    let file = std::io::BufWriter::new(std::fs::File::create(path)?);
    let mut encoder = png::Encoder::new(file, u32::try_from(width)?, u32::try_from(height)?);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::High);
    encoder.write_header()?.write_image_data(&data)?;
    Ok(())
}
