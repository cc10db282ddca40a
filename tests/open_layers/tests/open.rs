//! The layer's gradients, and those of a network of candle-nn's layers, e2h-nn's and this one, against finite differences;
//! training; weights through `VarMap` and `VarBuilder`; one optimiser for both.
#![allow(clippy::unwrap_used, reason = "a test fails by panicking")]

use candle_core::{DType, Device, Module, Result, Tensor, Var};
use candle_nn::{Conv2dConfig, Optimizer, ParamsAdamW, VarBuilder, VarMap};
use e2h_nn::rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use e2h_nn::{
    Adam, AdamConfig, Builder, Ema, EmaConfig, Mish, Mode, Params, Weights, backward, candle_operations, mse,
    no_grad, with_gradient,
};
use open_layers::RmsNorm;

fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Numbers between -1 and 1 that repeat nowhere near.
fn input(k: usize, shape: &[usize]) -> Tensor {
    let n = shape.iter().product();
    let data: Vec<f32> =
        (0..n).map(|i| (0.7 * ((i * 7919 + k * 4729) % 10_007) as f32 + 0.3).sin()).collect();
    Tensor::from_vec(data, shape, &Device::Cpu).unwrap()
}

fn values(x: &Tensor) -> Vec<f32> {
    x.flatten_all().unwrap().to_vec1().unwrap()
}

/// The weighted sum of `y`, tracked.
fn loss(y: &Tensor) -> Tensor {
    (y * input(99, y.dims())).unwrap().sum_all().unwrap()
}

/// The same, summed in `f64`.
fn loss64(y: &Tensor) -> f64 {
    values(y).iter().zip(values(&input(99, y.dims()))).map(|(a, b)| f64::from(*a) * f64::from(b)).sum()
}

/// Images through a convolution and a linear layer of candle-nn, with e2h-nn's layers and `RmsNorm` before, between and
/// behind; `conv`'s output has two readers.
struct Mixed {
    before: e2h_nn::Conv2d,
    conv: candle_nn::Conv2d,
    norm: e2h_nn::GroupNorm,
    points: e2h_nn::SpatialSoftmax,
    rms: RmsNorm,
    linear: candle_nn::Linear,
    last: e2h_nn::Mlp,
}

impl Mixed {
    fn new(b: &Builder<'_>) -> e2h_nn::Result<Self> {
        let padded = Conv2dConfig { padding: 1, ..Conv2dConfig::default() };
        Ok(Self {
            before: e2h_nn::Conv2d::new((3, 4), 3, 2, 1, true, &b.pp("before"))?,
            conv: candle_nn::conv2d(4, 4, 3, padded, b.pp("conv").var_builder())?,
            norm: e2h_nn::GroupNorm::new(2, 4, e2h_nn::Act::Relu, &b.pp("norm"))?,
            points: e2h_nn::SpatialSoftmax::new(4, 6, &b.pp("points"))?,
            rms: RmsNorm::new(12, &b.var_builder().pp("rms"))?,
            linear: candle_nn::linear(12, 5, b.var_builder().pp("linear"))?,
            last: e2h_nn::Mlp::new(&[5, 7, 2], 0.0, &b.pp("last"))?,
        })
    }
}

impl Module for Mixed {
    /// Shapes: (N, H, W, 3) to (N, 2).
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let h = Module::forward(&self.before, x)?;
        // Candle's convolutions have the channels first, and its products want contiguous rows.
        let h = self.conv.forward(&h.permute((0, 3, 1, 2))?.contiguous()?)?.permute((0, 2, 3, 1))?;
        let h = (self.norm.forward(&h, None)? + h)?;
        let h = self.rms.forward(&self.points.forward(&h)?)?;
        Module::forward(&self.last, &Mish.forward(&self.linear.forward(&h)?)?)
    }
}

/// Checks every parameter's gradient and that of the input, at some numbers of each.
fn check<T: Module>(x: &Tensor, eps: f32, tolerance: f64, build: fn(&Builder<'_>) -> e2h_nn::Result<T>) {
    let (params, net) = Params::build(Mode::Train, &mut rng(1), build).unwrap();
    let var = Var::from_tensor(x).unwrap();
    let both = loss(&net.forward(&var).unwrap());
    let grads = backward(&both, &params).unwrap().export(&params).unwrap();
    // The input's gradient, through frozen weights.
    let (frozen, fixed) = Params::build(Mode::Infer, &mut rng(1), build).unwrap();
    let store = loss(&fixed.forward(&var).unwrap()).backward().unwrap();
    let dx = values(store.get(&var).unwrap());
    let slope = |up: f64, down: f64| (up - down) / (2.0 * f64::from(eps));
    let close = |what: &str, pairs: &[(f64, f64)]| {
        let norm = |f: fn(&(f64, f64)) -> f64| pairs.iter().map(|p| f(p).powi(2)).sum::<f64>().sqrt();
        let (off, size) = (norm(|p| p.0 - p.1), norm(|p| p.1).max(1e-2));
        assert!(off <= tolerance * size, "{what}: off by {off:.1e} of {size:.1e}: {pairs:?}");
    };
    let weights = params.export().unwrap();
    for (name, t) in &weights {
        let at = |i: usize, by: f32| {
            let mut moved = weights.clone();
            moved.get_mut(name).unwrap().data[i] += by;
            frozen.import(&moved).unwrap();
            loss64(&fixed.forward(x).unwrap())
        };
        let step = t.data.len().div_ceil(24) | 1;
        let some = (0..t.data.len()).step_by(step);
        let pairs: Vec<_> =
            some.map(|i| (f64::from(grads[name].data[i]), slope(at(i, eps), at(i, -eps)))).collect();
        close(name, &pairs);
    }
    frozen.import(&weights).unwrap();
    let at = |i: usize, by: f32| {
        let mut moved = values(x);
        moved[i] += by;
        loss64(&fixed.forward(&Tensor::from_vec(moved, x.dims(), &Device::Cpu).unwrap()).unwrap())
    };
    let some = (0..x.elem_count()).step_by(x.elem_count().div_ceil(24) | 1);
    let pairs: Vec<_> = some.map(|i| (f64::from(dx[i]), slope(at(i, eps), at(i, -eps)))).collect();
    close("input", &pairs);
}

#[test]
fn the_layer_has_exact_gradients() {
    check(&input(1, &[5, 12]), 1e-2, 1e-3, |b| Ok(RmsNorm::new(12, &b.var_builder())?));
}

#[test]
fn a_mixed_network_has_exact_gradients() {
    check(&input(2, &[3, 8, 6, 3]), 3e-3, 1e-2, Mixed::new);
    candle_operations(|| check(&input(2, &[3, 8, 6, 3]), 3e-3, 1e-2, Mixed::new));
}

/// What `Builder::var_builder` warns of. Should Candle mend it, the warning goes.
#[test]
#[should_panic(expected = "weight: off by")]
fn candles_own_conv1d_learns_from_a_wrong_gradient() {
    check(&input(3, &[2, 3, 10]), 1e-2, 0.1, |b| {
        Ok(candle_nn::conv1d(3, 4, 5, candle_nn::Conv1dConfig::default(), b.var_builder())?)
    });
}

/// Losses of the first and the last of 150 steps.
fn train(params: &Params, net: &impl Module) -> (f32, f32) {
    let (x, y) = (input(3, &[16, 8, 6, 3]), input(4, &[16, 2]));
    let mut adam = Adam::new(&AdamConfig::default(), params).unwrap();
    let mut ema = Ema::new(&EmaConfig::default(), params).unwrap();
    let losses: Vec<f32> = (0..150)
        .map(|_| {
            let l = mse(&net.forward(&x).unwrap(), &y, None).unwrap();
            adam.step(params, &backward(&l, params).unwrap(), 1e-2).unwrap();
            ema.update(params).unwrap();
            l.to_scalar().unwrap()
        })
        .collect();
    assert_eq!(ema.weights().unwrap().len(), params.len());
    (losses[0], losses[149])
}

#[test]
fn a_mixed_network_trains_and_the_same_seed_gives_the_same_bytes() {
    let run = || {
        let (params, net) = Params::build(Mode::Train, &mut rng(5), Mixed::new).unwrap();
        let (first, last) = train(&params, &net);
        assert!(last < 0.05 * first, "{first} to {last}");
        params.export().unwrap()
    };
    let weights = run();
    assert_eq!(weights, run());
    assert_ne!(weights["rms.weight"].data, vec![1.0; 12]);
}

/// The same shapes of candle-nn's layers alone, for a plain model.
fn plain(vars: VarBuilder<'_>) -> candle_nn::Sequential {
    let hidden = candle_nn::linear(4, 16, vars.pp(0)).unwrap();
    candle_nn::seq().add(hidden).add_fn(|x| x.tanh()).add(candle_nn::linear(16, 2, vars.pp(1)).unwrap())
}

#[test]
fn weights_go_through_var_maps_by_name() {
    // Of candle-nn's linear layers, and ours of the same names: each opens the other's.
    let map = VarMap::new();
    let vars = VarBuilder::from_varmap(&map, DType::F32, &Device::Cpu);
    let theirs = plain(vars.pp("net"));
    let build = |b: &Builder<'_>| {
        let b = b.pp("net");
        Ok((e2h_nn::Linear::new(4, 16, &b.pp(0))?, e2h_nn::Linear::new(16, 2, &b.pp(1))?))
    };
    let (params, ours) = Params::build(Mode::Train, &mut rng(2), build).unwrap();
    let x = input(6, &[3, 4]);
    let out = || values(&ours.1.forward(&ours.0.forward(&x).unwrap().tanh().unwrap()).unwrap());
    let near = |a: &[f32], b: &[f32]| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(!near(&out(), &values(&theirs.forward(&x).unwrap())));
    params.import_from(&vars).unwrap();
    assert!(near(&out(), &values(&theirs.forward(&x).unwrap())));
    let drawn = Params::build(Mode::Train, &mut rng(3), build).unwrap().0.export().unwrap();
    params.import(&drawn).unwrap();
    params.export_to(&map).unwrap();
    assert!(near(&out(), &values(&theirs.forward(&x).unwrap())));

    // Through an empty map and back: the same bytes, of permuted layouts too, and through Candle's file.
    let (mixed, _) = Params::build(Mode::Train, &mut rng(4), Mixed::new).unwrap();
    let weights = mixed.export().unwrap();
    let fresh = VarMap::new();
    mixed.export_to(&fresh).unwrap();
    let path = std::env::temp_dir().join(format!("open_layers_{}.safetensors", std::process::id()));
    fresh.save(&path).unwrap();
    assert_eq!(e2h_nn::load_weights(&path).unwrap().0, weights);
    std::fs::remove_file(&path).unwrap();
    let (other, _) = Params::build(Mode::Infer, &mut rng(5), Mixed::new).unwrap();
    other.import_from(&VarBuilder::from_varmap(&fresh, DType::F32, &Device::Cpu)).unwrap();
    assert_eq!(other.export().unwrap(), weights);
    assert_eq!(Params::from_var_map(&fresh).unwrap().export().unwrap(), weights);
}

#[test]
fn what_does_not_fit_is_named_and_changes_nothing() {
    let map = VarMap::new();
    let vars = VarBuilder::from_varmap(&map, DType::F32, &Device::Cpu);
    vars.get((2, 3), "weight").unwrap();
    let (params, _) = Params::build(Mode::Train, &mut rng(0), |b| e2h_nn::Linear::new(4, 2, b)).unwrap();
    let before = params.export().unwrap();
    let error = params.import_from(&vars).unwrap_err().to_string();
    assert!(error.contains("missing [\"bias\"]") && error.contains("weight: expected [2, 4]"), "{error}");
    let error = params.export_to(&map).unwrap_err().to_string();
    assert!(error.contains("weight: expected [2, 4], found [2, 3]"), "{error}");
    assert_eq!((params.export().unwrap(), map.all_vars().len()), (before, 1));

    map.get(2, "wide", candle_nn::init::ZERO, DType::F64, &Device::Cpu).unwrap();
    assert!(Params::from_var_map(&map).unwrap_err().to_string().contains("`wide` of F64"));
    let twice = |b: &Builder<'_>| {
        let shared = (b.var_builder().get(2, "a")?, b.var_builder().get(2, "a")?);
        assert_eq!(shared.0.id(), shared.1.id());
        Ok(b.var_builder().get(3, "a")?)
    };
    let error = Params::build(Mode::Train, &mut rng(0), twice).unwrap_err().to_string();
    assert!(error.contains("`a`"), "{error}");
    assert_eq!(Params::count_of(Mixed::new).unwrap(), 433);
}

#[test]
fn the_optimiser_steps_plain_variables() {
    let config =
        AdamConfig { beta1: 0.9, weight_decay: 1e-2, decoupled: true, clip_norm: None, ..Default::default() };
    let (map, copy) = (VarMap::new(), VarMap::new());
    let vars = |map: &VarMap| VarBuilder::from_varmap(map, DType::F32, &Device::Cpu);
    let (net, twin) = (plain(vars(&map)), plain(vars(&copy)));
    // The same layers, as parameters of ours.
    let (params, same) = Params::build(Mode::Train, &mut rng(0), |b| Ok(plain(b.var_builder()))).unwrap();
    let of_map = Params::from_var_map(&map).unwrap();
    params.export_to(&map).unwrap();
    params.export_to(&copy).unwrap();
    let mut on_vars = Adam::new(&config, &of_map).unwrap();
    let mut on_params = Adam::new(&config, &params).unwrap();
    let settings = ParamsAdamW { lr: 1e-2, weight_decay: 1e-2, ..ParamsAdamW::default() };
    let mut theirs = candle_nn::AdamW::new(copy.all_vars(), settings).unwrap();
    for k in 0..20 {
        let (x, y) = (input(10 + k, &[6, 4]), input(50 + k, &[6, 2]));
        let loss = |net: &candle_nn::Sequential| candle_nn::loss::mse(&net.forward(&x)?, &y);
        let (a, b) = (loss(&net).unwrap(), loss(&same).unwrap());
        on_vars.step(&of_map, &backward(&a, &of_map).unwrap(), 1e-2).unwrap();
        on_params.step(&params, &backward(&b, &params).unwrap(), 1e-2).unwrap();
        theirs.backward_step(&loss(&twin).unwrap()).unwrap();
    }
    let weights = of_map.export().unwrap();
    assert_eq!(weights, params.export().unwrap(), "variables and parameters alike, to the bit");
    assert_eq!(on_vars.state().unwrap(), on_params.state().unwrap());
    let candle: Weights = Params::from_var_map(&copy).unwrap().export().unwrap();
    for (name, t) in &weights {
        for (a, b) in t.data.iter().zip(&candle[name].data) {
            assert!((a - b).abs() < 1e-5, "{name}: {a} and Candle's {b}");
        }
    }
}

/// Candle panics where something before a node gets no gradient; here it is an error, or zeros.
#[test]
fn mistakes_are_errors() {
    let x = Var::from_tensor(&input(1, &[2, 3])).unwrap();
    let before = (x.as_tensor() * 2.0).unwrap();
    let none = with_gradient(before.detach(), &[&before], |_, _| Ok([None, None, None])).unwrap();
    let error = loss(&none).backward().unwrap_err().to_string();
    assert!(error.contains("gradient: expected shape [2, 3] for argument 0, found []"), "{error}");
    let error = with_gradient(before.clone(), &[&before], |_, _| Ok([None, None, None])).unwrap_err();
    assert!(error.to_string().contains("detached"), "{error}");
    let untracked = no_grad(|| with_gradient(before.detach(), &[&before], |_, _| Ok([None, None, None])));
    assert!(!untracked.unwrap().track_op());
    // Candle's own `backward` reaches no weight of e2h-nn's kernels, and says so.
    let (_, net) = Params::build(Mode::Train, &mut rng(0), |b| e2h_nn::Linear::new(3, 2, b)).unwrap();
    let error = loss(&net.forward(&before).unwrap()).backward().unwrap_err().to_string();
    assert!(error.contains("e2h_nn::backward"), "{error}");
}
