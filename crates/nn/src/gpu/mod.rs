//! The same layers on NVIDIA GPUs: kernels of our own around products of cuBLAS, and of cuDNN for large convolutions.
//!
//! A network is one node of Candle's graph here too: its tape ([`flow`]) keeps what the way back needs, and weight gradients
//! go straight to the list that [`crate::backward`] collects. Everything is put on the one stream of the device, in order, so
//! nothing waits and memory can be handed back while kernels that read it are still to come.
#![allow(unsafe_code, reason = "launches and raw pointers to memory of the device")]

mod cudnn;
mod flow;
mod layers;
mod optim;

pub(crate) use flow::{Flow, Step, run};
pub(crate) use layers::*;

use crate::error::Result;
use crate::kernel::conv::Geo;
use candle_core::cuda_backend::cudarc::cublas;
use candle_core::cuda_backend::cudarc::cublas::sys::{
    cublasComputeType_t, cublasGemmAlgo_t, cublasOperation_t, cudaDataType,
};
use candle_core::cuda_backend::cudarc::driver::{CudaFunction, DevicePtr, result, sys};
use candle_core::cuda_backend::{CudaDevice, DeviceId};
use candle_core::op::BackpropOp;
use candle_core::{CudaStorage, DType, Device, Shape, Storage, Tensor};
use half::bf16;
use std::cell::RefCell;
use std::collections::HashMap;
use std::ffi::c_void;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Made by the build script.
const PTX: &str = include_str!(concat!(env!("OUT_DIR"), "/kernels.ptx"));

const NAMES: [&str; 52] = [
    "under_f32_1",
    "under_f32_4",
    "under_bf16_1",
    "under_bf16_4",
    "over_f32_1",
    "over_f32_4",
    "over_bf16_1",
    "over_bf16_4",
    "collect_under_f32_1",
    "collect_under_f32_4",
    "collect_under_bf16_1",
    "collect_under_bf16_4",
    "collect_over_f32_1",
    "collect_over_f32_4",
    "collect_over_bf16_1",
    "collect_over_bf16_4",
    "to_bf16",
    "add_bias",
    "from_bf16",
    "pad_f32",
    "pad_bf16",
    "cut_f32",
    "cut_bf16",
    "fold_f32",
    "fold_bf16",
    "unfold_f32",
    "unfold_bf16",
    "column_sums",
    "mish_forward",
    "mish_backward",
    "relu_forward",
    "relu_backward",
    "add",
    "multiply",
    "film_forward",
    "film_backward",
    "join",
    "split",
    "repeat_forward",
    "repeat_backward",
    "norm_forward",
    "norm_backward",
    "max_forward",
    "max_backward",
    "keypoints_forward",
    "keypoints_backward",
    "squared_error",
    "squared_error_backward",
    "squares",
    "root",
    "adam",
    "blend",
];

/// Threads of a block of an elementwise kernel.
const THREADS: u32 = 256;

/// A device with our kernels loaded.
pub(crate) struct Gpu {
    device: CudaDevice,
    functions: HashMap<&'static str, CudaFunction>,
    choice: cudnn::Choice,
    /// Opened at the first convolution that it is to compute; or why it cannot be.
    cudnn: OnceLock<std::result::Result<cudnn::Cudnn, String>>,
}

static OPENED: Mutex<Vec<(DeviceId, Arc<Gpu>)>> = Mutex::new(Vec::new());

thread_local! {
    /// The one asked for last.
    static LAST: RefCell<Option<(DeviceId, Arc<Gpu>)>> = const { RefCell::new(None) };
}

/// An argument of a kernel.
pub(crate) enum Arg<'a> {
    /// A tensor, contiguous.
    T(&'a Tensor),
    /// A tensor, or a null pointer.
    Maybe(Option<&'a Tensor>),
    /// A tensor of words, of 64 bits.
    Words(&'a Tensor),
    /// `int`
    I(usize),
    /// `size_t`
    N(usize),
    F(f32),
    G(&'a Sizes),
}

/// [`Geo`] as kernels read it.
#[repr(C)]
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub(crate) struct Sizes([i32; 13]);

impl Sizes {
    fn new(g: &Geo) -> Self {
        let all = [g.b, g.h, g.w, g.c, g.n, g.kh, g.kw, g.sh, g.sw, g.ph, g.pw, g.out_h(), g.out_w()];
        Self(all.map(|n| n as i32))
    }
}

fn wrap(e: impl std::error::Error + Send + Sync + 'static) -> candle_core::Error {
    candle_core::Error::wrap(e)
}

/// How the driver is to treat a device that was just opened.
pub(crate) fn prepare(device: &Device) -> candle_core::Result<()> {
    let Device::Cuda(device) = device else { return Ok(()) };
    // SAFETY: all tensors of this device live on its one stream, which orders their uses and their end.
    unsafe { device.disable_event_tracking() };
    let mut keep = u64::MAX;
    // SAFETY: the context is the device's own; the attribute is read as one u64.
    unsafe {
        let pool =
            result::device::get_default_mem_pool(device.cuda_stream().context().cu_device()).map_err(wrap)?;
        let attribute = sys::CUmemPool_attribute::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
        // Otherwise the driver returns all free memory to the system whenever the host waits.
        result::mem_pool::set_attribute(pool, attribute, (&raw mut keep).cast::<c_void>()).map_err(wrap)?;
    }
    Ok(())
}

impl Gpu {
    /// The GPU that `tensor` is on.
    pub(crate) fn of(tensor: &Tensor) -> candle_core::Result<Arc<Self>> {
        let Device::Cuda(device) = tensor.device() else { candle_core::bail!("expected a tensor on a GPU") };
        let id = device.id();
        LAST.with_borrow_mut(|last| {
            if let Some((_, gpu)) = last.as_ref().filter(|(i, _)| *i == id) {
                return Ok(gpu.clone());
            }
            let mut opened = OPENED.lock().unwrap_or_else(PoisonError::into_inner);
            let found = opened.iter().find(|(i, _)| *i == id).map(|(_, gpu)| gpu.clone());
            let gpu = match found {
                Some(gpu) => gpu,
                None => {
                    let gpu = Arc::new(Self::load(device)?);
                    opened.push((id, gpu.clone()));
                    gpu
                }
            };
            *last = Some((id, gpu.clone()));
            Ok(gpu)
        })
    }

    fn load(device: &CudaDevice) -> candle_core::Result<Self> {
        let mut functions = HashMap::new();
        for name in NAMES {
            let function = device.get_or_load_custom_func(name, "e2h", PTX)?;
            functions.insert(name, function.into_cuda_function());
        }
        Ok(Self {
            device: device.clone(),
            functions,
            choice: cudnn::Choice::asked()?,
            cudnn: OnceLock::new(),
        })
    }

    /// Memory whose numbers the next kernel sets.
    pub(crate) fn empty(&self, shape: impl Into<Shape>) -> candle_core::Result<Tensor> {
        let shape = shape.into();
        // SAFETY: every caller gives it to a kernel or a product that writes all of it before anything reads it.
        let slice = unsafe { self.device.alloc::<f32>(shape.elem_count())? };
        let storage = Storage::Cuda(CudaStorage::wrap_cuda_slice(slice, self.device.clone()));
        Ok(Tensor::from_storage(storage, shape, BackpropOp::none(), false))
    }

    /// The same in bf16.
    pub(crate) fn empty_bf16(&self, shape: impl Into<Shape>) -> candle_core::Result<Tensor> {
        let shape = shape.into();
        // SAFETY: as above.
        let slice = unsafe { self.device.alloc::<bf16>(shape.elem_count())? };
        let storage = Storage::Cuda(CudaStorage::wrap_cuda_slice(slice, self.device.clone()));
        Ok(Tensor::from_storage(storage, shape, BackpropOp::none(), false))
    }

    /// Where the numbers of a contiguous tensor of this device begin.
    pub(crate) fn address(&self, tensor: &Tensor) -> candle_core::Result<u64> {
        let (storage, layout) = tensor.storage_and_layout();
        let Storage::Cuda(storage) = &*storage else { candle_core::bail!("expected a tensor on a GPU") };
        if !layout.is_contiguous() {
            candle_core::bail!("expected a contiguous tensor, found {layout:?}");
        }
        let stream = self.device.cuda_stream();
        let (at, size) = match tensor.dtype() {
            DType::F32 => (storage.as_cuda_slice::<f32>()?.device_ptr(&stream).0, 4),
            DType::BF16 => (storage.as_cuda_slice::<bf16>()?.device_ptr(&stream).0, 2),
            DType::I64 => (storage.as_cuda_slice::<i64>()?.device_ptr(&stream).0, 8),
            found => candle_core::bail!("expected f32 or bf16, found {found:?}"),
        };
        Ok(at + layout.start_offset() as u64 * size)
    }

    /// Puts a kernel on the stream.
    pub(crate) fn launch(
        &self,
        name: &'static str,
        blocks: usize,
        threads: (u32, u32),
        shared: u32,
        arguments: &[Arg<'_>],
    ) -> candle_core::Result<()> {
        if blocks == 0 {
            return Ok(());
        }
        let Some(function) = self.functions.get(name) else { candle_core::bail!("no kernel {name}") };
        let Ok(blocks) = u32::try_from(blocks) else {
            candle_core::bail!(
                "{name}: expected at most 2^32 blocks of numbers, found {blocks}; take a smaller batch"
            );
        };
        debug_assert!(arguments.len() <= 16, "{name}: {} arguments", arguments.len());
        // Each in a word of its own: kernels read its first bytes, which is the low end here.
        let mut words = [0u64; 16];
        let mut pointers = [std::ptr::null_mut::<c_void>(); 16];
        for ((word, pointer), argument) in words.iter_mut().zip(&mut pointers).zip(arguments) {
            *pointer = std::ptr::from_mut(word).cast();
            match argument {
                Arg::T(t) | Arg::Words(t) => *word = self.address(t)?,
                Arg::Maybe(t) => *word = t.map_or(Ok(0), |t| self.address(t))?,
                Arg::I(i) => match i32::try_from(*i) {
                    Ok(i) => *word = u64::from(i as u32),
                    Err(_) => candle_core::bail!(
                        "{name}: expected sizes below 2^31, found {i}; take a smaller batch"
                    ),
                },
                Arg::N(n) => *word = *n as u64,
                Arg::F(f) => *word = u64::from(f.to_bits()),
                Arg::G(g) => *pointer = std::ptr::from_ref(*g).cast_mut().cast(),
            }
        }
        let stream = self.device.cuda_stream();
        stream.context().bind_to_thread().map_err(wrap)?;
        // SAFETY: the arguments are those of the kernel of that name, in its order; the tensors behind them are of the sizes
        // that its caller says, and outlive the launch on the stream.
        unsafe {
            result::launch_kernel(
                function.cu_function(),
                (blocks, 1, 1),
                (threads.0, threads.1, 1),
                shared,
                stream.cu_stream(),
                &mut pointers[..arguments.len()],
            )
        }
        .map_err(wrap)
    }

    /// A kernel with a thread for each of `n` numbers.
    pub(crate) fn each(
        &self,
        name: &'static str,
        n: usize,
        arguments: &[Arg<'_>],
    ) -> candle_core::Result<()> {
        self.launch(name, n.div_ceil(THREADS as usize), (THREADS, 1), 0, arguments)
    }

    /// `x` in bf16.
    pub(crate) fn bf16(&self, x: &Tensor) -> candle_core::Result<Tensor> {
        let (y, n) = (self.empty_bf16(x.shape())?, x.elem_count());
        self.each("to_bf16", n.div_ceil(4), &[Arg::T(x), Arg::T(&y), Arg::N(n)])?;
        Ok(y)
    }

    /// The sums of the columns of rows of `n`.
    pub(crate) fn column_sums(&self, x: &Tensor, n: usize) -> candle_core::Result<Tensor> {
        let (y, rows) = (self.empty(n)?, x.elem_count() / n.max(1));
        self.launch(
            "column_sums",
            n.div_ceil(32),
            (32, 32),
            0,
            &[Arg::T(x), Arg::T(&y), Arg::I(rows), Arg::I(n)],
        )?;
        Ok(y)
    }

    pub(crate) fn add(&self, a: &Tensor, b: &Tensor) -> candle_core::Result<Tensor> {
        let y = self.empty(a.shape())?;
        self.each("add", a.elem_count(), &[Arg::T(a), Arg::T(b), Arg::T(&y), Arg::N(a.elem_count())])?;
        Ok(y)
    }

    /// y (m, n) = a (m, k) b (k, n), row by row; `turned` says of a and b whether they lie there as (k, m) and (n, k).
    pub(crate) fn product(
        &self,
        (a, b, y): (&Tensor, &Tensor, &Tensor),
        (m, k, n): (usize, usize, usize),
        turned: (bool, bool),
    ) -> candle_core::Result<()> {
        let size = |n: usize| match i32::try_from(n) {
            Ok(n) => Ok(n),
            Err(_) => {
                candle_core::bail!("matrix: expected sizes below 2^31, found {n}; take a smaller batch")
            }
        };
        if a.elem_count() != m * k || b.elem_count() != k * n || y.elem_count() != m * n {
            candle_core::bail!(
                "matrices: expected ({m}, {k}) and ({k}, {n}), found {:?} and {:?}",
                a.dims(),
                b.dims()
            );
        }
        let kind = |t: &Tensor| {
            if t.dtype() == DType::BF16 { cudaDataType::CUDA_R_16BF } else { cudaDataType::CUDA_R_32F }
        };
        let tf32 = a.dtype() == DType::F32 && candle_core::cuda::gemm_reduced_precision_f32();
        let compute = if tf32 {
            cublasComputeType_t::CUBLAS_COMPUTE_32F_FAST_TF32
        } else {
            cublasComputeType_t::CUBLAS_COMPUTE_32F
        };
        let way =
            |turned| if turned { cublasOperation_t::CUBLAS_OP_T } else { cublasOperation_t::CUBLAS_OP_N };
        let (one, zero) = (1f32, 0f32);
        let blas = self.device.cublas_handle();
        self.device.cuda_stream().context().bind_to_thread().map_err(wrap)?;
        // cuBLAS reads columns first: there y^T = b^T a^T.
        // SAFETY: the three matrices have the sizes that were checked above.
        unsafe {
            cublas::result::gemm_ex(
                *blas.handle(),
                way(turned.1),
                way(turned.0),
                size(n)?,
                size(m)?,
                size(k)?,
                (&raw const one).cast(),
                self.address(b)? as *const c_void,
                kind(b),
                size(if turned.1 { k } else { n })?,
                self.address(a)? as *const c_void,
                kind(a),
                size(if turned.0 { m } else { k })?,
                (&raw const zero).cast(),
                self.address(y)? as *mut c_void,
                kind(y),
                size(n)?,
                compute,
                cublasGemmAlgo_t::CUBLAS_GEMM_DEFAULT,
            )
        }
        .map_err(wrap)
    }
}

/// A tensor with the same numbers and another shape.
fn shaped(t: &Tensor, shape: &[usize]) -> Result<Tensor> {
    Ok(if t.dims() == shape { t.clone() } else { t.reshape(shape)? })
}
