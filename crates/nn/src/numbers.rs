use crate::compute::Backend;
use crate::kernel::add_assign;
use crate::storage::{host, with};
use crate::{Error, Result};
use candle_core::{Tensor, Var};
use std::borrow::Cow;

/// A gradient, a moment or an average of one parameter, in its layout and where it is.
#[derive(Clone, Debug)]
pub(crate) enum Numbers {
    Host(Vec<f32>),
    Device(Tensor),
}

impl Numbers {
    /// `data` beside `var`.
    pub(crate) fn new(data: Vec<f32>, var: &Var, backend: Backend) -> Result<Self> {
        if backend == Backend::Kernels {
            return Ok(Self::Host(data));
        }
        Ok(Self::Device(Tensor::from_vec(data, var.shape(), var.device())?))
    }

    pub(crate) fn zeros(var: &Var, backend: Backend) -> Result<Self> {
        match backend {
            Backend::Kernels => Ok(Self::Host(vec![0.0; var.elem_count()])),
            Backend::Candle | Backend::Gpu => Ok(Self::Device(var.zeros_like()?)),
        }
    }

    /// The present numbers of `var`.
    pub(crate) fn copy(var: &Var, backend: Backend) -> Result<Self> {
        match backend {
            Backend::Kernels => with(var.as_tensor(), |v| Self::Host(v.to_vec())),
            Backend::Candle | Backend::Gpu => Ok(Self::Device(var.as_detached_tensor().force_contiguous()?)),
        }
    }

    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Host(v) => v.len(),
            Self::Device(t) => t.elem_count(),
        }
    }

    /// A copy that shares no memory with it.
    #[cfg(feature = "cuda")]
    pub(crate) fn apart(&self) -> Result<Self> {
        match self {
            Self::Host(v) => Ok(Self::Host(v.clone())),
            Self::Device(t) => Ok(Self::Device(t.force_contiguous()?)),
        }
    }

    /// Adds `other`, of the same parameter.
    pub(crate) fn add(&mut self, other: &Self) -> Result<()> {
        match (self, other) {
            (Self::Host(a), Self::Host(b)) => add_assign(a, b),
            (Self::Device(a), Self::Device(b)) => *a = (&*a + b)?,
            _ => return Err(elsewhere("gradients", 1)),
        }
        Ok(())
    }

    pub(crate) fn host(&self) -> Result<Cow<'_, [f32]>> {
        match self {
            Self::Host(v) => Ok(Cow::Borrowed(v)),
            Self::Device(t) => Ok(Cow::Owned(host(t)?)),
        }
    }
}

/// Numbers of a network elsewhere.
pub(crate) fn elsewhere(what: &'static str, parameters: usize) -> Error {
    Error::OtherParams { what, expected: parameters, found: parameters }
}
