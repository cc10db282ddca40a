//! A record of kernel calls that Candle sees as one operation.
//!
//! Candle's own graph allocates zeros and adds for every gradient that flows. Here a whole network is one node: inside it
//! the first gradient of a value is moved and only further ones are added, and weight gradients go straight to the list
//! that [`crate::backward`] collects.
//!
//! On NVIDIA GPUs a tape records launches in the same way (`gpu`). On other devices nothing is recorded: values are tensors
//! that Candle tracks, see [`crate::graph`].

use crate::builder::Weight;
use crate::compute::Backend;
use crate::grad;
use crate::kernel::add_assign;
use crate::numbers::Numbers;
use crate::storage::slice;
use crate::{Error, Result};
use candle_core::{
    CpuStorage, CustomOp1, CustomOp2, CustomOp3, DType, Device, Layout, Shape, StorageRef, Tensor, TensorId,
};
use std::ops::Deref;
use std::sync::Mutex;

/// The number of a value on a tape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Node(usize);

#[cfg(feature = "cuda")]
impl Node {
    pub(crate) fn index(self) -> usize {
        self.0
    }
}

enum Value {
    Own(Vec<f32>),
    Given(Tensor),
    /// On a tape of Candle's operations.
    Tracked(Tensor),
    /// Freed, or handed to Candle.
    Gone,
}

struct Slot {
    value: Value,
    shape: Vec<usize>,
    /// Whether a gradient is wanted.
    grad: bool,
}

/// A kernel call that can be undone: turns the gradient of its result into those of its inputs and weights.
pub(crate) trait Step: Send + Sync {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()>;
}

/// Values and the steps that made them.
pub(crate) struct Tape {
    slots: Vec<Slot>,
    steps: Vec<(Node, Box<dyn Step>)>,
    /// The same on a GPU.
    #[cfg(feature = "cuda")]
    device_steps: Vec<(Node, crate::gpu::Step)>,
    record: bool,
    backend: Backend,
}

/// The numbers of a value, wherever they live.
pub(crate) enum Read<'a> {
    Own(&'a [f32]),
    Given(StorageRef<'a>, &'a Layout),
}

impl Deref for Read<'_> {
    type Target = [f32];
    fn deref(&self) -> &[f32] {
        match self {
            Read::Own(v) => v,
            // Checked when the value was put on the tape.
            Read::Given(s, l) => slice(s, l).unwrap_or_default(),
        }
    }
}

/// Opens a contiguous tensor for reading.
pub(crate) fn read(tensor: &Tensor) -> Result<Read<'_>> {
    let (storage, layout) = tensor.storage_and_layout();
    slice(&storage, layout)?;
    Ok(Read::Given(storage, layout))
}

impl Tape {
    pub(crate) fn shape(&self, n: Node) -> &[usize] {
        &self.slots[n.0].shape
    }

    /// Whether a gradient of `n` is wanted.
    pub(crate) fn grad(&self, n: Node) -> bool {
        self.slots[n.0].grad
    }

    pub(crate) fn read(&self, n: Node) -> Result<Read<'_>> {
        match &self.slots[n.0].value {
            Value::Own(v) => Ok(Read::Own(v)),
            Value::Given(t) => read(t),
            Value::Tracked(_) | Value::Gone => Err(Error::NotRecording),
        }
    }

    #[cfg(feature = "cuda")]
    pub(crate) fn backend(&self) -> Backend {
        self.backend
    }

    /// Whether there will be a way back.
    #[cfg(feature = "cuda")]
    pub(crate) fn recording(&self) -> bool {
        self.record
    }

    /// Adds an input that is on a GPU.
    #[cfg(feature = "cuda")]
    pub(crate) fn given(&mut self, tensor: Tensor, grad: bool) -> Node {
        let node = Node(self.slots.len());
        let shape = tensor.dims().to_vec();
        self.slots.push(Slot { value: Value::Tracked(tensor), shape, grad });
        node
    }

    /// Adds a result that is on a GPU. `step` is kept if something needs a gradient through it, as `wanted` says.
    #[cfg(feature = "cuda")]
    pub(crate) fn push_device(
        &mut self,
        value: Tensor,
        wanted: bool,
        step: impl FnOnce(&Tensor, &mut crate::gpu::Flow) -> Result<()> + Send + 'static,
    ) -> Node {
        let grad = self.record && wanted;
        let node = self.given(value, grad);
        if grad {
            self.device_steps.push((node, Box::new(step)));
        }
        node
    }

    /// How many values there are, and the steps to take back.
    #[cfg(feature = "cuda")]
    pub(crate) fn into_device_steps(self) -> (usize, Vec<(Node, crate::gpu::Step)>) {
        (self.slots.len(), self.device_steps)
    }

    /// Whether layers are to compute with Candle's operations, on [`Tape::tensor`] and [`Tape::put`].
    pub(crate) fn in_graph(&self) -> bool {
        self.backend == Backend::Candle
    }

    /// A value as Candle sees it.
    pub(crate) fn tensor(&self, n: Node) -> Result<&Tensor> {
        match &self.slots[n.0].value {
            Value::Tracked(t) => Ok(t),
            _ => Err(Error::NotRecording),
        }
    }

    /// A weight as Candle sees it: tracked only if there will be a backward pass.
    pub(crate) fn weight(&self, w: &Weight) -> Tensor {
        if self.record { w.tensor.clone() } else { w.tensor.detach() }
    }

    /// Adds a result that Candle tracks.
    pub(crate) fn put(&mut self, tensor: Tensor) -> Node {
        let node = Node(self.slots.len());
        let (shape, grad) = (tensor.dims().to_vec(), tensor.track_op());
        self.slots.push(Slot { value: Value::Tracked(tensor), shape, grad });
        node
    }

    /// Adds a result. `step` is kept if something needs its gradient.
    pub(crate) fn push<S: Step + 'static>(
        &mut self,
        value: Vec<f32>,
        shape: impl Into<Vec<usize>>,
        inputs: &[Node],
        weights: &[&Weight],
        step: S,
    ) -> Node {
        let grad = self.record && (inputs.iter().any(|n| self.grad(*n)) || weights.iter().any(|w| w.train));
        let node = Node(self.slots.len());
        self.slots.push(Slot { value: Value::Own(value), shape: shape.into(), grad });
        if grad {
            self.steps.push((node, Box::new(step)));
        }
        node
    }

    /// The node that the next [`Tape::push`] will return.
    pub(crate) fn next(&self) -> Node {
        Node(self.slots.len())
    }

    /// Says that a value is not read again in the forward pass: without a record its memory is freed.
    pub(crate) fn done(&mut self, n: Node) {
        let slot = &mut self.slots[n.0];
        // What a backward pass needs of a tracked value, Candle holds.
        if matches!(slot.value, Value::Tracked(_)) || !self.record && matches!(slot.value, Value::Own(_)) {
            slot.value = Value::Gone;
        }
    }
}

/// The values of a finished tape, its result among them.
pub(crate) struct Values<'a> {
    tape: &'a Tape,
    out: Node,
    result: &'a Tensor,
}

impl Values<'_> {
    pub(crate) fn read(&self, n: Node) -> Result<Read<'_>> {
        if n == self.out { read(self.result) } else { self.tape.read(n) }
    }
    pub(crate) fn grad(&self, n: Node) -> bool {
        self.tape.grad(n)
    }
}

/// Gradients on their way back.
pub(crate) struct Flow {
    grads: Vec<Option<Vec<f32>>>,
    pub(crate) weights: Vec<(TensorId, Numbers)>,
}

impl Flow {
    /// A part of the gradient of `n`.
    pub(crate) fn add(&mut self, n: Node, g: Vec<f32>) {
        match &mut self.grads[n.0] {
            Some(sum) => add_assign(sum, &g),
            empty => *empty = Some(g),
        }
    }
    /// A part of the gradient of a weight.
    pub(crate) fn weight(&mut self, w: &Weight, g: Vec<f32>) {
        if w.train {
            self.weights.push((w.tensor.id(), Numbers::Host(g)));
        }
    }
}

/// A finished tape as an operation of Candle's.
struct Whole {
    /// Until a backward pass takes it: it frees each value as soon as no step left can read it.
    tape: Mutex<Option<Tape>>,
    out: Node,
    shape: Shape,
    /// The result, until Candle takes it.
    value: Mutex<Option<Vec<f32>>>,
    /// The inputs that Candle tracks, in the order of its arguments.
    tracked: Vec<Node>,
}

impl Whole {
    fn take(&self) -> candle_core::Result<(CpuStorage, Shape)> {
        let taken = self.value.lock().ok().and_then(|mut v| v.take());
        let Some(v) = taken else { candle_core::bail!("the result was taken before") };
        Ok((CpuStorage::F32(v), self.shape.clone()))
    }

    fn back(&self, result: &Tensor, dy: &Tensor) -> candle_core::Result<[Option<Tensor>; 3]> {
        let dy = dy.contiguous()?;
        let taken = self.tape.lock().ok().and_then(|mut t| t.take());
        let Some(mut tape) = taken else { return Err(candle_core::Error::wrap(Error::Freed)) };
        let flow = in_pool(|| self.flow(&mut tape, result, &dy)).map_err(candle_core::Error::wrap)?;
        grad::give(flow.weights).map_err(candle_core::Error::wrap)?;
        let mut grads = flow.grads;
        let mut out = [None, None, None];
        for (o, n) in out.iter_mut().zip(&self.tracked) {
            // Candle panics where what lies before an input gets no gradient.
            *o = Some(match grads[n.0].take() {
                Some(g) => Tensor::from_vec(g, tape.shape(*n), &Device::Cpu)?,
                None => Tensor::zeros(tape.shape(*n), DType::F32, &Device::Cpu)?,
            });
        }
        Ok(out)
    }

    fn flow(&self, tape: &mut Tape, result: &Tensor, dy: &Tensor) -> Result<Flow> {
        let mut flow = Flow { grads: tape.slots.iter().map(|_| None).collect(), weights: Vec::new() };
        flow.add(self.out, read(dy)?.to_vec());
        while let Some((node, step)) = tape.steps.pop() {
            // A value that nothing read has no gradient.
            if let Some(dy) = flow.grads[node.0].take() {
                step.backward(&Values { tape, out: self.out, result }, dy, &mut flow)?;
            }
            // Its readers came later, so they are done.
            tape.slots[node.0].value = Value::Gone;
        }
        Ok(flow)
    }
}

impl CustomOp1 for Whole {
    fn name(&self) -> &'static str {
        "network"
    }
    fn cpu_fwd(&self, _: &CpuStorage, _: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        self.take()
    }
    fn bwd(&self, _: &Tensor, y: &Tensor, dy: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let [a, _, _] = self.back(y, dy)?;
        Ok(a)
    }
}

impl CustomOp2 for Whole {
    fn name(&self) -> &'static str {
        "network"
    }
    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        self.take()
    }
    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let [a, b, _] = self.back(y, dy)?;
        Ok((a, b))
    }
}

impl CustomOp3 for Whole {
    fn name(&self) -> &'static str {
        "network"
    }
    fn cpu_fwd(
        &self,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
        _: &CpuStorage,
        _: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        self.take()
    }
    fn bwd(
        &self,
        _: &Tensor,
        _: &Tensor,
        _: &Tensor,
        y: &Tensor,
        dy: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [a, b, c] = self.back(y, dy)?;
        Ok((a, b, c))
    }
}

/// Runs `f` on a thread of the pool: from outside it every parallel loop would be handed over and waited for.
fn in_pool<R: Send>(f: impl FnOnce() -> R + Send) -> R {
    if rayon::current_thread_index().is_some() || rayon::current_num_threads() == 1 {
        return f();
    }
    rayon::scope(|_| f())
}

/// Runs `f` on a new tape with `inputs` (at most three) and returns its result as a tensor. `weight` is any weight that
/// `f` uses: it says whether there is something to train, and ties the result to Candle's graph.
pub(crate) fn run(
    inputs: &[&Tensor],
    weight: Option<&Weight>,
    f: impl FnOnce(&mut Tape, &[Node]) -> Result<Node> + Send,
) -> Result<Tensor> {
    let anchor = weight.filter(|w| w.train).map(|w| &w.tensor);
    let record = grad::enabled() && (anchor.is_some() || inputs.iter().any(|t| t.track_op()));
    let backend = weight.map_or_else(|| Backend::of(inputs), |w| w.backend);
    let mut tape = Tape {
        slots: Vec::new(),
        steps: Vec::new(),
        #[cfg(feature = "cuda")]
        device_steps: Vec::new(),
        record,
        backend,
    };
    #[cfg(feature = "cuda")]
    if backend == Backend::Gpu {
        return crate::gpu::run(tape, inputs, weight, f);
    }
    if backend == Backend::Candle {
        return run_tracked(tape, inputs, weight, f);
    }
    let mut nodes = Vec::with_capacity(inputs.len());
    let (mut arguments, mut tracked) = (Vec::new(), Vec::new());
    for input in inputs {
        let tensor = input.contiguous()?;
        drop(read(&tensor)?);
        let (node, grad) = (Node(tape.slots.len()), record && input.track_op());
        // Detached, or the tape would keep alive the graph before it.
        let value = Value::Given(tensor.detach());
        tape.slots.push(Slot { value, shape: input.dims().to_vec(), grad });
        nodes.push(node);
        if grad {
            arguments.push(*input);
            tracked.push(node);
        }
    }
    let out = in_pool(|| f(&mut tape, &nodes))?;
    let shape = tape.shape(out).to_vec();
    let value = match std::mem::replace(&mut tape.slots[out.0].value, Value::Gone) {
        Value::Own(v) => v,
        // A layer that returns an input unchanged.
        _ => return Ok(inputs.get(out.0).ok_or(Error::NotRecording)?.copy()?),
    };
    if !record {
        return Ok(Tensor::from_vec(value, shape, &Device::Cpu)?);
    }
    if arguments.is_empty() {
        arguments.extend(anchor);
    }
    let value = Mutex::new(Some(value));
    let whole = Whole { tape: Mutex::new(Some(tape)), out, shape: Shape::from(shape), value, tracked };
    Ok(match arguments[..] {
        [a] => a.apply_op1(whole)?,
        [a, b] => a.apply_op2(b, whole)?,
        [a, b, c] => a.apply_op3(b, c, whole)?,
        _ => return Err(Error::NotRecording),
    })
}

/// [`run`] on Candle's operations, on the calling thread: the work is the device's.
fn run_tracked(
    mut tape: Tape,
    inputs: &[&Tensor],
    weight: Option<&Weight>,
    f: impl FnOnce(&mut Tape, &[Node]) -> Result<Node>,
) -> Result<Tensor> {
    let device = weight.map(|w| w.tensor.device()).or(inputs.first().map(|t| t.device()));
    let mut nodes = Vec::with_capacity(inputs.len());
    for input in inputs {
        if let Some(device) = device.filter(|d| !input.device().same_device(d)) {
            return Err(Error::Config {
                what: "place of an input",
                expected: "the device of the network",
                found: format!("{:?} instead of {:?}", input.device().location(), device.location()),
            });
        }
        let tensor = input.contiguous()?;
        nodes.push(tape.put(if tape.record { tensor } else { tensor.detach() }));
    }
    let out = f(&mut tape, &nodes)?;
    Ok(tape.tensor(out)?.clone())
}
