//! Convolutions in every precision, through Candle or on a GPU, against our kernels in f32. With `E2H_CONVOLUTION=cudnn` a
//! GPU leaves to cuDNN all that it can.

use crate::gradients::same_in;
use crate::support::{device_given, input};
use e2h_nn::{Builder, Conv1d, Conv2d, ConvTranspose1d, Precision};

/// What rounding leaves of outputs and of gradients.
const PRECISIONS: [(Precision, (f64, f64)); 3] = [
    (Precision { tf32: false, bf16: false }, (1e-5, 1e-4)),
    (Precision { tf32: true, bf16: false }, (2e-3, 2e-3)),
    (Precision { tf32: false, bf16: true }, (1e-2, 2e-2)),
];

fn plane(shape: [usize; 4], to: usize, (kernel, stride, padding): (usize, usize, usize), bias: bool) {
    let what = format!("conv2d of {shape:?} to {to}, kernel {kernel}, stride {stride}");
    let x = [input(1, &shape, 1.0, 0.0)];
    for (precision, near) in PRECISIONS {
        let what = format!("{what}, {precision:?}");
        let build = |b: &Builder<'_>| Conv2d::new((shape[3], to), kernel, stride, padding, bias, b);
        same_in(precision, &what, &x, near, build, |n, x| n.forward(&x[0]));
    }
}

#[test]
fn planes_agree_in_every_precision() {
    plane([2, 9, 10, 16], 32, (3, 1, 1), false);
    plane([2, 9, 10, 32], 16, (3, 2, 1), true);
    // Images, and a kernel of even size that leaves a row over.
    plane([2, 21, 20, 3], 16, (7, 2, 3), false);
    plane([3, 8, 7, 8], 8, (2, 2, 0), true);
    // Channels that tensor cores do not like; one tap, in steps.
    plane([2, 9, 10, 12], 20, (3, 1, 1), true);
    plane([2, 6, 7, 5], 7, (3, 1, 1), true);
    plane([2, 9, 10, 16], 32, (1, 2, 0), false);
}

#[test]
fn lines_agree_in_every_precision() {
    for (from, to, kernel, stride, padding) in [(16, 32, 5, 1, 2), (7, 32, 5, 1, 2), (32, 32, 3, 2, 1)] {
        let x = [input(1, &[3, 16, from], 1.0, 0.0)];
        for (precision, near) in PRECISIONS {
            let what = format!("conv1d {from} to {to}, stride {stride}, {precision:?}");
            let build = |b: &Builder<'_>| Conv1d::new(from, to, kernel, stride, padding, b);
            same_in(precision, &what, &x, near, build, |n, x| n.forward(&x[0]));
        }
    }
    let x = [input(1, &[3, 8, 16], 1.0, 0.0)];
    for (precision, near) in PRECISIONS {
        let what = format!("transposed, {precision:?}");
        same_in(precision, &what, &x, near, |b| ConvTranspose1d::new(16, 8, b), |n, x| n.forward(&x[0]));
    }
}

/// So large that a GPU's network leaves them to cuDNN by itself.
#[test]
fn large_planes_agree_on_a_device() {
    if !device_given() {
        return;
    }
    plane([16, 64, 64, 64], 64, (3, 1, 1), false);
    plane([64, 128, 128, 3], 64, (7, 2, 3), false);
}
