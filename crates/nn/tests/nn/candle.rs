//! Networks, training and state through Candle's operations, or a GPU, against our kernels. The layers are
//! in `gradients.rs`.

use crate::gradients::same_through_candle;
use crate::support::{assert_close, compute, difference, elsewhere, fill, filled, input, rng, values, wide};
use candle_core::{DType, Device, Tensor};
use e2h_nn::{
    Adam, AdamConfig, Builder, Compute, ConditionalUnet1d, Conv2d, Ema, EmaConfig, Error, Linear, Mode,
    Params, Precision, Result, RgbEncoder, RgbEncoderConfig, UnetConfig, Weights, backward, mse, repeat_rows,
};

fn unet() -> UnetConfig {
    UnetConfig {
        input_dim: 8,
        down_dims: vec![32, 64],
        kernel_size: 5,
        n_groups: 8,
        step_embed_dim: 16,
        cond_dim: 16,
    }
}

fn encoder() -> RgbEncoderConfig {
    RgbEncoderConfig {
        height: 40,
        width: 40,
        base_width: 16,
        stage_blocks: vec![1, 2],
        keypoints: 8,
        feature_dim: 16,
    }
}

#[test]
fn networks_have_the_same_outputs_and_gradients() {
    let inputs = [input(1, &[5, 16, 8], 1.0, 0.0), input(2, &[5, 16], 1.0, 0.0)];
    let steps = [0.0, 3.0, 50.0, 77.0, 99.0];
    let build = |b: &Builder<'_>| ConditionalUnet1d::new(&unet(), b);
    same_through_candle("u-net", &inputs, 1e-4, build, |n, x| n.forward(&x[0], &steps, &x[1]));
    let images = [input(3, &[3, 40, 40, 3], 0.5, 0.5)];
    let build = |b: &Builder<'_>| RgbEncoder::new(&encoder(), b);
    same_through_candle("encoder", &images, 1e-4, build, |n, x| n.forward(&x[0]));
}

/// Both networks in training, with the state of the optimiser and the average.
struct Training {
    params: Params,
    encoder: RgbEncoder,
    unet: ConditionalUnet1d,
    adam: Adam,
    ema: Ema,
}

impl Training {
    fn new() -> Self {
        let build = |b: &Builder<'_>| {
            Ok((
                RgbEncoder::new(&encoder(), &b.pp("encoder"))?,
                ConditionalUnet1d::new(&unet(), &b.pp("unet"))?,
            ))
        };
        let (params, (encoder, unet)) =
            Params::build_on(&compute(), Mode::Train, &mut rng(3), build).unwrap();
        // A norm that every gradient here is longer than.
        let config = AdamConfig { clip_norm: Some(1e-2), ..AdamConfig::default() };
        let adam = Adam::new(&config, &params).unwrap();
        let ema = Ema::new(&EmaConfig::default(), &params).unwrap();
        Self { params, encoder, unet, adam, ema }
    }

    /// Loss and gradient norm of a step.
    fn step(&mut self, k: u64) -> [f32; 2] {
        let x = input(10 + k, &[6, 16, 8], 1.0, 0.0);
        let steps: Vec<f32> = (0..6).map(|i| 15.0 * i as f32).collect();
        let features = self.encoder.forward(&input(k, &[3, 40, 40, 3], 0.5, 0.5)).unwrap();
        let y = self.unet.forward(&x, &steps, &repeat_rows(&features, 2).unwrap()).unwrap();
        let mask: Vec<f32> = (0..96).map(|i| if i % 7 < 5 { 1.0 } else { 0.0 }).collect();
        let mask = Tensor::from_vec(mask, (6, 16), &Device::Cpu).unwrap();
        let l = mse(&y, &input(20 + k, &[6, 16, 8], 1.0, 0.0), Some(&mask)).unwrap();
        let grads = backward(&l, &self.params).unwrap();
        let norm = self.adam.step(&self.params, &grads, 1e-3).unwrap();
        self.ema.update(&self.params).unwrap();
        assert!(norm > 1e-2, "the clip is not active: {norm}");
        [l.to_scalar().unwrap(), norm]
    }

    fn state(&self) -> [Weights; 3] {
        [self.params.export().unwrap(), self.adam.state().unwrap(), self.ema.state().unwrap()]
    }

    fn load(&mut self, [weights, adam, ema]: &[Weights; 3]) {
        self.params.import(weights).unwrap();
        self.adam.load_state(adam).unwrap();
        self.ema.load_state(ema).unwrap();
    }
}

/// The largest difference of two networks' weights over the norm of each.
fn apart(a: &Weights, b: &Weights) -> f64 {
    assert!(a.keys().eq(b.keys()));
    a.iter().map(|(n, t)| difference(&wide(&t.data), &wide(&b[n].data))).fold(0.0, f64::max)
}

/// All numbers of a network, less those of `before`.
fn change(after: &Weights, before: &Weights) -> Vec<f64> {
    let each = after.values().zip(before.values());
    each.flat_map(|(a, b)| a.data.iter().zip(&b.data).map(|(a, b)| f64::from(*a) - f64::from(*b))).collect()
}

#[test]
fn a_training_step_is_the_same() {
    let mut own = Training::new();
    let mut candle = elsewhere(Training::new);
    assert_eq!(own.state(), candle.state(), "the same seed draws the same weights");
    // Biases that start at 0 would be Adam's first step alone, nearly the sign of a gradient.
    let before = fill(&own.params.export().unwrap());
    own.params.import(&before).unwrap();
    candle.params.import(&before).unwrap();
    let (a, b) = (elsewhere(|| candle.step(0)), own.step(0));
    assert_close("loss and norm", &wide(&a), &wide(&b), 1e-5);
    let ([aw, am, ae], [bw, bm, be]) = (candle.state(), own.state());
    for (what, a, b) in [("weights", &aw, &bw), ("average", &ae, &be)] {
        assert!(apart(a, b) < 1e-5, "{what}: {}", apart(a, b));
    }
    assert!(apart(&am, &bm) < 1e-4, "moments: {}", apart(&am, &bm));
    assert_close("the step", &change(&aw, &before), &change(&bw, &before), 1e-3);
}

/// Saved in one arithmetic, loaded in the other: nothing is lost, and both go on alike.
#[test]
fn state_crosses_over() {
    let mut own = Training::new();
    own.step(0);
    own.step(1);
    let saved = own.state();
    let mut candle = elsewhere(Training::new);
    elsewhere(|| {
        candle.load(&saved);
        assert_eq!(candle.state(), saved);
    });
    let (a, b) = (elsewhere(|| candle.step(2)), own.step(2));
    assert_close("loss and norm after", &wide(&a), &wide(&b), 1e-5);
    let saved = candle.state();
    own.load(&saved);
    assert_eq!(own.state(), saved);
}

/// A GPU changes moments and average in place: a clone must not see it, and a gradient that is not finite changes nothing.
#[test]
fn clones_of_the_optimiser_stay_as_they_were() {
    let check = || {
        let mut training = Training::new();
        training.step(0);
        let (mut adam, ema) = (training.adam.clone(), training.ema.clone());
        let before = (adam.state().unwrap(), ema.state().unwrap());
        training.step(1);
        assert!(training.adam.state().unwrap() != before.0 && training.ema.state().unwrap() != before.1);
        assert_eq!((adam.state().unwrap(), ema.state().unwrap()), before);
        let weights = training.params.export().unwrap();
        let x = input(1, &[2, 16, 8], f64::INFINITY, 0.0);
        let y = training.unet.forward(&x, &[1.0, 2.0], &input(2, &[2, 16], 1.0, 0.0)).unwrap();
        let grads = backward(&y.sum_all().unwrap(), &training.params).unwrap();
        assert!(!adam.step(&training.params, &grads, 1e-3).unwrap().is_finite());
        assert_eq!(adam.state().unwrap(), before.0);
        assert_eq!(training.params.export().unwrap(), weights);
    };
    check();
    elsewhere(check);
}

/// A network keeps the arithmetic that it was built with; only operations without weights look at the switch.
#[test]
fn networks_of_both_arithmetics_live_side_by_side() {
    let build = |b: &Builder<'_>| ConditionalUnet1d::new(&unet(), b);
    let (own_params, own) = filled(Mode::Train, build);
    let (candle_params, candle) = elsewhere(|| filled(Mode::Train, build));
    let l = |n: &ConditionalUnet1d| {
        let (x, cond) = (input(1, &[2, 16, 8], 1.0, 0.0), input(2, &[2, 16], 1.0, 0.0));
        mse(&n.forward(&x, &[1.0, 80.0], &cond).unwrap(), &x, None).unwrap()
    };
    let both = (l(&own) + elsewhere(|| l(&candle)).to_device(&Device::Cpu).unwrap()).unwrap();
    let grads = e2h_nn::backward_many(&both, &[&own_params, &candle_params]).unwrap();
    let [a, b] = [grads[0].export(&own_params).unwrap(), grads[1].export(&candle_params).unwrap()];
    assert!(apart(&a, &b) < 1e-4, "{}", apart(&a, &b));
    assert!((grads[0].norm().unwrap() / grads[1].norm().unwrap() - 1.0).abs() < 1e-5);
    // Gradients of one cannot move the other, or be added to it.
    let mut adam = Adam::new(&AdamConfig::default(), &own_params).unwrap();
    assert!(matches!(adam.step(&own_params, &grads[1], 1e-3), Err(Error::OtherParams { .. })));
    let mut sum = grads[1].clone();
    assert!(matches!(sum.add(&grads[0]), Err(Error::OtherParams { .. })));
    sum.add(&grads[1]).unwrap();
    sum.scale(0.5).unwrap();
    assert!(apart(&sum.export(&candle_params).unwrap(), &b) < 1e-6);
}

fn in_bf16<T>(f: impl FnOnce(&Builder<'_>) -> Result<T>) -> (Params, T) {
    let compute = Compute::open(compute().name(), Precision { tf32: false, bf16: true }).unwrap();
    Params::build_on(&compute, Mode::Train, &mut rng(7), f).unwrap()
}

/// bf16 rounds the factors to 8 bits: results are near those of f32, not the same, and everything else stays f32.
#[test]
fn bf16_rounds_the_factors_of_products_alone() {
    let outcome = |(params, net): (Params, Conv2d)| {
        let y = net.forward(&input(1, &[3, 10, 9, 4], 1.0, 0.0)).unwrap();
        assert_eq!(y.dtype(), DType::F32);
        let grads = backward(&y.sqr().unwrap().sum_all().unwrap(), &params).unwrap();
        (wide(&values(&y)), grads.export(&params).unwrap())
    };
    let build = |b: &Builder<'_>| Conv2d::new((4, 8), 3, 2, 1, true, b);
    let (y, g) = outcome(Params::build(Mode::Train, &mut rng(7), build).unwrap());
    let (yb, gb) = elsewhere(|| outcome(in_bf16(build)));
    let off = [difference(&yb, &y), apart(&gb, &g)];
    assert!(off.iter().all(|d| (1e-4..2e-2).contains(d)), "{off:?}");
    // What the rounding of each number to 8 bits gives, in f32.
    let round = |t: &Tensor| t.to_dtype(DType::BF16).unwrap().to_dtype(DType::F32).unwrap();
    let (params, net) = Params::build(Mode::Train, &mut rng(7), |b| Linear::new(9, 4, b)).unwrap();
    let rows = || input(1, &[30, 9], 1.0, 0.0);
    let mut weights = params.export().unwrap();
    let w = weights.get_mut("weight").unwrap();
    w.data = values(&round(&Tensor::new(&w.data[..], &Device::Cpu).unwrap()));
    params.import(&weights).unwrap();
    let want = net.forward(&round(&rows())).unwrap();
    let got = elsewhere(|| in_bf16(|b| Linear::new(9, 4, b)).1.forward(&rows()).unwrap());
    let off = difference(&wide(&values(&got)), &wide(&values(&want)));
    // The result of a product is rounded once more.
    assert!(off < 4e-3, "{off}");
}

#[test]
fn bf16_trains() {
    elsewhere(trains_in_bf16);
}

fn trains_in_bf16() {
    let (params, net) = in_bf16(|b| ConditionalUnet1d::new(&unet(), b));
    let mut adam = Adam::new(&AdamConfig::default(), &params).unwrap();
    let (x, cond) = (input(1, &[8, 16, 8], 1.0, 0.0), input(2, &[8, 16], 1.0, 0.0));
    let losses: Vec<f32> = (0..40)
        .map(|_| {
            let y = net.forward(&x, &[10.0; 8], &cond).unwrap();
            let l = mse(&y, &x, None).unwrap();
            adam.step(&params, &backward(&l, &params).unwrap(), 2e-3).unwrap();
            l.to_scalar().unwrap()
        })
        .collect();
    assert!(losses[39] < 0.1 * losses[0], "{losses:?}");
}

/// On the CPU's own kernels the precision has no effect.
#[test]
fn our_kernels_stay_in_f32() {
    let build = |b: &Builder<'_>| Linear::new(9, 4, b);
    let x = input(1, &[5, 9], 1.0, 0.0);
    let (_, plain) = Params::build(Mode::Train, &mut rng(7), build).unwrap();
    assert_eq!(values(&plain.forward(&x).unwrap()), values(&in_bf16(build).1.forward(&x).unwrap()));
}
