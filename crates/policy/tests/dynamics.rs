//! Dynamics models tell a step that can happen from one that cannot, and which action makes it.

#![allow(clippy::unwrap_used, reason = "a test that cannot be set up should fail")]

use e2h_core::{Action, Direction, Episode, Image, Observation, Origin, Outcome, stream};
use e2h_data::{Normaliser, NormaliserConfig};
use e2h_nn::{Compute, Weights};
use e2h_policy::{
    DiffusionPolicy, Dynamics, DynamicsConfig, DynamicsReport, DynamicsTraining, Error, PolicyConfig,
    train_dynamics,
};
use rand::Rng as _;
use std::ops::ControlFlow;

/// A walk in an oblique plane: each step goes to the goal of its action, never far from the middle; pictures brighten with x.
fn walk(seed: u64, rows: usize) -> Episode {
    let mut rng = stream(seed, "walk", 0, 0);
    let cameras = ["table".to_owned(), "wrist".to_owned()];
    let mut episode = Episode::new(Origin::demonstration("walk", Direction::Hard, 0, seed), &cameras);
    let mut at = [0.0f32; 2];
    for _ in 0..rows {
        let next = [0, 1].map(|i| 0.92 * at[i] + rng.random_range(-0.02..0.02f32));
        let state = [
            at[0],
            at[1],
            0.3 + at[0],
            0.,
            1.,
            0.,
            0.,
            0.1 + 0.2 * at[1],
            0.2 * at[0],
            0.1,
            1.,
            0.,
            0.,
            0.,
            0.05,
        ];
        let grey = (128.0 + 500.0 * at[0]) as u8;
        let image = Image { height: 24, width: 24, data: vec![grey; 24 * 24 * 3] };
        let action = [next[0], next[1], 0.3 + next[0], 0., 1., 0., 0., 0.];
        episode.push(&Observation { state, frames: vec![image.clone(), image] }, &action).unwrap();
        at = next;
    }
    episode.outcome = Outcome::Success { at: rows - 1 };
    episode
}

struct Parts {
    config: PolicyConfig,
    normaliser: Normaliser,
    weights: Weights,
    rollouts: Vec<Episode>,
}

fn parts() -> Parts {
    let rollouts: Vec<Episode> = (0..10).map(|seed| walk(seed, 80)).collect();
    let config = PolicyConfig::tiny();
    let normaliser = Normaliser::fit(&rollouts, &NormaliserConfig::default()).unwrap();
    let weights = DiffusionPolicy::untrained(&config, &normaliser, 3).unwrap().weights().unwrap();
    Parts { config, normaliser, weights, rollouts }
}

fn train(p: &Parts, dynamics: &DynamicsConfig) -> Result<(Dynamics, DynamicsReport), Error> {
    let training = DynamicsTraining {
        policy: &p.config,
        policy_weights: &p.weights,
        dynamics,
        compute: &Compute::cpu(),
        normaliser: &p.normaliser,
        rollouts: &p.rollouts,
        seed: 4,
        purpose: "test",
    };
    train_dynamics(&training, |_, _| ControlFlow::Continue(()))
}

fn small() -> DynamicsConfig {
    DynamicsConfig { hidden: vec![64], steps: 600, batch: 64, ..DynamicsConfig::default() }
}

#[test]
fn steps_that_happen_have_small_errors_and_their_own_actions() {
    let p = parts();
    let (dynamics, report) = train(&p, &small()).unwrap();
    assert!(report.forward < 0.05 && report.forward_held_out.unwrap() < 0.1, "{report:?}");
    assert!(report.inverse_held_out.unwrap() < 0.05, "{report:?}");
    assert!(report.label_mm.unwrap() < 8.0, "{report:?}");

    let path = walk(77, 60);
    let (errors, labels) = dynamics.judge(&path).unwrap();
    assert_eq!((errors.len(), labels.len()), (60, 60));
    assert_eq!((errors[59], labels[59][..7].to_vec()), (errors[58], labels[58][..7].to_vec()));
    let off = |t: usize| (0..2).map(|i| (labels[t][i] - path.action[t][i]).powi(2)).sum::<f32>().sqrt();
    let mean = (0..59).map(off).sum::<f32>() / 59.0;
    assert!(mean < 0.008, "{mean}");
    for (label, own) in labels.iter().zip(&path.action) {
        assert!((label[3..7].iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5);
        assert_eq!(label[7], own[7], "the gripper is the path's own");
    }

    // A jump across the plane is no step of these.
    let mut broken = path.clone();
    for row in 30..60 {
        broken.state[row][0] = -broken.state[row][0] + 0.15;
    }
    let (jumped, _) = dynamics.judge(&broken).unwrap();
    let others = jumped[..28].iter().copied().fold(0.0, f32::max);
    assert!(jumped[29] > 3.0 * others, "{} against {others}", jumped[29]);
}

#[test]
fn the_same_seed_gives_the_same_numbers_and_every_value_counts() {
    let p = parts();
    let base = DynamicsConfig { steps: 12, ..small() };
    let judged = |c: &DynamicsConfig| train(&p, c).unwrap().0.judge(&p.rollouts[0]).unwrap();
    let once = judged(&base);
    assert_eq!(once, judged(&base));
    for (name, other) in [
        ("hidden", DynamicsConfig { hidden: vec![32], ..base.clone() }),
        ("steps", DynamicsConfig { steps: 13, ..base.clone() }),
        ("batch", DynamicsConfig { batch: 63, ..base.clone() }),
        ("lr", DynamicsConfig { lr: 2e-3, ..base.clone() }),
        ("validation", DynamicsConfig { validation: 0.5, ..base.clone() }),
    ] {
        assert_ne!(once, judged(&other), "{name}");
    }
}

#[test]
fn what_does_not_fit_is_said() {
    let p = parts();
    let refused = |p: &Parts, c: &DynamicsConfig| train(p, c).err().unwrap().to_string();
    for (bad, word) in [
        (DynamicsConfig { steps: 0, ..small() }, "steps: expected 1"),
        (DynamicsConfig { batch: 0, ..small() }, "batch"),
        (DynamicsConfig { lr: f32::NAN, ..small() }, "lr"),
        (DynamicsConfig { validation: 1.0, ..small() }, "validation"),
        (DynamicsConfig { hidden: vec![0], ..small() }, "hidden"),
    ] {
        assert!(refused(&p, &bad).contains(word), "{word}");
    }
    let mut none = parts();
    none.rollouts = vec![walk(0, 1)];
    assert!(refused(&none, &small()).contains("two rows"));
    let mut blind = parts();
    blind.weights = Weights::default();
    assert!(refused(&blind, &small()).contains("image encoders"));
    // A path of one row has no step.
    let (dynamics, _) = train(&p, &DynamicsConfig { steps: 2, ..small() }).unwrap();
    let one = walk(5, 1);
    let (errors, labels): (Vec<f32>, Vec<Action>) = dynamics.judge(&one).unwrap();
    assert_eq!((errors, labels), (vec![0.0], one.action.clone()));
}

#[test]
fn a_training_can_be_broken_off() {
    let p = parts();
    let dynamics = small();
    let training = DynamicsTraining {
        policy: &p.config,
        policy_weights: &p.weights,
        dynamics: &dynamics,
        compute: &Compute::cpu(),
        normaliser: &p.normaliser,
        rollouts: &p.rollouts,
        seed: 4,
        purpose: "test",
    };
    let mut last = 0;
    let broken = train_dynamics(&training, |step, _| {
        last = step;
        if step == 603 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert!(matches!(broken.err().unwrap(), Error::Stopped { step: 3 }));
    assert_eq!(last, 603, "steps of both networks are counted together");
}
