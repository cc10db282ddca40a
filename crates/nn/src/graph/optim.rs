//! Steps of the optimiser and of the average on tensors.

use crate::kernel::optim::Adam;
use candle_core::{D, Result, Tensor, Var};

/// The sum of squares as a scalar. Rows first: Candle sums a whole tensor in one block of threads.
pub(crate) fn squares(x: &Tensor) -> Result<Tensor> {
    let square = x.sqr()?;
    if square.rank() > 1 { square.sum(D::Minus1)?.sum_all() } else { square.sum_all() }
}

fn times(x: &Tensor, factor: f32) -> Result<Tensor> {
    x.affine(f64::from(factor), 0.0)
}

/// One step: the parameter is set, the moments are replaced.
pub(crate) fn adam(p: &Var, g: &Tensor, m: &mut Tensor, v: &mut Tensor, a: Adam) -> Result<()> {
    let now = p.as_detached_tensor();
    let mut g = if a.clip < 1.0 { times(g, a.clip)? } else { g.clone() };
    if a.decay > 0.0 {
        g = (g + times(&now, a.decay)?)?;
    }
    *m = (times(m, a.beta1)? + times(&g, 1.0 - a.beta1)?)?;
    *v = (times(v, a.beta2)? + times(&g.sqr()?, 1.0 - a.beta2)?)?;
    let root = v.sqrt()?.affine(f64::from(a.root), f64::from(a.eps))?;
    let step = times(m, a.rate)?.div(&root)?;
    p.set(&if a.keep < 1.0 { times(&now, a.keep)? - step } else { now - step }?)
}

/// `e + part (p - e)`.
pub(crate) fn blend(e: &Tensor, p: &Tensor, part: f32) -> Result<Tensor> {
    times(&(p - e)?, part)? + e
}
