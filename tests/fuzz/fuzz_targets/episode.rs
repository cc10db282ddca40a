//! An episode's own file.

#![no_main]

use e2h_data::EpisodeStore;
use e2h_fuzz::fixture::{Scratch, episode};
use e2h_fuzz::{begin, judge, run};
use libfuzzer_sys::fuzz_target;

const FILE: &str = "one.safetensors";

thread_local! { static SCRATCH: Scratch = Scratch::new(|root| {
    EpisodeStore::open(root).expect("a store").write("one", &episode(1)).expect("an episode");
}); }

fuzz_target!(init: begin(|| SCRATCH.with(|s| vec![s.file(FILE).to_vec()])), |input: &[u8]| {
    SCRATCH.with(|s| s.with(&[(FILE, input)], false, |root| run(|| {
        let store = EpisodeStore::open(root).expect("a store");
        let (summary, whole) = (judge(root, store.summary("one")), judge(root, store.read("one")));
        if let Some(episode) = whole {
            episode.validate().expect("an episode without contradictions");
            assert_eq!(summary.map(|s| s.rows), Some(episode.len()));
        }
    })));
});
