//! Weight files.

#![no_main]

use e2h_fuzz::fixture::Scratch;
use e2h_fuzz::{begin, judge, run};
use e2h_nn::{HostTensor, load_weights, save_weights};
use libfuzzer_sys::fuzz_target;
use std::collections::BTreeMap;

const FILE: &str = "model.safetensors";

thread_local! { static SCRATCH: Scratch = Scratch::new(|root| {
    let tensor = |shape: &[usize]| {
        HostTensor { shape: shape.to_vec(), data: (0..shape.iter().product()).map(|i| i as f32 * 0.5).collect() }
    };
    let weights = [("a.bias", tensor(&[3])), ("a.weight", tensor(&[3, 2, 2])), ("empty", tensor(&[0, 4]))];
    let weights = weights.map(|(n, t)| (n.to_owned(), t)).into();
    let metadata = BTreeMap::from([("key".to_owned(), "value".to_owned())]);
    save_weights(root.join(FILE), &weights, &metadata).expect("a file");
}); }

fuzz_target!(init: begin(|| SCRATCH.with(|s| vec![s.file(FILE).to_vec()])), |input: &[u8]| {
    SCRATCH.with(|s| s.with(&[(FILE, input)], false, |root| run(|| {
        if let Some((weights, _)) = judge(root, load_weights(root.join(FILE))) {
            for tensor in weights.values() {
                assert_eq!(tensor.shape.iter().product::<usize>(), tensor.data.len());
            }
        }
    })));
});
