//! The way back through a network.

use super::Gpu;
use crate::builder::Weight;
use crate::error::{Error, Result};
use crate::graph::network;
use crate::numbers::Numbers;
use crate::tape::{Node, Tape};
use crate::{compute::Backend, grad};
use candle_core::{DType, Shape, Tensor, TensorId};
use std::sync::{Arc, Mutex};

/// Turns the gradient of a result into those of its inputs and weights.
pub(crate) type Step = Box<dyn FnOnce(&Tensor, &mut Flow) -> Result<()> + Send>;

/// Gradients on their way back.
pub(crate) struct Flow {
    pub(crate) gpu: Arc<Gpu>,
    grads: Vec<Option<Tensor>>,
    weights: Vec<(TensorId, Numbers)>,
}

impl Flow {
    /// A part of the gradient of `n`.
    pub(crate) fn add(&mut self, n: Node, g: Tensor) -> Result<()> {
        let sum = match self.grads[n.index()].take() {
            Some(sum) => self.gpu.add(&sum, &g)?,
            None => g,
        };
        self.grads[n.index()] = Some(sum);
        Ok(())
    }
    /// A part of the gradient of a weight.
    pub(crate) fn weight(&mut self, w: &Weight, g: Tensor) {
        if w.train {
            self.weights.push((w.tensor.id(), Numbers::Device(g)));
        }
    }
}

/// [`crate::tape::run`] on a GPU.
pub(crate) fn run(
    mut tape: Tape,
    inputs: &[&Tensor],
    weight: Option<&Weight>,
    f: impl FnOnce(&mut Tape, &[Node]) -> Result<Node>,
) -> Result<Tensor> {
    let Some(first) = weight.map(|w| &w.tensor).or(inputs.first().copied()) else {
        return Err(Error::NotRecording);
    };
    let gpu = Gpu::of(first)?;
    let mut nodes = Vec::with_capacity(inputs.len());
    let (mut arguments, mut tracked) = (Vec::new(), Vec::new());
    for input in inputs {
        if !input.device().same_device(first.device()) {
            let (expected, found) = (first.device().location(), input.device().location());
            return Err(Error::Config {
                what: "place of an input",
                expected: "the device of the network",
                found: format!("{found:?} instead of {expected:?}"),
            });
        }
        if input.dtype() != DType::F32 {
            let found = format!("{:?}", input.dtype());
            return Err(Error::Config { what: "numbers of an input", expected: "f32", found });
        }
        let wanted = tape.recording() && input.track_op();
        // Detached, or the tape would keep alive the graph before it.
        let node = tape.given(input.contiguous()?.detach(), wanted);
        nodes.push(node);
        if wanted {
            arguments.push(*input);
            tracked.push(node);
        }
    }
    let out = f(&mut tape, &nodes)?;
    let value = tape.tensor(out)?.clone();
    if !tape.recording() {
        return Ok(value);
    }
    if let Some(at) = nodes.iter().position(|n| *n == out) {
        // A layer that returns an input unchanged.
        return Ok(inputs[at].copy()?);
    }
    let (count, steps) = tape.into_device_steps();
    let kept = Mutex::new(Some(steps));
    let shapes: Vec<Shape> = arguments.iter().map(|a| a.shape().clone()).collect();
    let anchored = arguments.is_empty();
    if anchored {
        arguments.extend(weight.filter(|w| w.train).map(|w| &w.tensor));
    }
    let back = move |_: &crate::Given<'_>, dy: &Tensor| {
        let taken = kept.lock().ok().and_then(|mut s| s.take());
        let Some(mut steps) = taken else { return Err(candle_core::Error::wrap(Error::Freed)) };
        let mut flow =
            Flow { gpu: gpu.clone(), grads: (0..count).map(|_| None).collect(), weights: Vec::new() };
        flow.grads[out.index()] = Some(dy.clone());
        while let Some((node, step)) = steps.pop() {
            // A value that nothing read has no gradient.
            if let Some(dy) = flow.grads[node.index()].take() {
                step(&dy, &mut flow).map_err(candle_core::Error::wrap)?;
            }
        }
        grad::give(flow.weights).map_err(candle_core::Error::wrap)?;
        let mut gradients = [None, None, None];
        for ((g, n), input) in gradients.iter_mut().zip(&tracked).zip(&shapes) {
            // Candle panics where what lies before an input gets no gradient.
            *g = Some(match flow.grads[n.index()].take() {
                Some(g) => g,
                None => Tensor::zeros(input, DType::F32, dy.device())?,
            });
        }
        Ok(gradients)
    };
    Ok(network(value, &arguments, back)?)
}

impl Tape {
    /// Whether layers are to compute with our kernels for GPUs.
    pub(crate) fn on_gpu(&self) -> bool {
        self.backend() == Backend::Gpu
    }
}
