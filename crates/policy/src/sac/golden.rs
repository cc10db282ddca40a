//! One update against that of stable-baselines3 2.9.2 (`tests/golden/make_sac.py`).

use super::network::part;
use super::{Batch, Sac, SacConfig};
use e2h_nn::{Compute, HostTensor, Weights, backward};

const SIZES: [usize; 2] = [5, 3];

fn reference() -> Weights {
    let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/sac.safetensors");
    let file = std::fs::read(path).unwrap();
    let file = safetensors::SafeTensors::deserialize(&file).unwrap();
    let read = |(name, view): (String, safetensors::tensor::TensorView<'_>)| {
        let data =
            view.data().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
        (name, HostTensor { shape: view.shape().to_vec(), data })
    };
    file.tensors().into_iter().map(read).collect()
}

fn numbers(all: &Weights, name: &str) -> Vec<f32> {
    all[name].data.clone()
}

fn batch(all: &Weights) -> Batch {
    let of = |name: &str| numbers(all, &format!("batch.{name}"));
    Batch {
        observation: of("observation"),
        action: of("action"),
        reward: of("reward"),
        next: of("next"),
        bootstrap: of("bootstrap"),
    }
}

fn agent(all: &Weights) -> Sac {
    let config = SacConfig {
        hidden: vec![16, 12],
        lr: 1e-3,
        entropy_in_target: true,
        actor_every: 1,
        ..SacConfig::default()
    };
    let mut sac = Sac::new(&config, SIZES[0], SIZES[1], &Compute::cpu(), 0, "golden").unwrap();
    sac.actor().load(&part(all, "actor.")).unwrap();
    sac.critic_params().import(&part(all, "critics.")).unwrap();
    sac.target_params().import(&part(all, "targets.")).unwrap();
    sac.set_alpha(0.1);
    sac
}

#[track_caller]
fn near(what: &str, found: &[f32], expected: &[f32], tolerance: f32) {
    assert_eq!(found.len(), expected.len(), "{what}");
    let scale = expected.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
    for (i, (f, e)) in found.iter().zip(expected).enumerate() {
        assert!((f - e).abs() <= tolerance * scale, "{what}[{i}]: {f}, expected {e}");
    }
}

#[test]
fn targets_losses_and_gradients_are_those_of_stable_baselines3() {
    let all = reference();
    let (sac, b) = (agent(&all), batch(&all));
    let y = sac.targets(&b, &numbers(&all, "noise.target")).unwrap();
    near("targets", &y, &numbers(&all, "y"), 1e-5);
    let (loss, _) = sac.critic_loss(&b, &y).unwrap();
    near("loss of the critics", &[loss.to_scalar().unwrap()], &numbers(&all, "loss.critics"), 1e-5);
    let grads = backward(&loss, sac.critic_params()).unwrap().export(sac.critic_params()).unwrap();
    let expected = part(&all, "grad.critics.");
    assert_eq!(grads.len(), expected.len());
    for (name, grad) in &grads {
        // There both errors are halved.
        let twice: Vec<f32> = expected[name].data.iter().map(|g| 2.0 * g).collect();
        near(name, &grad.data, &twice, 1e-4);
    }
    // There the actor learns after the critics' step.
    sac.critic_params().import(&part(&all, "after.critics.")).unwrap();
    let (loss, log_p) = sac.actor_loss(&b, &numbers(&all, "noise.actor")).unwrap();
    near("loss of the actor", &[loss.to_scalar().unwrap()], &numbers(&all, "loss.actor"), 1e-5);
    let grads = backward(&loss, sac.actor().params()).unwrap().export(sac.actor().params()).unwrap();
    for (name, grad) in &part(&all, "grad.actor.") {
        near(name, &grads[name].data, &grad.data, 1e-4);
    }
    near("gradient of alpha", &[sac.surplus(log_p)], &numbers(&all, "grad.log_alpha"), 1e-5);
}

#[test]
fn a_whole_update_ends_where_that_of_stable_baselines3_does() {
    let all = reference();
    let mut sac = agent(&all);
    let noise = [numbers(&all, "noise.target"), numbers(&all, "noise.actor")];
    sac.update_with(&batch(&all), &noise).unwrap();
    let mut state = Weights::new();
    sac.state("", &mut state).unwrap();
    // A step of Adam is the learning rate, whatever the size of a gradient; where one is next to nothing its sign is noise.
    let grads = part(&all, "grad.critics.");
    for (name, expected) in &part(&all, "after.critics.") {
        let found = &state[&format!("critics.{name}")].data;
        for ((f, e), g) in found.iter().zip(&expected.data).zip(&grads[name].data) {
            assert!((f - e).abs() < if g.abs() > 1e-5 { 2e-6 } else { 2.1e-3 }, "{name}: {f}, expected {e}");
        }
    }
    for (name, expected) in &part(&all, "after.actor.") {
        near(name, &state[&format!("actor.{name}")].data, &expected.data, 2e-5);
    }
    for (name, expected) in &part(&all, "after.targets.") {
        near(name, &state[&format!("targets.{name}")].data, &expected.data, 2e-5);
    }
    near("alpha", &[state["alpha"].data[0]], &numbers(&all, "after.log_alpha"), 1e-5);
}
