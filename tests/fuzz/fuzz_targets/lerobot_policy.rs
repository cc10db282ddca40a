//! A policy of LeRobot's: description, processors with their statistics, weights.

#![no_main]

use e2h_core::Image;
use e2h_fuzz::fixture::Scratch;
use e2h_fuzz::{begin, judge, run};
use e2h_policy::lerobot::{LerobotObservation, import};
use libfuzzer_sys::fuzz_target;
use serde_json::Value;
use std::path::Path;

const FILES: [&str; 6] = [
    "config.json",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
    "policy_preprocessor_step_3_normalizer_processor.safetensors",
    "policy_postprocessor_step_0_unnormalizer_processor.safetensors",
    "model.safetensors",
];

/// Calls of the network that a policy's own configuration asks for.
fn sampling_steps(root: &Path) -> u64 {
    let text = std::fs::read(root.join(FILES[0])).expect("a file");
    // A reader passes over what it has no use for, such as half of a surrogate pair in a text.
    let Ok(value) = serde_json::from_slice::<Value>(&text) else { return u64::MAX };
    let number = |key: &str| value.get(key).and_then(Value::as_u64);
    number("num_inference_steps").or(number("num_train_timesteps")).unwrap_or(100)
}

thread_local! { static SCRATCH: Scratch = Scratch::lerobot("state"); }

fuzz_target!(init: begin(|| SCRATCH.with(|s| {
    FILES.iter().enumerate().map(|(i, f)| [&[i as u8], s.file(f)].concat()).collect()
})), |input: &[u8]| {
    let Some((which, bytes)) = input.split_first() else { return };
    let file = FILES[usize::from(*which) % FILES.len()];
    SCRATCH.with(|s| s.with(&[(file, bytes)], false, |root| run(|| {
        let Some(policy) = judge(root, import(root)) else { return };
        let (steps, [height, width]) = (policy.n_obs_steps(), policy.image_size());
        if steps > 4 || policy.horizon() > 64 || height * width > 4096 || sampling_steps(root) > 20 {
            return;
        }
        let image = Image { height, width, data: vec![90; height * width * 3] };
        let seen = LerobotObservation {
            state: vec![0.1; policy.state_dim()],
            environment: vec![0.1; policy.environment_dim()],
            images: vec![image; policy.cameras().count()],
        };
        let actions = policy.sample(&[vec![&seen; steps]], &mut |x| x.fill(0.5)).expect("actions");
        assert_eq!(actions[0][0].len(), policy.action_dim());
        judge(root, policy.into_policy());
    })));
});
