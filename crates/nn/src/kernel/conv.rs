//! Convolutions as matrix products over patches, a cache-sized tile of patches at a time.

use super::{Mat, add_assign, matmul, scratch, simd, worthwhile};
use rayon::prelude::*;
use std::cell::RefCell;

/// Numbers in a tile of patches: 256 KiB, half of a usual second-level cache.
const TILE: usize = 1 << 16;
/// Up to this many output positions all patches are laid out at once and the threads share one product.
const FEW: usize = 1024;
/// At most so many partial weight gradients.
const PARTS: usize = 8;

thread_local! {
    static PATCHES: RefCell<Vec<f32>> = const { RefCell::new(Vec::new()) };
}

/// Sizes of a convolution from `(b, h, w, c)` to `(b, out_h, out_w, n)`. One dimension: `h` and `kh` are 1.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geo {
    pub(crate) b: usize,
    pub(crate) h: usize,
    pub(crate) w: usize,
    pub(crate) c: usize,
    pub(crate) n: usize,
    pub(crate) kh: usize,
    pub(crate) kw: usize,
    pub(crate) sh: usize,
    pub(crate) sw: usize,
    pub(crate) ph: usize,
    pub(crate) pw: usize,
}

impl Geo {
    /// A product of `rows` rows of `c` with a matrix of `c` by `n`.
    pub(crate) fn linear(rows: usize, c: usize, n: usize) -> Self {
        Self { b: rows, h: 1, w: 1, c, n, kh: 1, kw: 1, sh: 1, sw: 1, ph: 0, pw: 0 }
    }
    pub(crate) fn out_h(&self) -> usize {
        (self.h + 2 * self.ph).saturating_sub(self.kh) / self.sh + 1
    }
    pub(crate) fn out_w(&self) -> usize {
        (self.w + 2 * self.pw).saturating_sub(self.kw) / self.sw + 1
    }
    /// Output positions of one sample.
    fn per(&self) -> usize {
        self.out_h() * self.out_w()
    }
    /// Output positions of all samples.
    pub(crate) fn m(&self) -> usize {
        self.b * self.per()
    }
    /// Numbers in a patch.
    pub(crate) fn k(&self) -> usize {
        self.kh * self.kw * self.c
    }
    /// Whether a patch is a row of the input.
    fn pointwise(&self) -> bool {
        self.kh * self.kw * self.sh * self.sw == 1 && self.ph + self.pw == 0
    }
    fn tile(&self) -> usize {
        (TILE / self.k().max(1)).clamp(32, 512)
    }
}

fn with_patches<R>(n: usize, f: impl FnOnce(&mut [f32]) -> R) -> R {
    // Taken out of its cell, so that a task stolen meanwhile could not meet a borrowed one.
    let mut buffer = PATCHES.with(RefCell::take);
    if buffer.len() < n {
        buffer = scratch(n);
    }
    let r = f(&mut buffer[..n]);
    PATCHES.with(|p| p.replace(buffer));
    r
}

/// Where the columns of a patch that starts at `x0` meet an input `w` wide: (first, end) of `kw`.
#[inline(always)]
fn overlap(x0: isize, w: usize, kw: usize) -> (usize, usize) {
    let lo = usize::try_from(-x0).unwrap_or(0).min(kw);
    let hi = usize::try_from(w as isize - x0).unwrap_or(0).min(kw);
    (lo, hi.max(lo))
}

/// Calls `f(patch offset, input offset or None, length)` for every run of numbers in the patches of rows `r0..r1`.
#[inline(always)]
fn runs(g: &Geo, r0: usize, r1: usize, mut f: impl FnMut(usize, Option<usize>, usize)) {
    let (oh, ow, k, c) = (g.out_h(), g.out_w(), g.k(), g.c);
    let seg = g.kw * c;
    let (mut bi, mut oy, mut ox) = (r0 / (oh * ow), r0 / ow % oh, r0 % ow);
    for r in 0..r1 - r0 {
        let x0 = (ox * g.sw) as isize - g.pw as isize;
        let (lo, hi) = overlap(x0, g.w, g.kw);
        for ky in 0..g.kh {
            let o = r * k + ky * seg;
            let iy = (oy * g.sh + ky) as isize - g.ph as isize;
            if iy < 0 || iy >= g.h as isize || lo == hi {
                f(o, None, seg);
                continue;
            }
            if lo > 0 {
                f(o, None, lo * c);
            }
            let s = ((bi * g.h + iy as usize) * g.w + (x0 + lo as isize) as usize) * c;
            f(o + lo * c, Some(s), (hi - lo) * c);
            if hi < g.kw {
                f(o + hi * c, None, (g.kw - hi) * c);
            }
        }
        ox += 1;
        if ox == ow {
            (ox, oy) = (0, oy + 1);
            if oy == oh {
                (oy, bi) = (0, bi + 1);
            }
        }
    }
}

simd! {
/// Copies the patches of output rows `r0..r1`.
fn gather(x: &[f32], g: &Geo, r0: usize, r1: usize, col: &mut [f32]) {
    let _ = FMA;
    runs(g, r0, r1, |o, s, len| match s {
        Some(s) => col[o..o + len].copy_from_slice(&x[s..s + len]),
        None => col[o..o + len].fill(0.0),
    });
}
}
simd! {
/// Adds the patches of output rows `r0..r1` to the input positions they came from. `x` starts at sample `b0`.
fn scatter(x: &mut [f32], b0: usize, g: &Geo, r0: usize, r1: usize, col: &[f32]) {
    let _ = FMA;
    let base = b0 * g.h * g.w * g.c;
    runs(g, r0, r1, |o, s, len| if let Some(s) = s {
        for (a, b) in x[s - base..][..len].iter_mut().zip(&col[o..o + len]) {
            *a += *b;
        }
    });
}
}

fn all_patches(x: &[f32], g: &Geo) -> Vec<f32> {
    let (m, k) = (g.m(), g.k());
    let rows = (TILE / k.max(1)).max(1);
    let mut col = scratch(m * k);
    let fill = |i: usize, c: &mut [f32]| gather(x, g, i * rows, (i * rows + rows).min(m), c);
    if worthwhile(col.len()) {
        col.par_chunks_mut(rows * k).enumerate().for_each(|(i, c)| fill(i, c));
    } else {
        col.chunks_mut(rows * k).enumerate().for_each(|(i, c)| fill(i, c));
    }
    col
}

fn fill_bias(y: &mut [f32], bias: Option<&[f32]>) {
    if let Some(b) = bias {
        y.chunks_exact_mut(b.len()).for_each(|r| r.copy_from_slice(b));
    }
}

/// y = conv(x, w) + bias, with `w` of `(kh, kw, c)` by `n`.
pub(crate) fn forward(x: &[f32], w: &[f32], bias: Option<&[f32]>, g: &Geo) -> Vec<f32> {
    let (m, n, k) = (g.m(), g.n, g.k());
    let mut y = scratch(m * n);
    let (w, add) = (Mat::rows(w, n), bias.is_some());
    if m <= FEW {
        fill_bias(&mut y, bias);
        if g.pointwise() {
            matmul((m, n, k), &mut y, add, Mat::rows(x, k), w, true);
        } else {
            matmul((m, n, k), &mut y, add, Mat::rows(&all_patches(x, g), k), w, true);
        }
        return y;
    }
    let t = g.tile();
    let tile = |i: usize, y: &mut [f32]| {
        let (r0, rows) = (i * t, y.len() / n);
        fill_bias(y, bias);
        if g.pointwise() {
            return matmul((rows, n, k), y, add, Mat::rows(&x[r0 * k..], k), w, false);
        }
        with_patches(t * k, |col| {
            gather(x, g, r0, r0 + rows, col);
            matmul((rows, n, k), y, add, Mat::rows(col, k), w, false);
        });
    };
    super::each(&mut y, t * n, tile);
    y
}

/// The kernel that turns the gradient of the result into that of the input by a convolution: taps reversed, channels
/// swapped.
fn flipped(w: &[f32], g: &Geo) -> Vec<f32> {
    let (taps, c, n) = (g.kh * g.kw, g.c, g.n);
    let mut out = scratch(w.len());
    let one = |t: usize, o: &mut [f32]| transpose(&w[(taps - 1 - t) * c * n..][..c * n], c, n, o);
    super::each(&mut out, c * n, one);
    out
}

/// `o[j][i] = w[i][j]` for `w` of `rows` by `cols`, by blocks that stay in the first-level cache.
fn transpose(w: &[f32], rows: usize, cols: usize, o: &mut [f32]) {
    const B: usize = 16;
    for i0 in (0..rows).step_by(B) {
        for j0 in (0..cols).step_by(B) {
            for j in j0..(j0 + B).min(cols) {
                for i in i0..(i0 + B).min(rows) {
                    o[j * rows + i] = w[i * cols + j];
                }
            }
        }
    }
}

/// Spreads `rows(r0, r1) -> patches` over the input positions: `x` is set to `bias` (or 0) and added to, some samples a task.
fn spread(g: &Geo, bias: Option<&[f32]>, product: impl Fn(usize, usize, &mut [f32]) + Sync) -> Vec<f32> {
    let (k, per, size) = (g.k(), g.per(), g.h * g.w * g.c);
    let t = g.tile();
    let samples = (t / per.max(1)).max(1);
    let mut x = scratch(g.b * size);
    super::each(&mut x, samples * size, |i, x| {
        match bias {
            Some(_) => fill_bias(x, bias),
            None => x.fill(0.0),
        }
        let b0 = i * samples;
        let end = (b0 + x.len() / size.max(1)) * per;
        with_patches(t * k, |col| {
            let mut r = b0 * per;
            while r < end {
                let r1 = (r + t).min(end);
                product(r, r1, col);
                scatter(x, b0, g, r, r1, col);
                r = r1;
            }
        });
    });
    x
}

/// The gradient of the input.
pub(crate) fn input_grad(w: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    let (n, k) = (g.n, g.k());
    if g.sh == 1 && g.sw == 1 && g.ph < g.kh && g.pw < g.kw {
        let back =
            Geo { h: g.out_h(), w: g.out_w(), c: n, n: g.c, ph: g.kh - 1 - g.ph, pw: g.kw - 1 - g.pw, ..*g };
        return forward(dy, &flipped(w, g), None, &back);
    }
    let mut wt = scratch(w.len());
    transpose(w, k, n, &mut wt);
    spread(g, None, |r0, r1, col| {
        matmul((r1 - r0, k, n), col, false, Mat::rows(&dy[r0 * n..], n), Mat::rows(&wt, k), false);
    })
}

/// The gradient of the weights, `(kh, kw, c)` by `n`.
pub(crate) fn weight_grad(x: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    let (m, n, k) = (g.m(), g.n, g.k());
    if m <= FEW {
        let mut dw = scratch(k * n);
        let own;
        let col = if g.pointwise() {
            x
        } else {
            own = all_patches(x, g);
            &own
        };
        matmul((k, n, m), &mut dw, false, Mat::transposed(col, k), Mat::rows(dy, n), true);
        return dw;
    }
    let t = g.tile();
    let parts = PARTS.min(m.div_ceil(FEW / 2));
    let rows = m.div_ceil(parts).div_ceil(t) * t;
    let part = |i: usize| {
        let (mut r, end) = (i * rows, (i * rows + rows).min(m));
        let mut dw = scratch(k * n);
        let mut add = false;
        while r < end {
            let r1 = (r + t).min(end);
            if g.pointwise() {
                let a = Mat::transposed(&x[r * k..], k);
                matmul((k, n, r1 - r), &mut dw, add, a, Mat::rows(&dy[r * n..], n), false);
            } else {
                with_patches(t * k, |col| {
                    gather(x, g, r, r1, col);
                    let a = Mat::transposed(col, k);
                    matmul((k, n, r1 - r), &mut dw, add, a, Mat::rows(&dy[r * n..], n), false);
                });
            }
            (r, add) = (r1, true);
        }
        dw
    };
    sum_parts(m.div_ceil(rows), part)
}

/// `part(0) + part(1) + ...`, in that order.
fn sum_parts(count: usize, part: impl Fn(usize) -> Vec<f32> + Sync + Send) -> Vec<f32> {
    let parts: Vec<Vec<f32>> = if super::threads() > 1 {
        (0..count).into_par_iter().map(&part).collect()
    } else {
        (0..count).map(&part).collect()
    };
    let mut parts = parts.into_iter();
    let mut sum = parts.next().unwrap_or_default();
    parts.for_each(|p: Vec<f32>| add_assign(&mut sum, &p));
    sum
}

/// Transposed convolution from `(b, out_h, out_w, n)` to `(b, h, w, c)`: the input gradient of the convolution `g`, here
/// with `w` of `n` by `(kh, kw, c)` and a bias of `c`.
pub(crate) fn transposed_forward(x: &[f32], w: &[f32], bias: &[f32], g: &Geo) -> Vec<f32> {
    let (n, k) = (g.n, g.k());
    if g.m() <= FEW {
        let mut all = scratch(g.m() * k);
        matmul((g.m(), k, n), &mut all, false, Mat::rows(x, n), Mat::rows(w, k), true);
        return spread(g, Some(bias), |r0, r1, col| {
            let rows = &all[r0 * k..r1 * k];
            col[..rows.len()].copy_from_slice(rows);
        });
    }
    spread(g, Some(bias), |r0, r1, col| {
        matmul((r1 - r0, k, n), col, false, Mat::rows(&x[r0 * n..], n), Mat::rows(w, k), false);
    })
}

/// The gradient of the input of [`transposed_forward`].
pub(crate) fn transposed_input_grad(w: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    let (n, k) = (g.n, g.k());
    let mut wt = scratch(w.len());
    transpose(w, n, k, &mut wt);
    forward(dy, &wt, None, g)
}

/// The gradient of the weights of [`transposed_forward`], `n` by `(kh, kw, c)`.
pub(crate) fn transposed_weight_grad(x: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    // The roles of x and dy are those of the plain convolution exchanged, so the result comes out transposed.
    let dw = weight_grad(dy, x, g);
    let mut out = scratch(dw.len());
    transpose(&dw, g.k(), g.n, &mut out);
    out
}
