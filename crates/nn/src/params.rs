use crate::compute::{Backend, Compute};
use crate::kernel::conv::in_panels;
use crate::numbers::Numbers;
use crate::storage::{edit, host, with};
use crate::weights::{HostTensor, Weights};
use crate::{Error, Result};
use candle_core::{DType, Device, Tensor, Var};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::TAU;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What a network is built for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Weights are variables: a forward pass keeps what [`crate::backward`] needs.
    Train,
    /// Weights are plain tensors that share storage with the variables: nothing is kept.
    Infer,
}

/// How a weight's axes lie here: `order[j]` is the PyTorch axis that is our axis j, and the last is cut into the panels of
/// [`crate::kernel::conv::panel`] where our kernels read it. `None` keeps PyTorch's, uncut.
pub(crate) type Order = Option<&'static [usize]>;

/// A weight as a layer holds it.
#[derive(Clone, Debug)]
pub(crate) struct Weight {
    pub(crate) tensor: Tensor,
    pub(crate) train: bool,
    /// What reads it.
    pub(crate) backend: Backend,
    /// Whether products read it as `bf16`.
    pub(crate) bf16: bool,
}

/// How a parameter starts.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Init {
    Constant(f32),
    /// Uniform in `mid` plus or minus `half`.
    Uniform {
        mid: f32,
        half: f32,
    },
    Normal {
        mean: f32,
        deviation: f32,
    },
}

impl Init {
    /// Uniform in plus or minus `bound`.
    pub(crate) const fn within(bound: f32) -> Self {
        Self::Uniform { mid: 0.0, half: bound }
    }

    fn draw(self, n: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
        match self {
            Self::Constant(c) => vec![c; n],
            Self::Uniform { mid, half } => {
                (0..n).map(|_| mid + (2.0 * rng.random::<f32>() - 1.0) * half).collect()
            }
            // Box and Muller; 1 - u is never 0.
            Self::Normal { mean, deviation } => (0..n)
                .map(|_| {
                    let (u, v) = (1.0 - rng.random::<f64>(), rng.random::<f64>());
                    mean + deviation * ((-2.0 * u.ln()).sqrt() * (TAU * v).cos()) as f32
                })
                .collect(),
        }
    }
}

struct Param {
    var: Var,
    /// PyTorch's shape.
    shape: Vec<usize>,
    order: Order,
    /// Whether the last axis is cut into panels.
    cut: bool,
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

/// What one network is built from; behind a lock because `candle_nn::VarBuilder` wants to cross threads.
struct Shared {
    mode: Mode,
    compute: Compute,
    state: Mutex<State>,
    /// Where only names and shapes are asked for: what stands in for every weight.
    plan: Option<Tensor>,
}

struct State {
    rng: ChaCha8Rng,
    params: BTreeMap<String, Param>,
    duplicate: Option<String>,
    /// Instead of parameters, where only these are asked for.
    shapes: Shapes,
}

impl Shared {
    fn new(mode: Mode, compute: &Compute, rng: ChaCha8Rng, plan: Option<Tensor>) -> Self {
        let (params, shapes) = (BTreeMap::new(), Shapes::new());
        let state = Mutex::new(State { rng, params, duplicate: None, shapes });
        Self { mode, compute: compute.clone(), state, plan }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn into_state(self) -> State {
        self.state.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Shapes by name.
type Shapes = BTreeMap<String, Vec<usize>>;

/// Parameters of a network whose shapes are asked for; the largest here has some hundred.
const MOST: usize = 1 << 16;

/// Collects the parameters of layers while they are built; a path, like `VarBuilder`.
#[derive(Clone)]
pub struct Builder<'a> {
    shared: &'a Shared,
    path: String,
}

impl Builder<'_> {
    /// The builder for a part of the network called `name`.
    #[must_use]
    pub fn pp(&self, name: impl std::fmt::Display) -> Self {
        let dot = if self.path.is_empty() { "" } else { "." };
        Self { shared: self.shared, path: format!("{}{dot}{name}", self.path) }
    }

    /// The dotted path so far.
    #[must_use]
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Adds a parameter of PyTorch shape `shape`.
    pub(crate) fn weight(&self, name: &str, shape: &[usize], order: Order, init: Init) -> Result<Weight> {
        let name = self.pp(name).path;
        let mut state = self.shared.state();
        if let Some(nothing) = &self.shared.plan {
            if state.shapes.len() == MOST {
                let found = format!("`{name}` after them");
                return Err(Error::Config { what: "network", expected: "at most 65536 parameters", found });
            }
            state.shapes.insert(name, shape.to_vec());
            return Ok(Weight {
                tensor: nothing.clone(),
                train: false,
                backend: Backend::Kernels,
                bf16: false,
            });
        }
        let data = init.draw(shape.iter().product(), &mut state.rng);
        let inner: Vec<usize> = order.map_or(shape.to_vec(), |o| o.iter().map(|a| shape[*a]).collect());
        let compute = &self.shared.compute;
        let (backend, bf16) = (compute.backend(), compute.bf16());
        let cut = order.is_some() && backend == Backend::Kernels;
        let data = if cut { in_panels(&data, inner.last().copied().unwrap_or(1), false) } else { data };
        let var = Var::from_vec(data, inner, compute.device())?;
        let train = self.shared.mode == Mode::Train;
        let tensor = if train { var.as_tensor().clone() } else { var.as_detached_tensor() };
        let param = Param { var, shape: shape.to_vec(), order, cut };
        if state.params.insert(name.clone(), param).is_some() {
            state.duplicate = Some(name);
        }
        Ok(Weight { tensor, train, backend, bf16 })
    }

    /// A tensor in PyTorch's layout for Candle's operations: the parameter `name`, made where there is none of that name
    /// yet, as `VarBuilder` has it.
    pub(crate) fn tensor(&self, name: &str, shape: &[usize], init: Init) -> Result<Tensor> {
        let path = self.pp(name).path;
        let found = match self.shared.state().params.get(&path) {
            None => None,
            Some(p) if p.order.is_none() && p.shape == shape => Some(p.var.as_tensor().clone()),
            Some(p) => {
                let expected = format!("{:?} for the parameter `{path}`", p.shape);
                return Err(Error::Shape {
                    what: "variable asked for again",
                    expected,
                    found: shape.to_vec(),
                });
            }
        };
        match (found, self.shared.mode) {
            (Some(tensor), Mode::Train) => Ok(tensor),
            (Some(tensor), Mode::Infer) => Ok(tensor.detach()),
            (None, _) => {
                let tensor = self.weight(name, shape, None, init)?.tensor;
                // The stand-in of a plan takes its shape without taking memory.
                Ok(if self.shared.plan.is_some() { tensor.broadcast_as(shape)? } else { tensor })
            }
        }
    }

    pub(crate) fn has(&self, name: &str) -> bool {
        let (path, state) = (self.pp(name).path, self.shared.state());
        state.params.contains_key(&path) || state.shapes.contains_key(&path)
    }

    pub(crate) fn device(&self) -> &Device {
        self.shared.compute.device()
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
        let built = f(&Builder { shared: &shared, path: String::new() })?;
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
        f(&Builder { shared: &shared, path: String::new() })?;
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
            let tensor = if self.backend == Backend::Candle {
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
            if self.backend == Backend::Candle {
                param.var.set(&Tensor::from_vec(data, param.var.shape(), param.var.device())?)?;
            } else {
                edit(&param.var, |p| p.copy_from_slice(&data))?;
            }
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
