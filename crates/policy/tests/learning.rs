//! The tiny network really learns, saves, and says what does not fit.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Direction, Episode, Image, Observation, Origin, stream};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_policy::{
    Checkpoint, CriticConfig, CriticTraining, DiffusionPolicy, EncoderNorm, Error, PolicyConfig, Provenance,
    ScheduleConfig, ScheduleKind, ScheduledAdam, TrainConfig, Trainer, TrainingData, train_critic,
};
use std::sync::Arc;

/// A path along a line; the images brighten with it.
fn episode(rows: usize, success: bool) -> Episode {
    let cameras = ["table".to_owned(), "wrist".to_owned()];
    let mut episode = Episode::new(Origin::demonstration("line", Direction::Hard, 0, 0), &cameras);
    for t in 0..rows {
        let x = t as f32 * 0.01;
        let state =
            [x, -x, 0.5 * x, 0., 1., 0., 0., 0.3, x, 0.1, 1., 0., 0., 0., if t < 20 { 0.08 } else { 0.03 }];
        let image = Image { height: 24, width: 24, data: vec![(t * 4) as u8; 24 * 24 * 3] };
        let action = [x + 0.01, -x - 0.01, 0.5 * x, 0., 1., 0., 0., if t < 20 { 1. } else { 0. }];
        episode.push(&Observation { state, frames: vec![image.clone(), image] }, &action).unwrap();
    }
    if success {
        episode.outcome = e2h_core::Outcome::Success { at: rows - 1 };
    }
    episode
}

fn train_config() -> TrainConfig {
    TrainConfig {
        conditions: 16,
        noises: 2,
        shards: 1,
        conditioning_dropout: 0.0,
        indicator_dropout: 0.3,
        observation_noise: 0.0,
        keypoint_sharpness: 1.0,
        adam: ScheduledAdam { clip_norm: Some(1.0), ..Default::default() },
        schedule: ScheduleConfig { kind: ScheduleKind::Cosine, lr: 2e-3, warmup: 10 },
        ema: e2h_nn::EmaConfig::default(),
    }
}

#[test]
fn an_encoder_without_its_norm_is_not_trained() {
    let config = PolicyConfig { encoder_norm: EncoderNorm::Folded, ..PolicyConfig::tiny() };
    let message = Trainer::new(&config, &train_config(), 1, None, 0, "test").err().unwrap().to_string();
    assert!(message.contains("encoder_norm: expected group, got folded"), "{message}");
}

#[test]
fn one_trajectory_is_overfitted_and_the_sampled_actions_are_its_own() {
    let episodes = [Arc::new(episode(40, true))];
    let config = PolicyConfig::tiny();
    let normaliser =
        Normaliser::fit(&episodes.each_ref().map(|e| &**e), &NormaliserConfig::default()).unwrap();
    let sources = [e2h_data::Source::whole(episodes.to_vec())];
    let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
    let mut trainer = Trainer::new(&config, &train_config(), 400, None, 1, "overfit").unwrap();
    let losses: Vec<f32> = (0..400).map(|_| trainer.step(&data).unwrap()).collect();
    let last = losses[380..].iter().sum::<f32>() / 20.0;
    assert!(last < 0.02 && last < losses[0] / 20.0, "loss {} to {last}", losses[0]);

    let policy = DiffusionPolicy::with_weights(&config, &normaliser, &trainer.weights().unwrap()).unwrap();
    let e = &episodes[0];
    let seen: Vec<Observation> = [9, 10]
        .map(|t| Observation {
            state: e.state[t],
            frames: e
                .frames
                .iter()
                .map(|f| Image { height: 24, width: 24, data: f.image(t).unwrap().into_owned() })
                .collect(),
        })
        .to_vec();
    let chunk = policy.sample(&[seen.iter().collect()], &mut [stream(0, "act", 0, 0)]).unwrap().remove(0);
    for (k, action) in chunk.iter().enumerate() {
        let want = &e.action[10 + k];
        for i in 0..3 {
            assert!((action[i] - want[i]).abs() < 0.04, "action {k}: {action:?}, expected {want:?}");
        }
        assert_eq!(action[7] > 0.5, want[7] > 0.5, "gripper of action {k}: {}", action[7]);
    }
}

#[test]
fn sharper_keypoints_start_from_the_same_draw() {
    let config = PolicyConfig::tiny();
    let weights = |keypoint_sharpness: f32| {
        let train = TrainConfig { keypoint_sharpness, ..train_config() };
        Trainer::new(&config, &train, 10, None, 1, "sharp").map(|t| t.weights().unwrap())
    };
    let (plain, sharp) = (weights(1.0).unwrap(), weights(4.0).unwrap());
    let mut attention = 0;
    for (name, before) in &plain {
        let factor = if name.ends_with("pool.nets.weight") { 4.0 } else { 1.0 };
        attention += usize::from(factor > 1.0);
        let after = &sharp[name].data;
        assert!(before.data.iter().zip(after).all(|(b, a)| (b * factor - a).abs() < 1e-6), "{name}");
    }
    assert_eq!(attention, config.cameras.len());
    assert!(matches!(weights(0.0), Err(Error::Config(_))));
}

#[test]
fn a_checkpoint_comes_back_and_refuses_another_network() {
    let dir = tempfile::tempdir().unwrap();
    let config = PolicyConfig::tiny();
    let normaliser = Normaliser::fit(&[episode(30, true)], &NormaliserConfig::default()).unwrap();
    let policy = DiffusionPolicy::untrained(&config, &normaliser, 3).unwrap();
    policy.save(dir.path(), &Provenance::default()).unwrap();
    let (back, checkpoint) = DiffusionPolicy::load(dir.path()).unwrap();
    assert_eq!(back.weights().unwrap(), policy.weights().unwrap());
    assert_eq!(checkpoint.config, config);
    let other = PolicyConfig { down_dims: vec![16, 32], ..config };
    let error = DiffusionPolicy::with_weights(&other, &normaliser, &policy.weights().unwrap()).err().unwrap();
    assert!(error.to_string().contains("diffusion.unet."), "{error}");
    let short = Observation { state: [0.0; 15], frames: vec![] };
    let error = policy.sample(&[vec![&short, &short]], &mut [stream(0, "act", 0, 0)]).err().unwrap();
    assert!(matches!(error, Error::Observation { .. }), "{error}");
}

/// What `policy.json` describes is refused by what the weights are, before there is memory for it, and numbers that are none
/// are refused too; always by the file's name.
#[test]
fn a_checkpoint_of_impossible_numbers_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let ranges = Normaliser {
        state_min: [-1.0; 15],
        state_max: [1.0; 15],
        action_min: [-1.0; 8],
        action_max: [1.0; 8],
    };
    let config = PolicyConfig { cameras: vec![], ..PolicyConfig::tiny() };
    let policy = DiffusionPolicy::untrained(&config, &ranges, 1).unwrap();
    policy.save(folder.path(), &Provenance::default()).unwrap();
    let path = folder.path().join("policy.json");
    let text = std::fs::read_to_string(&path).unwrap();
    let refusal = |from: &str, to: &str| {
        let compact: serde_json::Value = serde_json::from_str(&text).unwrap();
        let compact = compact.to_string();
        assert!(compact.contains(from), "{from} in {compact}");
        std::fs::write(&path, compact.replacen(from, to, 1)).unwrap();
        let message = DiffusionPolicy::load(folder.path()).err().unwrap().to_string();
        assert!(message.contains(folder.path().to_str().unwrap()), "{message}");
        message
    };
    let dims = "\"down_dims\":[16,16]";
    assert!(refusal(dims, "\"down_dims\":[1048576,1048576]").contains("of another shape"));
    assert!(refusal(dims, "\"down_dims\":[72057594037927936]").contains("1 to 16 sizes"));
    assert!(refusal("\"horizon\":16", "\"horizon\":1152921504606846976").contains("horizon"));
    assert!(refusal("\"guidance\":1.0", "\"guidance\":1e39").contains("guidance: expected 0 to 100"));
    let range = "\"state_max\":[1.0,";
    assert!(refusal(range, "\"state_max\":[-1.0,").contains("state entry 0: expected finite ends"));
    assert!(refusal(range, "\"state_max\":[1e39,").contains("state entry 0"));

    // A weight that is none is never written, and what was there stays.
    std::fs::write(&path, &text).unwrap();
    let mut weights = policy.weights().unwrap();
    weights.get_mut("diffusion.unet.final_conv.1.bias").unwrap().data[3] = f32::NAN;
    let refused = Checkpoint { config, normaliser: ranges, provenance: Provenance::default() }
        .write(folder.path(), &weights)
        .err()
        .unwrap()
        .to_string();
    let expected = "`diffusion.unet.final_conv.1.bias`, entry 3: expected a finite number, found NaN";
    assert!(refused.ends_with(expected) && refused.contains("model.safetensors"), "{refused}");
    DiffusionPolicy::load(folder.path()).unwrap();
}

#[test]
fn training_goes_on_from_a_saved_state_with_the_same_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("training.safetensors");
    let episodes = [Arc::new(episode(40, true))];
    let config = PolicyConfig::tiny();
    let normaliser = Normaliser::fit(&[episode(40, true)], &NormaliserConfig::default()).unwrap();
    let sources = [e2h_data::Source::whole(episodes.to_vec())];
    let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
    let new = || Trainer::new(&config, &train_config(), 8, None, 1, "resume").unwrap();
    let (mut whole, mut first, mut second) = (new(), new(), new());
    for _ in 0..8 {
        whole.step(&data).unwrap();
    }
    for _ in 0..3 {
        first.step(&data).unwrap();
    }
    first.save(&path).unwrap();
    second.restore(&path).unwrap();
    assert_eq!(second.step_count(), 3);
    for _ in 0..5 {
        second.step(&data).unwrap();
    }
    assert_eq!(whole.weights().unwrap(), second.weights().unwrap());

    // One bit of one number.
    let mut bytes = std::fs::read(&path).unwrap();
    let last = bytes.len() - 9;
    bytes[last] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let message = new().restore(&path).unwrap_err().to_string();
    assert!(
        message.contains("damaged: expected SHA-256") && message.contains("training.safetensors"),
        "{message}"
    );
}

#[test]
fn a_critic_learns_that_successes_end_higher_than_failures() {
    // Failures have the object elsewhere: the value can be told from what is seen.
    let mut rollouts: Vec<Episode> = (0..6).map(|i| episode(40, i < 3)).collect();
    for state in rollouts[3..].iter_mut().flat_map(|e| &mut e.state) {
        state[7] = 0.6;
    }
    let config = PolicyConfig::tiny();
    let normaliser = Normaliser::fit(&rollouts, &NormaliserConfig::default()).unwrap();
    let policy = DiffusionPolicy::untrained(&config, &normaliser, 3).unwrap();
    let critic = CriticConfig {
        crop_size: 18,
        hidden: vec![32, 16],
        dropout: 0.0,
        colour_jitter: 0.1,
        batch: 32,
        steps: 150,
        validation: 0.2,
        adam: e2h_nn::AdamConfig { lr: 2e-3, ..Default::default() },
    };
    let weights = policy.weights().unwrap();
    let training = CriticTraining {
        policy: &config,
        critic: &critic,
        compute: &e2h_nn::Compute::cpu(),
        normaliser: &normaliser,
        policy_weights: &weights,
        rollouts: &rollouts,
        horizon: 100,
        seed: 0,
        purpose: "critic",
    };
    let (critic, report) = train_critic(&training, |_, _| std::ops::ControlFlow::Continue(())).unwrap();
    assert!(report.train_loss < 0.05, "{}", report.train_loss);
    let values = critic.evaluate(&rollouts[0]).unwrap();
    assert_eq!(values.len(), 40);
    // G rises along a success: 1 - 40/200 at the start, 1 - 1/200 at the end.
    assert!((values[39] - 0.995).abs() < 0.25, "{values:?}");
    let failed = critic.evaluate(&rollouts[5]).unwrap();
    assert!((failed[39] - -0.005).abs() < 0.25, "{failed:?}");
}
