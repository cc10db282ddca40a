use crate::graph;
use crate::tape::{Flow, Node, Step, Values, run};
use crate::{Error, Result};
use candle_core::Tensor;

struct MseStep {
    prediction: Node,
    target: Node,
    /// Weight of each row over all weights times the numbers in a row; empty where all are 1.
    weights: Vec<f32>,
    scale: f32,
    width: usize,
}

impl Step for MseStep {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let (p, t) = (values.read(self.prediction)?, values.read(self.target)?);
        let d = 2.0 * self.scale * dy.first().copied().unwrap_or(0.0);
        let g: Vec<f32> = if self.weights.is_empty() {
            p.iter().zip(t.iter()).map(|(p, t)| d * (p - t)).collect()
        } else {
            let rows = p.chunks_exact(self.width).zip(t.chunks_exact(self.width)).zip(&self.weights);
            rows.flat_map(|((p, t), w)| p.iter().zip(t).map(move |(p, t)| d * w * (p - t))).collect()
        };
        if values.grad(self.target) {
            flow.add(self.target, g.iter().map(|g| -g).collect());
        }
        if values.grad(self.prediction) {
            flow.add(self.prediction, g);
        }
        Ok(())
    }
}

/// The mean squared error over the rows that count.
///
/// # Shapes
/// `prediction` and `target` (B, T, D); `weight` (B, T), 1 for rows that count and 0 for padding. Without it all count. The
/// result is a scalar: sum of weight times squared error over sum of weight times D.
///
/// # Errors
/// [`Error::Shape`] when the shapes differ, [`Error::Config`] when no row counts.
pub fn mse(prediction: &Tensor, target: &Tensor, weight: Option<&Tensor>) -> Result<Tensor> {
    squared_error(prediction, target, weight, None)
}

/// The part of a mean squared error that a part of a batch makes: the parts of all, added, are [`mse`] of the whole. A mean of the
/// parts' own means would count padding of one part as rows of another.
///
/// # Shapes
/// As [`mse`]; `rows` is the sum of the whole batch's weights. A part in which no row counts is 0.
///
/// # Errors
/// [`Error::Shape`] when the shapes differ, [`Error::Config`] when no row of the whole counts.
pub fn mse_part(prediction: &Tensor, target: &Tensor, weight: &Tensor, rows: f64) -> Result<Tensor> {
    squared_error(prediction, target, Some(weight), Some(rows))
}

fn squared_error(
    prediction: &Tensor,
    target: &Tensor,
    weight: Option<&Tensor>,
    rows: Option<f64>,
) -> Result<Tensor> {
    let dims = prediction.dims();
    let wrong = |what, expected: String, found: &Tensor| Error::Shape {
        what,
        expected,
        found: found.dims().to_vec(),
    };
    if target.dims() != dims || dims.is_empty() {
        return Err(wrong("target of the loss", format!("{dims:?}"), target));
    }
    let width = dims[dims.len() - 1];
    let weights = match weight {
        None => Vec::new(),
        Some(w) if w.dims() == &dims[..dims.len() - 1] => w.flatten_all()?.to_vec1::<f32>()?,
        Some(w) => return Err(wrong("weight of the loss", format!("{:?}", &dims[..dims.len() - 1]), w)),
    };
    let rows = rows.unwrap_or_else(|| match weight {
        None => (prediction.elem_count() / width.max(1)) as f64,
        Some(_) => weights.iter().map(|w| f64::from(*w)).sum(),
    });
    let count = rows * width as f64;
    if count.is_nan() || count <= 0.0 {
        let found = format!("{count}");
        return Err(Error::Config {
            what: "numbers that count in the loss",
            expected: "at least one",
            found,
        });
    }
    run(&[prediction, target], None, |tape, n| {
        #[cfg(feature = "cuda")]
        if tape.on_gpu() {
            return crate::gpu::squared_error(tape, (n[0], n[1]), &weights, width, (1.0 / count) as f32);
        }
        if tape.in_graph() {
            let (p, t) = (tape.tensor(n[0])?, tape.tensor(n[1])?);
            return Ok(tape.put(graph::act::squared_error(p, t, &weights, 1.0 / count)?));
        }
        let (p, t) = (tape.read(n[0])?, tape.read(n[1])?);
        let square =
            |p: &[f32], t: &[f32]| p.iter().zip(t).map(|(p, t)| f64::from(p - t).powi(2)).sum::<f64>();
        let sum = if weights.is_empty() {
            square(&p, &t)
        } else {
            let rows = p.chunks_exact(width).zip(t.chunks_exact(width)).zip(&weights);
            rows.map(|((p, t), w)| f64::from(*w) * square(p, t)).sum()
        };
        drop((p, t));
        let scale = (1.0 / count) as f32;
        let step = MseStep { prediction: n[0], target: n[1], weights, scale, width };
        Ok(tape.push(vec![(sum / count) as f32], [], n, &[], step))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    #[test]
    fn parts_of_a_loss_add_up_to_the_whole_also_where_one_is_all_padding() {
        let numbers = |scale: f32| (0..24_u8).map(|i| scale * f32::from(i % 7)).collect::<Vec<f32>>();
        let p = Var::from_vec(numbers(0.3), (3, 4, 2), &Device::Cpu).unwrap();
        let t = Tensor::from_vec(numbers(0.2), (3, 4, 2), &Device::Cpu).unwrap();
        let mask = [[1f32, 1., 1., 1.], [0., 0., 0., 0.], [1., 0., 0., 0.]];
        let mask = Tensor::new(&mask, &Device::Cpu).unwrap();
        let whole = mse(p.as_tensor(), &t, Some(&mask)).unwrap();
        let of = |i: usize| {
            let part = |x: &Tensor| x.narrow(0, i, 1).unwrap().contiguous().unwrap();
            mse_part(&part(p.as_tensor()), &part(&t), &part(&mask), 5.0).unwrap().to_scalar::<f32>().unwrap()
        };
        assert_eq!(of(1), 0.0);
        assert!((of(0) + of(2) - whole.to_scalar::<f32>().unwrap()).abs() < 1e-7);
        assert!(mse_part(p.as_tensor(), &t, &mask, 0.0).is_err(), "nothing counts anywhere");
    }
}
