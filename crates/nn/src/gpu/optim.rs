//! Norm of the gradient, Adam and moving averages over all parameters, a launch or two each.

use super::{Arg, Gpu};
use crate::error::Result;
use crate::kernel::optim::Adam;
use candle_core::Tensor;

/// Numbers of a block, as the kernels have it.
const CHUNK: usize = 8192;
/// Threads of a block.
const THREADS: (u32, u32) = (256, 1);

/// Where the numbers of some parameters lie: what kernels read, and how many blocks there are.
struct Table {
    words: Tensor,
    count: usize,
    blocks: usize,
}

impl Gpu {
    /// `rows` has the tensors of each parameter, alike in size.
    fn table<const K: usize>(&self, rows: &[[&Tensor; K]]) -> Result<Table> {
        let count = rows.len();
        let mut words = vec![0i64; (K + 2) * count];
        let mut blocks = 0;
        for (i, row) in rows.iter().enumerate() {
            for (k, t) in row.iter().enumerate() {
                words[k * count + i] = self.address(t)?.cast_signed();
            }
            let n = row.first().map_or(0, |t| t.elem_count());
            words[K * count + i] = n as i64;
            words[(K + 1) * count + i] = blocks as i64;
            blocks += n.div_ceil(CHUNK);
        }
        let device = candle_core::Device::Cuda(self.device.clone());
        Ok(Table { words: Tensor::from_vec(words, (K + 2) * count, &device)?, count, blocks })
    }

    /// The Euclidean norm of all `gradients`, as a scalar on the device.
    pub(crate) fn norm(&self, gradients: &[&Tensor]) -> Result<Tensor> {
        let rows: Vec<[&Tensor; 1]> = gradients.iter().map(|g| [*g]).collect();
        let table = self.table(&rows)?;
        let (parts, norm) = (self.empty(table.blocks)?, self.empty(())?);
        let arguments = [Arg::Words(&table.words), Arg::I(table.count), Arg::T(&parts)];
        self.launch("squares", table.blocks, THREADS, 0, &arguments)?;
        self.launch("root", 1, THREADS, 0, &[Arg::T(&parts), Arg::T(&norm), Arg::I(table.blocks)])?;
        Ok(norm)
    }

    /// A step of Adam in place, unless `norm` is not finite. Rows: parameter, gradient, mean, square. Gradients are cut to
    /// `longest`; the `clip` of `a` is not read.
    pub(crate) fn adam(
        &self,
        rows: &[[&Tensor; 4]],
        norm: &Tensor,
        a: &Adam,
        longest: Option<f32>,
    ) -> Result<()> {
        let table = self.table(rows)?;
        let longest = longest.unwrap_or(f32::INFINITY);
        let numbers = [a.rate, a.beta1, a.beta2, a.eps, a.root, longest, a.decay, a.keep];
        let mut arguments = vec![Arg::Words(&table.words), Arg::I(table.count), Arg::T(norm)];
        arguments.extend(numbers.map(Arg::F));
        Ok(self.launch("adam", table.blocks, THREADS, 0, &arguments)?)
    }

    /// `average += part (p - average)` in place. Rows: average, parameter.
    pub(crate) fn blend(&self, rows: &[[&Tensor; 2]], part: f32) -> Result<()> {
        let table = self.table(rows)?;
        let arguments = [Arg::Words(&table.words), Arg::I(table.count), Arg::F(part)];
        Ok(self.launch("blend", table.blocks, THREADS, 0, &arguments)?)
    }
}
