use crate::compute::Compute;
use crate::kernel::conv::in_panels;
use crate::numbers::Numbers;
use crate::weights::{HostTensor, Weights};
use crate::{Error, Result};
use candle_core::{CpuStorage, DType, InplaceOp1, Layout, Storage, Tensor, Var};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

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
    /// Whether it is for Candle's operations, uncut, instead of our kernels.
    pub(crate) graph: bool,
    /// Whether products read it as `bf16`.
    pub(crate) bf16: bool,
}

/// How a parameter starts.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Init {
    /// Uniform in plus or minus this.
    Uniform(f32),
    Ones,
    Zeros,
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

struct Shared {
    mode: Mode,
    compute: Compute,
    rng: RefCell<ChaCha8Rng>,
    params: RefCell<BTreeMap<String, Param>>,
    duplicate: Cell<Option<String>>,
    /// Where only names and shapes are asked for: those, and what stands in for every weight.
    plan: Option<(RefCell<Shapes>, Tensor)>,
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
        if let Some((shapes, nothing)) = &self.shared.plan {
            let mut shapes = shapes.borrow_mut();
            if shapes.len() == MOST {
                let found = format!("`{name}` after them");
                return Err(Error::Config { what: "network", expected: "at most 65536 parameters", found });
            }
            shapes.insert(name, shape.to_vec());
            return Ok(Weight { tensor: nothing.clone(), train: false, graph: false, bf16: false });
        }
        let n = shape.iter().product();
        let data: Vec<f32> = match init {
            Init::Uniform(b) => {
                let mut rng = self.shared.rng.borrow_mut();
                (0..n).map(|_| (2.0 * rng.random::<f32>() - 1.0) * b).collect()
            }
            Init::Ones => vec![1.0; n],
            Init::Zeros => vec![0.0; n],
        };
        let inner: Vec<usize> = order.map_or(shape.to_vec(), |o| o.iter().map(|a| shape[*a]).collect());
        let compute = &self.shared.compute;
        let (graph, bf16) = (compute.through_candle(), compute.bf16());
        let cut = order.is_some() && !graph;
        let data = if cut { in_panels(&data, inner.last().copied().unwrap_or(1), false) } else { data };
        let var = Var::from_vec(data, inner, compute.device())?;
        let train = self.shared.mode == Mode::Train;
        let tensor = if train { var.as_tensor().clone() } else { var.as_detached_tensor() };
        let param = Param { var, shape: shape.to_vec(), order, cut };
        if self.shared.params.borrow_mut().insert(name.clone(), param).is_some() {
            self.shared.duplicate.set(Some(name));
        }
        Ok(Weight { tensor, train, graph, bf16 })
    }
}

/// The parameters of a network, by name.
///
/// Clones share the numbers.
#[derive(Clone)]
pub struct Params {
    params: Arc<BTreeMap<String, Param>>,
    compute: Compute,
    /// Whether gradients and what follows them are tensors.
    graph: bool,
}

impl std::fmt::Debug for Params {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_map().entries(self.params.iter().map(|(n, p)| (n, &p.shape))).finish()
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
        let shared = Shared {
            mode,
            compute: compute.clone(),
            rng: RefCell::new(rng.clone()),
            params: RefCell::default(),
            duplicate: Cell::default(),
            plan: None,
        };
        let built = f(&Builder { shared: &shared, path: String::new() })?;
        *rng = shared.rng.into_inner();
        if let Some(name) = shared.duplicate.take() {
            return Err(Error::Duplicate(name));
        }
        let graph = compute.through_candle();
        let params = Arc::new(shared.params.into_inner());
        Ok((Self { params, compute: shared.compute, graph }, built))
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
        let shared = Shared {
            mode: Mode::Infer,
            compute,
            rng: RefCell::new(ChaCha8Rng::seed_from_u64(0)),
            params: RefCell::default(),
            duplicate: Cell::default(),
            plan: Some((RefCell::default(), nothing)),
        };
        f(&Builder { shared: &shared, path: String::new() })?;
        Ok(shared.plan.map(|(shapes, _)| shapes.into_inner()).unwrap_or_default())
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
            && self.graph == compute.through_candle()
    }

    /// Whether gradients and what follows them are tensors.
    pub(crate) fn in_graph(&self) -> bool {
        self.graph
    }

    /// All parameters in PyTorch's layout.
    ///
    /// # Errors
    /// [`Error::Candle`] when a variable cannot be read.
    pub fn export(&self) -> Result<Weights> {
        let mut out = Weights::new();
        for (name, p) in self.params.iter() {
            let tensor = if self.graph {
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
            if self.graph {
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

    /// Fails with the list of differences unless `weights` has these names and shapes.
    pub(crate) fn matches(&self, weights: &Weights) -> Result<()> {
        fit(self.params.iter().map(|(n, p)| (n, &p.shape)), weights)
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
        each.map(|(p, t)| Numbers::new(p.inward(&t.data), &p.var, self.graph)).collect()
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

/// The numbers of a contiguous host tensor of `f32`.
pub(crate) fn slice<'a>(storage: &'a Storage, layout: &Layout) -> Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (Storage::Cpu(CpuStorage::F32(v)), Some((a, b))) => Ok(&v[a..b]),
        _ => Err(Error::Config {
            what: "tensor",
            expected: "contiguous f32 on the CPU",
            found: format!("{:?} of {layout:?}", storage.dtype()),
        }),
    }
}

/// The numbers of a tensor, wherever it is.
pub(crate) fn host(tensor: &Tensor) -> Result<Vec<f32>> {
    Ok(tensor.flatten_all()?.to_vec1()?)
}

/// Runs `f` on the numbers of a contiguous tensor.
pub(crate) fn with<R>(tensor: &Tensor, f: impl FnOnce(&[f32]) -> R) -> Result<R> {
    let (storage, layout) = tensor.storage_and_layout();
    Ok(f(slice(&storage, layout)?))
}

struct Edit<F>(RefCell<Option<F>>);

impl<F: FnOnce(&mut [f32])> InplaceOp1 for Edit<F> {
    fn name(&self) -> &'static str {
        "edit"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> candle_core::Result<()> {
        let (CpuStorage::F32(v), Some((a, b))) = (storage, layout.contiguous_offsets()) else {
            candle_core::bail!("expected a contiguous variable of f32");
        };
        if let Some(f) = self.0.take() {
            f(&mut v[a..b]);
        }
        Ok(())
    }
}

/// Changes a variable in place.
pub(crate) fn edit(var: &Var, f: impl FnOnce(&mut [f32])) -> Result<()> {
    Ok(var.as_tensor().inplace_op1(&Edit(RefCell::new(Some(f))))?)
}
