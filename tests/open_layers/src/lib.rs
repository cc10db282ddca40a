//! A layer with parameters and an exact backward pass of its own, as a crate elsewhere would write it.

use candle_core::{D, Module, Result, Tensor};
use candle_nn::{Init, VarBuilder};
use e2h_nn::with_gradient;

/// Added to the mean square.
const EPS: f64 = 1e-6;

/// `gain * x / sqrt(mean(x^2) + 1e-6)` over the last axis, in one pass with its gradient; candle-nn's own has none.
///
/// # Source
/// Zhang and Sennrich, "Root Mean Square Layer Normalization", equation 4.
pub struct RmsNorm {
    gain: Tensor,
}

impl RmsNorm {
    /// A layer with the parameter `weight` (width), which starts at 1.
    ///
    /// # Errors
    /// When `vars` has a `weight` of another shape.
    pub fn new(width: usize, vars: &VarBuilder<'_>) -> Result<Self> {
        Ok(Self { gain: vars.get_with_hints(width, "weight", Init::Const(1.0))? })
    }
}

/// x / r and 1 / r, with r the root mean square of each row.
fn normal(x: &Tensor) -> Result<(Tensor, Tensor)> {
    let rate = (x.sqr()?.mean_keepdim(D::Minus1)? + EPS)?.sqrt()?.recip()?;
    Ok((x.broadcast_mul(&rate)?, rate))
}

impl Module for RmsNorm {
    /// Shapes: (B, width) to the same.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let y = normal(&x.detach())?.0.broadcast_mul(&self.gain.detach())?;
        with_gradient(y, &[x, &self.gain], |given, dy| {
            let (n, rate) = normal(&given.argument(0))?;
            // d (x / r) / dx = (1 - n n^T / width) / r.
            let dx = given.gradient(0, || {
                let d = dy.broadcast_mul(&given.argument(1))?;
                let along = (&d * &n)?.mean_keepdim(D::Minus1)?;
                (d - n.broadcast_mul(&along)?)?.broadcast_mul(&rate)
            })?;
            let dgain = given.gradient(1, || (dy * &n)?.sum(0))?;
            Ok([dx, dgain, None])
        })
    }
}
