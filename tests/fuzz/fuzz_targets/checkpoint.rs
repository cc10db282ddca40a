//! A checkpoint of ours: description and weights, with a checksum that fits.

#![no_main]

use e2h_core::{Image, Observation, stream};
use e2h_data::Normaliser;
use e2h_fuzz::container::{join, split, with_checksum};
use e2h_fuzz::fixture::Scratch;
use e2h_fuzz::{begin, judge, run};
use e2h_policy::{DiffusionPolicy, PolicyConfig, Provenance};
use libfuzzer_sys::fuzz_target;

const DESCRIPTION: &str = "policy.json";
const WEIGHTS: &str = "model.safetensors";

thread_local! { static SCRATCH: Scratch = Scratch::new(|root| {
    let ranges = Normaliser {
        state_min: [-1.0; 15], state_max: [1.0; 15], action_min: [-1.0; 8], action_max: [1.0; 8],
    };
    // No cameras: an encoder's weights are many bytes that all mean the same.
    let config = PolicyConfig { cameras: vec![], down_dims: vec![8], step_embed_dim: 4, ..PolicyConfig::tiny() };
    let policy = DiffusionPolicy::untrained(&config, &ranges, 1).expect("a policy");
    policy.save(root, &Provenance::default()).expect("a checkpoint");
}); }

fuzz_target!(init: begin(|| SCRATCH.with(|s| {
    vec![join(s.file(DESCRIPTION), s.file(WEIGHTS)), join(s.file(DESCRIPTION), &[])]
})), |input: &[u8]| {
    let Some((json, weights)) = split(input) else { return };
    SCRATCH.with(|s| {
        // Without weights of the input's the folder keeps its own.
        let weights = if weights.is_empty() { s.file(WEIGHTS) } else { weights };
        let json = with_checksum(json, weights);
        s.with(&[(DESCRIPTION, &json), (WEIGHTS, weights)], false, |root| run(|| {
            let Some((policy, checkpoint)) = judge(root, DiffusionPolicy::load(root)) else { return };
            let c = &checkpoint.config;
            if c.n_obs_steps > 4 || c.horizon > 64 || c.inference_steps > 8 || c.image_size > 64 {
                return;
            }
            let side = c.image_size;
            let image = Image { height: side, width: side, data: vec![90; side * side * 3] };
            let seen = Observation { state: [0.1; 15], frames: vec![image; c.cameras.len()] };
            let actions = policy.sample(&[vec![&seen; c.n_obs_steps]], &mut [stream(0, "fuzz", 0, 0)]);
            assert_eq!(actions.expect("actions")[0].len(), c.n_action_steps);
        }));
    });
});
