use crate::builder::Builder;
use crate::layers::{Linear, masked, relu};
use crate::tape::run;
use crate::{Error, Result};
use candle_core::Tensor;
use rand::Rng;

/// Linear layers with ReLU and dropout between them.
///
/// Parameters are `0.weight`, `0.bias`, `1.weight`, and so on.
#[derive(Clone, Debug)]
pub struct Mlp {
    layers: Vec<Linear>,
    dropout: f32,
}

/// Largest width that is taken for one.
const WIDEST: usize = 1 << 30;

impl Mlp {
    /// A network through the sizes `dims`, the input's first, that drops hidden numbers with probability `dropout`.
    ///
    /// # Errors
    /// [`Error::Config`] with fewer than two sizes, a size of zero or above 2^30, or a probability outside [0, 1).
    pub fn new(dims: &[usize], dropout: f32, builder: &Builder<'_>) -> Result<Self> {
        if dims.len() < 2 || dims.iter().any(|d| *d > WIDEST) {
            let found = format!("{dims:?}");
            return Err(Error::Config {
                what: "sizes of an mlp",
                expected: "at least input and output, none above 1073741824",
                found,
            });
        }
        if !(0.0..1.0).contains(&dropout) {
            let expected = "a probability in [0, 1)";
            return Err(Error::Config { what: "dropout", expected, found: dropout.to_string() });
        }
        let pairs = dims.windows(2).enumerate();
        let layers: Result<_> = pairs.map(|(i, d)| Linear::new(d[0], d[1], &builder.pp(i))).collect();
        Ok(Self { layers: layers?, dropout })
    }

    /// With `rng`, dropout is on and draws from it; without, the network is evaluated.
    ///
    /// # Shapes
    /// `(B, first size)` to `(B, last size)`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the input has another width.
    pub fn forward<R: Rng>(&self, x: &Tensor, rng: Option<&mut R>) -> Result<Tensor> {
        let Some(first) = self.layers.first() else { return Ok(x.clone()) };
        let rows = x.elem_count() / x.dims().last().copied().unwrap_or(1).max(1);
        // Drawn before the pass, one mask a hidden layer, so that the numbers do not depend on how it runs.
        let mut masks = Vec::new();
        if let Some(rng) = rng.filter(|_| self.dropout > 0.0) {
            let (p, keep) = (self.dropout, 1.0 / (1.0 - self.dropout));
            for layer in &self.layers[..self.layers.len() - 1] {
                let n = rows * layer.out_dim();
                masks.push(
                    (0..n).map(|_| if rng.random::<f32>() < p { 0.0 } else { keep }).collect::<Vec<f32>>(),
                );
            }
        }
        run(&[x], Some(first.anchor()), |t, n| {
            let mut masks = masks.into_iter();
            let mut x = n[0];
            for (i, layer) in self.layers.iter().enumerate() {
                x = layer.record(t, x)?;
                if i + 1 < self.layers.len() {
                    x = relu(t, x)?;
                    if let Some(mask) = masks.next() {
                        x = masked(t, x, mask)?;
                    }
                }
            }
            Ok(x)
        })
    }
}
