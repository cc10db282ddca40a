use super::conv::Convolution;
use crate::builder::{Builder, Init, Weight};
use crate::kernel::conv::Geo;
use crate::tape::{Node, Tape, run};
use crate::{Error, Result};
use candle_core::Tensor;

/// `x W^T + b` over the last axis.
#[derive(Clone, Debug)]
pub struct Linear {
    weight: Weight,
    bias: Weight,
    from: usize,
    to: usize,
}

impl Linear {
    /// A layer from `from` to `to` numbers; parameters `weight` (to, from) and `bias` (to).
    ///
    /// # Errors
    /// [`Error::Config`] when a size is zero.
    pub fn new(from: usize, to: usize, builder: &Builder<'_>) -> Result<Self> {
        if from == 0 || to == 0 {
            let found = format!("{from} to {to}");
            return Err(Error::Config { what: "linear layer", expected: "positive sizes", found });
        }
        let bound = Init::within(1.0 / (from as f32).sqrt());
        let weight = builder.weight("weight", &[to, from], Some(&[1, 0]), bound)?;
        Ok(Self { weight, bias: builder.weight("bias", &[to], None, bound)?, from, to })
    }

    /// # Shapes
    /// `(.., from)` to `(.., to)`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the last size is another.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], Some(&self.weight), |t, n| self.record(t, n[0]))
    }

    pub(crate) fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let mut shape = tape.shape(x).to_vec();
        if shape.last() != Some(&self.from) {
            let expected = format!("(.., {})", self.from);
            return Err(Error::Shape { what: "linear input", expected, found: shape });
        }
        let rows = shape.iter().product::<usize>() / self.from;
        if let Some(last) = shape.last_mut() {
            *last = self.to;
        }
        let geo = Geo::linear(rows, self.from, self.to);
        Convolution { x, weight: self.weight.clone(), bias: Some(self.bias.clone()), geo }.record(tape, shape)
    }

    pub(crate) fn out_dim(&self) -> usize {
        self.to
    }

    pub(crate) fn anchor(&self) -> &Weight {
        &self.weight
    }
}
