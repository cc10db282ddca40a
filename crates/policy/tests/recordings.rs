//! Policies learn from recordings of any robot, and are LeRobot's then.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Frames, Image, stream};
use e2h_data::{CameraLayout, Layout, RecordedSource, Recording};
use e2h_policy::lerobot::{Features, IMAGENET, LerobotObservation, Scalings, import, save};
use e2h_policy::{
    Error, PolicyConfig, Provenance, ScheduleConfig, ScheduleKind, ScheduledAdam, TrainConfig, Trainer,
    TrainingData,
};
use rand::Rng as _;
use std::sync::Arc;

fn layout(state: usize, environment: usize, cameras: &[&str]) -> Arc<Layout> {
    let names = |n: usize| (0..n).map(|i| i.to_string()).collect();
    let camera =
        |name: &&str| CameraLayout { feature: format!("observation.images.{name}"), height: 40, width: 56 };
    Arc::new(Layout {
        fps: 30.0,
        state: names(state),
        environment: names(environment),
        action: names(2),
        cameras: cameras.iter().map(camera).collect(),
    })
}

/// A point on a circle of 3 numbers, whose action is where it will be next; the images are as bright as it is far round.
fn circle(layout: &Arc<Layout>, rows: usize, phase: f32) -> Recording {
    let angle = |t: usize| phase + t as f32 * 0.1;
    let width = layout.state_width();
    let state = (0..rows).flat_map(|t| {
        let all = [angle(t).cos(), angle(t).sin(), 100.0];
        (0..width).map(move |i| all[i.min(2)])
    });
    let action = (0..rows).flat_map(|t| [50.0 * angle(t + 1).cos(), 50.0 * angle(t + 1).sin()]);
    let frame = |c: &CameraLayout| {
        let bytes: Vec<u8> = (0..rows).flat_map(|t| vec![(t * 5) as u8; c.height * c.width * 3]).collect();
        Frames::new(&c.feature, c.height, c.width, &bytes)
    };
    let frames = layout.cameras.iter().map(frame).collect();
    Recording::new(layout, state.collect(), action.collect(), frames, true).unwrap()
}

fn config() -> PolicyConfig {
    PolicyConfig {
        n_image_steps: 2,
        n_action_steps: 8,
        lerobot_alignment: true,
        encoder_width: 64,
        encoder_blocks: vec![2; 4],
        keypoints: 4,
        image_features: 8,
        down_dims: vec![32, 32],
        relative_features: false,
        unit_quaternion: false,
        ..PolicyConfig::tiny()
    }
}

fn train(conditions: usize) -> TrainConfig {
    TrainConfig {
        conditions,
        noises: 2,
        shards: 1,
        conditioning_dropout: 0.0,
        indicator_dropout: 0.0,
        observation_noise: 0.0,
        keypoint_sharpness: 1.0,
        adam: ScheduledAdam::default(),
        schedule: ScheduleConfig { kind: ScheduleKind::Constant, lr: 2e-3, warmup: 0 },
        ema: e2h_nn::EmaConfig::default(),
    }
}

fn sources(layout: &Arc<Layout>, n: usize) -> Vec<RecordedSource> {
    let one = |i: usize| Arc::new(circle(layout, 40, i as f32 * 0.9));
    vec![RecordedSource { recordings: (0..n).map(one).collect(), share: 1.0 }]
}

#[test]
fn a_robot_of_three_numbers_learns_and_is_opened_as_lerobots() {
    let layout = layout(2, 1, &[]);
    let features = Features::of_layout(&layout, None).unwrap();
    let sources = sources(&layout, 7);
    let scalings = Scalings::fit(&sources[0].recordings, vec![]).unwrap();
    let data = TrainingData::of_recordings(&sources, &config(), &features, &scalings, 7).unwrap();
    let mut trainer = Trainer::of_features(&config(), &features, &train(32), 400, 3, "test").unwrap();
    let before = trainer.validation_loss(&data, 4).unwrap();
    for _ in 0..400 {
        trainer.step(&data).unwrap();
    }
    let after = trainer.validation_loss(&data, 4).unwrap();
    assert!(after < 0.3 * before, "{before} to {after}");
    assert_eq!(after.to_bits(), trainer.validation_loss(&data, 4).unwrap().to_bits());

    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("policy");
    let weights = trainer.weights().unwrap();
    save(&dir, &config(), &features, &scalings, &weights, &Provenance::default()).unwrap();
    let policy = import(&dir).unwrap();
    assert_eq!((policy.state_dim(), policy.environment_dim(), policy.action_dim()), (2, 1, 2));
    // It goes on round the circle, in the units of the recording.
    let at = |a: f32| LerobotObservation {
        state: vec![a.cos(), a.sin()],
        environment: vec![100.0],
        images: vec![],
    };
    let mut rng = stream(1, "act", 0, 0);
    for angle in [0.4_f32, 1.9, 3.1] {
        let (before, now) = (at(angle - 0.1), at(angle));
        let noise = &mut |x: &mut [f32]| x.fill_with(|| rng.sample(rand_distr::StandardNormal));
        let chunk = policy.sample(&[vec![&before, &now]], noise).unwrap().remove(0);
        assert_eq!(chunk.len(), 8);
        for (i, action) in chunk.iter().enumerate() {
            let a = angle + 0.1 * (i + 1) as f32;
            let off = (action[0] - 50.0 * a.cos()).hypot(action[1] - 50.0 * a.sin());
            assert!(off < 10.0, "{off} off at {angle}, action {i}");
        }
    }
}

#[test]
fn wide_images_of_two_cameras_go_through_training_a_resume_and_lerobots_files() {
    let layout = layout(3, 0, &["front", "hand"]);
    let features = Features::of_layout(&layout, Some([36, 50])).unwrap();
    let sources = sources(&layout, 2);
    let scalings = Scalings::fit(&sources[0].recordings, vec![IMAGENET; 2]).unwrap();
    let data = TrainingData::of_recordings(&sources, &config(), &features, &scalings, 7).unwrap();
    let begin = || Trainer::of_features(&config(), &features, &train(3), 4, 5, "test").unwrap();
    let (mut whole, mut first) = (begin(), begin());
    for _ in 0..4 {
        whole.step(&data).unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let state = folder.path().join("state.safetensors");
    for _ in 0..2 {
        first.step(&data).unwrap();
    }
    first.save(&state).unwrap();
    let mut second = begin();
    second.restore(&state).unwrap();
    for _ in 0..2 {
        second.step(&data).unwrap();
    }
    let weights = whole.weights().unwrap();
    assert!(weights == second.weights().unwrap());

    let dir = folder.path().join("policy");
    save(&dir, &config(), &features, &scalings, &weights, &Provenance::default()).unwrap();
    let policy = import(&dir).unwrap();
    assert_eq!(policy.image_size(), [40, 56]);
    assert_eq!(policy.cameras().collect::<Vec<_>>(), ["observation.images.front", "observation.images.hand"]);
    let gradient = |v: u8| Image {
        height: 40,
        width: 56,
        data: (0..40 * 56 * 3).map(|i| if i / 3 % 56 > usize::from(v) { 200 } else { 20 }).collect(),
    };
    let seen = |v: u8| LerobotObservation {
        state: vec![1.0, 0.0, 100.0],
        environment: vec![],
        images: vec![gradient(v); 2],
    };
    let act = |v: u8| policy.sample(&[vec![&seen(v), &seen(v)]], &mut |x| x.fill(0.3)).unwrap();
    assert_eq!(act(10)[0].len(), 8);
    // It sees the images.
    assert_ne!(act(10), act(40));
}

#[test]
fn what_lerobot_cannot_express_and_what_does_not_fit_is_listed() {
    let mixed = Layout {
        cameras: vec![
            CameraLayout { feature: "observation.images.a".to_owned(), height: 20, width: 20 },
            CameraLayout { feature: "observation.images.b".to_owned(), height: 30, width: 20 },
        ],
        ..(*layout(3, 0, &[])).clone()
    };
    let text = Features::of_layout(&mixed, Some([40, 8])).unwrap_err().to_string();
    assert!(text.contains("images of one size") && text.contains("crop"), "{text}");

    let layout = layout(3, 0, &["front"]);
    let features = Features::of_layout(&layout, None).unwrap();
    let sources = sources(&layout, 1);
    let scalings = Scalings::fit(&sources[0].recordings, vec![]).unwrap();
    let small = PolicyConfig { encoder_width: 16, keypoints: 3, ..config() };
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("policy");
    let refused = save(&dir, &small, &features, &scalings, &Default::default(), &Provenance::default());
    let Err(Error::Lerobot { obstacles, .. }) = refused else { panic!("{refused:?}") };
    let names: Vec<&str> = obstacles.iter().map(|o| o.setting.as_str()).collect();
    assert_eq!(names, ["encoder_width", "image_features"]);
    assert!(!dir.exists());
    let other = Features { action: 5, ..features.clone() };
    assert!(TrainingData::of_recordings(&sources, &config(), &other, &scalings, 0).is_err());
}
