//! Linear layers and convolutions: a gather and one product each way, so that no gradient needs Candle's convolutions.

use super::gather::{Gather, over, under};
use super::{column_sums, with_gradient};
use crate::kernel::conv::Geo;
use candle_core::{DType, Device, Result, Tensor};

/// A convolution, or with one tap a linear layer, with weights `(kh, kw, c, n)`.
///
/// # Shapes
/// `x` of `(b, h, w, c)` in any shape, to `(b out_h out_w, n)`.
pub(crate) fn convolution(
    x: &Tensor,
    w: &Tensor,
    bias: Option<&Tensor>,
    g: &Geo,
    bf16: bool,
) -> Result<Tensor> {
    let x = x.reshape((g.b, g.h * g.w, g.c))?;
    apply(&x, w, bias, Way { geo: *g, transposed: false, bf16 })
}

/// The input gradient of the convolution `g` as a layer, with weights `(kh, kw, n, c)`.
///
/// # Shapes
/// `x` of `(b, out_h, out_w, n)` in any shape, to `(b h w, c)`.
pub(crate) fn transposed(x: &Tensor, w: &Tensor, bias: &Tensor, g: &Geo, bf16: bool) -> Result<Tensor> {
    let x = x.reshape((g.b, g.out_h() * g.out_w(), g.n))?;
    apply(&x, w, Some(bias), Way { geo: *g, transposed: true, bf16 })
}

/// Which rows meet which weights, and in which number type.
#[derive(Clone, Copy)]
struct Way {
    geo: Geo,
    transposed: bool,
    bf16: bool,
}

impl Way {
    fn there(&self, device: &Device) -> Result<Gather> {
        if self.transposed { over(&self.geo, device) } else { under(&self.geo, device) }
    }
    fn back(&self, device: &Device) -> Result<Gather> {
        if self.transposed { under(&self.geo, device) } else { over(&self.geo, device) }
    }
    /// A factor of a product.
    fn factor(&self, x: &Tensor) -> Result<Tensor> {
        if self.bf16 { x.to_dtype(DType::BF16) } else { Ok(x.clone()) }
    }
    fn product(&self, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        a.matmul(b)?.to_dtype(DType::F32)
    }
}

fn apply(x: &Tensor, w: &Tensor, bias: Option<&Tensor>, way: Way) -> Result<Tensor> {
    let (batch, _, from) = x.dims3()?;
    let to = w.dims().last().copied().unwrap_or(1);
    let there = way.there(x.device())?;
    let patches = there.take(&way.factor(&x.detach())?, 0.0)?;
    let mut y = way.product(&patches, &way.factor(&w.detach().reshape(((), to))?)?)?;
    drop(patches);
    if let Some(bias) = bias {
        y = y.broadcast_add(&bias.detach())?;
    }
    let arguments: Vec<&Tensor> = [Some(x), Some(w), bias].into_iter().flatten().collect();
    with_gradient(y, &arguments, move |given, dy| {
        let d = way.factor(dy)?;
        let dx = given.gradient(0, || {
            let w = way.factor(&given.argument(1))?.reshape((there.taps, from, to))?;
            let w = w.transpose(1, 2)?.contiguous()?.reshape((there.taps * to, from))?;
            let rows = way.back(dy.device())?.take(&d.reshape((batch, there.rows, to))?, 0.0)?;
            way.product(&rows, &w)
        })?;
        let dw = given.gradient(1, || {
            let patches = there.take(&way.factor(&given.argument(0))?, 0.0)?;
            way.product(&patches.t()?, &d)
        })?;
        Ok([dx, dw, given.gradient(2, || column_sums(dy))?])
    })
}
