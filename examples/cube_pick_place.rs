//! Learns to put a cube into a tray from nothing but reversed demonstrations of taking it out.
//!
//! ```text
//! cargo run --release --example cube_pick_place
//! ```
//!
//! The paper's algorithm 1, line by line.

#![allow(clippy::print_stdout, reason = "what an example is for")]

mod common;

use auto_e2h::core::Failure;
use auto_e2h::learn::{Run, report};
use std::time::Instant;

fn main() -> Result<(), Failure> {
    let run = Run::open(&common::options("cube_pick_place")?)?;

    // Line 1: easy demonstrations, their reversal, and a policy from each.
    let base = run.demonstrations()?;
    let mut easy = run.train_easy(&base)?;
    let mut hard = run.train_initial(&base)?;
    let mut records = vec![run.evaluate(0, &hard, None)?];

    // Lines 2 to 8: each policy resets the scene for the other; what the easy one does, turned round, teaches the hard one.
    for n in 1..=run.iterations() {
        let accepted = match run.stored(n)? {
            Some(accepted) => accepted,
            None => {
                let clock = Instant::now();
                let rollouts = run.collect(n, &hard, &easy)?;
                run.refine(n, rollouts, clock.elapsed(), &base, &hard)?
            }
        };
        hard = run.update(n, &hard, &base, &run.training_set(n, &accepted)?)?;
        easy = run.update_easy(n, easy, &base)?; // the paper's stays as it is
        records.push(run.evaluate(n, &hard, Some(&accepted))?);
    }

    let (results, page) = run.report(&base, records)?;
    println!("{}", report::table::iterations(&results));
    println!("report: {}", page.display());
    Ok(())
}
