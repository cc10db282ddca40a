//! Max pooling and the spatial softmax.

use super::act::exp;
use super::{fma, made, simd, worthwhile};
use rayon::prelude::*;

/// Window of the pooling, its step and its border.
const K: usize = 3;
const STEP: usize = 2;
const PAD: usize = 1;

/// Sizes of a map `(b, h, w, c)`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Map {
    pub(crate) b: usize,
    pub(crate) h: usize,
    pub(crate) w: usize,
    pub(crate) c: usize,
}

impl Map {
    /// The map after pooling.
    pub(crate) fn pooled(&self) -> Self {
        let half = |n: usize| (n + 2 * PAD).saturating_sub(K) / STEP + 1;
        Self { h: half(self.h), w: half(self.w), ..*self }
    }
    fn size(&self) -> usize {
        self.h * self.w * self.c
    }
    fn check(&self, slices: &[&[f32]]) {
        debug_assert!(self.size() > 0, "an empty {self:?}");
        debug_assert!(slices.iter().all(|x| x.len() == self.b * self.size()), "numbers of a {self:?}");
    }
}

/// The input position under tap (ky, kx) of output (oy, ox), if inside.
#[inline(always)]
fn under(m: &Map, oy: usize, ox: usize, tap: usize) -> Option<usize> {
    let y = (oy * STEP + tap / K).checked_sub(PAD).filter(|y| *y < m.h)?;
    let x = (ox * STEP + tap % K).checked_sub(PAD).filter(|x| *x < m.w)?;
    Some((y * m.w + x) * m.c)
}

simd! {
fn max_sample(x: &[f32], y: &mut [f32], m: &Map) {
    let _ = FMA;
    let (p, c) = (m.pooled(), m.c);
    for (o, y) in y.chunks_exact_mut(c).enumerate() {
        y.fill(f32::NEG_INFINITY);
        let (oy, ox) = (o / p.w, o % p.w);
        for tap in 0..K * K {
            let Some(s) = under(m, oy, ox, tap) else { continue };
            for (y, x) in y.iter_mut().zip(&x[s..s + c]) {
                // A NaN, once met, stays.
                *y = if *x > *y || x.is_nan() { *x } else { *y };
            }
        }
    }
}
}
simd! {
/// `dx` starts at zero. `left` is scratch of a row: what of the gradient no position has taken yet.
fn max_sample_back(x: &[f32], y: &[f32], dy: &[f32], dx: &mut [f32], left: &mut [f32], m: &Map) {
    let _ = FMA;
    let (p, c) = (m.pooled(), m.c);
    for (o, (y, dy)) in y.chunks_exact(c).zip(dy.chunks_exact(c)).enumerate() {
        left.copy_from_slice(dy);
        let (oy, ox) = (o / p.w, o % p.w);
        for tap in 0..K * K {
            let Some(s) = under(m, oy, ox, tap) else { continue };
            let (x, dx, left) = (&x[s..s + c], &mut dx[s..s + c], &mut left[..c]);
            for i in 0..c {
                let here = if x[i] == y[i] { left[i] } else { 0.0 };
                dx[i] += here;
                left[i] -= here;
            }
        }
    }
}
}

/// The largest of every 3x3 window, step 2, border 1.
pub(crate) fn max_forward(x: &[f32], m: &Map) -> Vec<f32> {
    let size = m.pooled().size();
    m.check(&[x]);
    made(m.b * size, size, |i, y| max_sample(&x[i * m.size()..][..m.size()], y, m))
}

/// The gradient of the input `x` with result `y`. Of equal maxima the first takes it.
pub(crate) fn max_backward(x: &[f32], y: &[f32], dy: &[f32], m: &Map) -> Vec<f32> {
    let (full, size) = (m.size(), m.pooled().size());
    m.check(&[x]);
    m.pooled().check(&[y, dy]);
    made(m.b * full, full, |i, dx| {
        let (x, at) = (&x[i * full..][..full], i * size..(i + 1) * size);
        max_sample_back(x, &y[at.clone()], &dy[at], dx, &mut vec![0.0; m.c], m);
    })
}

/// -1, ..., 1 in `n` equal steps; -1 alone.
pub(crate) fn position(i: usize, n: usize) -> f32 {
    if n < 2 { -1.0 } else { (2.0 * i as f64 / (n - 1) as f64 - 1.0) as f32 }
}

simd! {
/// Turns the logits `(h, w, c)` of one sample into attention, and sets `out` to the pairs (x, y). `t` is scratch of 4c.
fn attend(a: &mut [f32], out: &mut [f32], m: &Map, t: &mut [f32]) {
    let c = m.c;
    let (top, rest) = t.split_at_mut(c);
    let (sum, rest) = rest.split_at_mut(c);
    let (ex, ey) = rest.split_at_mut(c);
    top.fill(f32::NEG_INFINITY);
    for r in a.chunks_exact(c) {
        for i in 0..c {
            top[i] = if r[i] > top[i] { r[i] } else { top[i] };
        }
    }
    sum.fill(0.0);
    ex.fill(0.0);
    ey.fill(0.0);
    for (p, r) in a.chunks_exact_mut(c).enumerate() {
        let (x, y) = (position(p % m.w, m.w), position(p / m.w, m.h));
        for i in 0..c {
            let e = exp::<FMA>(r[i] - top[i]);
            r[i] = e;
            sum[i] += e;
            ex[i] = fma::<FMA>(e, x, ex[i]);
            ey[i] = fma::<FMA>(e, y, ey[i]);
        }
    }
    for i in 0..c {
        sum[i] = 1.0 / sum[i];
        out[2 * i] = ex[i] * sum[i];
        out[2 * i + 1] = ey[i] * sum[i];
    }
    for r in a.chunks_exact_mut(c) {
        for i in 0..c {
            r[i] *= sum[i];
        }
    }
}
}
simd! {
/// The gradient of the logits: attention times the gradient of the pair times the distance from the pair.
fn attend_back(a: &[f32], out: &[f32], d: &[f32], dx: &mut [f32], m: &Map) {
    let _ = FMA;
    let c = m.c;
    for (p, (a, dx)) in a.chunks_exact(c).zip(dx.chunks_exact_mut(c)).enumerate() {
        let (x, y) = (position(p % m.w, m.w), position(p / m.w, m.h));
        for i in 0..c {
            dx[i] = a[i] * (d[2 * i] * (x - out[2 * i]) + d[2 * i + 1] * (y - out[2 * i + 1]));
        }
    }
}
}

/// `(b, h, w, c)` logits to `(b, c, 2)` expected positions, and the attention.
pub(crate) fn keypoints_forward(logits: &[f32], m: &Map) -> (Vec<f32>, Vec<f32>) {
    m.check(&[logits]);
    let mut a = logits.to_vec();
    let mut out = vec![0.0; m.b * m.c * 2];
    let one = |a: &mut [f32], o: &mut [f32]| attend(a, o, m, &mut vec![0.0; 4 * m.c]);
    if m.b > 1 && worthwhile(logits.len()) {
        a.par_chunks_mut(m.size()).zip(out.par_chunks_mut(m.c * 2)).for_each(|(a, o)| one(a, o));
    } else {
        a.chunks_mut(m.size()).zip(out.chunks_mut(m.c * 2)).for_each(|(a, o)| one(a, o));
    }
    (out, a)
}

pub(crate) fn keypoints_backward(a: &[f32], out: &[f32], d: &[f32], m: &Map) -> Vec<f32> {
    let (size, pair) = (m.size(), m.c * 2);
    m.check(&[a]);
    debug_assert!([out.len(), d.len()] == [m.b * pair; 2], "pairs of a {m:?}");
    made(a.len(), size, |i, dx| {
        attend_back(&a[i * size..][..size], &out[i * pair..][..pair], &d[i * pair..][..pair], dx, m);
    })
}
