//! `info.json` and `stats.json` of a dataset whose rows are in order.

#![no_main]

use e2h_data::lerobot::{Dataset, Writer, check};
use e2h_fuzz::fixture::{INFO, STATS, Scratch};
use e2h_fuzz::{begin, judge, judge_message, run};
use libfuzzer_sys::fuzz_target;

const FILES: [&str; 2] = [INFO, STATS];

thread_local! { static SCRATCH: Scratch = Scratch::small_dataset(); }

fn seeds() -> Vec<Vec<u8>> {
    let seed = |which: u8, how: u8| {
        SCRATCH.with(|s| [&[which | how << 4][..], s.file(FILES[usize::from(which)])].concat())
    };
    vec![seed(0, 0), seed(0, 1), seed(0, 2), seed(1, 1)]
}

fuzz_target!(init: begin(seeds), |input: &[u8]| {
    let Some((which, bytes)) = input.split_first() else { return };
    let how = which >> 4 & 3;
    SCRATCH.with(|s| s.with(&[(FILES[usize::from(which & 1)], bytes)], how == 2, |root| run(|| match how {
        0 => {
            let Some(dataset) = judge(root, Dataset::open(root)) else { return };
            for i in 0..dataset.len().min(3) {
                judge(root, dataset.read(i));
                judge(root, dataset.row_tasks(i));
            }
        }
        2 => drop(judge(root, Writer::append(root))),
        _ => {
            let report = judge(root, check(root));
            report.iter().flat_map(|r| &r.faults).for_each(|f| judge_message(root, &f.message));
        }
    })));
});
