//! Draws the demonstration curve: success before and after the loop against the number of easy demonstrations.
//!
//! ```text
//! cargo run --release --example curve -- checkpoints/curve/cube_pick_place
//! ```
//!
//! Reads the `results.json` of runs (files, or folders with such files in them), writes `curve.svg` beside the first, and prints
//! the table.

use anyhow::{Context as _, bail};
use auto_e2h::core::say;
use auto_e2h::report::record::RunResults;
use auto_e2h::report::{self, curve};
use clap::Parser;
use std::path::{Path, PathBuf};

/// Draws success against the number of easy demonstrations, before and after the loop.
#[derive(Parser)]
#[command(
    version,
    after_help = "Example:\n  cargo run --release --example curve -- checkpoints/curve/cube_pick_place"
)]
struct Arguments {
    /// Results of runs of one pair: JSON files, run directories, or folders of either.
    #[arg(required = true)]
    results: Vec<PathBuf>,
    /// Where the drawing goes (by default curve.svg in the first folder).
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    let mut runs = vec![];
    for path in &a.results {
        let before = runs.len();
        find(path, &mut runs)?;
        if runs.len() == before {
            bail!("{}: no results of a run (results.json) in it", path.display());
        }
    }
    let of = |r: &RunResults| (r.task.clone(), r.variant.clone());
    let first = of(&runs[0]);
    if let Some(other) = runs.iter().find(|r| of(r) != first) {
        bail!("results of one pair are drawn together: expected {first:?}, found {:?}", of(other));
    }
    let out = a.out.unwrap_or_else(|| {
        let first = &a.results[0];
        let folder = if first.is_dir() { first } else { first.parent().unwrap_or(Path::new(".")) };
        folder.join("curve.svg")
    });
    let runs: Vec<&RunResults> = runs.iter().collect();
    report::write_svg(&out, &curve::demonstration_curve(&runs))?;
    say(curve::table(&runs))?;
    say(format_args!("{} runs: {}", runs.len(), out.display()))?;
    Ok(())
}

/// The results at a path: a file, the `results.json` of a run directory, or all JSON files and run directories of a folder.
fn find(path: &Path, runs: &mut Vec<RunResults>) -> anyhow::Result<()> {
    let own = path.join("results.json");
    if path.is_file() || own.is_file() {
        let file = if own.is_file() { &own } else { path };
        let text = std::fs::read_to_string(file).with_context(|| format!("reading {}", file.display()))?;
        let run: RunResults =
            serde_json::from_str(&text).with_context(|| format!("{} is no results.json", file.display()))?;
        if run.demonstrations == 0 {
            bail!("{}: it does not say how many demonstrations it began with", file.display());
        }
        runs.push(run);
        return Ok(());
    }
    let entries = std::fs::read_dir(path).with_context(|| format!("reading {}", path.display()))?;
    let mut inside: Vec<PathBuf> = entries.map(|e| Ok(e?.path())).collect::<std::io::Result<_>>()?;
    inside.sort();
    for path in inside {
        if path.extension().is_some_and(|e| e == "json") || path.join("results.json").is_file() {
            find(&path, runs)?;
        }
    }
    Ok(())
}
