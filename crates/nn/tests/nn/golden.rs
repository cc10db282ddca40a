//! Against LeRobot 0.4.4 on torch 2.7.1; see `tests/golden/README.md`.

use crate::support::{Golden, assert_close, difference, elsewhere, filled, input, loss, values, wide};
use e2h_nn::{ConditionalUnet1d, Mode, RgbEncoder, RgbEncoderConfig, UnetConfig, backward};

fn unet() -> UnetConfig {
    UnetConfig {
        input_dim: 8,
        down_dims: vec![32, 64, 128],
        kernel_size: 5,
        n_groups: 8,
        step_embed_dim: 32,
        cond_dim: 286,
    }
}

#[test]
fn unet_output_and_gradients() {
    unet_as_in_lerobot();
    elsewhere(unet_as_in_lerobot);
}

fn unet_as_in_lerobot() {
    let golden = Golden::open("unet1d");
    let (params, net) = filled(Mode::Train, |b| ConditionalUnet1d::new(&unet(), b));
    let steps: Vec<f32> = golden.get("t").1.iter().map(|t| *t as f32).collect();
    let y = net.forward(&golden.tensor("x"), &steps, &golden.tensor("cond")).unwrap();
    assert_close("output", &wide(&values(&y)), &golden.get("out").1, 1e-5);
    let l = loss(&y);
    assert_close("loss", &[f64::from(l.to_scalar::<f32>().unwrap())], &golden.get("L").1, 1e-5);
    let grads = backward(&l, &params).unwrap().export(&params).unwrap();
    golden.compare_gradients(&grads, 1e-4);
}

#[test]
fn rgb_encoder_output_and_gradients() {
    rgb_encoder_as_in_lerobot();
    elsewhere(rgb_encoder_as_in_lerobot);
}

fn rgb_encoder_as_in_lerobot() {
    let golden = Golden::open("rgb_encoder");
    let config = RgbEncoderConfig {
        height: 56,
        width: 56,
        base_width: 64,
        stage_blocks: vec![2, 2, 2, 2],
        keypoints: 32,
        feature_dim: 64,
    };
    let (params, net) = filled(Mode::Train, |b| RgbEncoder::new(&config, b));
    let x = golden.tensor("x").permute((0, 2, 3, 1)).unwrap();
    let y = net.forward(&x).unwrap();
    // This case is ill-conditioned: scaling the images by 1 + 3e-7 moves gradients by 1e-3, outputs by 2e-5.
    assert_close("output", &wide(&values(&y)), &golden.get("out").1, 1e-4);
    let grads = backward(&loss(&y), &params).unwrap().export(&params).unwrap();
    golden.compare_gradients(&grads, 5e-4);
}

/// Against float64. Where a number lies beside a kink, one rounding more or less turns a whole path on or off: single cases say
/// nothing, their middle does.
#[test]
fn the_rgb_encoder_rounds_no_worse_than_torch() {
    const SAMPLES: usize = 16;
    let golden = Golden::open("rounding");
    let config = RgbEncoderConfig {
        height: 72,
        width: 64,
        base_width: 64,
        stage_blocks: vec![2, 2, 2, 2],
        keypoints: 32,
        feature_dim: 64,
    };
    let (params, net) = filled(Mode::Train, |b| RgbEncoder::new(&config, b));
    let (mut ours, mut torch) = ([vec![], vec![]], [vec![], vec![]]);
    for case in 0..25 {
        let x = input(1020 + case, &[2, 3, 72, 64], 0.5, 0.5).permute((0, 2, 3, 1)).unwrap();
        let y = net.forward(&x).unwrap();
        ours[0].push(difference(&wide(&values(&y)), &golden.get(&format!("out.{case}")).1));
        let grads = backward(&loss(&y), &params).unwrap().export(&params).unwrap();
        let (_, expected) = golden.get(&format!("grad.{case}"));
        let mut off = vec![];
        for ((name, g), want) in grads.iter().zip(expected.chunks_exact(SAMPLES)) {
            let step = g.data.len() / SAMPLES;
            let got: Vec<f32> = g.data.iter().step_by(step).take(SAMPLES).copied().collect();
            let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|v| v * v).sum::<f64>().sqrt();
            let size = norm(&mut want.iter().copied());
            if name != "pool.nets.bias" && size > 0.0 {
                off.push(norm(&mut wide(&got).iter().zip(want).map(|(a, b)| a - b)) / size);
            }
        }
        ours[1].push(middle(off));
        let (_, found) = golden.get(&format!("torch.{case}"));
        torch[0].push(found[0]);
        torch[1].push(found[1]);
    }
    for (what, (ours, torch)) in ["output", "gradients"].iter().zip(ours.into_iter().zip(torch)) {
        let (ours, torch) = (middle(ours), middle(torch));
        println!("{what}: {ours:.2e} from float64, torch {torch:.2e}");
        assert!(ours <= torch, "{what}: {ours:.2e} from float64, torch {torch:.2e}");
    }
}

fn middle(mut v: Vec<f64>) -> f64 {
    v.sort_by(f64::total_cmp);
    v[v.len() / 2]
}

#[test]
fn without_a_record_the_output_is_the_same() {
    without_a_record();
    elsewhere(without_a_record);
}

fn without_a_record() {
    let golden = Golden::open("unet1d");
    let steps: Vec<f32> = golden.get("t").1.iter().map(|t| *t as f32).collect();
    let (x, cond) = (golden.tensor("x"), golden.tensor("cond"));
    let (_, train) = filled(Mode::Train, |b| ConditionalUnet1d::new(&unet(), b));
    let (_, infer) = filled(Mode::Infer, |b| ConditionalUnet1d::new(&unet(), b));
    let with = train.forward(&x, &steps, &cond).unwrap();
    let without = infer.forward(&x, &steps, &cond).unwrap();
    let off = e2h_nn::no_grad(|| train.forward(&x, &steps, &cond)).unwrap();
    assert!(with.track_op() && !without.track_op() && !off.track_op());
    assert_eq!(values(&with), values(&without));
    assert_eq!(values(&with), values(&off));
}
