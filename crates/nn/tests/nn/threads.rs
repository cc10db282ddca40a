//! The number of threads changes no byte.

use crate::support::{input, rng, values};
use candle_core::Tensor;
use e2h_nn::{
    Adam, AdamConfig, ConditionalUnet1d, Ema, EmaConfig, Mlp, Mode, Params, RgbEncoder, RgbEncoderConfig,
    UnetConfig, Weights, backward, mse, repeat_rows,
};

fn networks(b: &e2h_nn::Builder<'_>) -> e2h_nn::Result<(RgbEncoder, ConditionalUnet1d)> {
    let encoder = RgbEncoderConfig {
        height: 40,
        width: 40,
        base_width: 16,
        stage_blocks: vec![1, 1],
        keypoints: 8,
        feature_dim: 16,
    };
    let unet = UnetConfig {
        input_dim: 8,
        down_dims: vec![32, 64],
        kernel_size: 5,
        n_groups: 8,
        step_embed_dim: 16,
        cond_dim: 16,
    };
    Ok((RgbEncoder::new(&encoder, &b.pp("encoder"))?, ConditionalUnet1d::new(&unet, &b.pp("unet"))?))
}

/// Two training steps: losses, weights, moments, averages, and the condition of a few images.
fn train() -> (Vec<f32>, Vec<Weights>) {
    let (params, (encoder, unet)) = Params::build(Mode::Train, &mut rng(3), networks).unwrap();
    let mut adam = Adam::new(&AdamConfig::default(), &params).unwrap();
    let mut ema = Ema::new(&EmaConfig::default(), &params).unwrap();
    let images = input(1, &[24, 40, 40, 3], 0.5, 0.5);
    let (x, noise) = (input(2, &[96, 16, 8], 1.0, 0.0), input(3, &[96, 16, 8], 1.0, 0.0));
    let steps: Vec<f32> = (0..96).map(|i| i as f32).collect();
    let mut numbers = Vec::new();
    for _ in 0..2 {
        let cond = repeat_rows(&encoder.forward(&images).unwrap(), 4).unwrap();
        let y = unet.forward(&x, &steps, &cond).unwrap();
        let l = mse(&y, &noise, None).unwrap();
        let grads = backward(&l, &params).unwrap();
        numbers.push(adam.step(&params, &grads, 1e-3).unwrap());
        numbers.push(l.to_scalar().unwrap());
        ema.update(&params).unwrap();
        numbers.extend(values(&cond));
    }
    (numbers, vec![params.export().unwrap(), adam.state().unwrap(), ema.weights().unwrap()])
}

fn infer() -> Vec<f32> {
    let (_, (encoder, unet)) = Params::build(Mode::Infer, &mut rng(3), networks).unwrap();
    let mut out = Vec::new();
    for b in [1, 8, 80] {
        let cond = encoder.forward(&input(1, &[b, 40, 40, 3], 0.5, 0.5)).unwrap();
        let x = input(2, &[b, 16, 8], 1.0, 0.0);
        let y: Tensor = unet.forward(&x, &vec![5.0; b], &cond).unwrap();
        out.extend(values(&cond).into_iter().chain(values(&y)));
    }
    out
}

fn within<R: Send>(threads: usize, f: impl FnOnce() -> R + Send) -> R {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(f)
}

#[test]
fn training_and_inference_in_any_pool() {
    let (train_one, infer_one) = within(1, || (train(), infer()));
    for threads in [2, 3] {
        let (t, i) = within(threads, || (train(), infer()));
        assert!(t == train_one, "training differs between 1 and {threads} threads");
        assert!(i == infer_one, "inference differs between 1 and {threads} threads");
    }
    // From outside every pool.
    assert!((train(), infer()) == (train_one, infer_one));
}

/// Networks trained at the same time, as tasks of one pool, do not mix their gradients.
#[test]
fn networks_side_by_side() {
    use rayon::prelude::*;
    let alone = train();
    let together: Vec<_> = within(2, || (0..4).into_par_iter().map(|_| train()).collect());
    assert!(together.iter().all(|t| *t == alone));
}

#[test]
fn dropout_draws_from_its_stream() {
    let (_, net) = Params::build(Mode::Infer, &mut rng(0), |b| Mlp::new(&[4, 64, 1], 0.5, b)).unwrap();
    let x = input(1, &[8, 4], 1.0, 0.0);
    let run = |seed| values(&net.forward(&x, Some(&mut rng(seed))).unwrap());
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
}
