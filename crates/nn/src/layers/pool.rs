use super::Conv2d;
use crate::builder::Builder;
use crate::graph;
use crate::kernel::pool::{self, Map};
use crate::tape::{Flow, Node, Step, Tape, Values, run};
use crate::weights::HostTensor;
use crate::{Error, Result};
use candle_core::Tensor;

fn map(tape: &Tape, x: Node, what: &'static str) -> Result<Map> {
    match tape.shape(x)[..] {
        [b, h, w, c] if b * h * w * c > 0 => Ok(Map { b, h, w, c }),
        _ => Err(Error::Shape { what, expected: "(N, H, W, C)".into(), found: tape.shape(x).to_vec() }),
    }
}

/// Max pooling over 3x3, stride 2, padding 1: the stem of a ResNet.
///
/// # Source
/// `torch.nn.MaxPool2d(3, 2, 1)`: of equal maxima the first takes the gradient.
#[derive(Clone, Copy, Debug, Default)]
pub struct MaxPool2d;

impl MaxPool2d {
    /// # Shapes
    /// `(N, H, W, C)` to `(N, (H - 1) / 2 + 1, (W - 1) / 2 + 1, C)`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the input has another rank or is empty.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], None, |t, n| self.record(t, n[0]))
    }

    pub(crate) fn record(self, tape: &mut Tape, x: Node) -> Result<Node> {
        let map = map(tape, x, "max pool input")?;
        #[cfg(feature = "cuda")]
        if tape.on_gpu() {
            return crate::gpu::max_pool(tape, x, &map);
        }
        if tape.in_graph() {
            return Ok(tape.put(graph::pool::max_pool(tape.tensor(x)?, &map)?));
        }
        let y = pool::max_forward(&tape.read(x)?, &map);
        let p = map.pooled();
        let step = Pooled { x, y: tape.next(), map };
        Ok(tape.push(y, [p.b, p.h, p.w, p.c], &[x], &[], step))
    }
}

struct Pooled {
    x: Node,
    y: Node,
    map: Map,
}

impl Step for Pooled {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let dx = pool::max_backward(&values.read(self.x)?, &values.read(self.y)?, &dy, &self.map);
        flow.add(self.x, dx);
        Ok(())
    }
}

/// Expected positions of learned features: a 1x1 convolution, a softmax over positions, the mean position under it.
///
/// # Source
/// Levine et al., "End-to-End Training of Deep Visuomotor Policies", section 5.1; `SpatialSoftmax` of LeRobot 0.4.4
/// (`modeling_diffusion.py`), itself after robomimic. Its position grid is a buffer there and computed here, from the size
/// of the map that arrives.
#[derive(Clone, Debug)]
pub struct SpatialSoftmax {
    nets: Conv2d,
    keypoints: usize,
}

impl SpatialSoftmax {
    /// A layer with parameters `nets.weight` (keypoints, channels, 1, 1) and `nets.bias`.
    ///
    /// # Errors
    /// [`Error::Config`] when a size is zero.
    pub fn new(channels: usize, keypoints: usize, builder: &Builder<'_>) -> Result<Self> {
        Ok(Self { nets: Conv2d::new((channels, keypoints), 1, 1, 0, true, &builder.pp("nets"))?, keypoints })
    }

    /// # Shapes
    /// `(N, H, W, channels)` to `(N, 2 keypoints)`: x and y of each keypoint in [-1, 1], x along W.
    ///
    /// # Errors
    /// [`Error::Shape`] when the channels differ.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], Some(self.nets.anchor()), |t, n| self.record(t, n[0]))
    }

    pub(crate) fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let logits = self.nets.record(tape, x)?;
        let map = map(tape, logits, "spatial softmax input")?;
        #[cfg(feature = "cuda")]
        if tape.on_gpu() {
            return crate::gpu::keypoints(tape, logits, &map);
        }
        if tape.in_graph() {
            return Ok(tape.put(graph::pool::keypoints(tape.tensor(logits)?, &map)?));
        }
        let (out, attention) = pool::keypoints_forward(&tape.read(logits)?, &map);
        let step = Attended { logits, out: tape.next(), attention, map };
        tape.done(logits);
        Ok(tape.push(out, [map.b, 2 * self.keypoints], &[logits], &[], step))
    }

    /// LeRobot's buffer `pos_grid` for a map of `h` by `w`: (h w, 2), x first.
    #[must_use]
    pub fn position_grid(h: usize, w: usize) -> HostTensor {
        let at = |i| [pool::position(i % w.max(1), w), pool::position(i / w.max(1), h)];
        HostTensor { shape: vec![h * w, 2], data: (0..h * w).flat_map(at).collect() }
    }
}

struct Attended {
    logits: Node,
    out: Node,
    attention: Vec<f32>,
    map: Map,
}

impl Step for Attended {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let dx = pool::keypoints_backward(&self.attention, &values.read(self.out)?, &dy, &self.map);
        flow.add(self.logits, dx);
        Ok(())
    }
}
