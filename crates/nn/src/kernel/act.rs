//! Elementwise functions.

use super::{each, fma, made, simd};

const CHUNK: usize = 1 << 13;

/// `exp` within two units in the last place, clamped where `f32` would overflow or vanish.
///
/// # Source
/// Cody-Waite reduction by ln 2 in two parts and a fifth-degree polynomial, the coefficients of Cephes `expf`.
#[inline(always)]
pub(crate) fn exp<const FMA: bool>(x: f32) -> f32 {
    let x = x.clamp(-87.0, 88.0);
    let n = (x * std::f32::consts::LOG2_E + 12_582_912.0) - 12_582_912.0; // adding 1.5 * 2^23 rounds to an integer
    let r = fma::<FMA>(n, 2.121_944_4e-4, fma::<FMA>(n, -355.0 / 512.0, x));
    let mut p = fma::<FMA>(1.987_569_1e-4, r, 1.398_2e-3);
    for c in [8.333_452e-3, 4.166_579_6e-2, 1.666_666_5e-1, 0.5] {
        p = fma::<FMA>(p, r, c);
    }
    let y = fma::<FMA>(p, r * r, r) + 1.0;
    f32::from_bits(((n as i32 + 127) as u32) << 23) * y
}

/// Where Mish is 0 and where it is x, in `f32`. Clamped there, no product overflows.
const ENDS: (f32, f32) = (-87.0, 30.0);

/// x tanh(softplus(x)) = x n / (n + 2) with n = e^x (e^x + 2).
#[inline(always)]
pub(crate) fn mish<const FMA: bool>(x: f32) -> f32 {
    let e = exp::<FMA>(x.min(ENDS.1));
    let n = e * (e + 2.0);
    x.max(ENDS.0) * (n / (n + 2.0))
}

/// Value and derivative of [`mish`].
#[inline(always)]
pub(crate) fn mish_both<const FMA: bool>(x: f32) -> (f32, f32) {
    let e = exp::<FMA>(x.min(ENDS.1));
    let n = e * (e + 2.0);
    let w = n / (n + 2.0);
    // 1 - w^2 = (1 - w)(1 + w), with 1 - w = 2 / (n + 2) free of cancellation.
    let d = (2.0 / (n + 2.0)) * (1.0 + w) * (e / (1.0 + e));
    (x.max(ENDS.0) * w, fma::<FMA>(x.clamp(ENDS.0, ENDS.1), d, w))
}

simd! {
fn mish_chunk(x: &[f32], y: &mut [f32]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y = mish::<FMA>(*x);
    }
}
}
simd! {
fn mish_chunk_back(x: &[f32], d: &mut [f32]) {
    for (d, x) in d.iter_mut().zip(x) {
        *d *= mish_both::<FMA>(*x).1;
    }
}
}
simd! {
fn relu_chunk(x: &[f32], y: &mut [f32]) {
    let _ = FMA;
    for (y, x) in y.iter_mut().zip(x) {
        *y = if *x < 0.0 { 0.0 } else { *x }; // NaN stays NaN
    }
}
}
simd! {
fn relu_chunk_back(y: &[f32], d: &mut [f32]) {
    let _ = FMA;
    for (d, y) in d.iter_mut().zip(y) {
        *d = if *y > 0.0 { *d } else { 0.0 };
    }
}
}
simd! {
fn mul_chunk(m: &[f32], d: &mut [f32]) {
    let _ = FMA;
    for (d, m) in d.iter_mut().zip(m) {
        *d *= *m;
    }
}
}

fn chunk(x: &[f32], i: usize, n: usize) -> &[f32] {
    &x[i * CHUNK..][..n]
}

pub(crate) fn mish_forward(x: &[f32]) -> Vec<f32> {
    made(x.len(), CHUNK, |i, y| mish_chunk(chunk(x, i, y.len()), y))
}

/// `d` holds the gradient of the result and becomes that of `x`.
pub(crate) fn mish_backward(x: &[f32], d: &mut [f32]) {
    debug_assert_eq!(d.len(), x.len(), "numbers of the gradient");
    each(d, CHUNK, |i, d| mish_chunk_back(chunk(x, i, d.len()), d));
}

pub(crate) fn relu_forward(x: &[f32]) -> Vec<f32> {
    made(x.len(), CHUNK, |i, y| relu_chunk(chunk(x, i, y.len()), y))
}

/// `d` holds the gradient of the result `y` and becomes that of the input.
pub(crate) fn relu_backward(y: &[f32], d: &mut [f32]) {
    debug_assert_eq!(d.len(), y.len(), "numbers of the gradient");
    each(d, CHUNK, |i, d| relu_chunk_back(chunk(y, i, d.len()), d));
}

pub(crate) fn mul_assign(d: &mut [f32], m: &[f32]) {
    debug_assert_eq!(d.len(), m.len(), "numbers of the gradient");
    each(d, CHUNK, |i, d| mul_chunk(chunk(m, i, d.len()), d));
}

simd! {
/// One sample: every row of `x` times `scale` plus `shift`.
fn film_sample(x: &[f32], y: &mut [f32], scale: &[f32], shift: &[f32]) {
    let c = scale.len();
    for (x, y) in x.chunks_exact(c).zip(y.chunks_exact_mut(c)) {
        for i in 0..c {
            y[i] = fma::<FMA>(x[i], scale[i], shift[i]);
        }
    }
}
}
simd! {
fn film_sample_back(x: &[f32], d: &mut [f32], scale: &[f32], d_scale: &mut [f32], d_shift: &mut [f32]) {
    let c = scale.len();
    for (x, d) in x.chunks_exact(c).zip(d.chunks_exact_mut(c)) {
        for i in 0..c {
            d_scale[i] = fma::<FMA>(d[i], x[i], d_scale[i]);
            d_shift[i] += d[i];
            d[i] *= scale[i];
        }
    }
}
}

fn film_sizes(x: &[f32], e: &[f32], size: usize, c: usize) {
    debug_assert!(c > 0 && size > 0, "samples of {size} numbers in rows of {c}");
    debug_assert_eq!(x.len() * 2 * c, e.len() * size, "samples of x and pairs of scale and shift");
}

/// `x` of rows of `c`, `steps` rows per sample; `e` holds scale and shift of each sample.
pub(crate) fn film_forward(x: &[f32], e: &[f32], steps: usize, c: usize) -> Vec<f32> {
    let size = steps * c;
    film_sizes(x, e, size, c);
    made(x.len(), size, |i, y| {
        let (scale, shift) = e[i * 2 * c..][..2 * c].split_at(c);
        film_sample(&x[i * size..][..size], y, scale, shift);
    })
}

/// `d` becomes the gradient of `x`; the gradient of `e` is returned.
pub(crate) fn film_backward(x: &[f32], e: &[f32], d: &mut [f32], steps: usize, c: usize) -> Vec<f32> {
    let mut de = vec![0.0; e.len()];
    let size = steps * c;
    film_sizes(x, e, size, c);
    debug_assert_eq!(d.len(), x.len(), "numbers of the gradient");
    for (i, (d, de)) in d.chunks_mut(size).zip(de.chunks_mut(2 * c)).enumerate() {
        let (d_scale, d_shift) = de.split_at_mut(c);
        film_sample_back(&x[i * size..][..size], d, &e[i * 2 * c..][..c], d_scale, d_shift);
    }
    de
}
