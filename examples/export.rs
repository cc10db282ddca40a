//! Writes a policy for LeRobot, or makes one of ours of a policy of LeRobot's.
//!
//! ```text
//! cargo run --release --example export -- --checkpoint runs/x/iteration_03/policy --lerobot published
//! cargo run --release --example export -- --from-lerobot downloaded --out checkpoint
//! ```
//!
//! Needs neither Python nor LeRobot. What LeRobot cannot express is listed, and nothing is written then. Policies of
//! `--preset paper --set policy.lerobot_alignment=true --set policy.n_action_steps=8` go both ways.

use anyhow::{Context, bail};
use auto_e2h::core::say;
use auto_e2h::policy::lerobot;
use clap::Parser;
use std::path::{Path, PathBuf};

/// Converts diffusion policies to and from LeRobot 0.4.4.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example export -- --checkpoint runs/x/iteration_03/policy --lerobot published\n  cargo run --release --example export -- --from-lerobot downloaded --out checkpoint"
)]
struct Arguments {
    /// Our checkpoint: a folder with policy.json and model.safetensors.
    #[arg(long, value_name = "DIR", requires = "lerobot", conflicts_with_all = ["from_lerobot", "out"])]
    checkpoint: Option<PathBuf>,
    /// Folder to write for LeRobot; new or empty.
    #[arg(long, value_name = "DIR", requires = "checkpoint")]
    lerobot: Option<PathBuf>,
    /// LeRobot's checkpoint: a folder with config.json (its `pretrained_model`).
    #[arg(long, value_name = "DIR", requires = "out")]
    from_lerobot: Option<PathBuf>,
    /// Folder to write our checkpoint to; new or empty.
    #[arg(long, value_name = "DIR", requires = "from_lerobot")]
    out: Option<PathBuf>,
    /// Print one JSON line and nothing else.
    #[arg(long)]
    json: bool,
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    match (&a.checkpoint, &a.lerobot, &a.from_lerobot, &a.out) {
        (Some(from), Some(to), ..) => to_lerobot(from, to, a.json),
        (.., Some(from), Some(to)) => from_lerobot(from, to, a.json),
        _ => bail!("expected --checkpoint DIR --lerobot DIR, or --from-lerobot DIR --out DIR"),
    }
}

fn to_lerobot(from: &Path, to: &Path, json: bool) -> anyhow::Result<()> {
    let done = lerobot::export(from, to)?;
    if json {
        say(serde_json::json!({"lerobot": to, "files": done.files, "notes": done.notes}))?;
        return Ok(());
    }
    say(format_args!("{}: {}", to.display(), done.files.join(", ")))?;
    for note in &done.notes {
        say(format_args!("note: {note}"))?;
    }
    say(format_args!("LeRobot: DiffusionPolicy.from_pretrained(\"{}\")", to.display()))?;
    Ok(())
}

fn from_lerobot(from: &Path, to: &Path, json: bool) -> anyhow::Result<()> {
    let opened = lerobot::import(from)?;
    let (state, action) = (opened.state_dim(), opened.action_dim());
    let cameras: Vec<String> = opened.cameras().map(str::to_owned).collect();
    if std::fs::read_dir(to).is_ok_and(|mut entries| entries.next().is_some()) {
        bail!("{}: expected a new or an empty folder, found files in it", to.display());
    }
    let (policy, provenance) = opened.into_policy()?;
    policy.save(to, &provenance).with_context(|| to.display().to_string())?;
    if json {
        say(serde_json::json!({"out": to, "parameters": policy.parameters(), "config": policy.config()}))?;
        return Ok(());
    }
    say(format_args!(
        "{}: {} parameters, state of {state}, action of {action}, cameras {cameras:?}",
        to.display(),
        policy.parameters()
    ))?;
    Ok(())
}
