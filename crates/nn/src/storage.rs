//! Reads and changes the numbers of tensors in place.

use crate::{Error, Result};
use candle_core::{CpuStorage, InplaceOp1, Layout, Storage, Tensor, Var};
use std::cell::RefCell;

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
