//! The parameters of a network: their names, how they lie here and in PyTorch, weights in and out.

use crate::builder::{Builder, Mode, Order, Shapes, Shared};
use crate::compute::{Backend, Compute};
use crate::graph;
use crate::kernel::conv::in_panels;
use crate::kernel::optim::blend;
use crate::numbers::Numbers;
use crate::storage::{edit, host, with};
use crate::weights::{HostTensor, Weights};
use crate::{Error, Result};
use candle_core::{DType, Device, Tensor, Var};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

pub(crate) struct Param {
    pub(crate) var: Var,
    /// PyTorch's shape.
    pub(crate) shape: Vec<usize>,
    pub(crate) order: Order,
    /// Whether the last axis is cut into panels.
    pub(crate) cut: bool,
}

impl Param {
    /// From PyTorch's layout to ours.
    fn inward(&self, data: &[f32]) -> Vec<f32> {
        let Some(order) = self.order else { return data.to_vec() };
        let data = permute_axes(data, &self.shape, order, true);
        if self.cut { in_panels(&data, self.columns(order), false) } else { data }
    }

    /// From our layout to PyTorch's.
    fn outward(&self, data: &[f32]) -> HostTensor {
        let data = match self.order {
            None => data.to_vec(),
            Some(order) if self.cut => {
                permute_axes(&in_panels(data, self.columns(order), true), &self.shape, order, false)
            }
            Some(order) => permute_axes(data, &self.shape, order, false),
        };
        HostTensor { shape: self.shape.clone(), data }
    }

    fn columns(&self, order: &[usize]) -> usize {
        order.last().map_or(1, |a| self.shape[*a])
    }
}

/// The parameters of a network, by name.
///
/// Clones share the numbers.
#[derive(Clone)]
pub struct Params {
    params: Arc<BTreeMap<String, Param>>,
    compute: Compute,
    backend: Backend,
}

impl std::fmt::Debug for Params {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_map().entries(self.shapes()).finish()
    }
}

impl Params {
    /// Builds a network on the CPU with `f` and returns its parameters beside it.
    ///
    /// They start as in PyTorch: weights and biases of linear and convolution layers uniform in plus or minus
    /// 1 / sqrt(fan in), gains of norms 1, their biases 0, drawn from `rng` in the order of building.
    ///
    /// # Errors
    /// What `f` returns, and [`Error::Duplicate`] when two parameters have one name.
    pub fn build<T>(
        mode: Mode,
        rng: &mut ChaCha8Rng,
        f: impl FnOnce(&Builder<'_>) -> Result<T>,
    ) -> Result<(Self, T)> {
        Self::build_on(&Compute::cpu(), mode, rng, f)
    }

    /// [`Params::build`] on any device. The same `rng` gives the same weights everywhere.
    ///
    /// # Errors
    /// As [`Params::build`], and [`Error::Candle`] when the device fails.
    pub fn build_on<T>(
        compute: &Compute,
        mode: Mode,
        rng: &mut ChaCha8Rng,
        f: impl FnOnce(&Builder<'_>) -> Result<T>,
    ) -> Result<(Self, T)> {
        let shared = Shared::new(mode, compute, rng.clone(), None);
        let built = f(&Builder::root(&shared))?;
        let state = shared.into_state();
        *rng = state.rng;
        if let Some(name) = state.duplicate {
            return Err(Error::Duplicate(name));
        }
        Ok((Self::of(state.params, compute), built))
    }

    fn of(params: BTreeMap<String, Param>, compute: &Compute) -> Self {
        Self { params: Arc::new(params), compute: compute.clone(), backend: compute.backend() }
    }

    /// `vars` themselves as parameters, all on one device and of `f32`.
    pub(crate) fn of_vars(vars: BTreeMap<String, Var>) -> Result<Self> {
        let device = vars.values().next().map_or(Device::Cpu, |v| v.device().clone());
        for (name, var) in &vars {
            if var.dtype() != DType::F32 || !var.is_contiguous() || !var.device().same_device(&device) {
                let found = format!("`{name}` of {:?} on {:?}", var.dtype(), var.device().location());
                let expected = "contiguous f32, all on one device";
                return Err(Error::Config { what: "variables", expected, found });
            }
        }
        let param = |var: Var| Param { shape: var.dims().to_vec(), var, order: None, cut: false };
        let params = vars.into_iter().map(|(name, var)| (name, param(var))).collect();
        Ok(Self::of(params, &Compute::of(&device)))
    }

    /// Checks that the network which `f` builds has these weights, before there is memory for it: a file may describe a
    /// network of any size.
    ///
    /// # Errors
    /// What `f` returns, and [`Error::Import`] with every missing, unexpected and mis-shaped tensor.
    pub fn check<T>(weights: &Weights, f: impl FnOnce(&Builder<'_>) -> Result<T>) -> Result<()> {
        fit(Self::shapes_of(f)?.iter(), weights)
    }

    fn shapes_of<T>(f: impl FnOnce(&Builder<'_>) -> Result<T>) -> Result<Shapes> {
        let compute = Compute::cpu();
        let nothing = Tensor::zeros((), DType::F32, compute.device())?;
        let shared = Shared::new(Mode::Infer, &compute, ChaCha8Rng::seed_from_u64(0), Some(nothing));
        f(&Builder::root(&shared))?;
        Ok(shared.into_state().shapes)
    }

    /// How many numbers the parameters that `f` asks for would be, without taking the memory for them.
    ///
    /// # Errors
    /// What `f` returns.
    pub fn count_of<T>(f: impl FnOnce(&Builder<'_>) -> Result<T>) -> Result<u128> {
        Ok(Self::shapes_of(f)?.values().map(|shape| shape.iter().map(|&n| n as u128).product::<u128>()).sum())
    }

    /// Where they are, and how they are computed with.
    #[must_use]
    pub fn compute(&self) -> &Compute {
        &self.compute
    }

    /// Whether a network built with `compute` would be the same in place and arithmetic.
    #[must_use]
    pub fn is_on(&self, compute: &Compute) -> bool {
        self.compute.device().same_device(compute.device())
            && self.compute.bf16() == compute.bf16()
            && self.backend == compute.backend()
    }

    pub(crate) fn backend(&self) -> Backend {
        self.backend
    }

    /// All parameters in PyTorch's layout.
    ///
    /// # Errors
    /// [`Error::Candle`] when a variable cannot be read.
    pub fn export(&self) -> Result<Weights> {
        let mut out = Weights::new();
        for (name, p) in self.params.iter() {
            let tensor = if self.backend != Backend::Kernels {
                p.outward(&host(p.var.as_tensor())?)
            } else {
                with(p.var.as_tensor(), |d| p.outward(d))?
            };
            out.insert(name.clone(), tensor);
        }
        Ok(out)
    }

    /// Takes over `weights`, all or nothing.
    ///
    /// # Errors
    /// [`Error::Import`] lists every missing, unexpected and mis-shaped tensor; the parameters are then as before.
    pub fn import(&self, weights: &Weights) -> Result<()> {
        self.matches(weights)?;
        for (param, tensor) in self.params.values().zip(weights.values()) {
            let data = param.inward(&tensor.data);
            if self.backend != Backend::Kernels {
                param.var.set(&Tensor::from_vec(data, param.var.shape(), param.var.device())?)?;
            } else {
                edit(&param.var, |p| p.copy_from_slice(&data))?;
            }
        }
        Ok(())
    }

    /// Moves the parameters towards those of `other`: `p += part (other - p)`. A part of 1 copies them to the last bit. For target networks.
    ///
    /// # Errors
    /// [`Error::OtherParams`] when `other` is of another network or elsewhere; nothing has changed then.
    pub fn follow(&self, other: &Self, part: f32) -> Result<()> {
        let same = |(a, b): (&Param, &Param)| a.shape == b.shape && a.order == b.order && a.cut == b.cut;
        let alike = self.len() == other.len() && self.params.values().zip(other.params.values()).all(same);
        if !alike || self.backend != other.backend {
            let (expected, found) = (self.len(), other.len());
            return Err(Error::OtherParams { what: "parameters to follow", expected, found });
        }
        for (ours, theirs) in self.variables().zip(other.variables()) {
            if self.backend != Backend::Kernels {
                let theirs = theirs.as_detached_tensor();
                let moved = if part < 1.0 {
                    graph::optim::blend(&ours.as_detached_tensor(), &theirs, part)?
                } else {
                    theirs.force_contiguous()?
                };
                ours.set(&moved)?;
                continue;
            }
            let theirs = with(theirs.as_tensor(), <[f32]>::to_vec)?;
            edit(ours, |p| if part < 1.0 { blend(p, &theirs, part) } else { p.copy_from_slice(&theirs) })?;
        }
        Ok(())
    }

    /// How many numbers the parameters hold.
    #[must_use]
    pub fn count(&self) -> usize {
        self.params.values().map(|p| p.var.elem_count()).sum()
    }

    /// How many parameters there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.params.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.params.is_empty()
    }

    /// The names, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.params.keys().map(String::as_str)
    }

    /// Names and PyTorch's shapes, sorted by name.
    pub(crate) fn shapes(&self) -> impl Iterator<Item = (&String, &Vec<usize>)> {
        self.params.iter().map(|(n, p)| (n, &p.shape))
    }

    /// Fails with the list of differences unless `weights` has these names and shapes.
    pub(crate) fn matches(&self, weights: &Weights) -> Result<()> {
        fit(self.shapes(), weights)
    }

    pub(crate) fn variables(&self) -> impl Iterator<Item = &Var> {
        self.params.values().map(|p| &p.var)
    }

    /// All of `list`, one entry per parameter in our layout, by name in PyTorch's.
    pub(crate) fn all_outward(&self, list: &[Numbers]) -> Result<Weights> {
        let each = self.params.iter().zip(list);
        each.map(|((n, p), d)| Ok((n.clone(), p.outward(&d.host()?)))).collect()
    }

    /// The inverse of [`Params::all_outward`].
    pub(crate) fn all_inward(&self, weights: &Weights) -> Result<Vec<Numbers>> {
        self.matches(weights)?;
        let each = self.params.values().zip(weights.values());
        each.map(|(p, t)| Numbers::new(p.inward(&t.data), &p.var, self.backend)).collect()
    }
}

/// Fails with the list of differences unless `weights` has these names and shapes.
fn fit<'a>(shapes: impl Iterator<Item = (&'a String, &'a Vec<usize>)>, weights: &Weights) -> Result<()> {
    let (mut missing, mut misshaped) = (vec![], vec![]);
    let mut unexpected: BTreeSet<&String> = weights.keys().collect();
    for (name, shape) in shapes {
        unexpected.remove(name);
        let size = shape.iter().try_fold(1_usize, |n, size| n.checked_mul(*size));
        match weights.get(name) {
            None => missing.push(name.clone()),
            Some(t) if t.shape != *shape || size != Some(t.data.len()) => misshaped.push(format!(
                "{name}: expected {shape:?}, found {:?} with {} numbers",
                t.shape,
                t.data.len()
            )),
            Some(_) => {}
        }
    }
    let unexpected: Vec<String> = unexpected.into_iter().cloned().collect();
    if missing.is_empty() && unexpected.is_empty() && misshaped.is_empty() {
        return Ok(());
    }
    Err(Error::Import { missing, unexpected, misshaped })
}

/// Copies between PyTorch's layout `shape` and that of the permuted axes, in the direction asked for.
fn permute_axes(data: &[f32], shape: &[usize], order: &[usize], inward: bool) -> Vec<f32> {
    let mut strides = vec![1; shape.len()];
    for i in (1..shape.len()).rev() {
        strides[i - 1] = strides[i] * shape[i];
    }
    let dims: Vec<(usize, usize)> = order.iter().map(|a| (shape[*a], strides[*a])).collect();
    let mut out = vec![0.0; data.len()];
    let mut index = vec![0; dims.len()];
    let mut theirs = 0;
    for ours in 0..data.len() {
        if inward {
            out[ours] = data[theirs];
        } else {
            out[theirs] = data[ours];
        }
        for (i, (size, stride)) in dims.iter().enumerate().rev() {
            index[i] += 1;
            theirs += stride;
            if index[i] < *size {
                break;
            }
            theirs -= size * stride;
            index[i] = 0;
        }
    }
    out
}
