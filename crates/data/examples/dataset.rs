//! Looks for damage in a LeRobot dataset, whoever wrote it, and repairs what can be repaired.
//!
//! ```text
//! cargo run --release --example dataset -- check recordings/unplug
//! cargo run --release --example dataset -- check recordings/unplug --repair
//! ```
//!
//! Ends with status 0 for a sound dataset, 1 for one that is damaged or cannot be read at all, 3 where something beside the rows
//! is stale (the rows are whole), 4 where something is not supported here (nothing is known of it, and `--repair` touches nothing).

use anyhow::{Context as _, Result};
use clap::{Parser, Subcommand};
use e2h_data::lerobot::{FaultKind, REMOVED, Report, check, repair};
use std::io::{ErrorKind, Write as _};
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
    let text = if json { serde_json::to_string(&report)? + "\n" } else { words(&report, mend) };
    // Not `say`, which ends with status 0 where nobody reads: here the status is what is asked for.
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() == ErrorKind::BrokenPipe => {}
        done => done.context("standard output")?,
    }
    Ok(ExitCode::from(match report.worst() {
        None => 0,
        Some(FaultKind::Damage) => 1,
        Some(FaultKind::Stale) => 3,
        Some(FaultKind::Unsupported) => 4,
    }))
}

fn words(report: &Report, mend: bool) -> String {
    let mut lines: Vec<String> = report.repairs.iter().map(|line| format!("repaired: {line}")).collect();
    for fault in &report.faults {
        let episode = match (fault.kind, fault.episode) {
            (FaultKind::Damage, Some(e)) => format!(" (from episode {e} on)"),
            (_, Some(e)) => format!(" (episode {e})"),
            (_, None) => String::new(),
        };
        lines.push(format!("{}{episode}: {}", fault.kind, fault.message));
    }
    lines.push(format!(
        "{}: {} episodes, {} frames, {} whole; checksums of {} files compared, {} files have none",
        report.root.display(),
        report.episodes,
        report.frames,
        report.whole,
        report.verified_files,
        report.unverified_files
    ));
    if report.is_sound() {
        lines.push("sound".to_owned());
    } else if report.has(FaultKind::Unsupported) {
        lines.push(
            "not all of it can be read here, so nothing is known of the rest; --repair touches nothing"
                .to_owned(),
        );
    } else if !mend && report.has(FaultKind::Damage) {
        if report.whole > 0 && report.faults.iter().any(|f| f.kind == FaultKind::Damage && f.repairable) {
            lines.push(format!("--repair keeps {} episodes and puts the rest into {REMOVED}/", report.whole));
        }
    } else if !mend {
        lines.push("the rows are whole; --repair takes anew from them what is stale".to_owned());
    }
    lines.join("\n") + "\n"
}
