//! From recordings of an easy task to a policy of the hard one that is served: a robot that the framework knows nothing of.
//!
//! ```text
//! examples/real_robot/run.sh runs/real_robot            # all of it; crates/refine/REAL_ROBOT.md follows it
//! cargo run --release --example real_robot -- record --episodes 30 --out recordings/unplug
//! cargo run --release --example real_robot -- run --server ws://127.0.0.1:8000 --trials 20
//! ```

mod client;
mod record;
mod robot;

use clap::{Parser, Subcommand};
use std::path::PathBuf;

/// A simulated robot with its own units, its own order of numbers and 30 Hz: records the easy task, runs a served policy of the
/// hard one.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  examples/real_robot/run.sh runs/real_robot\n  cargo run --release --example real_robot -- record --episodes 30 --out recordings/unplug"
)]
struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// Records the easy task, the plug being pulled out, as a LeRobotDataset.
    Record {
        /// Episodes.
        #[arg(long, default_value_t = 30)]
        episodes: usize,
        /// Seed of where the plug is put, and of how shaky the hand is.
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Folder of the dataset.
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// Lets a policy server put the plug in, and counts successes.
    Run {
        /// Address of the server.
        #[arg(long, value_name = "URL", default_value = "ws://127.0.0.1:8000")]
        server: String,
        /// Trials.
        #[arg(long, default_value_t = 20)]
        trials: usize,
        /// Seed of where the plug lies.
        #[arg(long, default_value_t = 1000)]
        seed: u64,
        /// Write an animation (a .png that plays) of the first trials.
        #[arg(long, value_name = "FILE")]
        video: Option<PathBuf>,
    },
}

fn main() -> Result<(), auto_e2h::core::Failure> {
    match Arguments::parse().what {
        What::Record { episodes, seed, out } => record::record(&out, episodes, seed)?,
        What::Run { server, trials, seed, video } => client::run(&server, trials, seed, video.as_deref())?,
    }
    Ok(())
}
