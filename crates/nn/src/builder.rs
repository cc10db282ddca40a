//! Building a network: what a layer asks for becomes a parameter.

use crate::compute::{Backend, Compute};
use crate::kernel::conv::in_panels;
use crate::params::Param;
use crate::{Error, Result};
use candle_core::{Device, Tensor, Var};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::sync::{Mutex, MutexGuard, PoisonError};

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

/// What one network is built from; behind a lock because `candle_nn::VarBuilder` wants to cross threads.
pub(crate) struct Shared {
    mode: Mode,
    compute: Compute,
    state: Mutex<State>,
    /// Where only names and shapes are asked for: what stands in for every weight.
    plan: Option<Tensor>,
}

pub(crate) struct State {
    pub(crate) rng: ChaCha8Rng,
    pub(crate) params: BTreeMap<String, Param>,
    pub(crate) duplicate: Option<String>,
    /// Instead of parameters, where only these are asked for.
    pub(crate) shapes: Shapes,
}

impl Shared {
    pub(crate) fn new(mode: Mode, compute: &Compute, rng: ChaCha8Rng, plan: Option<Tensor>) -> Self {
        let (params, shapes) = (BTreeMap::new(), Shapes::new());
        let state = Mutex::new(State { rng, params, duplicate: None, shapes });
        Self { mode, compute: compute.clone(), state, plan }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(crate) fn into_state(self) -> State {
        self.state.into_inner().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Shapes by name.
pub(crate) type Shapes = BTreeMap<String, Vec<usize>>;

/// Parameters of a network whose shapes are asked for; the largest here has some hundred.
const MOST: usize = 1 << 16;

/// Collects the parameters of layers while they are built; a path, like `VarBuilder`.
#[derive(Clone)]
pub struct Builder<'a> {
    shared: &'a Shared,
    path: String,
}

impl<'a> Builder<'a> {
    /// The builder of a whole network.
    pub(crate) fn root(shared: &'a Shared) -> Self {
        Self { shared, path: String::new() }
    }
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
