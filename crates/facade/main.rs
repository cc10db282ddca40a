//! The front door: what there is, how to run it, and what this machine has for it.
//!
//! ```text
//! cargo run --release
//! cargo run --release -- doctor
//! ```

mod doctor;
mod list;

use auto_e2h::core::Failure;
use clap::{Parser, Subcommand};

/// Learning hard manipulation from easy, reversed tasks.
///
/// Without a command: what there is in this checkout, and how to run it.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release               # tasks, presets, trained policies, programs\n  \
                  cargo run --release -- doctor     # what this machine has"
)]
struct Arguments {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    /// Lists tasks, presets, trained policies with their successes, and all programs with the commands that start them.
    List,
    /// Says what this machine has: the MuJoCo library, threads and vector units, GPU, ffmpeg, folders.
    Doctor,
}

fn main() -> Result<(), Failure> {
    match Arguments::parse().command.unwrap_or(Command::List) {
        Command::List => list::list(),
        Command::Doctor => doctor::doctor(),
    }
}
