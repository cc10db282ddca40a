//! Looks for damage in a LeRobot dataset, whoever wrote it, and repairs what can be repaired.
//!
//! ```text
//! cargo run --release --example dataset -- check recordings/unplug
//! cargo run --release --example dataset -- check recordings/unplug --repair
//! ```
//!
//! Ends with status 0 for a sound dataset, 1 for one that is damaged or cannot be read at all, 3 where something beside the rows
//! is stale (the rows are whole), 4 where something is not supported here (nothing is known of it, and `--repair` touches nothing).
#![allow(clippy::print_stdout, reason = "what an example is for")]

use anyhow::Result;
use clap::{Parser, Subcommand};
use e2h_data::lerobot::{FaultKind, REMOVED, Report, check, repair};
use std::path::PathBuf;
use std::process::ExitCode;

/// LeRobot datasets.
#[derive(Parser)]
#[command(
    version,
    after_help = "Examples:\n  cargo run --release --example dataset -- check recordings/unplug\n  cargo run --release --example dataset -- check recordings/unplug --repair"
)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Reads every row and image and the tables of videos; compares counts, types, ranges, times and checksums.
    Check {
        /// The dataset's folder.
        dir: PathBuf,
        /// Where there is damage, cut off after the last whole episode and remove what nothing counts; take anew from the rows
        /// what is stale. What was there before is kept in DIR/removed. Where something is not supported, nothing is touched.
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
    Ok(ExitCode::from(match report.worst() {
        None => 0,
        Some(FaultKind::Damage) => 1,
        Some(FaultKind::Stale) => 3,
        Some(FaultKind::Unsupported) => 4,
    }))
}

fn print(report: &Report, mend: bool) {
    for line in &report.repairs {
        println!("repaired: {line}");
    }
    for fault in &report.faults {
        let episode = match (fault.kind, fault.episode) {
            (FaultKind::Damage, Some(e)) => format!(" (from episode {e} on)"),
            (_, Some(e)) => format!(" (episode {e})"),
            (_, None) => String::new(),
        };
        println!("{}{episode}: {}", fault.kind, fault.message);
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
    } else if report.has(FaultKind::Unsupported) {
        println!("not all of it can be read here, so nothing is known of the rest; --repair touches nothing");
    } else if !mend && report.has(FaultKind::Damage) {
        if report.whole > 0 && report.faults.iter().any(|f| f.kind == FaultKind::Damage && f.repairable) {
            println!("--repair keeps {} episodes and puts the rest into {REMOVED}/", report.whole);
        }
    } else if !mend {
        println!("the rows are whole; --repair takes anew from them what is stale");
    }
}
