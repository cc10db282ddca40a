//! A policy and a critic through Candle's operations, or a GPU, against our kernels.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Direction, Episode, Image, Observation, Origin, Outcome, stream};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_nn::{Compute, Precision, candle_operations};
use e2h_policy::{
    CriticConfig, CriticTraining, DiffusionPolicy, PolicyConfig, Prediction, ScheduleConfig, ScheduleKind,
    ScheduledAdam, TrainConfig, Trainer, TrainingData, train_critic,
};
use std::cell::Cell;
use std::sync::Arc;

thread_local! {
    static ELSEWHERE: Cell<bool> = const { Cell::new(false) };
}

/// Where networks are made now, as `E2H_TEST_DEVICE` says inside [`elsewhere`].
fn compute(precision: Precision) -> Compute {
    let name = std::env::var("E2H_TEST_DEVICE").ok().filter(|_| ELSEWHERE.get());
    Compute::open(name.as_deref().unwrap_or("cpu"), precision).unwrap()
}

/// Runs `f` on Candle's operations: on the device that `E2H_TEST_DEVICE` names (`benches/cuda/run.sh`), else on the CPU.
fn elsewhere<R>(f: impl FnOnce() -> R) -> R {
    ELSEWHERE.set(true);
    let result = candle_operations(f);
    ELSEWHERE.set(false);
    result
}

fn here() -> Compute {
    compute(Precision::default())
}

fn observation(t: usize) -> Observation {
    let x = t as f32 * 0.01;
    let state =
        [x, -x, 0.5 * x, 0., 1., 0., 0., 0.3, x, 0.1, 1., 0., 0., 0., if t < 20 { 0.08 } else { 0.03 }];
    let image = |k: usize| Image {
        height: 24,
        width: 24,
        data: (0..24 * 24 * 3).map(|i| ((i * k + t * 5) % 256) as u8).collect(),
    };
    Observation { state, frames: vec![image(3), image(7)] }
}

fn episode(rows: usize, success: bool) -> Episode {
    let cameras = ["table".to_owned(), "wrist".to_owned()];
    let mut episode = Episode::new(Origin::demonstration("line", Direction::Hard, 0, 0), &cameras);
    for t in 0..rows {
        let x = t as f32 * 0.01;
        let action = [x + 0.01, -x - 0.01, 0.5 * x, 0., 1., 0., 0., if t < 20 { 1. } else { 0. }];
        episode.push(&observation(t), &action).unwrap();
    }
    if success {
        episode.outcome = Outcome::Success { at: rows - 1 };
    }
    episode
}

fn train_config() -> TrainConfig {
    TrainConfig {
        conditions: 8,
        noises: 2,
        shards: 1,
        conditioning_dropout: 0.2,
        indicator_dropout: 0.3,
        observation_noise: 0.05,
        keypoint_sharpness: 1.0,
        adam: ScheduledAdam { clip_norm: Some(1.0), ..Default::default() },
        schedule: ScheduleConfig { kind: ScheduleKind::Cosine, lr: 1e-3, warmup: 2 },
        ema: e2h_nn::EmaConfig::default(),
    }
}

fn assert_near(what: &str, got: &[f32], want: &[f32], tolerance: f64) {
    assert_eq!(got.len(), want.len(), "{what}");
    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
    let wide = |v: &f32| f64::from(*v);
    let off =
        norm(&mut got.iter().zip(want).map(|(a, b)| wide(a) - wide(b))) / norm(&mut want.iter().map(wide));
    assert!(off <= tolerance, "{what}: {off:.1e} apart\n{got:?}\n{want:?}");
}

#[test]
fn training_and_sampling_are_the_same() {
    let episodes = [Arc::new(episode(40, true))];
    let normaliser = Normaliser::fit(&[episode(40, true)], &NormaliserConfig::default()).unwrap();
    for (prediction, guidance, indicator) in
        [(Prediction::Sample, 1.0, false), (Prediction::Epsilon, 1.5, false), (Prediction::Sample, 1.5, true)]
    {
        let config =
            PolicyConfig { prediction, guidance, indicator, relative_features: true, ..PolicyConfig::tiny() };
        let whole = e2h_data::Source::whole(episodes.to_vec());
        let sources = [whole.clone().labelled(1.0), whole.labelled(-1.0)];
        let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
        let run = || {
            // What `into_device` is for on a GPU machine: made on the CPU, moved.
            let trainer = Trainer::new(&config, &train_config(), 8, None, 1, "candle").unwrap();
            let mut trainer = trainer.into_device(&here()).unwrap();
            let losses: Vec<f32> = (0..5).map(|_| trainer.step(&data).unwrap()).collect();
            (losses, trainer)
        };
        let (own, own_trainer) = run();
        let (candle, candle_trainer) = elsewhere(run);
        assert_near("losses", &candle, &own, 1e-4);

        // The same weights, so that what differs is sampling alone.
        let weights = own_trainer.weights().unwrap();
        let histories: Vec<Vec<Observation>> =
            [3, 17].map(|t| vec![observation(t), observation(t + 1)]).into();
        let chunk = || {
            let policy = DiffusionPolicy::with_weights(&config, &normaliser, &weights).unwrap();
            let policy = policy.into_device(&here()).unwrap();
            let histories: Vec<Vec<&Observation>> = histories.iter().map(|h| h.iter().collect()).collect();
            let mut rngs = [stream(0, "act", 0, 0), stream(0, "act", 0, 1)];
            let chunks = policy.sample(&histories, &mut rngs).unwrap();
            chunks.into_iter().flatten().flatten().collect::<Vec<f32>>()
        };
        assert_near("actions", &elsewhere(chunk), &chunk(), 1e-4);

        // Half a training in one arithmetic goes on in the other, through the same file.
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("training.safetensors");
        candle_trainer.save(&path).unwrap();
        let mut onward = Trainer::new(&config, &train_config(), 8, None, 1, "candle").unwrap();
        onward.restore(&path).unwrap();
        assert_eq!(onward.step_count(), 5);
        let mut own_trainer = own_trainer;
        let (a, b) = (onward.step(&data).unwrap(), own_trainer.step(&data).unwrap());
        assert_near("loss after the change", &[a], &[b], 1e-3);
    }
}

/// A trainer that is moved in the middle goes on with its optimiser and its average.
#[test]
fn a_training_moves() {
    let episodes = [Arc::new(episode(40, true))];
    let normaliser = Normaliser::fit(&[episode(40, true)], &NormaliserConfig::default()).unwrap();
    let config = PolicyConfig::tiny();
    let sources = [e2h_data::Source::whole(episodes.to_vec())];
    let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
    let new = || Trainer::new(&config, &train_config(), 8, None, 1, "move").unwrap();
    let (mut stays, mut moves) = (new(), new());
    for _ in 0..3 {
        assert!((stays.step(&data).unwrap() - moves.step(&data).unwrap()).abs() < 1e-9);
    }
    let before = moves.weights().unwrap();
    let (after, loss) = elsewhere(|| {
        let mut moved = moves.into_device(&here()).unwrap();
        (moved.weights().unwrap(), moved.step(&data).unwrap())
    });
    assert_eq!(before, after);
    assert_near("loss after the move", &[loss], &[stays.step(&data).unwrap()], 1e-4);
}

#[test]
fn the_critic_is_the_same() {
    let rollouts: Vec<Episode> = (0..4).map(|i| episode(30 + i, i < 2)).collect();
    let config = PolicyConfig::tiny();
    let normaliser = Normaliser::fit(&rollouts, &NormaliserConfig::default()).unwrap();
    let weights = DiffusionPolicy::untrained(&config, &normaliser, 3).unwrap().weights().unwrap();
    let critic = CriticConfig {
        crop_size: 18,
        hidden: vec![32, 16],
        dropout: 0.15,
        colour_jitter: 0.1,
        batch: 16,
        steps: 6,
        validation: 0.25,
        adam: e2h_nn::AdamConfig { lr: 1e-3, ..Default::default() },
    };
    let train = |compute: &Compute| {
        let training = CriticTraining {
            policy: &config,
            critic: &critic,
            compute,
            normaliser: &normaliser,
            policy_weights: &weights,
            rollouts: &rollouts,
            horizon: 100,
            seed: 0,
            purpose: "critic",
        };
        let (critic, report) = train_critic(&training, |_, _| std::ops::ControlFlow::Continue(())).unwrap();
        (critic.evaluate(&rollouts[0]).unwrap(), report)
    };
    let (own_values, own) = train(&here());
    let (values, candle) = elsewhere(|| train(&here()));
    assert_near("losses of the critic", &candle.losses, &own.losses, 1e-4);
    assert_near("values", &values, &own_values, 1e-3);
    // Products in bf16 are near, and not the same.
    let (_, half) = elsewhere(|| train(&compute(Precision { tf32: false, bf16: true })));
    assert_ne!(half.losses, candle.losses);
    assert_near("losses in bf16", &half.losses, &own.losses, 5e-2);
}
