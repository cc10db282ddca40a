//! Looks for damage in a LeRobot dataset, whoever wrote it, and repairs what can be repaired.
//!
//! ```text
//! cargo run --release --example dataset -- check recordings/unplug
//! cargo run --release --example dataset -- check recordings/unplug --repair
//! ```
//!
//! Ends with status 1 when faults are left.
#![allow(clippy::print_stdout, reason = "what an example is for")]

use anyhow::Result;
use clap::{Parser, Subcommand};
use e2h_data::lerobot::{REMOVED, Report, check, repair};
use std::path::PathBuf;
use std::process::ExitCode;

/// LeRobot datasets.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Reads every row and image; compares counts, types, ranges and checksums.
    Check {
        /// The dataset's folder.
        dir: PathBuf,
        /// Cut it off after the last whole episode and remove what nothing counts; what is removed is kept in DIR/removed.
        #[arg(long)]
        repair: bool,
        /// Print one JSON line and nothing else.
        #[arg(long)]
        json: bool,
    },
}

fn main() -> Result<ExitCode, e2h_core::Failure> {
    Ok(program()?)
}

fn program() -> Result<ExitCode> {
    let Command::Check { dir, repair: mend, json } = Arguments::parse().command;
    let report = if mend { repair(&dir)? } else { check(&dir)? };
    if json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print(&report, mend);
    }
    Ok(if report.is_sound() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn print(report: &Report, mend: bool) {
    for line in &report.repairs {
        println!("repaired: {line}");
    }
    for fault in &report.faults {
        let episode = fault.episode.map_or_else(String::new, |e| format!(" (from episode {e} on)"));
        println!("fault{episode}: {}", fault.message);
    }
    println!(
        "{}: {} episodes, {} frames, {} whole; checksums of {} files compared, {} files have none",
        report.root.display(),
        report.episodes,
        report.frames,
        report.whole,
        report.verified_files,
        report.unverified_files
    );
    if report.is_sound() {
        println!("sound");
    } else if !mend && report.whole > 0 && report.faults.iter().any(|f| f.repairable) {
        println!("--repair keeps {} episodes and puts the rest into {REMOVED}/", report.whole);
    }
}
