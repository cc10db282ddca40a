use crate::builder::{Builder, Init, Weight};
use crate::graph;
use crate::kernel::norm::{self, Dims, Post, Saved};
use crate::tape::{Flow, Node, Read, Step, Tape, Values, read, run};
use crate::{Error, Result};
use candle_core::Tensor;

/// The activation after a normalisation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Act {
    /// None.
    None,
    /// max(x, 0).
    Relu,
    /// x tanh(ln(1 + e^x)).
    Mish,
}

/// Group normalisation over all axes but the first, with an activation and an optional residual in the same pass.
///
/// # Source
/// `torch.nn.GroupNorm` (epsilon 1e-5, biased variance); Wu and He, "Group Normalization", equation 1.
#[derive(Clone, Debug)]
pub struct GroupNorm {
    gain: Weight,
    bias: Weight,
    groups: usize,
    channels: usize,
    act: Act,
}

/// The second input of a fused normalisation on a tape.
#[derive(Clone, Copy)]
pub(crate) enum Extra {
    None,
    /// Added before the activation: the residual of a ResNet block.
    Before(Node),
    /// Added after the activation: the residual of a U-Net block.
    After(Node),
    /// Scale and shift `(B, 2C)` after the activation.
    Film(Node),
}

impl GroupNorm {
    /// A layer with parameters `weight` (channels) and `bias` (channels).
    ///
    /// # Errors
    /// [`Error::Config`] unless `groups` divides `channels`.
    pub fn new(groups: usize, channels: usize, act: Act, builder: &Builder<'_>) -> Result<Self> {
        if channels == 0 || groups == 0 || !channels.is_multiple_of(groups) {
            let found = format!("{channels} channels in {groups} groups");
            return Err(Error::Config {
                what: "group norm",
                expected: "channels divisible by the groups",
                found,
            });
        }
        let gain = builder.weight("weight", &[channels], None, Init::Constant(1.0))?;
        Ok(Self {
            gain,
            bias: builder.weight("bias", &[channels], None, Init::Constant(0.0))?,
            groups,
            channels,
            act,
        })
    }

    /// act(norm(x) + residual).
    ///
    /// # Shapes
    /// `(B, .., channels)`, and `residual` alike.
    ///
    /// # Errors
    /// [`Error::Shape`] when the channels or the shapes differ, [`Error::Config`] for a residual before [`Act::Mish`] or
    /// [`Act::None`], which no network here has.
    pub fn forward(&self, x: &Tensor, residual: Option<&Tensor>) -> Result<Tensor> {
        match residual {
            None => run(&[x], Some(&self.gain), |t, n| self.record(t, n[0], Extra::None)),
            Some(r) => run(&[x, r], Some(&self.gain), |t, n| self.record(t, n[0], Extra::Before(n[1]))),
        }
    }

    pub(crate) fn record(&self, tape: &mut Tape, x: Node, extra: Extra) -> Result<Node> {
        let shape = tape.shape(x).to_vec();
        let wrong =
            |what, expected: String, found: &[usize]| Error::Shape { what, expected, found: found.to_vec() };
        if shape.len() < 2 || shape.last() != Some(&self.channels) || shape.contains(&0) {
            return Err(wrong("group norm input", format!("(B, .., {})", self.channels), &shape));
        }
        let (post, other) = match (self.act, extra) {
            (Act::None, Extra::None) => (Post::None, None),
            (Act::Relu, Extra::None) => (Post::Relu, None),
            (Act::Relu, Extra::Before(r)) => (Post::AddRelu, Some(r)),
            (Act::Mish, Extra::None) => (Post::Mish, None),
            (Act::Mish, Extra::After(r)) => (Post::MishAdd, Some(r)),
            (Act::Mish, Extra::Film(e)) => (Post::MishFilm, Some(e)),
            (act, _) => {
                let expected = "a residual only before Relu, or after Mish inside a U-Net block";
                return Err(Error::Config {
                    what: "group norm residual",
                    expected,
                    found: format!("{act:?}"),
                });
            }
        };
        let expected = if post == Post::MishFilm { vec![shape[0], 2 * self.channels] } else { shape.clone() };
        if let Some(o) = other.filter(|o| tape.shape(*o) != expected) {
            return Err(wrong("second input of group norm", format!("{expected:?}"), tape.shape(o)));
        }
        let dims = Dims {
            b: shape[0],
            s: shape[1..shape.len() - 1].iter().product(),
            c: self.channels,
            groups: self.groups,
        };
        #[cfg(feature = "cuda")]
        if tape.on_gpu() {
            return crate::gpu::group_norm(tape, x, other, (&self.gain, &self.bias), post, &dims);
        }
        if tape.in_graph() {
            let (gain, bias) = (tape.weight(&self.gain), tape.weight(&self.bias));
            let z = graph::norm::group_norm(tape.tensor(x)?, &gain, &bias, self.groups)?;
            let other = other.map(|o| tape.tensor(o)).transpose()?;
            let y = match (post, other) {
                (Post::Relu, _) => graph::act::relu(&z)?,
                (Post::AddRelu, Some(r)) => graph::act::relu(&(z + r)?)?,
                (Post::Mish, _) => graph::act::mish(&z)?,
                (Post::MishFilm, Some(e)) => graph::act::film(&graph::act::mish(&z)?, e)?,
                (Post::MishAdd, Some(r)) => (graph::act::mish(&z)? + r)?,
                _ => z,
            };
            return Ok(tape.put(y));
        }
        let extra = other.map(|o| tape.read(o)).transpose()?;
        let (gain, bias) = (read(&self.gain.tensor)?, read(&self.bias.tensor)?);
        let (y, stats) =
            norm::forward(&tape.read(x)?, &gain, &bias, extra.as_deref().unwrap_or_default(), post, &dims);
        drop((gain, bias, extra));
        let step = Normalise { x, y: tape.next(), other, layer: self.clone(), post, dims, stats };
        let inputs = [Some(x), other];
        let inputs: Vec<Node> = inputs.into_iter().flatten().collect();
        Ok(tape.push(y, shape, &inputs, &[&self.gain], step))
    }
}

struct Normalise {
    x: Node,
    y: Node,
    other: Option<Node>,
    layer: GroupNorm,
    post: Post,
    dims: Dims,
    stats: Vec<f32>,
}

impl Step for Normalise {
    fn backward(&self, values: &Values<'_>, mut dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let extra: Option<Read<'_>> = self.other.map(|o| values.read(o)).transpose()?;
        let saved = Saved {
            x: &values.read(self.x)?,
            y: &values.read(self.y)?,
            gamma: &read(&self.layer.gain.tensor)?,
            beta: &read(&self.layer.bias.tensor)?,
            extra: extra.as_deref().unwrap_or_default(),
            stats: &self.stats,
        };
        let back = norm::backward(&saved, &mut dy, self.post, &self.dims);
        flow.weight(&self.layer.gain, back.gamma);
        flow.weight(&self.layer.bias, back.beta);
        if let Some((other, g)) = self.other.zip(back.extra).filter(|(o, _)| values.grad(*o)) {
            flow.add(other, g);
        }
        if values.grad(self.x) {
            flow.add(self.x, dy);
        }
        Ok(())
    }
}
