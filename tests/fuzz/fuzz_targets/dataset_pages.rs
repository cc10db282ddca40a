//! Pages of a dataset's Parquet files, inside a file that is otherwise in order.

#![no_main]

use e2h_data::lerobot::{Dataset, check};
use e2h_fuzz::fixture::{DATA, EPISODES, Scratch};
use e2h_fuzz::pages::Template;
use e2h_fuzz::{begin, judge, judge_message, run};
use libfuzzer_sys::fuzz_target;

struct Parts {
    scratch: Scratch,
    templates: [(&'static str, Template); 2],
}

thread_local! { static PARTS: Parts = {
    let scratch = Scratch::dataset();
    let place = scratch.root().with_extension("template");
    let templates = [DATA, EPISODES].map(|f| (f, Template::of(scratch.file(f), &place)));
    // A template's own pages make a dataset without faults.
    for (file, template) in &templates {
        scratch.with(&[(file, &template.build(&[]))], false, |root| {
            let report = check(root).expect("a report");
            assert!(report.is_sound(), "{:?}", report.faults);
        });
    }
    Parts { scratch, templates }
}; }

fuzz_target!(init: begin(|| PARTS.with(|p| {
    let seeds = |i: usize, how: u8| {
        p.templates[i].1.seeds().into_iter().map(move |s| [&[i as u8 | how][..], &s].concat())
    };
    // Statistics are read by the check alone.
    seeds(0, 0).chain(seeds(1, 0).take(10)).chain(seeds(1, 2)).collect()
})), |input: &[u8]| {
    let Some((which, pages)) = input.split_first() else { return };
    PARTS.with(|p| {
        let (file, template) = &p.templates[usize::from(which & 1)];
        p.scratch.with(&[(file, &template.build(pages))], false, |root| run(|| {
            if let Some(dataset) = judge(root, Dataset::open(root)) {
                judge(root, dataset.read_episode(0));
                judge(root, dataset.read_columns(0, &["matrix", "note"]));
            }
            if which & 2 != 0 {
                let report = judge(root, check(root));
                report.iter().flat_map(|r| &r.faults).for_each(|f| judge_message(root, &f.message));
            }
        }));
    });
});
