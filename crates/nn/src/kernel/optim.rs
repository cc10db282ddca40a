//! One pass over parameters, gradients and moments.

use super::{simd, threads};
use rayon::prelude::*;

/// Elements a task: fixed, so that sums do not depend on the number of threads.
const CHUNK: usize = 1 << 15;

simd! {
fn square_sum(x: &[f32], out: &mut f64) {
    let _ = FMA;
    let mut lanes = [0.0f32; 32];
    let rest = x.chunks_exact(32).remainder();
    for r in x.chunks_exact(32) {
        for i in 0..32 {
            lanes[i] += r[i] * r[i];
        }
    }
    *out = lanes.iter().chain(&[]).map(|v| f64::from(*v)).sum::<f64>()
        + rest.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>();
}
}

/// The sum of squares, in `f64` over chunks of fixed size.
pub(crate) fn squares(x: &[f32]) -> f64 {
    let one = |c: &[f32]| {
        let mut s = 0.0;
        square_sum(c, &mut s);
        s
    };
    if x.len() > CHUNK && threads() > 1 {
        let parts: Vec<f64> = x.par_chunks(CHUNK).map(one).collect();
        parts.iter().sum()
    } else {
        x.chunks(CHUNK).map(one).sum()
    }
}

/// The numbers of one Adam step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Adam {
    /// Learning rate over the bias correction of the first moment.
    pub(crate) rate: f32,
    pub(crate) beta1: f32,
    pub(crate) beta2: f32,
    pub(crate) eps: f32,
    /// One over the square root of the bias correction of the second moment.
    pub(crate) root: f32,
    /// Factor of the gradient, from clipping.
    pub(crate) clip: f32,
    /// Weight decay added to the gradient.
    pub(crate) decay: f32,
    /// Factor of the parameter, from decoupled weight decay.
    pub(crate) keep: f32,
}

simd! {
fn adam_chunk(p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], a: Adam) {
    let _ = FMA;
    for (((p, g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
        let g = g * a.clip + a.decay * *p;
        *m = a.beta1 * *m + (1.0 - a.beta1) * g;
        *v = a.beta2 * *v + (1.0 - a.beta2) * g * g;
        *p = *p * a.keep - a.rate * *m / (v.sqrt() * a.root + a.eps);
    }
}
}

pub(crate) fn adam(p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], a: Adam) {
    debug_assert!([g.len(), m.len(), v.len()] == [p.len(); 3], "a gradient and moments for each parameter");
    if p.len() > CHUNK && threads() > 1 {
        p.par_chunks_mut(CHUNK)
            .zip(g.par_chunks(CHUNK))
            .zip(m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK)))
            .for_each(|((p, g), (m, v))| adam_chunk(p, g, m, v, a));
    } else {
        adam_chunk(p, g, m, v, a);
    }
}

simd! {
fn blend_chunk(e: &mut [f32], p: &[f32], part: f32) {
    let _ = FMA;
    for (e, p) in e.iter_mut().zip(p) {
        *e += part * (*p - *e);
    }
}
}

/// `e += part (p - e)`.
pub(crate) fn blend(e: &mut [f32], p: &[f32], part: f32) {
    debug_assert_eq!(e.len(), p.len(), "an average for each parameter");
    super::each(e, CHUNK, |i, e| blend_chunk(e, &p[i * CHUNK..][..e.len()], part));
}
