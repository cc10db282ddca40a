//! A policy that is told which of its data to follow: it begins as the plain one, learns the difference, and is asked for the good.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{ActionChunk, Direction, Episode, Image, Observation, Origin, stream};
use e2h_data::{Normaliser, NormaliserConfig, Source};
use e2h_nn::{EmaConfig, Weights};
use e2h_policy::{
    DiffusionPolicy, PolicyConfig, Prediction, Provenance, ScheduleConfig, ScheduleKind, ScheduledAdam,
    TrainConfig, Trainer, TrainingData, lerobot,
};
use rand::Rng as _;
use std::sync::Arc;

fn observation(x: f32) -> Observation {
    let state = [x, -x, 0.5 * x, 0., 1., 0., 0., 0.3, x, 0.1, 1., 0., 0., 0., 0.08];
    let image = Image { height: 24, width: 24, data: vec![(x * 400.0) as u8; 24 * 24 * 3] };
    Observation { state, frames: vec![image.clone(), image] }
}

/// A path along a line whose goals lie `aside` of it.
fn episode(rows: usize, aside: f32) -> Episode {
    let cameras = ["table".to_owned(), "wrist".to_owned()];
    let mut episode = Episode::new(Origin::demonstration("line", Direction::Hard, 0, 0), &cameras);
    for t in 0..rows {
        let x = t as f32 * 0.01;
        episode.push(&observation(x), &[x + 0.01, aside - x, 0.5 * x, 0., 1., 0., 0., 1.]).unwrap();
    }
    episode
}

fn normaliser() -> Normaliser {
    Normaliser::fit(&[episode(40, 0.2), episode(40, -0.2)], &NormaliserConfig::default()).unwrap()
}

fn train_config() -> TrainConfig {
    TrainConfig {
        conditions: 16,
        noises: 2,
        shards: 1,
        conditioning_dropout: 0.0,
        indicator_dropout: 0.3,
        observation_noise: 0.05,
        keypoint_sharpness: 1.0,
        // A clip would tie the step of every weight to the gradients of all others.
        adam: ScheduledAdam { clip_norm: None, ..Default::default() },
        schedule: ScheduleConfig { kind: ScheduleKind::Constant, lr: 2e-3, warmup: 0 },
        ema: EmaConfig::default(),
    }
}

fn with_indicator(plain: &PolicyConfig) -> PolicyConfig {
    PolicyConfig { indicator: true, ..plain.clone() }
}

/// Plain networks whose conditions end inside a block of the products' sums and at its border.
fn plain() -> [PolicyConfig; 3] {
    let tiny = PolicyConfig::tiny();
    let blind = PolicyConfig { cameras: vec![], step_embed_dim: 98, ..PolicyConfig::tiny() };
    assert_eq!(blind.step_embed_dim + blind.condition_dim(), 128);
    [
        tiny,
        blind,
        PolicyConfig { relative_features: true, prediction: Prediction::Epsilon, ..PolicyConfig::tiny() },
    ]
}

fn act(config: &PolicyConfig, weights: &Weights) -> Vec<ActionChunk> {
    let policy = DiffusionPolicy::with_weights(config, &normaliser(), weights).unwrap();
    let histories: Vec<Vec<Observation>> =
        [0.03, 0.17, 0.3].map(|x| vec![observation(x), observation(x + 0.01)]).into();
    let histories: Vec<Vec<&Observation>> = histories.iter().map(|h| h.iter().collect()).collect();
    policy.sample(&histories, &mut [0, 1, 2].map(|i| stream(0, "act", 0, i))).unwrap()
}

fn reads_condition(name: &str) -> bool {
    name.ends_with("cond_encoder.1.weight")
}

#[test]
fn a_widened_policy_acts_as_the_plain_one_to_the_last_bit() {
    for config in plain() {
        let start = DiffusionPolicy::untrained(&config, &normaliser(), 3).unwrap().weights().unwrap();
        for guidance in [1.0, 2.5] {
            let wide = PolicyConfig { guidance, ..with_indicator(&config) };
            let trainer = Trainer::new(&wide, &train_config(), 1, Some(&start), 1, "widen").unwrap();
            let weights = trainer.weights().unwrap();
            let mut wider = 0;
            for (name, before) in &start {
                let after = &weights[name];
                if !reads_condition(name) {
                    assert_eq!(before, after, "{name}");
                    continue;
                }
                let [rows, columns] = before.shape[..] else { panic!("{name}: {:?}", before.shape) };
                assert_eq!(after.shape, [rows, columns + 1], "{name}");
                for (a, b) in after.data.chunks(columns + 1).zip(before.data.chunks(columns)) {
                    assert!(a[..columns] == *b && a[columns] == 0.0, "{name}");
                }
                wider += 1;
            }
            assert_eq!(wider, 2 * (2 * config.down_dims.len()), "one in every residual block");
            // With c = 0 and c = 1 the same, guidance has nothing to add but its rounding.
            let (plain, wide) = (act(&config, &start), act(&wide, &weights));
            if guidance == 1.0 {
                assert_eq!(plain, wide);
            }
            let worst = plain.iter().flatten().flatten().zip(wide.iter().flatten().flatten());
            assert!(worst.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) < 1e-4);
        }
        // Weights that have the column already are taken as they are.
        let wide = with_indicator(&config);
        let drawn = DiffusionPolicy::untrained(&wide, &normaliser(), 4).unwrap().weights().unwrap();
        let again = Trainer::new(&wide, &train_config(), 1, Some(&drawn), 1, "widen").unwrap();
        assert_eq!(again.weights().unwrap(), drawn);
    }
}

/// The same draws, the same loss, the same gradients: the first step of a widened network moves everything but its new column as
/// the plain network's does.
#[test]
fn the_first_step_of_a_widened_policy_is_the_plain_ones_and_a_step_of_its_own_column() {
    let normaliser = normaliser();
    let episodes = [0.2, -0.2].map(|aside| Arc::new(episode(40, aside)));
    let sources = [
        Source::new(vec![episodes[0].clone()], 0.5).labelled(1.0),
        Source::new(vec![episodes[1].clone()], 0.5).labelled(-1.0),
    ];
    let train = TrainConfig { conditioning_dropout: 0.3, ..train_config() };
    for config in plain() {
        let start = DiffusionPolicy::untrained(&config, &normaliser, 3).unwrap().weights().unwrap();
        let step = |config: &PolicyConfig| {
            let data = TrainingData::new(&sources, config, &normaliser).unwrap();
            let mut trainer = Trainer::new(config, &train, 1, Some(&start), 1, "step").unwrap();
            let loss = trainer.step(&data).unwrap();
            (loss, trainer.weights().unwrap())
        };
        let ((plain_loss, plain), (loss, wide)) = (step(&config), step(&with_indicator(&config)));
        assert_eq!(plain_loss.to_bits(), loss.to_bits());
        assert_ne!(plain, start);
        for (name, want) in &plain {
            let mut got = wide[name].clone();
            if reads_condition(name) {
                let columns = got.shape[1];
                let column: Vec<f32> = got.data.chunks(columns).map(|row| row[columns - 1]).collect();
                assert!(column.iter().any(|v| *v != 0.0), "{name}: the column has not moved");
                got.data = got.data.chunks(columns).flat_map(|row| row[..columns - 1].to_vec()).collect();
                got.shape[1] -= 1;
            }
            assert_eq!(*want, got, "{name}");
        }
    }
}

/// Mish, which the condition passes on its way into every block.
fn mish(x: f32) -> f32 {
    x * x.exp().ln_1p().tanh()
}

/// With c fixed its column is a part of the bias: so a policy with an indicator that is sampled at c is a plain one.
fn fixed_at(c: f32, wide: &Weights) -> Weights {
    let mut plain = wide.clone();
    for (name, tensor) in wide.iter().filter(|(name, _)| reads_condition(name)) {
        let columns = tensor.shape[1];
        let bias = plain.get_mut(&name.replace(".weight", ".bias")).unwrap();
        for (b, row) in bias.data.iter_mut().zip(tensor.data.chunks(columns)) {
            *b += row[columns - 1] * mish(c);
        }
        let weight = plain.get_mut(name).unwrap();
        weight.shape[1] -= 1;
        weight.data = tensor.data.chunks(columns).flat_map(|row| row[..columns - 1].to_vec()).collect();
    }
    plain
}

/// Weights in which the indicator says much.
fn loud(config: &PolicyConfig) -> Weights {
    let mut weights = DiffusionPolicy::untrained(config, &normaliser(), 5).unwrap().weights().unwrap();
    let mut rng = stream(5, "loud", 0, 0);
    for (_, tensor) in weights.iter_mut().filter(|(name, _)| reads_condition(name)) {
        let columns = tensor.shape[1];
        tensor.data.chunks_mut(columns).for_each(|row| row[columns - 1] = rng.random_range(-2.0..2.0));
    }
    weights
}

fn apart(a: &[ActionChunk], b: &[ActionChunk]) -> f32 {
    let pairs = a.iter().flatten().flatten().zip(b.iter().flatten().flatten());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn a_policy_is_asked_for_what_has_the_positive_label() {
    for config in plain() {
        let wide = with_indicator(&config);
        let weights = loud(&wide);
        let actions = act(&wide, &weights);
        assert!(apart(&actions, &act(&config, &fixed_at(1.0, &weights))) < 1e-4);
        for other in [0.0, -1.0] {
            assert!(apart(&actions, &act(&config, &fixed_at(other, &weights))) > 1e-2, "{other}");
        }
        // A weight of 0 is the unconditional pass: the same observation, and nothing known of the label.
        let free = act(&PolicyConfig { guidance: 0.0, ..wide.clone() }, &weights);
        assert!(apart(&free, &act(&config, &fixed_at(0.0, &weights))) < 1e-4);
    }
}

/// One step from noise to actions is linear in what the network predicts of them, so guidance is seen in the actions themselves.
#[test]
fn guidance_goes_on_from_no_label_past_the_positive_one() {
    let config = PolicyConfig {
        indicator: true,
        inference_steps: 1,
        prediction: Prediction::Sample,
        unit_quaternion: false,
        ..PolicyConfig::tiny()
    };
    // Small, so that nothing is clipped.
    let mut weights = loud(&config);
    for end in ["weight", "bias"] {
        let last = weights.get_mut(&format!("diffusion.unet.final_conv.1.{end}")).unwrap();
        last.data.iter_mut().for_each(|v| *v *= 0.05);
    }
    let at = |guidance: f32| act(&PolicyConfig { guidance, ..config.clone() }, &weights);
    let (free, positive) = (at(0.0), at(1.0));
    assert!(apart(&free, &positive) > 1e-3, "{}", apart(&free, &positive));
    for beta in [1.5, 2.0, 2.5] {
        let mut wanted = free.clone();
        for (w, p) in wanted.iter_mut().flatten().flatten().zip(positive.iter().flatten().flatten()) {
            *w += beta * (p - *w);
        }
        let off = apart(&wanted, &at(beta));
        assert!(off < 1e-5, "{beta}: {off}");
    }
}

#[test]
fn what_is_labelled_good_is_done_and_what_is_labelled_bad_is_not() {
    let normaliser = normaliser();
    let config = PolicyConfig { cameras: vec![], ..PolicyConfig::tiny() };
    // The same is seen, and other things are done: nothing but the label tells them apart.
    let source = |aside: f32| Source::new(vec![Arc::new(episode(40, aside))], 0.5);
    let aside = |good: f32, label: f32| {
        let wide = with_indicator(&config);
        let sources = [source(good).labelled(label), source(-good).labelled(-label)];
        let data = TrainingData::new(&sources, &wide, &normaliser).unwrap();
        let start = DiffusionPolicy::untrained(&config, &normaliser, 3).unwrap().weights().unwrap();
        let train = TrainConfig { observation_noise: 0.0, ..train_config() };
        let mut trainer = Trainer::new(&wide, &train, 500, Some(&start), 1, "labels").unwrap();
        for _ in 0..500 {
            trainer.step(&data).unwrap();
        }
        let chunks = act(&wide, &trainer.weights().unwrap());
        // The first action's second entry is this much off the path.
        [0.04, 0.18, 0.31].iter().zip(&chunks).map(|(x, c)| c[0][1] + x).sum::<f32>() / 3.0
    };
    let (left, right) = (aside(0.2, 1.0), aside(0.2, -1.0));
    assert!((left - 0.2).abs() < 0.06, "asked for 0.2 aside: {left}");
    assert!((right + 0.2).abs() < 0.06, "asked for -0.2 aside: {right}");
}

#[test]
fn checkpoints_say_it_where_it_is_and_nothing_where_it_is_not() {
    let dir = tempfile::tempdir().unwrap();
    for (config, says) in [(PolicyConfig::tiny(), false), (with_indicator(&PolicyConfig::tiny()), true)] {
        let policy = DiffusionPolicy::untrained(&config, &normaliser(), 3).unwrap();
        policy.save(dir.path(), &Provenance::default()).unwrap();
        let text = std::fs::read_to_string(dir.path().join("policy.json")).unwrap();
        assert_eq!(text.contains("indicator"), says, "{text}");
        let (back, checkpoint) = DiffusionPolicy::load(dir.path()).unwrap();
        assert_eq!(back.weights().unwrap(), policy.weights().unwrap());
        assert_eq!(checkpoint.config, config);
    }
    // LeRobot has no such input.
    let obstacles = lerobot::obstacles(&with_indicator(&PolicyConfig::tiny()));
    assert!(obstacles.iter().any(|o| o.setting == "indicator"), "{obstacles:?}");
}
