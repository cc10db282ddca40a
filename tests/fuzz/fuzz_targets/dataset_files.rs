//! Parquet files of a dataset, byte by byte: rows, list of episodes, tasks.

#![no_main]

use e2h_data::lerobot::{Dataset, Report, Writer, check, repair};
use e2h_fuzz::fixture::{DATA, EPISODES, Scratch, TASKS};
use e2h_fuzz::{begin, judge, judge_message, run};
use libfuzzer_sys::fuzz_target;
use std::path::Path;

const FILES: [&str; 3] = [DATA, EPISODES, TASKS];

// One that this project wrote and one that LeRobot did: other encodings, other statistics.
thread_local! { static SCRATCH: [Scratch; 2] = [Scratch::small_dataset(), Scratch::lerobot("dataset")]; }

fn seeds() -> Vec<Vec<u8>> {
    let seed = |all: u8| {
        let (whose, how, which) = (all / 12, all / 3 % 4, all % 3);
        let head = [which | how << 4 | whose << 6];
        SCRATCH.with(|s| [&head[..], s[usize::from(whose)].file(FILES[usize::from(which)])].concat())
    };
    (0..24).map(seed).collect()
}

fn faults(root: &Path, report: Option<Report>) {
    report.iter().flat_map(|r| &r.faults).for_each(|f| judge_message(root, &f.message));
}

fn read(root: &Path, how: u8) {
    run(|| match how {
        0 => {
            let Some(dataset) = judge(root, Dataset::open(root)) else { return };
            for i in 0..dataset.len().min(3) {
                judge(root, dataset.read(i));
                judge(root, dataset.row_tasks(i));
            }
        }
        1 => faults(root, judge(root, check(root))),
        2 => drop(judge(root, Writer::append(root))),
        _ => faults(root, judge(root, repair(root))),
    });
}

fuzz_target!(init: begin(seeds), |input: &[u8]| {
    let Some((which, bytes)) = input.split_first() else { return };
    let (file, how) = (FILES[usize::from(which & 0x0f) % FILES.len()], which >> 4 & 3);
    SCRATCH.with(|s| s[usize::from(which >> 6 & 1)].with(&[(file, bytes)], how > 1, |root| read(root, how)));
});
