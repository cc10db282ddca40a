//! A critic: description and weights, with a checksum that fits.

#![no_main]

use e2h_data::Normaliser;
use e2h_fuzz::container::{join, split, with_checksum};
use e2h_fuzz::fixture::{Scratch, episode};
use e2h_fuzz::{begin, judge, run};
use e2h_nn::{AdamConfig, Compute};
use e2h_policy::{
    Critic, CriticConfig, CriticProvenance, CriticTraining, DiffusionPolicy, PolicyConfig, train_critic,
};
use libfuzzer_sys::fuzz_target;

const DESCRIPTION: &str = "critic.json";
const WEIGHTS: &str = "model.safetensors";

thread_local! { static SCRATCH: Scratch = Scratch::new(|root| {
    let ranges = Normaliser {
        state_min: [-1.0; 15], state_max: [1.0; 15], action_min: [-1.0; 8], action_max: [1.0; 8],
    };
    let network = PolicyConfig { cameras: vec![], down_dims: vec![8], step_embed_dim: 4, ..PolicyConfig::tiny() };
    let config = CriticConfig {
        crop_size: 4,
        hidden: vec![6],
        dropout: 0.0,
        colour_jitter: 0.0,
        batch: 1,
        steps: 1,
        validation: 0.0,
        adam: AdamConfig::default(),
    };
    let policy = DiffusionPolicy::untrained(&network, &ranges, 1).expect("a policy");
    let weights = policy.weights().expect("weights");
    let training = CriticTraining {
        policy: &network,
        critic: &config,
        compute: &Compute::cpu(),
        normaliser: &ranges,
        policy_weights: &weights,
        rollouts: &[episode(0)],
        horizon: 10,
        seed: 0,
        purpose: "fuzz",
    };
    let (critic, _) =
        train_critic(&training, |_, _| std::ops::ControlFlow::Continue(())).expect("a critic");
    critic.save(root, &config, &CriticProvenance::default()).expect("a folder");
}); }

fuzz_target!(init: begin(|| SCRATCH.with(|s| {
    vec![join(s.file(DESCRIPTION), s.file(WEIGHTS)), join(s.file(DESCRIPTION), &[])]
})), |input: &[u8]| {
    let Some((json, weights)) = split(input) else { return };
    SCRATCH.with(|s| {
        let weights = if weights.is_empty() { s.file(WEIGHTS) } else { weights };
        let json = with_checksum(json, weights);
        s.with(&[(DESCRIPTION, &json), (WEIGHTS, weights)], false, |root| run(|| {
            if let Some((critic, _)) = judge(root, Critic::load(root))
                && let Ok(values) = critic.evaluate(&episode(2))
            {
                assert_eq!(values.len(), 3);
            }
        }));
    });
});
