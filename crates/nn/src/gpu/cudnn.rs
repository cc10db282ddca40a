//! Convolutions by cuDNN, which reads the rows under its taps where they lie: no columns are written. Only where columns would
//! be large, and on machines that have the library; [`super::layers`] gathers anywhere else.
//!
//! Its functions are looked up at the first such convolution, so programs are built and start without it. Of each pass its
//! algorithm 1 is taken: products on tensor cores, without columns, and with sums in a fixed order.

use super::layers::KEPT;
use super::{Arg, Gpu, Sizes, wrap};
use crate::builder::Weight;
use crate::error::Result;
use crate::kernel::conv::Geo;
use crate::tape::{Node, Tape};
use candle_core::Tensor;
use libloading::Library;
use std::collections::HashMap;
use std::ffi::{c_int, c_void};
use std::ptr::null_mut;
use std::sync::{Arc, Mutex, PoisonError};

/// Rows for every column of the result from which writing columns costs more than turning weights to cuDNN's order and back.
const ROWS: usize = 4;
const VARIABLE: &str = "E2H_CONVOLUTION";

// Of cuDNN's enumerations.
const ALGORITHM: c_int = 1;
const FLOAT: c_int = 0;
const BFLOAT16: c_int = 9;
const CHANNELS_LAST: c_int = 1;
const CROSS_CORRELATION: c_int = 1;
const TENSOR_OP_MATH: c_int = 1;
const FMA_MATH: c_int = 3;

type Pointer = *mut c_void;
type Create = unsafe extern "C" fn(*mut Pointer) -> c_int;
type Four = unsafe extern "C" fn(Pointer, c_int, c_int, c_int, c_int, c_int, c_int) -> c_int;
/// The three passes agree in their arguments: the two factors, how, and the result.
type Room = unsafe extern "C" fn(Pointer, Pointer, Pointer, Pointer, Pointer, c_int, *mut usize) -> c_int;
type Run = unsafe extern "C" fn(
    Pointer,
    *const f32,
    Pointer,
    *const c_void,
    Pointer,
    *const c_void,
    Pointer,
    c_int,
    Pointer,
    usize,
    *const f32,
    Pointer,
    Pointer,
) -> c_int;

macro_rules! functions {
    ($($name:ident: $kind:ty = $symbol:literal;)*) => {
        struct Functions {
            $($name: $kind,)*
        }
        impl Functions {
            fn of(library: &Library) -> std::result::Result<Self, libloading::Error> {
                // SAFETY: the types are those that cudnn_ops.h and cudnn_cnn.h of cuDNN 9 declare.
                Ok(unsafe { Self { $($name: *library.get::<$kind>($symbol)?,)* } })
            }
        }
    };
}
functions! {
    create: Create = "cudnnCreate";
    set_stream: unsafe extern "C" fn(Pointer, Pointer) -> c_int = "cudnnSetStream";
    tensor: Create = "cudnnCreateTensorDescriptor";
    set_tensor: Four = "cudnnSetTensor4dDescriptor";
    filter: Create = "cudnnCreateFilterDescriptor";
    set_filter: Four = "cudnnSetFilter4dDescriptor";
    convolution: Create = "cudnnCreateConvolutionDescriptor";
    set_convolution: unsafe extern "C" fn(Pointer, c_int, c_int, c_int, c_int, c_int, c_int, c_int, c_int) -> c_int =
        "cudnnSetConvolution2dDescriptor";
    set_math: unsafe extern "C" fn(Pointer, c_int) -> c_int = "cudnnSetConvolutionMathType";
    forward_room: Room = "cudnnGetConvolutionForwardWorkspaceSize";
    data_room: Room = "cudnnGetConvolutionBackwardDataWorkspaceSize";
    filter_room: Room = "cudnnGetConvolutionBackwardFilterWorkspaceSize";
    forward: Run = "cudnnConvolutionForward";
    data: Run = "cudnnConvolutionBackwardData";
    filters: Run = "cudnnConvolutionBackwardFilter";
}

fn check(call: &str, status: c_int) -> candle_core::Result<()> {
    if status != 0 {
        candle_core::bail!(
            "{call}: expected status 0 of cuDNN, found {status}; without {VARIABLE} it is not asked"
        );
    }
    Ok(())
}

/// Who computes convolutions.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Choice {
    Gather,
    /// cuDNN where it should pay and can be loaded.
    Large,
    /// cuDNN whatever the sizes, for comparisons.
    Cudnn,
}

impl Choice {
    /// What the environment asks for.
    pub(crate) fn asked() -> candle_core::Result<Self> {
        match std::env::var(VARIABLE).as_deref() {
            // The default until cuDNN has been measured beside it.
            Err(_) | Ok("" | "gather") => Ok(Self::Gather),
            Ok("large") => Ok(Self::Large),
            Ok("cudnn") => Ok(Self::Cudnn),
            Ok(found) => candle_core::bail!("{VARIABLE}: expected gather, large or cudnn, found {found}"),
        }
    }
}

/// The library, opened for one GPU. Neither is ever closed.
pub(crate) struct Cudnn {
    functions: Functions,
    state: Mutex<State>,
    _library: Library,
}

struct State {
    handle: Pointer,
    /// By sizes and number type; none where cuDNN refused.
    plans: HashMap<(Sizes, bool, bool), Option<Arc<Plan>>>,
}
// SAFETY: a handle may be used by one thread after another; here it is reached through a lock alone.
unsafe impl Send for State {}

#[derive(Clone, Copy)]
enum Pass {
    /// (x, w) to y
    Forward,
    /// (w, dy) to dx
    Data,
    /// (x, dy) to dw
    Filter,
}

/// How a convolution of certain sizes is computed.
pub(super) struct Plan {
    /// With as many channels as cuDNN reads.
    geo: Geo,
    /// Channels of the network.
    c: usize,
    bf16: bool,
    x: Pointer,
    w: Pointer,
    y: Pointer,
    how: Pointer,
    /// Bytes that each pass wants beside its tensors.
    room: [usize; 3],
}
// SAFETY: descriptors are set before the plan is shared, and only read from then on.
unsafe impl Send for Plan {}
// SAFETY: as above.
unsafe impl Sync for Plan {}

impl Cudnn {
    pub(crate) fn open(gpu: &Gpu) -> candle_core::Result<Self> {
        let name = if cfg!(windows) { "cudnn64_9.dll" } else { "libcudnn.so.9" };
        // SAFETY: what the library does when it is loaded touches nothing of ours.
        let library = unsafe { Library::new(name) }.map_err(wrap)?;
        let functions = Functions::of(&library).map_err(wrap)?;
        let stream = gpu.device.cuda_stream();
        stream.context().bind_to_thread().map_err(wrap)?;
        let mut handle = null_mut();
        // SAFETY: the handle is made before it is used; the stream lives as long as the device.
        unsafe {
            check("cudnnCreate", (functions.create)(&raw mut handle))?;
            check("cudnnSetStream", (functions.set_stream)(handle, stream.cu_stream().cast()))?;
        }
        let state = Mutex::new(State { handle, plans: HashMap::new() });
        Ok(Self { functions, state, _library: library })
    }

    /// Describes a convolution and computes each of its passes once, on whatever the memory holds: what the library cannot do
    /// shows here.
    fn plan(
        &self,
        gpu: &Gpu,
        handle: Pointer,
        geo: Geo,
        c: usize,
        math: (bool, bool),
    ) -> candle_core::Result<Plan> {
        let f = &self.functions;
        let (bf16, tf32) = math;
        let int = |n: usize| c_int::try_from(n).map_err(wrap);
        let kind = if bf16 { BFLOAT16 } else { FLOAT };
        let [b, h, w, wide, n, kh, kw] = [geo.b, geo.h, geo.w, geo.c, geo.n, geo.kh, geo.kw].map(int);
        let (b, n, wide) = (b?, n?, wide?);
        let mut plan =
            Plan { geo, c, bf16, x: null_mut(), w: null_mut(), y: null_mut(), how: null_mut(), room: [0; 3] };
        // SAFETY: each descriptor is made before it is set, and given numbers of the types that the headers declare.
        unsafe {
            check("cudnnCreateTensorDescriptor", (f.tensor)(&raw mut plan.x))?;
            check("cudnnCreateTensorDescriptor", (f.tensor)(&raw mut plan.y))?;
            check("cudnnCreateFilterDescriptor", (f.filter)(&raw mut plan.w))?;
            check("cudnnCreateConvolutionDescriptor", (f.convolution)(&raw mut plan.how))?;
            let set = "cudnnSetTensor4dDescriptor";
            let (oh, ow) = (int(geo.out_h())?, int(geo.out_w())?);
            check(set, (f.set_tensor)(plan.x, CHANNELS_LAST, kind, b, wide, h?, w?))?;
            check(set, (f.set_tensor)(plan.y, CHANNELS_LAST, kind, b, n, oh, ow))?;
            let (kh, kw) = (kh?, kw?);
            // Here the type comes before the order.
            let status = (f.set_filter)(plan.w, kind, CHANNELS_LAST, n, wide, kh, kw);
            check("cudnnSetFilter4dDescriptor", status)?;
            let [ph, pw, sh, sw] = [geo.ph, geo.pw, geo.sh, geo.sw].map(int);
            let status = (f.set_convolution)(plan.how, ph?, pw?, sh?, sw?, 1, 1, CROSS_CORRELATION, FLOAT);
            check("cudnnSetConvolution2dDescriptor", status)?;
            let math = if bf16 || tf32 { TENSOR_OP_MATH } else { FMA_MATH };
            check("cudnnSetConvolutionMathType", (f.set_math)(plan.how, math))?;
        }
        let rooms =
            [(Pass::Forward, f.forward_room), (Pass::Data, f.data_room), (Pass::Filter, f.filter_room)];
        for (pass, room) in rooms {
            let [first, second, result] = plan.descriptors(pass);
            let mut bytes = 0;
            // SAFETY: the descriptors were set above.
            let status = unsafe { room(handle, first, second, plan.how, result, ALGORITHM, &raw mut bytes) };
            check("the workspace of a convolution", status)?;
            plan.room[pass as usize] = bytes;
        }
        let (x, w, y) = (
            plan.empty(gpu, plan.inputs())?,
            plan.empty(gpu, plan.filters())?,
            plan.empty(gpu, plan.outputs())?,
        );
        self.launch(gpu, handle, &plan, Pass::Forward, [&x, &w, &y])?;
        self.launch(gpu, handle, &plan, Pass::Data, [&w, &y, &x])?;
        self.launch(gpu, handle, &plan, Pass::Filter, [&x, &y, &w])?;
        Ok(plan)
    }

    /// Puts a pass on the stream.
    fn launch(
        &self,
        gpu: &Gpu,
        handle: Pointer,
        plan: &Plan,
        pass: Pass,
        tensors: [&Tensor; 3],
    ) -> candle_core::Result<()> {
        let f = &self.functions;
        let (name, run) = match pass {
            Pass::Forward => ("cudnnConvolutionForward", f.forward),
            Pass::Data => ("cudnnConvolutionBackwardData", f.data),
            Pass::Filter => ("cudnnConvolutionBackwardFilter", f.filters),
        };
        let bytes = plan.room[pass as usize];
        // Given back at once: the stream keeps it until the pass is over.
        let room = gpu.empty(bytes.div_ceil(4).max(1))?;
        let (one, zero) = (1f32, 0f32);
        let [first, second, result] = plan.descriptors(pass);
        let [a, b, c] = tensors.map(|t| gpu.address(t));
        gpu.device.cuda_stream().context().bind_to_thread().map_err(wrap)?;
        // SAFETY: the tensors have the sizes and the type of their descriptors, and outlive the pass on the stream.
        let status = unsafe {
            run(
                handle,
                &raw const one,
                first,
                a? as *const c_void,
                second,
                b? as *const c_void,
                plan.how,
                ALGORITHM,
                gpu.address(&room)? as Pointer,
                bytes,
                &raw const zero,
                result,
                c? as Pointer,
            )
        };
        check(name, status)
    }
}

/// How cuDNN is to compute a layer; none where the layer is to gather.
pub(super) fn plan(gpu: &Gpu, g: &Geo, x: &Tensor, bf16: bool) -> candle_core::Result<Option<Arc<Plan>>> {
    let tf32 = !bf16 && candle_core::cuda::gemm_reduced_precision_f32();
    let (taps, rows) = (g.kh * g.kw, g.b * g.out_h() * g.out_w());
    let columns = rows * taps * g.c * if bf16 { 2 } else { 4 };
    let asked = match gpu.choice {
        Choice::Gather => false,
        Choice::Large => (bf16 || tf32) && columns > KEPT && rows >= ROWS * g.n,
        Choice::Cudnn => true,
    };
    // Tensor cores want 16 bytes of channels. Those of an input are filled up with zeros.
    let step = if bf16 { 8 } else { 4 };
    let wide = g.c.next_multiple_of(step);
    let fits = taps > 1 && g.n.is_multiple_of(step);
    if !asked || !fits || !gpu.address(x)?.is_multiple_of(16) {
        return Ok(None);
    }
    let cudnn = match gpu.cudnn.get_or_init(|| Cudnn::open(gpu).map_err(|e| e.to_string())) {
        Ok(cudnn) => cudnn,
        Err(e) if gpu.choice == Choice::Cudnn => {
            candle_core::bail!("{VARIABLE}=cudnn: expected cuDNN 9, found none that loads: {e}")
        }
        Err(_) => return Ok(None),
    };
    let mut state = cudnn.state.lock().unwrap_or_else(PoisonError::into_inner);
    let key = (Sizes::new(g), bf16, tf32);
    if let Some(plan) = state.plans.get(&key) {
        return Ok(plan.clone());
    }
    let made = cudnn.plan(gpu, state.handle, Geo { c: wide, ..*g }, g.c, (bf16, tf32)).ok().map(Arc::new);
    state.plans.insert(key, made.clone());
    Ok(made)
}

impl Plan {
    fn descriptors(&self, pass: Pass) -> [Pointer; 3] {
        match pass {
            Pass::Forward => [self.x, self.w, self.y],
            Pass::Data => [self.w, self.y, self.x],
            Pass::Filter => [self.x, self.y, self.w],
        }
    }

    /// Channels of all taps, as cuDNN reads them.
    fn reach(&self) -> usize {
        self.geo.kh * self.geo.kw * self.geo.c
    }
    fn inputs(&self) -> usize {
        self.geo.b * self.geo.h * self.geo.w * self.geo.c
    }
    fn filters(&self) -> usize {
        self.geo.n * self.reach()
    }
    fn outputs(&self) -> usize {
        self.geo.b * self.geo.out_h() * self.geo.out_w() * self.geo.n
    }

    fn empty(&self, gpu: &Gpu, n: usize) -> candle_core::Result<Tensor> {
        if self.bf16 { gpu.empty_bf16(n) } else { gpu.empty(n) }
    }

    fn run(&self, gpu: &Gpu, pass: Pass, a: &Tensor, b: &Tensor, n: usize) -> candle_core::Result<Tensor> {
        let result = self.empty(gpu, n)?;
        let Some(Ok(cudnn)) = gpu.cudnn.get() else { candle_core::bail!("expected cuDNN, found it closed") };
        let state = cudnn.state.lock().unwrap_or_else(PoisonError::into_inner);
        cudnn.launch(gpu, state.handle, self, pass, [a, b, &result])?;
        Ok(result)
    }

    fn named(&self, f32: &'static str, bf16: &'static str) -> &'static str {
        if self.bf16 { bf16 } else { f32 }
    }

    /// The input as cuDNN reads it.
    fn input(&self, gpu: &Gpu, x: &Tensor) -> candle_core::Result<Tensor> {
        let (n, wide) = (self.inputs(), self.geo.c);
        if wide == self.c {
            return self.factor(gpu, x);
        }
        let y = self.empty(gpu, n)?;
        let arguments = [Arg::T(x), Arg::T(&y), Arg::N(n), Arg::I(self.c), Arg::I(wide)];
        gpu.each(self.named("pad_f32", "pad_bf16"), n, &arguments)?;
        Ok(y)
    }

    fn factor(&self, gpu: &Gpu, x: &Tensor) -> candle_core::Result<Tensor> {
        match self.bf16 {
            true => gpu.bf16(x),
            false if gpu.address(x)?.is_multiple_of(16) => Ok(x.clone()),
            false => x.force_contiguous(),
        }
    }

    /// Between our weights (taps c, n) and cuDNN's filters (n, taps c).
    fn turn(&self, gpu: &Gpu, name: &'static str, from: &Tensor, to: &Tensor) -> candle_core::Result<()> {
        let (rows, n) = (self.reach(), self.geo.n);
        let sizes = [Arg::I(self.c), Arg::I(self.geo.c), Arg::I(rows), Arg::I(n)];
        let arguments: Vec<_> = [Arg::T(from), Arg::T(to)].into_iter().chain(sizes).collect();
        gpu.launch(name, rows.div_ceil(32) * n.div_ceil(32), (32, 8), 0, &arguments)
    }

    /// What cuDNN computed, in f32.
    fn output(
        &self,
        gpu: &Gpu,
        y: Tensor,
        bias: Option<&Tensor>,
        shape: &[usize],
    ) -> candle_core::Result<Tensor> {
        let (all, width) = (y.elem_count(), self.geo.n);
        if self.bf16 {
            let out = gpu.empty(shape)?;
            let arguments = [Arg::T(&y), Arg::Maybe(bias), Arg::T(&out), Arg::N(all), Arg::I(width)];
            gpu.each("from_bf16", all / 4, &arguments)?;
            return Ok(out);
        }
        if let Some(bias) = bias {
            gpu.each("add_bias", all, &[Arg::T(&y), Arg::T(bias), Arg::N(all), Arg::I(width)])?;
        }
        y.reshape(shape)
    }

    /// The gradient of the input.
    fn back(&self, gpu: &Gpu, dx: Tensor, shape: &[usize]) -> candle_core::Result<Tensor> {
        if self.geo.c == self.c {
            return self.output(gpu, dx, None, shape);
        }
        let out = gpu.empty(shape)?;
        let n = out.elem_count();
        let arguments = [Arg::T(&dx), Arg::T(&out), Arg::N(n), Arg::I(self.c), Arg::I(self.geo.c)];
        gpu.each(self.named("cut_f32", "cut_bf16"), n, &arguments)?;
        Ok(out)
    }
}

/// The layer, and its way back.
pub(super) fn convolution(
    tape: &mut Tape,
    x: Node,
    (weight, bias): (&Weight, Option<&Weight>),
    plan: Arc<Plan>,
    shape: Vec<usize>,
) -> Result<Node> {
    let xt = tape.tensor(x)?;
    let (gpu, x_shape) = (Gpu::of(xt)?, xt.dims().to_vec());
    let input = plan.input(&gpu, xt)?;
    let filters = plan.empty(&gpu, plan.filters())?;
    plan.turn(&gpu, plan.named("fold_f32", "fold_bf16"), &weight.tensor.detach(), &filters)?;
    let y = plan.run(&gpu, Pass::Forward, &input, &filters, plan.outputs())?;
    let y = plan.output(&gpu, y, bias.map(|b| b.tensor.detach()).as_ref(), &shape)?;
    let (weight, bias) = (weight.clone(), bias.cloned());
    let (wanted, trained) = (tape.grad(x), weight.train || bias.as_ref().is_some_and(|b| b.train));
    Ok(tape.push_device(y, wanted || trained, move |dy, flow| {
        let gpu = flow.gpu.clone();
        let d = plan.factor(&gpu, dy)?;
        if weight.train {
            let turned = plan.run(&gpu, Pass::Filter, &input, &d, plan.filters())?;
            let dw = gpu.empty(weight.tensor.shape())?;
            plan.turn(&gpu, plan.named("unfold_f32", "unfold_bf16"), &turned, &dw)?;
            flow.weight(&weight, dw);
        }
        if let Some(bias) = bias.filter(|b| b.train) {
            let sums = gpu.column_sums(dy, plan.geo.n)?;
            flow.weight(&bias, sums);
        }
        if wanted {
            let dx = plan.run(&gpu, Pass::Data, &filters, &d, plan.inputs())?;
            flow.add(x, plan.back(&gpu, dx, &x_shape)?)?;
        }
        Ok(())
    }))
}
