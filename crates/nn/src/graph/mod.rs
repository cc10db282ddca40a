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

use crate::Error;
use crate::grad::enabled;
use candle_core::backend::BackendStorage;
use candle_core::{
    CpuStorage, CudaStorage, CustomOp1, CustomOp2, CustomOp3, DType, Layout, Result, Shape, Storage, Tensor,
};
use std::sync::Mutex;

/// What the backward pass of [`with_gradient`] is given.
pub struct Given<'a> {
    arguments: Vec<&'a Tensor>,
    result: &'a Tensor,
}

impl Given<'_> {
    /// Argument number `i`, untracked.
    ///
    /// # Panics
    /// When there is none of that number.
    #[must_use]
    pub fn argument(&self, i: usize) -> Tensor {
        self.arguments[i].detach()
    }
    /// The result, untracked.
    #[must_use]
    pub fn result(&self) -> Tensor {
        self.result.detach()
    }
    /// The gradient of argument `i`, if it is wanted: what `f` returns, in the shape of the argument.
    ///
    /// # Errors
    /// What `f` returns, and Candle's where the number of elements is another.
    pub fn gradient(&self, i: usize, f: impl FnOnce() -> Result<Tensor>) -> Result<Option<Tensor>> {
        match self.arguments.get(i) {
            Some(a) if a.track_op() => Ok(Some(f()?.reshape(a.dims())?)),
            _ => Ok(None),
        }
    }
}

/// The gradients of up to three arguments, of their shapes; [`Given::gradient`] makes each.
pub type Gradients = [Option<Tensor>; 3];

/// A value with a gradient of its own.
struct Formula<F> {
    /// Until Candle takes it.
    value: Mutex<Option<Tensor>>,
    back: F,
    /// Whether every argument that wants a gradient has to get one.
    complete: bool,
}

/// `value`, which was computed from `arguments`, with `back` for its gradient: a layer of your own, on any device.
///
/// Its inputs and its weights are arguments alike; [`crate::Builder::var_builder`] makes weights. `back` turns the gradient of
/// the result, contiguous and of its shape, into those of the arguments. The layers here are made so wherever they do not run
/// on this crate's kernels.
///
/// # Shapes
/// One to three arguments of any shape; `value` of any shape.
///
/// # Errors
/// Candle's, when `value` was computed from tracked tensors (detach the arguments first: what is tracked and no argument would
/// get no gradient), or when there are no or too many arguments. The backward pass fails when `back` returns no gradient for an
/// argument that wants one, or one of another shape.
///
/// ```
/// use e2h_nn::candle_core::{Device, Result, Tensor, Var};
/// use e2h_nn::with_gradient;
///
/// /// x^3, with 3 x^2 for its gradient.
/// fn cube(x: &Tensor) -> Result<Tensor> {
///     with_gradient(x.detach().powf(3.0)?, &[x], |given, dy| {
///         let dx = given.gradient(0, || dy * (given.argument(0).sqr()? * 3.0)?)?;
///         Ok([dx, None, None])
///     })
/// }
///
/// let x = Var::new(&[2f32, -1.], &Device::Cpu)?;
/// let grads = cube(&x)?.sum_all()?.backward()?;
/// assert_eq!(grads.get(&x).unwrap().to_vec1::<f32>()?, [12.0, 3.0]);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn with_gradient<F>(value: Tensor, arguments: &[&Tensor], back: F) -> Result<Tensor>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients> + Send + Sync + 'static,
{
    if value.track_op() {
        let (what, expected) = ("value with a gradient of its own", "one computed from detached tensors");
        return Err(Error::Config { what, expected, found: "a tracked one".into() }.into());
    }
    if !enabled() || !arguments.iter().any(|a| a.track_op()) {
        return Ok(value);
    }
    apply(value, arguments, back, true)
}

/// [`with_gradient`] for a whole network: it may answer for an argument with nothing, because the gradients of weights go
/// elsewhere.
#[cfg(feature = "cuda")]
pub(crate) fn network<F>(value: Tensor, arguments: &[&Tensor], back: F) -> Result<Tensor>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients> + Send + Sync + 'static,
{
    apply(value, arguments, back, false)
}

fn apply<F>(value: Tensor, arguments: &[&Tensor], back: F, complete: bool) -> Result<Tensor>
where
    F: Fn(&Given<'_>, &Tensor) -> Result<Gradients> + Send + Sync + 'static,
{
    let whole = value.is_contiguous() && value.layout().start_offset() == 0;
    let value = if whole { value } else { value.force_contiguous()? };
    let formula = Formula { value: Mutex::new(Some(value)), back, complete };
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
        let given = Given { arguments, result };
        let gradients = (self.back)(&given, &dy.detach().contiguous()?)?;
        for (i, (a, g)) in given.arguments.iter().zip(&gradients).enumerate() {
            // Candle would panic.
            let found = g.as_ref().map(Tensor::dims);
            if found.is_some_and(|d| d != a.dims()) || found.is_none() && a.track_op() && self.complete {
                let expected = format!("{:?} for argument {i}", a.dims());
                let found = found.unwrap_or_default().to_vec();
                return Err(Error::Shape { what: "gradient", expected, found }.into());
            }
        }
        Ok(gradients)
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
