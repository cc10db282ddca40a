//! Every gradient against central finite differences, and Candle's operations against our kernels.

use crate::support::{
    assert_close, compute, elsewhere, fill, filled, in_precision, input, loss, loss64, rng, values, wide,
};
use candle_core::{Device, Tensor, Var};
use e2h_nn::{
    Act, Builder, ConditionalUnet1d, Conv1d, Conv2d, ConvTranspose1d, Film, GroupNorm, Linear, MaxPool2d,
    Mish, Mlp, Mode, Params, Precision, Relu, Result, RgbEncoder, RgbEncoderConfig, SpatialSoftmax,
    UnetConfig, Weights, backward, dropout, mse, repeat_rows,
};
use rand_chacha::ChaCha8Rng;

/// Indices spread over a tensor of `n` numbers.
fn spread(n: usize) -> impl Iterator<Item = usize> {
    let step = n.div_ceil(48).max(1) | 1;
    (0..n).step_by(step)
}

fn shifted(x: &Tensor, i: usize, by: f32) -> Tensor {
    let mut v = values(x);
    v[i] += by;
    Tensor::from_vec(v, x.dims(), &Device::Cpu).unwrap()
}

/// The output, the gradients of `inputs` through frozen weights, and those of every parameter.
fn outcome<T>(
    inputs: &[Tensor],
    build: impl Fn(&Builder<'_>) -> Result<T>,
    forward: impl Fn(&T, &[Tensor]) -> Result<Tensor>,
) -> (Vec<f32>, Vec<Vec<f32>>, Weights) {
    let (_, net) = filled(Mode::Infer, &build);
    let inputs: Vec<Tensor> = inputs.iter().map(|x| x.to_device(compute().device()).unwrap()).collect();
    let vars: Vec<Var> = inputs.iter().map(|x| Var::from_tensor(x).unwrap()).collect();
    let tensors: Vec<Tensor> = vars.iter().map(|v| v.as_tensor().clone()).collect();
    let out = forward(&net, &tensors).unwrap();
    let store = loss(&out).backward().unwrap();
    let gradients = vars.iter().map(|v| values(store.get(v.as_tensor()).unwrap())).collect();
    let (params, net) = filled(Mode::Train, &build);
    if params.is_empty() {
        return (values(&out), gradients, Weights::new());
    }
    let grads = backward(&loss(&forward(&net, &tensors).unwrap()), &params).unwrap();
    let plain = backward(&loss(&forward(&net, &inputs).unwrap()), &params).unwrap();
    let weights = grads.export(&params).unwrap();
    assert_eq!(weights, plain.export(&params).unwrap(), "with and without a gradient of the inputs");
    (values(&out), gradients, weights)
}

/// Candle's operations, or a GPU, against our kernels.
pub(crate) fn same_through_candle<T>(
    what: &str,
    inputs: &[Tensor],
    tolerance: f64,
    build: impl Fn(&Builder<'_>) -> Result<T>,
    forward: impl Fn(&T, &[Tensor]) -> Result<Tensor>,
) {
    same_in(Precision::default(), what, inputs, (1e-5, tolerance), build, forward);
}

/// The same with products of this precision, against f32; the tolerances are those of the output and of gradients.
pub(crate) fn same_in<T>(
    precision: Precision,
    what: &str,
    inputs: &[Tensor],
    (near, tolerance): (f64, f64),
    build: impl Fn(&Builder<'_>) -> Result<T>,
    forward: impl Fn(&T, &[Tensor]) -> Result<Tensor>,
) {
    let (out, gradients, weights) = outcome(inputs, &build, &forward);
    let other = || in_precision(precision, || outcome(inputs, &build, &forward));
    let (c_out, c_gradients, c_weights) = elsewhere(other);
    assert_close(&format!("{what} through Candle"), &wide(&c_out), &wide(&out), near);
    for (k, (c, g)) in c_gradients.iter().zip(&gradients).enumerate() {
        assert_close(&format!("{what} through Candle, input {k}"), &wide(c), &wide(g), tolerance);
    }
    assert!(c_weights.keys().eq(weights.keys()));
    for (name, g) in &weights {
        let (c, g) = (wide(&c_weights[name].data), wide(&g.data));
        if name.ends_with("nets.bias") {
            // A softmax does not see a constant: what is left is rounding.
            assert!(c.iter().chain(&g).all(|v| v.abs() < 1e-4), "{what}, {name}: {c:?} {g:?}");
            continue;
        }
        assert_close(&format!("{what} through Candle, {name}"), &c, &g, tolerance);
    }
}

/// Checks the gradients of `inputs`, then of every parameter, of sum(out * s).
fn check<T>(
    what: &str,
    inputs: &[Tensor],
    eps: f32,
    tolerance: f64,
    build: impl Fn(&Builder<'_>) -> Result<T>,
    forward: impl Fn(&T, &[Tensor]) -> Result<Tensor>,
) {
    same_through_candle(what, inputs, 1e-4, &build, &forward);
    // Inputs, through frozen weights.
    let (_, net) = filled(Mode::Infer, &build);
    let vars: Vec<Var> = inputs.iter().map(|x| Var::from_tensor(x).unwrap()).collect();
    let tensors: Vec<Tensor> = vars.iter().map(|v| v.as_tensor().clone()).collect();
    let store = loss(&forward(&net, &tensors).unwrap()).backward().unwrap();
    let value = |x: &[Tensor]| loss64(&forward(&net, x).unwrap());
    for (k, var) in vars.iter().enumerate() {
        let got = values(store.get(var.as_tensor()).unwrap());
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for i in spread(got.len()) {
            let at = |by| {
                let mut x = inputs.to_vec();
                x[k] = shifted(&x[k], i, by);
                value(&x)
            };
            a.push(f64::from(got[i]));
            b.push((at(eps) - at(-eps)) / (2.0 * f64::from(eps)));
        }
        assert_close(&format!("{what}, input {k}"), &a, &b, tolerance);
    }
    // Weights, with and without a gradient of the inputs.
    let (params, net) = filled(Mode::Train, &build);
    if params.is_empty() {
        return;
    }
    let grads = backward(&loss(&forward(&net, inputs).unwrap()), &params).unwrap().export(&params).unwrap();
    let both = backward(&loss(&forward(&net, &tensors).unwrap()), &params).unwrap().export(&params).unwrap();
    assert_eq!(grads, both, "{what}: weight gradients depend on whether the input has one");
    let weights = params.export().unwrap();
    for (name, g) in &grads {
        let (mut a, mut b) = (Vec::new(), Vec::new());
        for i in spread(g.data.len()) {
            let at = |by| {
                let mut w: Weights = weights.clone();
                w.get_mut(name).unwrap().data[i] += by;
                params.import(&w).unwrap();
                loss64(&forward(&net, inputs).unwrap())
            };
            a.push(f64::from(g.data[i]));
            b.push((at(eps) - at(-eps)) / (2.0 * f64::from(eps)));
        }
        params.import(&weights).unwrap();
        if name.ends_with("nets.bias") {
            // A softmax does not see a constant: the gradient is zero, its estimate rounding.
            assert!(a.iter().all(|a| a.abs() < 1e-4), "{what}, {name}: {a:?}");
            continue;
        }
        assert_close(&format!("{what}, {name}"), &a, &b, tolerance);
    }
}

fn x(k: u64, shape: &[usize]) -> Tensor {
    input(k, shape, 1.0, 0.0)
}

#[test]
fn linear() {
    for rows in [1, 3, 1100] {
        check("linear", &[x(1, &[rows, 5])], 1e-2, 2e-3, |b| Linear::new(5, 7, b), |n, x| n.forward(&x[0]));
    }
    check(
        "linear of a sequence",
        &[x(1, &[2, 3, 5])],
        1e-2,
        2e-3,
        |b| Linear::new(5, 4, b),
        |n, x| n.forward(&x[0]),
    );
}

#[test]
fn conv1d() {
    for (batch, length, kernel, stride, padding) in [
        (1, 7, 5, 1, 2),
        (3, 8, 5, 1, 2),
        (3, 7, 3, 2, 1),
        (2, 9, 1, 1, 0),
        (3, 8, 3, 2, 1),
        (2, 6, 2, 1, 0),
        (160, 9, 5, 1, 2),
    ] {
        let what = format!("conv1d {batch}x{length}, kernel {kernel}, stride {stride}");
        let build = |b: &Builder<'_>| Conv1d::new(3, 4, kernel, stride, padding, b);
        check(&what, &[x(1, &[batch, length, 3])], 1e-2, 2e-3, build, |n, x| n.forward(&x[0]));
    }
}

/// A batch of nothing has no gradient, not what was in memory before.
#[test]
fn empty_batches() {
    fn zero<T>(
        what: &str,
        shape: &[usize],
        build: impl Fn(&Builder<'_>) -> Result<T>,
        forward: impl Fn(&T, &Tensor) -> Result<Tensor>,
    ) {
        let (params, net) = filled(Mode::Train, build);
        // The allocator hands out what was just given back.
        drop(params.export().unwrap().values().map(|t| vec![f32::NAN; t.data.len()]).collect::<Vec<_>>());
        let y = forward(&net, &Tensor::zeros(shape, candle_core::DType::F32, &Device::Cpu).unwrap()).unwrap();
        assert_eq!(y.elem_count(), 0, "{what}");
        for (name, g) in backward(&loss(&y), &params).unwrap().export(&params).unwrap() {
            assert!(g.data.iter().all(|v| *v == 0.0), "{what}, {name}: {:?}", &g.data[..4]);
        }
    }
    zero("conv1d", &[0, 16, 40], |b| Conv1d::new(40, 24, 5, 1, 2, b), |n, x| n.forward(x));
    zero("conv2d", &[0, 6, 6, 16], |b| Conv2d::new((16, 32), 3, 2, 1, true, b), |n, x| n.forward(x));
    zero(
        "conv2d of colours",
        &[0, 6, 6, 3],
        |b| Conv2d::new((3, 16), 7, 2, 3, false, b),
        |n, x| n.forward(x),
    );
    zero("transposed conv1d", &[0, 4, 8], |b| ConvTranspose1d::new(8, 6, b), |n, x| n.forward(x));
    zero("linear", &[0, 70], |b| Linear::new(70, 90, b), |n, x| n.forward(x));
}

#[test]
fn conv2d() {
    for (batch, size, kernel, stride, padding) in [
        (1, (5, 7), 3, 1, 1),
        (3, (6, 6), 3, 2, 1),
        (2, (9, 7), 7, 2, 3),
        (2, (5, 6), 1, 2, 0),
        (3, (4, 4), 1, 1, 0),
        (9, (13, 11), 3, 1, 1), // more positions than are laid out at once
        (19, (15, 15), 3, 2, 1),
    ] {
        for bias in [false, true] {
            let what = format!("conv2d {batch} of {size:?}, kernel {kernel}, stride {stride}, bias {bias}");
            let build = |b: &Builder<'_>| Conv2d::new((3, 4), kernel, stride, padding, bias, b);
            check(&what, &[x(1, &[batch, size.0, size.1, 3])], 1e-2, 2e-3, build, |n, x| n.forward(&x[0]));
        }
    }
}

#[test]
fn transposed_conv1d() {
    for (batch, length) in [(1, 1), (1, 5), (3, 4), (130, 9)] {
        let build = |b: &Builder<'_>| ConvTranspose1d::new(3, 4, b);
        check("transposed conv1d", &[x(1, &[batch, length, 3])], 1e-2, 2e-3, build, |n, x| n.forward(&x[0]));
    }
}

#[test]
fn group_norm() {
    for act in [Act::None, Act::Relu, Act::Mish] {
        for (shape, groups) in
            [(vec![1, 5, 8], 2), (vec![3, 4, 3, 16], 1), (vec![2, 1, 16], 2), (vec![40, 8, 80], 8)]
        {
            let (what, c) = (format!("group norm {act:?} of {shape:?}"), *shape.last().unwrap());
            let eps = if act == Act::Relu { 1e-3 } else { 1e-2 };
            let build = |b: &Builder<'_>| GroupNorm::new(groups, c, act, b);
            check(&what, &[x(1, &shape)], eps, 1e-2, build, |n, x| n.forward(&x[0], None));
            if act == Act::Relu {
                let inputs = [x(1, &shape), x(2, &shape)];
                check(&what, &inputs, eps, 1e-2, build, |n, x| n.forward(&x[0], Some(&x[1])));
            }
        }
    }
}

fn nothing(_: &Builder<'_>) -> Result<()> {
    Ok(())
}

#[test]
fn elementwise() {
    check("mish", &[input(1, &[3, 11], 4.0, 0.0)], 1e-2, 2e-3, nothing, |(), x| Mish.forward(&x[0]));
    check("relu", &[x(1, &[3, 11])], 1e-3, 2e-3, nothing, |(), x| Relu.forward(&x[0]));
    let film = |(): &(), x: &[Tensor]| Film.forward(&x[0], &x[1]);
    check("film", &[x(1, &[3, 5, 7]), x(2, &[3, 14])], 1e-2, 2e-3, nothing, film);
    check("repeat", &[x(1, &[3, 5])], 1e-2, 2e-3, nothing, |(), x| repeat_rows(&x[0], 4));
    let mask = Tensor::new(&[[0f32, 2., 0., 2., 2.], [2., 2., 0., 0., 2.]], &Device::Cpu).unwrap();
    check("dropout", &[x(1, &[2, 5])], 1e-2, 2e-3, nothing, |(), x| dropout(&x[0], &mask));
}

#[test]
fn losses() {
    let inputs = [x(1, &[3, 4, 2]), x(2, &[3, 4, 2])];
    check("mse", &inputs, 1e-2, 2e-3, nothing, |(), x| mse(&x[0], &x[1], None));
    let mask: Vec<f32> = (0..12).map(|i| if i % 5 < 3 { 1.0 } else { 0.0 }).collect();
    let mask = Tensor::from_vec(mask, (3, 4), &Device::Cpu).unwrap();
    check("masked mse", &inputs, 1e-2, 2e-3, nothing, |(), x| mse(&x[0], &x[1], Some(&mask)));
    // The mean over the rows that count.
    let got = mse(&inputs[0], &inputs[1], Some(&mask)).unwrap().to_scalar::<f32>().unwrap();
    let (p, t, m) = (values(&inputs[0]), values(&inputs[1]), values(&mask));
    let sum: f32 = (0..24).map(|i| m[i / 2] * (p[i] - t[i]).powi(2)).sum();
    assert!((got - sum / (2.0 * m.iter().sum::<f32>())).abs() < 1e-6);
    assert!(mse(&inputs[0], &inputs[1], Some(&mask.zeros_like().unwrap())).is_err());
}

#[test]
fn pooling() {
    for (batch, h, w) in [(1, 8, 8), (3, 9, 7), (2, 1, 5), (2, 2, 3)] {
        let shape = [batch, h, w, 5];
        // Numbers far enough apart that a step of eps changes no maximum.
        let n: usize = shape.iter().product();
        let v: Vec<f32> = (0..n).map(|i| ((i * 7919) % 10_007) as f32 / 1000.0).collect();
        let input = Tensor::from_vec(v, &shape, &Device::Cpu).unwrap();
        check("max pool", std::slice::from_ref(&input), 2e-4, 2e-2, nothing, |(), x| {
            MaxPool2d.forward(&x[0])
        });
        // And the values, position by position.
        let y = MaxPool2d.forward(&input).unwrap().to_vec1_4();
        let at = |b: usize, y: usize, x: usize, c: usize| values(&input)[((b * h + y) * w + x) * 5 + c];
        for (i, got) in y.1.iter().enumerate() {
            let (oh, ow) = (y.0[1], y.0[2]);
            let (c, ox, oy, b) = (i % 5, i / 5 % ow, i / 5 / ow % oh, i / 5 / ow / oh);
            let mut want = f32::MIN;
            for iy in (2 * oy).saturating_sub(1)..(2 * oy + 2).min(h) {
                for ix in (2 * ox).saturating_sub(1)..(2 * ox + 2).min(w) {
                    want = want.max(at(b, iy, ix, c));
                }
            }
            assert_eq!(*got, want);
        }
    }
    for (h, w) in [(4, 6), (1, 5), (7, 7)] {
        let build = |b: &Builder<'_>| SpatialSoftmax::new(6, 5, b);
        check("spatial softmax", &[x(1, &[3, h, w, 6])], 1e-2, 5e-3, build, |n, x| n.forward(&x[0]));
    }
}

/// Shape and numbers at once.
trait Parts {
    fn to_vec1_4(&self) -> (Vec<usize>, Vec<f32>);
}

impl Parts for Tensor {
    fn to_vec1_4(&self) -> (Vec<usize>, Vec<f32>) {
        (self.dims().to_vec(), values(self))
    }
}

#[test]
fn whole_networks() {
    for (batch, length) in [(1, 8), (3, 12)] {
        let config = UnetConfig {
            input_dim: 3,
            down_dims: vec![8, 16],
            kernel_size: 3,
            n_groups: 2,
            step_embed_dim: 8,
            cond_dim: 5,
        };
        let steps: Vec<f32> = (0..batch).map(|i| 7.0 * i as f32 + 3.0).collect();
        let inputs = [x(1, &[batch, length, 3]), x(2, &[batch, 5])];
        let build = |b: &Builder<'_>| ConditionalUnet1d::new(&config, b);
        check("u-net", &inputs, 1e-3, 2e-2, build, |n, x| n.forward(&x[0], &steps, &x[1]));
    }
    let config = RgbEncoderConfig {
        height: 21,
        width: 18,
        base_width: 16,
        stage_blocks: vec![1, 1],
        keypoints: 4,
        feature_dim: 6,
    };
    let build = |b: &Builder<'_>| RgbEncoder::new(&config, b);
    // Rectifiers bend: the smaller eps, the fewer of the thousands of kinks it crosses.
    check("encoder", &[input(1, &[2, 21, 18, 3], 0.5, 0.5)], 1e-4, 0.1, build, |n, x| n.forward(&x[0]));
    let build = |b: &Builder<'_>| RgbEncoder::folded(&config, b);
    check("folded encoder", &[input(1, &[2, 21, 18, 3], 0.5, 0.5)], 1e-4, 0.1, build, |n, x| {
        n.forward(&x[0])
    });
    let build = |b: &Builder<'_>| Mlp::new(&[5, 9, 8, 2], 0.3, b);
    check("mlp", &[x(1, &[3, 5])], 1e-3, 1e-2, build, |n, x| n.forward(&x[0], None::<&mut ChaCha8Rng>));
    check("mlp with dropout", &[x(1, &[3, 5])], 1e-3, 1e-2, build, |n, x| {
        n.forward(&x[0], Some(&mut rng(5)))
    });
}

#[test]
fn mish_is_finite_far_out() {
    far_out();
    elsewhere(far_out);
}

fn far_out() {
    let far = [-1e30f32, -200., -89., -30., 0., 30., 89., 200., 1e30];
    let v = Var::new(&far, compute().device()).unwrap();
    let y = Mish.forward(v.as_tensor()).unwrap();
    let g = values(y.sum_all().unwrap().backward().unwrap().get(v.as_tensor()).unwrap());
    assert!(values(&y).iter().chain(&g).all(|v| v.is_finite()), "{:?} {g:?}", values(&y));
    assert_eq!((g[7], g[8], values(&y)[8]), (1.0, 1.0, 1e30));
    assert!(g[0].abs() < 1e-6 && g[1].abs() < 1e-6);
    for x in [-5.0f32, -1.0, -0.1, 0.0, 0.3, 2.0, 7.0] {
        let got = Mish.forward(&Tensor::new(&[x], &Device::Cpu).unwrap()).unwrap();
        let want = f64::from(x) * f64::from(x).exp().ln_1p().tanh();
        assert!((f64::from(values(&got)[0]) - want).abs() < 1e-6);
    }
}

/// Two networks in one loss, one used twice.
#[test]
fn shared_and_joint_networks() {
    shared_and_joint();
    elsewhere(shared_and_joint);
}

fn shared_and_joint() {
    let (pa, a) = filled(Mode::Train, |b| Linear::new(4, 4, b));
    let (pb, b) = filled(Mode::Train, |b| Linear::new(4, 4, b));
    let input = x(1, &[3, 4]);
    let out = |first: &Linear| b.forward(&first.forward(&first.forward(&input).unwrap()).unwrap()).unwrap();
    let grads = e2h_nn::backward_many(&loss(&out(&a)), &[&pa, &pb]).unwrap();
    let one = backward(&loss(&out(&a)), &pa).unwrap();
    assert_eq!(grads[0].export(&pa).unwrap(), one.export(&pa).unwrap());
    let weights = pa.export().unwrap();
    let at = |by: f32| {
        let mut w = weights.clone();
        w.get_mut("weight").unwrap().data[5] += by;
        pa.import(&w).unwrap();
        loss64(&out(&a))
    };
    let want = (at(1e-2) - at(-1e-2)) / 2e-2;
    let got = f64::from(one.export(&pa).unwrap()["weight"].data[5]);
    assert!((got - want).abs() < 2e-3 * want.abs().max(0.1), "{got} {want}");
    // Gradients of a whole add up over parts of a batch.
    let part = |i| backward(&loss(&a.forward(&input.narrow(0, i, 1).unwrap()).unwrap()), &pa).unwrap();
    let mut sum = part(0);
    sum.add(&part(1)).unwrap();
    assert!(sum.norm().unwrap() > 0.0 && sum.add(&grads[1]).is_ok());
    let (other, _) = Params::build(Mode::Train, &mut rng(0), |b| Linear::new(4, 5, b)).unwrap();
    assert!(sum.export(&other).is_err());
}

/// Weight gradients have nowhere to go in Candle's own call: that is an error, not a silent loss.
#[test]
fn a_second_backward_pass_is_refused() {
    let (params, net) = filled(Mode::Train, |b| Linear::new(4, 2, b));
    let loss = loss(&net.forward(&x(1, &[3, 4])).unwrap());
    backward(&loss, &params).unwrap();
    let message = backward(&loss, &params).unwrap_err().to_string();
    assert!(message.contains("an earlier backward pass has freed"), "{message}");
}

#[test]
fn candle_backward_is_refused() {
    let (_, net) = filled(Mode::Train, |b| Linear::new(4, 4, b));
    let _ = fill(&Weights::new());
    assert!(loss(&net.forward(&x(1, &[3, 4])).unwrap()).backward().is_err());
}

/// Candle panics where a tracked value with a past gets no gradient.
#[test]
fn an_unused_input_gets_zeros() {
    let config = UnetConfig {
        input_dim: 2,
        down_dims: vec![8],
        kernel_size: 3,
        n_groups: 2,
        step_embed_dim: 4,
        cond_dim: 0,
    };
    let (params, net) = filled(Mode::Train, |b| ConditionalUnet1d::new(&config, b));
    let x = Var::from_tensor(&input(1, &[2, 4, 2], 1.0, 0.0)).unwrap();
    let cond = (Var::from_tensor(&input(2, &[2, 0], 1.0, 0.0)).unwrap().as_tensor() * 2.0).unwrap();
    let out = net.forward(&(x.as_tensor() * 2.0).unwrap(), &[1.0, 2.0], &cond).unwrap();
    assert_eq!(backward(&loss(&out), &params).unwrap().export(&params).unwrap().len(), params.len());
}
