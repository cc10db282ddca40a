//! One self-contained page of a dataset or a run: every episode, playable, with filters.
//!
//! ```text
//! cargo run --release --example view -- runs/nut_assembly-laptop-0
//! cargo run --release --example view -- recordings/unplug --out unplug.html --episodes 50
//! ```

use auto_e2h::core::say;
use auto_e2h::data::lerobot::ColumnSlice;
use auto_e2h::report::view::{Options, VIEW_FILE, write, write_scalars};
use clap::Parser;
use std::path::PathBuf;
use std::time::UNIX_EPOCH;

/// Writes an HTML page of every episode of a dataset or a run.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example view -- runs/nut_assembly-laptop-0\n  cargo run --release --example view -- recordings/unplug --out unplug.html --episodes 50"
)]
struct Arguments {
    /// A LeRobotDataset v3.0 or a run directory.
    dir: PathBuf,
    /// The page (by default DIR/view.html).
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Most episodes on the page; of more, evenly spread ones.
    #[arg(long, default_value_t = Options::default().episodes)]
    episodes: usize,
    /// Rows from one picture to the next (by default what fits the page).
    #[arg(long)]
    stride: Option<usize>,
    /// Size of the page, MB; pictures that do not fit are left out.
    #[arg(long, default_value_t = Options::default().megabytes)]
    megabytes: f64,
    /// Position of the tool in a dataset, m, for its speed (by default found by name).
    #[arg(long, value_name = "COLUMN[a:b]")]
    position: Option<ColumnSlice>,
    /// Write TensorBoard event files into this folder too.
    #[arg(long, value_name = "OUT")]
    tensorboard: Option<PathBuf>,
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    let out = a.out.unwrap_or_else(|| a.dir.join(VIEW_FILE));
    let options =
        Options { episodes: a.episodes, stride: a.stride, megabytes: a.megabytes, position: a.position };
    let page = write(&a.dir, &out, &options)?;
    let mut values = None;
    if let Some(folder) = a.tensorboard {
        // What was measured is dated by its own files, not by the moment of looking at it.
        let files = ["results.json", "run.json", "meta/info.json"].map(|f| a.dir.join(f));
        let time = files.iter().find_map(|f| f.metadata().ok()?.modified().ok()).unwrap_or(UNIX_EPOCH);
        let time = time.duration_since(UNIX_EPOCH)?.as_secs_f64();
        values = Some(format!("{}: {} values", folder.display(), write_scalars(&a.dir, &folder, time)?));
    }
    say(format_args!(
        "{}: {} of {} episodes, {:.1} MB",
        page.path.display(),
        page.shown,
        page.episodes,
        page.bytes as f64 / 1e6
    ))?;
    for line in page.left_out {
        say(format_args!("  {line}"))?;
    }
    Ok(values.map_or(Ok(()), say)?)
}
