//! A step that several ranks share: the same bytes as on one.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Direction, Episode, Image, Observation, Origin, Team as _, Threads, all_alike};
use e2h_data::{Normaliser, NormaliserConfig, Source};
use e2h_nn::Weights;
use e2h_policy::{
    Error, PolicyConfig, ScheduleConfig, ScheduleKind, ScheduledAdam, TrainConfig, Trainer, TrainingData,
};
use std::path::Path;
use std::sync::Arc;

/// A path whose end is padding to those that look at it, so that shards have unlike masks.
fn episode(rows: usize) -> Episode {
    let cameras = ["table".to_owned(), "wrist".to_owned()];
    let mut episode = Episode::new(Origin::demonstration("line", Direction::Hard, 0, 0), &cameras);
    for t in 0..rows {
        let x = t as f32 * 0.01;
        let state = [x, -x, 0.5 * x, 0., 1., 0., 0., 0.3, x, 0.1, 1., 0., 0., 0., 0.08];
        let image = Image { height: 24, width: 24, data: vec![(t * 4) as u8; 24 * 24 * 3] };
        let action = [x + 0.01, -x - 0.01, 0.5 * x, 0., 1., 0., 0., 1.];
        episode.push(&Observation { state, frames: vec![image.clone(), image] }, &action).unwrap();
    }
    episode.terminal = false;
    episode
}

fn train(shards: usize) -> TrainConfig {
    TrainConfig {
        conditions: 16,
        noises: 2,
        shards,
        conditioning_dropout: 0.2,
        indicator_dropout: 0.3,
        observation_noise: 0.05,
        keypoint_sharpness: 1.0,
        adam: ScheduledAdam { clip_norm: Some(1.0), ..Default::default() },
        schedule: ScheduleConfig { kind: ScheduleKind::Cosine, lr: 2e-3, warmup: 2 },
        ema: e2h_nn::EmaConfig::default(),
    }
}

fn config() -> PolicyConfig {
    PolicyConfig { indicator: true, ..PolicyConfig::tiny() }
}

const STEPS: usize = 12;

/// Trains until step `until` on `ranks` threads, from a state if one is there, and leaves one; the weights and losses of each.
fn trained(shards: usize, ranks: usize, until: usize, state: &Path) -> Vec<(Weights, Vec<f32>)> {
    let episodes = vec![Arc::new(episode(20)), Arc::new(episode(9))];
    let normaliser = Normaliser::fit(&[episode(20)], &NormaliserConfig::default()).unwrap();
    let sources = [Source::new(episodes.clone(), 0.5).labelled(1.0), Source::new(episodes, 0.5)];
    Threads::run(ranks, |team| {
        let config = config();
        let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
        let mut trainer = Trainer::new(&config, &train(shards), STEPS, None, 3, "shards").unwrap();
        if state.exists() {
            trainer.restore(state).unwrap();
        }
        let losses =
            (trainer.step_count()..until).map(|_| trainer.step_with(&data, &team).unwrap()).collect();
        assert!(all_alike(&team, trainer.fingerprint(&data).unwrap().as_bytes()).unwrap());
        if team.rank() == 0 {
            trainer.save(state).unwrap();
        }
        (trainer.weights().unwrap(), losses)
    })
}

#[test]
fn weights_are_the_same_bytes_on_1_2_and_4_ranks_also_where_their_number_changes() {
    let dir = tempfile::tempdir().unwrap();
    let one = trained(4, 1, STEPS, &dir.path().join("1"));
    for ranks in [2, 4] {
        for rank in trained(4, ranks, STEPS, &dir.path().join(ranks.to_string())) {
            assert_eq!(rank, one[0], "{ranks} ranks");
        }
    }
    let state = dir.path().join("resumed");
    trained(4, 4, 5, &state);
    for (weights, losses) in trained(4, 2, STEPS, &state) {
        assert_eq!((weights, &losses[..]), (one[0].0.clone(), &one[0].1[5..]), "4 ranks, then 2");
    }
}

#[test]
fn shards_change_last_bits_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let whole = trained(1, 1, STEPS, &dir.path().join("whole"))[0].clone();
    let parts = trained(4, 1, STEPS, &dir.path().join("parts"))[0].clone();
    let (mut apart, mut length) = (0.0, 0.0);
    for (a, b) in whole.0.values().zip(parts.0.values()) {
        for (a, b) in a.data.iter().zip(&b.data) {
            apart += f64::from(a - b).powi(2);
            length += f64::from(*a).powi(2);
        }
    }
    let relative = (apart / length).sqrt();
    // A mean of the shards' means would differ in the second digit here.
    assert!(relative > 0.0 && relative < 1e-5, "relative distance {relative:e}");
    for (a, b) in whole.1.iter().zip(&parts.1) {
        assert!((a - b).abs() < 1e-4 * a.abs(), "{:?} and {:?}", whole.1, parts.1);
    }
}

#[test]
fn a_loss_that_is_no_number_on_one_rank_ends_all_at_the_same_step() {
    let normaliser = Normaliser::fit(&[episode(20)], &NormaliserConfig::default()).unwrap();
    let mut wild = episode(20);
    wild.action[7] = [1e30; 8];
    // Of sixteen observations one, so of eight shards one.
    let sources = [Source::new(vec![Arc::new(episode(20))], 15.0), Source::new(vec![Arc::new(wild)], 1.0)];
    let errors = Threads::run(4, |team| {
        let config = PolicyConfig::tiny();
        let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
        let mut trainer = Trainer::new(&config, &train(8), 40, None, 3, "shards").unwrap();
        (0..40).find_map(|_| trainer.step_with(&data, &team).err()).unwrap()
    });
    let steps: Vec<_> = errors
        .iter()
        .map(|e| match e {
            Error::NotFinite { step, .. } => *step,
            other => panic!("{other}"),
        })
        .collect();
    assert!(steps.iter().all(|step| *step == steps[0]), "{steps:?}");
}

#[test]
fn ranks_that_do_not_divide_the_shards_and_shards_that_do_not_divide_a_step_are_refused() {
    let normaliser = Normaliser::fit(&[episode(20)], &NormaliserConfig::default()).unwrap();
    let sources = [Source::whole(vec![Arc::new(episode(20))])];
    let config = PolicyConfig::tiny();
    let messages = Threads::run(3, |team| {
        let data = TrainingData::new(&sources, &config, &normaliser).unwrap();
        let mut trainer = Trainer::new(&config, &train(4), 1, None, 3, "shards").unwrap();
        trainer.step_with(&data, &team).unwrap_err().to_string()
    });
    assert!(
        messages.iter().all(|m| m.ends_with("expected a multiple of the 3 ranks, got 4")),
        "{messages:?}"
    );
    for shards in [0, 3, 32] {
        let message = Trainer::new(&config, &train(shards), 1, None, 3, "shards").err().unwrap().to_string();
        let expected = format!("expected a power of two that divides conditions (16), got {shards}");
        assert!(message.ends_with(&expected), "{message}");
    }
}
