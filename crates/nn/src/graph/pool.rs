//! Max pooling and the spatial softmax.

use super::gather::{readers, under};
use super::with_gradient;
use crate::kernel::conv::Geo;
use crate::kernel::pool::{Map, position};
use candle_core::{DType, Result, Tensor};

/// The largest of every 3x3 window, step 2, border 1. Of equal maxima the first takes the gradient.
///
/// # Shapes
/// `x` (b, h, w, c) to (b, h', w', c).
pub(crate) fn max_pool(x: &Tensor, m: &Map) -> Result<Tensor> {
    let g = Geo { b: m.b, h: m.h, w: m.w, c: m.c, n: m.c, kh: 3, kw: 3, sh: 2, sw: 2, ph: 1, pw: 1 };
    let (b, c, p) = (m.b, m.c, m.pooled());
    let map = *m;
    let patches = move |x: &Tensor| {
        let gather = under(&g, x.device())?;
        let taken = gather.take(&x.reshape((b, map.h * map.w, c))?, f32::NEG_INFINITY)?;
        taken.reshape((b * gather.rows, gather.taps, c))
    };
    let y = patches(&x.detach())?.max(1)?.reshape((p.b, p.h, p.w, p.c))?;
    with_gradient(y, &[x], move |given, dy| {
        let dx = given.gradient(0, || {
            let x = patches(&given.argument(0))?;
            let (rows, taps, _) = x.dims3()?;
            let is_largest = x.broadcast_eq(&given.result().reshape((rows, 1, c))?)?.to_dtype(DType::F32)?;
            // The earlier a tap, the higher it ranks: the first of equal maxima is the one of the highest rank.
            let rank: Vec<f32> = (1..=taps).rev().map(|r| r as f32).collect();
            let ranked = is_largest.broadcast_mul(&Tensor::from_vec(rank, (1, taps, 1), x.device())?)?;
            let first = ranked.broadcast_eq(&ranked.max_keepdim(1)?)?.to_dtype(DType::F32)?;
            let d = first.broadcast_mul(&dy.reshape((rows, 1, c))?)?.reshape((b, rows / b * taps, c))?;
            let gather = readers(&g, x.device())?;
            gather.take(&d, 0.0)?.reshape((b * gather.rows, gather.taps, c))?.sum(1)
        })?;
        Ok([dx, None, None])
    })
}

/// Expected positions (b, 2c), pairs of x and y, of logits (b, h, w, c).
pub(crate) fn keypoints(logits: &Tensor, m: &Map) -> Result<Tensor> {
    let (b, n, c) = (m.b, m.h * m.w, m.c);
    let logits = logits.reshape((b, n, c))?;
    let top = logits.detach().max_keepdim(1)?;
    let e = logits.broadcast_sub(&top)?.exp()?;
    let attention = e.broadcast_div(&e.sum_keepdim(1)?)?;
    let mean = |at: Vec<f32>| {
        let at = Tensor::from_vec(at, (1, n, 1), logits.device())?;
        attention.broadcast_mul(&at)?.sum(1)?.reshape((b, c, 1))
    };
    let x = mean((0..n).map(|p| position(p % m.w, m.w)).collect())?;
    let y = mean((0..n).map(|p| position(p / m.w, m.h)).collect())?;
    Tensor::cat(&[&x, &y], 2)?.reshape((b, 2 * c))
}
