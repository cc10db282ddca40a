//! What folders are opened as.

use crate::common::{Client, actions, direct, policy, seen, settings};
use e2h_policy::lerobot::export;
use e2h_policy::{DiffusionPolicy, PolicyConfig, Prediction, Provenance, SamplerKind};
use e2h_serve::wire::{Array, Value};
use e2h_serve::{Server, open};

/// A checkpoint of ours that LeRobot has words for.
fn expressible(sampler: SamplerKind) -> (DiffusionPolicy, Provenance) {
    let made = policy(&["table", "wrist"]);
    let config = PolicyConfig {
        n_image_steps: 2,
        n_action_steps: 8,
        lerobot_alignment: true,
        encoder_width: 64,
        encoder_blocks: vec![2; 4],
        keypoints: 32,
        image_size: 72,
        crop_size: 64,
        image_features: 64,
        down_dims: vec![16, 16],
        kernel_size: 5,
        prediction: Prediction::Epsilon,
        inference_steps: if sampler == SamplerKind::Ddpm { 100 } else { 4 },
        unit_quaternion: false,
        sampler,
        ..made.config().clone()
    };
    let policy = DiffusionPolicy::untrained(&config, made.normaliser(), 3).unwrap();
    (policy, Provenance { task: "nut_assembly".to_owned(), ..Provenance::default() })
}

#[test]
fn a_policy_of_lerobots_is_served_as_it_acts() {
    let dir = tempfile::tempdir().unwrap();
    let (ours, theirs) = (dir.path().join("ours"), dir.path().join("theirs"));
    let (policy, provenance) = expressible(SamplerKind::Ddim);
    policy.save(&ours, &provenance).unwrap();
    export(&ours, &theirs).unwrap();
    std::fs::remove_file(theirs.join("policy.json")).unwrap();

    let server = Server::start(open(&theirs).unwrap(), settings()).unwrap();
    let inputs = server.inputs().clone();
    assert_eq!((inputs.kind.as_str(), inputs.n_action_steps, inputs.action), ("lerobot diffusion", 8, 8));
    assert_eq!(inputs.cameras[0].name, "table");
    let mut client = Client::new(&server);
    assert_eq!(client.metadata.get("task"), Some(&Value::from("nut_assembly")));
    let policy = open(&theirs).unwrap();
    for k in 0..3 {
        let seen = seen(k, &inputs);
        let request = Value::map([
            ("observation.state", Array::f32(&[15], &seen.state).into()),
            ("observation.images.table", Array::image(&seen.images[0]).into()),
            ("observation.images.wrist", Array::image(&seen.images[1]).into()),
            ("seed", Value::from(k)),
        ]);
        assert_eq!(actions(&client.infer(&request)), direct(&*policy, k, k));
    }
}

#[test]
fn a_batch_changes_no_bit_of_an_answer() {
    for sampler in [SamplerKind::Ddim, SamplerKind::Ddpm] {
        let (policy, _) = expressible(sampler);
        let inputs = e2h_serve::Servable::inputs(&policy);
        let alone: Vec<Vec<f32>> = (0..5).map(|k| direct(&policy, k, k)).collect();
        let histories = (0..5).map(|k| vec![seen(k, &inputs); inputs.n_obs_steps]).collect();
        let mut rngs: Vec<_> = (0..5).map(|k| e2h_core::stream(k, "serve/act", 0, 0)).collect();
        let together = e2h_serve::Servable::act(&policy, histories, &mut rngs).unwrap();
        assert_eq!(together.iter().map(|c| c.concat()).collect::<Vec<_>>(), alone, "{sampler:?}");
    }
}

#[test]
fn what_is_no_checkpoint_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let error = open(dir.path()).err().unwrap().to_string();
    assert!(error.contains("policy.json"), "{error}");
    std::fs::write(dir.path().join("config.json"), "{}").unwrap();
    let error = open(dir.path()).err().unwrap().to_string();
    assert!(error.contains("config.json") && error.contains("`type`"), "{error}");
}
