//! The same layers out of Candle's operations, for devices other than the CPU.
//!
//! Candle tracks them, but several of its gradients are wrong or slow. So a forward pass is computed out of its sight, and
//! [`with_gradient`] gives the result a backward pass that is written out, itself of forward operations only. Left to
//! Candle are sums, products of elements, joining, broadcasting and reshaping, whose gradients are right.

pub(crate) mod act;
mod gather;
pub(crate) mod linear;
pub(crate) mod norm;
pub(crate) mod optim;
pub(crate) mod pool;

use candle_core::backend::BackendStorage;
use candle_core::{
    CpuStorage, CudaStorage, CustomOp1, CustomOp2, CustomOp3, DType, Layout, Result, Shape, Storage, Tensor,
};
use std::sync::Mutex;

/// What a backward pass is given.
pub(crate) struct Given<'a> {
    arguments: Vec<&'a Tensor>,
    result: &'a Tensor,
}

impl Given<'_> {
    /// Argument number `i`, untracked.
    fn argument(&self, i: usize) -> Tensor {
        self.arguments[i].detach()
    }
    /// The result, untracked.
    fn result(&self) -> Tensor {
        self.result.detach()
    }
    /// The gradient of argument `i`, if it is wanted. Candle panics where a wanted one is missing.
    fn gradient(&self, i: usize, f: impl FnOnce() -> Result<Tensor>) -> Result<Option<Tensor>> {
        match self.arguments.get(i) {
            Some(a) if a.track_op() => Ok(Some(f()?.reshape(a.dims())?)),
            _ => Ok(None),
        }
    }
}

type Gradients = [Option<Tensor>; 3];

/// A value with a gradient of its own.
struct Formula<F> {
    /// Until Candle takes it.
    value: Mutex<Option<Tensor>>,
    back: F,
}

/// `value`, which was computed from `arguments` (at most three), with `back` for its gradient.
fn with_gradient<F>(value: Tensor, arguments: &[&Tensor], back: F) -> Result<Tensor>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients> + Send + Sync + 'static,
{
    if !arguments.iter().any(|a| a.track_op()) {
        return Ok(value);
    }
    let whole = value.is_contiguous() && value.layout().start_offset() == 0;
    let value = if whole { value } else { value.force_contiguous()? };
    let formula = Formula { value: Mutex::new(Some(value)), back };
    match arguments {
        [a] => a.apply_op1(formula),
        [a, b] => a.apply_op2(b, formula),
        [a, b, c] => a.apply_op3(b, c, formula),
        _ => candle_core::bail!("expected one to three arguments, found {}", arguments.len()),
    }
}

impl<F> Formula<F>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients>,
{
    fn take(&self) -> Result<Tensor> {
        let taken = self.value.lock().ok().and_then(|mut v| v.take());
        taken.ok_or_else(|| candle_core::Error::Msg("the result was taken before".to_owned()))
    }
    fn cpu(&self) -> Result<(CpuStorage, Shape)> {
        let value = self.take()?;
        let (storage, layout) = value.storage_and_layout();
        match &*storage {
            Storage::Cpu(s) => Ok((s.try_clone(layout)?, value.shape().clone())),
            _ => candle_core::bail!("expected a value on the CPU"),
        }
    }
    fn cuda(&self) -> Result<(CudaStorage, Shape)> {
        let value = self.take()?;
        let (storage, layout) = value.storage_and_layout();
        match &*storage {
            Storage::Cuda(s) => Ok((s.try_clone(layout)?, value.shape().clone())),
            _ => candle_core::bail!("expected a value on the GPU"),
        }
    }
    fn gradients(&self, arguments: Vec<&Tensor>, result: &Tensor, dy: &Tensor) -> Result<Gradients> {
        (self.back)(&Given { arguments, result }, &dy.detach().contiguous()?)
    }
}

const NAME: &str = "layer";

impl<F> CustomOp1 for Formula<F>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients>,
{
    fn name(&self) -> &'static str {
        NAME
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.cpu()
    }
    fn cuda_fwd(&self, _: &CudaStorage, _: &Layout) -> Result<(CudaStorage, Shape)> {
        self.cuda()
    }
    fn bwd(&self, a: &Tensor, y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let [a, _, _] = self.gradients(vec![a], y, dy)?;
        Ok(a)
    }
}

impl<F> CustomOp2 for Formula<F>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients>,
{
    fn name(&self) -> &'static str {
        NAME
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout, _: &CpuStorage, _: &Layout) -> Result<(CpuStorage, Shape)> {
        self.cpu()
    }
    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        self.cuda()
    }
    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let [a, b, _] = self.gradients(vec![a, b], y, dy)?;
        Ok((a, b))
    }
}

impl<F> CustomOp3 for Formula<F>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients>,
{
    fn name(&self) -> &'static str {
        NAME
    }
    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        self.cpu()
    }
    fn cuda_fwd(
        &self,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
        _: &CudaStorage,
        _: &Layout,
    ) -> Result<(CudaStorage, Shape)> {
        self.cuda()
    }
    fn bwd(
        &self,
        a: &Tensor,
        b: &Tensor,
        c: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [a, b, c] = self.gradients(vec![a, b, c], y, dy)?;
        Ok((a, b, c))
    }
}

/// The sums of the columns of a matrix, as a product: Candle's own sum reads columns with long strides.
fn column_sums(rows: &Tensor) -> Result<Tensor> {
    let ones = Tensor::ones((1, rows.dim(0)?), DType::F32, rows.device())?;
    ones.matmul(rows)?.squeeze(0)
}
