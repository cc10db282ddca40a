//! Group normalisation.

use super::{column_sums, with_gradient};
use candle_core::{Result, Tensor};

/// Added to the variance, as in PyTorch.
const EPS: f64 = 1e-5;
/// A sample's axes (B, S, groups, channels of a group) that a group has its moments over.
const OVER: (usize, usize) = (1, 3);

/// Normalises each group of channels of each sample over all positions.
///
/// # Shapes
/// `x` (B, .., C), gain and bias (C), to the shape of `x`.
pub(crate) fn group_norm(x: &Tensor, gain: &Tensor, bias: &Tensor, groups: usize) -> Result<Tensor> {
    let (b, c) = (x.dim(0)?, gain.elem_count());
    let s = x.elem_count() / (b * c);
    let (split, joined) = ((b, s, groups, c / groups), (b * s, c));
    let flat = x.detach().reshape(split)?;
    let mean = flat.mean_keepdim(OVER)?;
    let centred = flat.broadcast_sub(&mean)?;
    let rate = (centred.sqr()?.mean_keepdim(OVER)? + EPS)?.sqrt()?.recip()?;
    let normal = centred.broadcast_mul(&rate)?.reshape(joined)?;
    let y = normal.broadcast_mul(&gain.detach())?.broadcast_add(&bias.detach())?.reshape(x.dims())?;
    with_gradient(y, &[x, gain, bias], move |given, dy| {
        let normal = given.argument(0).reshape(split)?.broadcast_sub(&mean)?.broadcast_mul(&rate)?;
        let rows = dy.reshape(joined)?;
        let dx = given.gradient(0, || {
            let d = rows.broadcast_mul(&given.argument(1))?.reshape(split)?;
            let (m, n) = (d.mean_keepdim(OVER)?, (&d * &normal)?.mean_keepdim(OVER)?);
            d.broadcast_sub(&m)?.sub(&normal.broadcast_mul(&n)?)?.broadcast_mul(&rate)
        })?;
        let dgain = given.gradient(1, || column_sums(&(&rows * normal.reshape(joined)?)?))?;
        Ok([dx, dgain, given.gradient(2, || column_sums(&rows))?])
    })
}
