//! Elementwise functions and what is nearly that.

use super::with_gradient;
use candle_core::{D, Result, Tensor};

/// max(x, 0), with gradient 0 at 0 (Candle's own has 1 there) and NaN kept.
pub(crate) fn relu(x: &Tensor) -> Result<Tensor> {
    let v = x.detach();
    let zeros = v.zeros_like()?;
    let y = v.lt(&zeros)?.where_cond(&zeros, &v)?;
    with_gradient(y, &[x], |given, dy| {
        let dx = given.gradient(0, || given.result().gt(0f32)?.to_dtype(dy.dtype())? * dy)?;
        Ok([dx, None, None])
    })
}

/// Beyond these Mish is 0 or x in `f32`, and e^x neither vanishes nor overflows.
const ENDS: (f32, f32) = (-87.0, 30.0);

/// n / (n + 2) and 2 / (n + 2) with n = e^x (e^x + 2), and e^x.
fn mish_parts(x: &Tensor) -> Result<(Tensor, Tensor, Tensor)> {
    let e = x.minimum(ENDS.1)?.exp()?;
    let n = (&e * (&e + 2.0)?)?;
    let below = (&n + 2.0)?;
    Ok(((n / &below)?, (below.recip()? * 2.0)?, e))
}

/// x tanh(ln(1 + e^x)).
pub(crate) fn mish(x: &Tensor) -> Result<Tensor> {
    let v = x.detach();
    let y = (&v * mish_parts(&v)?.0)?;
    with_gradient(y, &[x], |given, dy| {
        let dx = given.gradient(0, || {
            let x = given.argument(0);
            let (w, rest, e) = mish_parts(&x)?;
            let slope = ((rest * (&w + 1.0)?)? * (&e / (&e + 1.0)?)?)?;
            dy * (w + (x.clamp(ENDS.0, ENDS.1)? * slope)?)?
        })?;
        Ok([dx, None, None])
    })
}

/// `x * scale + shift` with `e` holding scales, then shifts, of each sample.
///
/// # Shapes
/// `x` (B, .., C), `e` (B, 2C).
pub(crate) fn film(x: &Tensor, e: &Tensor) -> Result<Tensor> {
    let (b, c) = (x.dim(0)?, x.dim(D::Minus1)?);
    let flat = x.reshape((b, (), c))?;
    let half = |at| e.narrow(1, at, c)?.contiguous()?.reshape((b, 1, c));
    flat.broadcast_mul(&half(0)?)?.broadcast_add(&half(c)?)?.reshape(x.dims())
}

/// Every row `times` times in a row.
pub(crate) fn repeat_rows(x: &Tensor, times: usize) -> Result<Tensor> {
    let (b, c) = x.dims2()?;
    x.reshape((b, 1, c))?.broadcast_as((b, times, c))?.contiguous()?.reshape((b * times, c))
}

/// The weighted sum of squared differences times `scale`; `weights` (rows) for rows of the last axis, or none.
pub(crate) fn squared_error(p: &Tensor, t: &Tensor, weights: &[f32], scale: f64) -> Result<Tensor> {
    let mut square = (p - t)?.sqr()?;
    if !weights.is_empty() {
        let width = p.dim(D::Minus1)?;
        let weights = Tensor::from_slice(weights, (weights.len(), 1), p.device())?;
        square = square.reshape(((), width))?.broadcast_mul(&weights)?;
    }
    square.sum_all()? * scale
}
