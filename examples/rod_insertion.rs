//! Learns to insert the rod that the hand holds into a hole from nothing but reversed demonstrations of pulling it out.
//!
//! ```text
//! cargo run --release --example rod_insertion
//! ```
//!
//! The paper's algorithm 1, line by line.

mod common;

use auto_e2h::learn::Result;
use common::{Learned, Run};
use std::process::ExitCode;
use std::time::Instant;

fn main() -> ExitCode {
    common::main("rod_insertion", learn)
}

fn learn(run: &Run) -> Result<Learned> {
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

    run.report(&base, records)
}
