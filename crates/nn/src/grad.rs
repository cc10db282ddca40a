use crate::compute::Backend;
use crate::graph;
use crate::kernel;
use crate::numbers::Numbers;
use crate::params::Params;
use crate::storage::with;
use crate::weights::Weights;
use crate::{Error, Result};
use candle_core::{Tensor, TensorId};
use std::cell::{Cell, RefCell};
use std::collections::HashMap;

thread_local! {
    /// One list per running `backward` of this thread. Another can start while the first waits for a parallel loop.
    static RUNNING: RefCell<Vec<HashMap<TensorId, Numbers>>> = const { RefCell::new(Vec::new()) };
    static OFF: Cell<bool> = const { Cell::new(false) };
}

/// Whether forward passes on this thread may keep a record.
pub(crate) fn enabled() -> bool {
    !OFF.get()
}

/// Runs `f` without keeping anything for a backward pass, even in [`crate::Mode::Train`]: for validation losses.
pub fn no_grad<R>(f: impl FnOnce() -> R) -> R {
    struct Restore(bool);
    impl Drop for Restore {
        fn drop(&mut self) {
            OFF.set(self.0);
        }
    }
    let _restore = Restore(OFF.replace(true));
    f()
}

/// Adds weight gradients to the list of the innermost `backward`.
pub(crate) fn give(list: Vec<(TensorId, Numbers)>) -> Result<()> {
    if list.is_empty() {
        return Ok(());
    }
    RUNNING.with_borrow_mut(|r| {
        let store = r.last_mut().ok_or(Error::NotRecording)?;
        for (id, g) in list {
            match store.get_mut(&id) {
                Some(sum) => sum.add(&g)?,
                None => {
                    store.insert(id, g);
                }
            }
        }
        Ok(())
    })
}

/// The gradients of the parameters of one network.
#[derive(Debug, Clone)]
pub struct Grads {
    /// In the order of the parameters; `None` where the loss does not depend on one.
    pub(crate) list: Vec<Option<Numbers>>,
}

impl Grads {
    /// The Euclidean norm over all parameters.
    ///
    /// # Errors
    /// [`Error::Candle`] when a device fails; none on the CPU.
    pub fn norm(&self) -> Result<f32> {
        #[cfg(feature = "cuda")]
        if let Some(norm) = self.device_norm()? {
            return Ok(norm.to_scalar::<f32>()?);
        }
        let (mut sum, mut elsewhere) = (0.0, Vec::new());
        for g in self.list.iter().flatten() {
            match g {
                Numbers::Host(g) => sum += kernel::optim::squares(g),
                Numbers::Device(g) => elsewhere.push(graph::optim::squares(g)?),
            }
        }
        if !elsewhere.is_empty() {
            // One number comes back, and with it the wait for the device.
            sum += f64::from(Tensor::stack(&elsewhere, 0)?.sum_all()?.to_scalar::<f32>()?);
        }
        Ok(sum.sqrt() as f32)
    }

    /// The norm as a scalar on the GPU that all gradients are on, or none.
    #[cfg(feature = "cuda")]
    pub(crate) fn device_norm(&self) -> Result<Option<Tensor>> {
        let mut all = Vec::with_capacity(self.list.len());
        for g in self.list.iter().flatten() {
            match g {
                Numbers::Device(t) if t.device().is_cuda() => all.push(t),
                _ => return Ok(None),
            }
        }
        let Some(first) = all.first() else { return Ok(None) };
        Ok(Some(crate::gpu::Gpu::of(first)?.norm(&all)?))
    }

    /// Adds `other`, for a batch that is taken in parts.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when `other` is of another network.
    pub fn add(&mut self, other: &Self) -> Result<()> {
        let same = |(a, b): (&Option<Numbers>, &Option<Numbers>)| {
            a.as_ref().zip(b.as_ref()).is_none_or(|(a, b)| a.len() == b.len())
        };
        if self.list.len() != other.list.len() || !self.list.iter().zip(&other.list).all(same) {
            let (expected, found) = (self.list.len(), other.list.len());
            return Err(Error::OtherParams { what: "gradients", expected, found });
        }
        for (a, b) in self.list.iter_mut().zip(&other.list) {
            match (a, b) {
                (Some(a), Some(b)) => a.add(b)?,
                (a @ None, Some(b)) => *a = Some(b.clone()),
                (_, None) => {}
            }
        }
        Ok(())
    }

    /// Multiplies all gradients.
    ///
    /// # Errors
    /// [`Error::Candle`] when a device fails; none on the CPU.
    pub fn scale(&mut self, factor: f32) -> Result<()> {
        for g in self.list.iter_mut().flatten() {
            match g {
                Numbers::Host(g) => g.iter_mut().for_each(|g| *g *= factor),
                Numbers::Device(g) => *g = g.affine(f64::from(factor), 0.0)?,
            }
        }
        Ok(())
    }

    /// Appends all gradients to `out`, in the layout and the order of the parameters; zeros where the loss does not depend on one.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when they are of another network, [`Error::Candle`] when a device fails.
    pub fn flatten(&self, params: &Params, out: &mut Vec<f32>) -> Result<()> {
        self.check(params)?;
        for (g, var) in self.list.iter().zip(params.variables()) {
            match g {
                Some(g) => out.extend_from_slice(&g.host()?),
                None => out.resize(out.len() + var.elem_count(), 0.0),
            }
        }
        Ok(())
    }

    /// Takes over numbers in the order of [`Grads::flatten`]. Those of a parameter that the loss does not depend on are left out.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when they are of another network or not as many, [`Error::Candle`] when a device fails.
    pub fn unflatten(&mut self, params: &Params, numbers: &[f32]) -> Result<()> {
        self.check(params)?;
        if numbers.len() != params.count() {
            let (expected, found) = (params.count(), numbers.len());
            return Err(Error::OtherParams { what: "numbers of gradients", expected, found });
        }
        let mut rest = numbers;
        for (g, var) in self.list.iter_mut().zip(params.variables()) {
            let (own, after) = rest.split_at(var.elem_count());
            rest = after;
            if let Some(g) = g {
                *g = Numbers::new(own.to_vec(), var, params.backend())?;
            }
        }
        Ok(())
    }

    /// Gradients by parameter name in PyTorch's layout, zeros where the loss does not depend on one.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when they are of another network.
    pub fn export(&self, params: &Params) -> Result<Weights> {
        self.check(params)?;
        let full = |(g, v): (&Option<Numbers>, &candle_core::Var)| match g {
            Some(g) => Ok(g.clone()),
            None => Numbers::zeros(v, params.backend()),
        };
        let list: Result<Vec<Numbers>> = self.list.iter().zip(params.variables()).map(full).collect();
        params.all_outward(&list?)
    }

    pub(crate) fn check(&self, params: &Params) -> Result<()> {
        let fits = |(g, v): (&Option<Numbers>, &candle_core::Var)| {
            g.as_ref().is_none_or(|g| g.len() == v.elem_count())
        };
        if self.list.len() == params.len() && self.list.iter().zip(params.variables()).all(fits) {
            return Ok(());
        }
        Err(Error::OtherParams { what: "gradients", expected: params.len(), found: self.list.len() })
    }
}

/// The gradients of `loss` with respect to `params`.
///
/// # Shapes
/// `loss` is a scalar.
///
/// # Errors
/// [`Error::Shape`] when `loss` is no scalar, [`Error::Candle`] when Candle cannot differentiate an operation in between.
pub fn backward(loss: &Tensor, params: &Params) -> Result<Grads> {
    let mut all = backward_many(loss, &[params])?;
    Ok(all.pop().unwrap_or(Grads { list: Vec::new() }))
}

/// The gradients of `loss` with respect to several networks at once.
///
/// # Shapes
/// `loss` is a scalar.
///
/// # Errors
/// As [`backward`].
pub fn backward_many(loss: &Tensor, networks: &[&Params]) -> Result<Vec<Grads>> {
    struct Pop;
    impl Drop for Pop {
        fn drop(&mut self) {
            RUNNING.with_borrow_mut(Vec::pop);
        }
    }
    if loss.elem_count() != 1 {
        return Err(Error::Shape { what: "loss", expected: "()".into(), found: loss.dims().to_vec() });
    }
    RUNNING.with_borrow_mut(|r| r.push(HashMap::new()));
    let pop = Pop;
    let store = loss.backward()?;
    let mut found = RUNNING.with_borrow_mut(|r| r.last_mut().map(std::mem::take)).unwrap_or_default();
    drop(pop);
    let mut out = Vec::with_capacity(networks.len());
    for params in networks {
        let mut list = Vec::with_capacity(params.len());
        for var in params.variables() {
            if params.backend() == Backend::Candle {
                let g = store.get(var.as_tensor()).map(Tensor::contiguous).transpose()?;
                list.push(g.map(Numbers::Device));
                continue;
            }
            let mut g = found.remove(&var.as_tensor().id());
            // A variable used through Candle's own operations has its gradient there.
            if let Some(t) = store.get(var.as_tensor()) {
                let more = match params.backend() {
                    Backend::Kernels => Numbers::Host(with(&t.contiguous()?, <[f32]>::to_vec)?),
                    _ => Numbers::Device(t.contiguous()?),
                };
                match &mut g {
                    Some(g) => g.add(&more)?,
                    None => g = Some(more),
                }
            }
            list.push(g);
        }
        out.push(Grads { list });
    }
    Ok(out)
}
