//! Learns to put a computer mouse on its pad from nothing but reversed demonstrations of taking it off.
//!
//! ```text
//! cargo run --release --example mouse
//! ```
//!
//! The paper's algorithm 1, line by line.

mod common;

use auto_e2h::learn::{Parts, Result};
use common::{Learned, Run};
use std::process::ExitCode;

fn main() -> ExitCode {
    common::main("mouse", Parts::default(), learn)
}

fn learn(run: &Run) -> Result<Learned> {
    // Line 1: easy demonstrations, their reversal, and a policy from each.
    let demonstrations = run.demonstrations()?;
    let mut easy = run.train_easy(&demonstrations)?;
    let mut hard = run.train_initial(&demonstrations)?;
    let mut records = vec![run.evaluate(0, &*hard, None)?];

    // Lines 2 to 8: each policy resets the scene for the other; what the easy one does, turned round, teaches the hard one.
    let mut rounds = vec![];
    for n in 1..=run.iterations() {
        rounds.push(run.lesson(n, &demonstrations, &*hard, || run.collect(n, &*hard, &*easy))?);
        hard = run.update(n, &*hard, &demonstrations, &rounds)?;
        easy = run.update_easy(n, easy, &demonstrations, &rounds)?; // the paper's stays as it is
        records.push(run.evaluate(n, &*hard, rounds.last())?);
    }

    run.report(&demonstrations, records)
}
