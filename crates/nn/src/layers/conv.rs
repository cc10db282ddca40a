use crate::builder::{Builder, Init, Weight};
use crate::graph;
use crate::kernel::column_sums;
use crate::kernel::conv::{self, Geo};
use crate::tape::{Flow, Node, Step, Tape, Values, read, run};
use crate::{Error, Result};
use candle_core::Tensor;

/// A convolution, or with one tap a linear layer, on a tape.
pub(crate) struct Convolution {
    pub(crate) x: Node,
    pub(crate) weight: Weight,
    pub(crate) bias: Option<Weight>,
    pub(crate) geo: Geo,
}

impl Convolution {
    pub(crate) fn record(self, tape: &mut Tape, shape: Vec<usize>) -> Result<Node> {
        #[cfg(feature = "cuda")]
        if tape.on_gpu() {
            let weights = (&self.weight, self.bias.as_ref());
            return crate::gpu::convolution(tape, self.x, weights, &self.geo, false, shape);
        }
        if tape.in_graph() {
            let (w, bias) = (tape.weight(&self.weight), self.bias.as_ref().map(|b| tape.weight(b)));
            let x = tape.tensor(self.x)?;
            let y = graph::linear::convolution(x, &w, bias.as_ref(), &self.geo, self.weight.bf16)?;
            return Ok(tape.put(y.reshape(shape)?));
        }
        let bias = self.bias.as_ref().map(|b| read(&b.tensor)).transpose()?;
        let y = conv::forward(&tape.read(self.x)?, &read(&self.weight.tensor)?, bias.as_deref(), &self.geo);
        drop(bias);
        let weight = self.weight.clone();
        Ok(tape.push(y, shape, &[self.x], &[&weight], self))
    }
}

impl Step for Convolution {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        if self.weight.train {
            flow.weight(&self.weight, conv::weight_grad(&values.read(self.x)?, &dy, &self.geo));
        }
        if let Some(bias) = self.bias.as_ref().filter(|b| b.train) {
            flow.weight(bias, column_sums(&dy, self.geo.n));
        }
        if values.grad(self.x) {
            flow.add(self.x, conv::input_grad(&read(&self.weight.tensor)?, &dy, &self.geo));
        }
        Ok(())
    }
}

fn positive(what: &'static str, sizes: &[usize]) -> Result<()> {
    if sizes.contains(&0) {
        return Err(Error::Config { what, expected: "positive sizes", found: format!("{sizes:?}") });
    }
    Ok(())
}

/// Convolution over time.
///
/// # Source
/// `torch.nn.Conv1d` with its parameter layout; channels come last here.
#[derive(Clone, Debug)]
pub struct Conv1d {
    weight: Weight,
    bias: Weight,
    from: usize,
    to: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
}

impl Conv1d {
    /// A layer with parameters `weight` (to, from, kernel) and `bias` (to).
    ///
    /// # Errors
    /// [`Error::Config`] when a size is zero.
    pub fn new(
        from: usize,
        to: usize,
        kernel: usize,
        stride: usize,
        padding: usize,
        builder: &Builder<'_>,
    ) -> Result<Self> {
        positive("conv1d channels, kernel and stride", &[from, to, kernel, stride])?;
        let bound = Init::within(1.0 / ((from * kernel) as f32).sqrt());
        let weight = builder.weight("weight", &[to, from, kernel], Some(&[2, 1, 0]), bound)?;
        let bias = builder.weight("bias", &[to], None, bound)?;
        Ok(Self { weight, bias, from, to, kernel, stride, padding })
    }

    /// # Shapes
    /// `(B, L, from)` to `(B, (L + 2 padding - kernel) / stride + 1, to)`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the channels differ or the input is shorter than the kernel.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], Some(&self.weight), |t, n| self.record(t, n[0]))
    }

    pub(crate) fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let [b, w, c] = tape.shape(x)[..] else { return Err(self.wrong(tape.shape(x))) };
        if c != self.from || w + 2 * self.padding < self.kernel {
            return Err(self.wrong(tape.shape(x)));
        }
        let (n, kw, sw, pw) = (self.to, self.kernel, self.stride, self.padding);
        let geo = Geo { b, h: 1, w, c, n, kh: 1, kw, sh: 1, sw, ph: 0, pw };
        let shape = vec![b, geo.out_w(), n];
        Convolution { x, weight: self.weight.clone(), bias: Some(self.bias.clone()), geo }.record(tape, shape)
    }

    fn wrong(&self, found: &[usize]) -> Error {
        let least = self.kernel.saturating_sub(2 * self.padding);
        let expected = format!("(B, at least {least}, {})", self.from);
        Error::Shape { what: "conv1d input", expected, found: found.to_vec() }
    }
}

/// Convolution over images, without bias unless asked for.
///
/// # Source
/// `torch.nn.Conv2d` with its parameter layout; channels come last here.
#[derive(Clone, Debug)]
pub struct Conv2d {
    weight: Weight,
    bias: Option<Weight>,
    from: usize,
    to: usize,
    kernel: usize,
    stride: usize,
    padding: usize,
}

impl Conv2d {
    /// A layer with parameters `weight` (to, from, kernel, kernel) and, with `bias`, `bias` (to).
    ///
    /// # Errors
    /// [`Error::Config`] when a size is zero.
    pub fn new(
        channels: (usize, usize),
        kernel: usize,
        stride: usize,
        padding: usize,
        bias: bool,
        builder: &Builder<'_>,
    ) -> Result<Self> {
        let (from, to) = channels;
        positive("conv2d channels, kernel and stride", &[from, to, kernel, stride])?;
        let bound = Init::within(1.0 / ((from * kernel * kernel) as f32).sqrt());
        let weight = builder.weight("weight", &[to, from, kernel, kernel], Some(&[2, 3, 1, 0]), bound)?;
        let bias = bias.then(|| builder.weight("bias", &[to], None, bound)).transpose()?;
        Ok(Self { weight, bias, from, to, kernel, stride, padding })
    }

    /// # Shapes
    /// `(N, H, W, from)` to `(N, H', W', to)` with `H' = (H + 2 padding - kernel) / stride + 1`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the channels differ or the image is smaller than the kernel.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], Some(&self.weight), |t, n| self.record(t, n[0]))
    }

    pub(crate) fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let [b, h, w, c] = tape.shape(x)[..] else { return Err(self.wrong(tape.shape(x))) };
        let (n, k, s, p) = (self.to, self.kernel, self.stride, self.padding);
        if c != self.from || h.min(w) + 2 * p < k {
            return Err(self.wrong(tape.shape(x)));
        }
        let geo = Geo { b, h, w, c, n, kh: k, kw: k, sh: s, sw: s, ph: p, pw: p };
        let shape = vec![b, geo.out_h(), geo.out_w(), n];
        Convolution { x, weight: self.weight.clone(), bias: self.bias.clone(), geo }.record(tape, shape)
    }

    fn wrong(&self, found: &[usize]) -> Error {
        let least = self.kernel.saturating_sub(2 * self.padding);
        let expected = format!("(N, at least {least}, at least {least}, {})", self.from);
        Error::Shape { what: "conv2d input", expected, found: found.to_vec() }
    }

    pub(crate) fn anchor(&self) -> &Weight {
        &self.weight
    }
}

/// Transposed convolution of kernel 4, stride 2 and padding 1, which doubles the length.
///
/// # Source
/// `torch.nn.ConvTranspose1d(from, to, 4, 2, 1)` with its parameter layout; channels come last here.
#[derive(Clone, Debug)]
pub struct ConvTranspose1d {
    weight: Weight,
    bias: Weight,
    from: usize,
    to: usize,
}

impl ConvTranspose1d {
    const KERNEL: usize = 4;

    /// A layer with parameters `weight` (from, to, 4) and `bias` (to).
    ///
    /// # Errors
    /// [`Error::Config`] when a size is zero.
    pub fn new(from: usize, to: usize, builder: &Builder<'_>) -> Result<Self> {
        positive("transposed convolution channels", &[from, to])?;
        // PyTorch takes the second axis of the weight for its fan in.
        let bound = Init::within(1.0 / ((to * Self::KERNEL) as f32).sqrt());
        let weight = builder.weight("weight", &[from, to, Self::KERNEL], Some(&[2, 0, 1]), bound)?;
        Ok(Self { weight, bias: builder.weight("bias", &[to], None, bound)?, from, to })
    }

    /// # Shapes
    /// `(B, L, from)` to `(B, 2 L, to)`.
    ///
    /// # Errors
    /// [`Error::Shape`] when the channels differ.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], Some(&self.weight), |t, n| self.record(t, n[0]))
    }

    pub(crate) fn record(&self, tape: &mut Tape, x: Node) -> Result<Node> {
        let (b, l) = match tape.shape(x)[..] {
            [b, l, c] if c == self.from && l > 0 => (b, l),
            _ => {
                let expected = format!("(B, at least 1, {})", self.from);
                let found = tape.shape(x).to_vec();
                return Err(Error::Shape { what: "transposed convolution input", expected, found });
            }
        };
        // The sizes of the convolution whose input gradient this is.
        let (c, n, kw) = (self.to, self.from, Self::KERNEL);
        let geo = Geo { b, h: 1, w: 2 * l, c, n, kh: 1, kw, sh: 1, sw: 2, ph: 0, pw: 1 };
        #[cfg(feature = "cuda")]
        if tape.on_gpu() {
            let weights = (&self.weight, Some(&self.bias));
            return crate::gpu::convolution(tape, x, weights, &geo, true, vec![b, 2 * l, c]);
        }
        if tape.in_graph() {
            let (w, bias) = (tape.weight(&self.weight), tape.weight(&self.bias));
            let y = graph::linear::transposed(tape.tensor(x)?, &w, &bias, &geo, self.weight.bf16)?;
            return Ok(tape.put(y.reshape((b, 2 * l, c))?));
        }
        let (weight, bias) = (self.weight.clone(), self.bias.clone());
        let y = conv::transposed_forward(&tape.read(x)?, &read(&weight.tensor)?, &read(&bias.tensor)?, &geo);
        let step = Transposed { x, weight, bias, geo };
        Ok(tape.push(y, [b, 2 * l, c], &[x], &[&self.weight], step))
    }
}

struct Transposed {
    x: Node,
    weight: Weight,
    bias: Weight,
    geo: Geo,
}

impl Step for Transposed {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        if self.weight.train {
            let dw = conv::transposed_weight_grad(&values.read(self.x)?, &dy, &self.geo);
            flow.weight(&self.weight, dw);
            flow.weight(&self.bias, column_sums(&dy, self.geo.c));
        }
        if values.grad(self.x) {
            flow.add(self.x, conv::transposed_input_grad(&read(&self.weight.tensor)?, &dy, &self.geo));
        }
        Ok(())
    }
}
