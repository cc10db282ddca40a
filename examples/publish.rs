//! Publishes a policy on the Hugging Face hub, with its model card and curve.
//!
//! ```text
//! HF_TOKEN=... cargo run --release --features hub --example publish -- --repo me/nut runs/nut_assembly-laptop-0/iteration_03/policy
//! ```

use auto_e2h::core::say;
use auto_e2h::learn::hub::{Address, Publication, Settings, publish};
use clap::Parser;
use std::path::PathBuf;

/// Publishes a checkpoint folder as one commit.
#[derive(Parser)]
#[command(
    version,
    after_help = "Example:\n  HF_TOKEN=... cargo run --release --features hub --example publish -- --repo me/nut runs/nut_assembly-laptop-0/iteration_03/policy"
)]
struct Arguments {
    /// Folder with policy.json and model.safetensors; of a run, its results are published too.
    dir: PathBuf,
    /// Where to, as OWNER/NAME or OWNER/NAME@branch; made when it is not there.
    #[arg(long, value_name = "OWNER/NAME")]
    repo: Address,
    /// A repository that this makes can be seen by its owner alone.
    #[arg(long)]
    private: bool,
    /// Licence of the weights by its name on the hub, for example mit.
    #[arg(long)]
    license: Option<String>,
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    Ok(program()?)
}

fn program() -> anyhow::Result<()> {
    let a = Arguments::parse();
    let publication = Publication { address: a.repo, dir: a.dir, private: a.private, license: a.license };
    Ok(say(publish(&publication, &Settings::from_env())?)?)
}
