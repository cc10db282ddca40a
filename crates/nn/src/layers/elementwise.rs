use crate::graph;
use crate::kernel::{act, add_assign};
use crate::tape::{Flow, Node, Step, Tape, Values, run};
use crate::{Error, Result};
use candle_core::{Device, Tensor};

/// x tanh(ln(1 + e^x)), with a finite gradient for every finite x.
///
/// # Source
/// Misra, "Mish: A Self Regularized Non-Monotonic Activation Function", equation 1.
#[derive(Clone, Copy, Debug, Default)]
pub struct Mish;

impl Mish {
    /// # Shapes
    /// Any.
    ///
    /// # Errors
    /// [`Error::Config`] when `x` is on the CPU and not `f32`.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], None, |t, n| mish(t, n[0]))
    }
}

/// max(x, 0).
#[derive(Clone, Copy, Debug, Default)]
pub struct Relu;

impl Relu {
    /// # Shapes
    /// Any.
    ///
    /// # Errors
    /// [`Error::Config`] when `x` is on the CPU and not `f32`.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        run(&[x], None, |t, n| relu(t, n[0]))
    }
}

struct MishStep(Node);

impl Step for MishStep {
    fn backward(&self, values: &Values<'_>, mut dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        act::mish_backward(&values.read(self.0)?, &mut dy);
        flow.add(self.0, dy);
        Ok(())
    }
}

pub(crate) fn mish(tape: &mut Tape, x: Node) -> Result<Node> {
    #[cfg(feature = "cuda")]
    if tape.on_gpu() {
        return crate::gpu::mish(tape, x);
    }
    if tape.in_graph() {
        return Ok(tape.put(graph::act::mish(tape.tensor(x)?)?));
    }
    let y = act::mish_forward(&tape.read(x)?);
    Ok(tape.push(y, tape.shape(x).to_vec(), &[x], &[], MishStep(x)))
}

struct ReluStep {
    x: Node,
    y: Node,
}

impl Step for ReluStep {
    fn backward(&self, values: &Values<'_>, mut dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        act::relu_backward(&values.read(self.y)?, &mut dy);
        flow.add(self.x, dy);
        Ok(())
    }
}

pub(crate) fn relu(tape: &mut Tape, x: Node) -> Result<Node> {
    #[cfg(feature = "cuda")]
    if tape.on_gpu() {
        return crate::gpu::relu(tape, x);
    }
    if tape.in_graph() {
        return Ok(tape.put(graph::act::relu(tape.tensor(x)?)?));
    }
    let y = act::relu_forward(&tape.read(x)?);
    let step = ReluStep { x, y: tape.next() };
    Ok(tape.push(y, tape.shape(x).to_vec(), &[x], &[], step))
}

struct Sum([Node; 2]);

impl Step for Sum {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let [a, b] = self.0;
        if values.grad(a) {
            flow.add(a, dy.clone());
        }
        if values.grad(b) {
            flow.add(b, dy);
        }
        Ok(())
    }
}

/// a + b, of one shape.
pub(crate) fn add(tape: &mut Tape, a: Node, b: Node) -> Result<Node> {
    if tape.shape(a) != tape.shape(b) {
        let expected = format!("{:?}", tape.shape(a));
        return Err(Error::Shape { what: "second summand", expected, found: tape.shape(b).to_vec() });
    }
    #[cfg(feature = "cuda")]
    if tape.on_gpu() {
        return crate::gpu::add(tape, a, b);
    }
    if tape.in_graph() {
        return Ok(tape.put((tape.tensor(a)? + tape.tensor(b)?)?));
    }
    let mut y = tape.read(a)?.to_vec();
    add_assign(&mut y, &tape.read(b)?);
    Ok(tape.push(y, tape.shape(a).to_vec(), &[a, b], &[], Sum([a, b])))
}

/// Feature-wise scale and shift: `x * scale + shift`, a pair for each sample and channel.
///
/// # Source
/// Perez et al., "FiLM: Visual Reasoning with a General Conditioning Layer", equation 2, with the scale first as in the
/// conditional residual block of Diffusion Policy.
#[derive(Clone, Copy, Debug, Default)]
pub struct Film;

impl Film {
    /// # Shapes
    /// `x` (B, L, C) and `scale_shift` (B, 2C), scales first, to (B, L, C).
    ///
    /// # Errors
    /// [`Error::Shape`] when they do not fit.
    pub fn forward(&self, x: &Tensor, scale_shift: &Tensor) -> Result<Tensor> {
        run(&[x, scale_shift], None, |t, n| {
            let (steps, c) = match (t.shape(n[0]), t.shape(n[1])) {
                ([b, l, c], [b2, c2]) if b == b2 && 2 * c == *c2 && l * c > 0 => (*l, *c),
                (x, found) => {
                    let expected = format!("(B, 2C) for x (B, L, C) = {x:?}");
                    return Err(Error::Shape { what: "scale and shift", expected, found: found.to_vec() });
                }
            };
            #[cfg(feature = "cuda")]
            if t.on_gpu() {
                return crate::gpu::film(t, n[0], n[1], steps, c);
            }
            if t.in_graph() {
                return Ok(t.put(graph::act::film(t.tensor(n[0])?, t.tensor(n[1])?)?));
            }
            let y = act::film_forward(&t.read(n[0])?, &t.read(n[1])?, steps, c);
            Ok(t.push(y, t.shape(n[0]).to_vec(), n, &[], FilmStep { x: n[0], e: n[1], steps, c }))
        })
    }
}

struct FilmStep {
    x: Node,
    e: Node,
    steps: usize,
    c: usize,
}

impl Step for FilmStep {
    fn backward(&self, values: &Values<'_>, mut dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let (x, e) = (values.read(self.x)?, values.read(self.e)?);
        let de = act::film_backward(&x, &e, &mut dy, self.steps, self.c);
        if values.grad(self.e) {
            flow.add(self.e, de);
        }
        if values.grad(self.x) {
            flow.add(self.x, dy);
        }
        Ok(())
    }
}

/// Joins along the last axis.
struct Concat {
    parts: Vec<(Node, usize)>,
    width: usize,
}

impl Step for Concat {
    fn backward(&self, values: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let mut at = 0;
        for (node, width) in &self.parts {
            if values.grad(*node) {
                let mut g = Vec::with_capacity(dy.len() / self.width * width);
                dy.chunks_exact(self.width).for_each(|r| g.extend_from_slice(&r[at..at + width]));
                flow.add(*node, g);
            }
            at += width;
        }
        Ok(())
    }
}

/// Joins `parts` along their last axis; the other axes must agree.
pub(crate) fn concat(tape: &mut Tape, parts: &[Node]) -> Result<Node> {
    let split = |n: Node| match tape.shape(n) {
        [front @ .., last] => (front.to_vec(), *last),
        [] => (Vec::new(), 1),
    };
    let mut shape = parts.first().map(|n| split(*n).0).unwrap_or_default();
    let mut widths = Vec::with_capacity(parts.len());
    for n in parts {
        let (front, width) = split(*n);
        if front != shape || width == 0 {
            let expected = format!("{shape:?} and channels");
            return Err(Error::Shape { what: "joined values", expected, found: tape.shape(*n).to_vec() });
        }
        widths.push(width);
    }
    #[cfg(feature = "cuda")]
    if tape.on_gpu() {
        let parts: Vec<_> = parts.iter().copied().zip(widths.iter().copied()).collect();
        shape.push(widths.iter().sum());
        return crate::gpu::concat(tape, &parts, &shape);
    }
    if tape.in_graph() {
        let parts: Result<Vec<&Tensor>> = parts.iter().map(|n| tape.tensor(*n)).collect();
        return Ok(tape.put(Tensor::cat(&parts?, shape.len())?));
    }
    let (rows, width) = (shape.iter().product::<usize>(), widths.iter().sum::<usize>());
    let read: Vec<_> = parts.iter().map(|n| tape.read(*n)).collect::<Result<_>>()?;
    let mut y = Vec::with_capacity(rows * width);
    for row in 0..rows {
        for (x, w) in read.iter().zip(&widths) {
            y.extend_from_slice(&x[row * w..][..*w]);
        }
    }
    drop(read);
    shape.push(width);
    let step = Concat { parts: parts.iter().copied().zip(widths).collect(), width };
    Ok(tape.push(y, shape, parts, &[], step))
}

struct Masked {
    x: Node,
    mask: Vec<f32>,
}

impl Step for Masked {
    fn backward(&self, _: &Values<'_>, mut dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        act::mul_assign(&mut dy, &self.mask);
        flow.add(self.x, dy);
        Ok(())
    }
}

pub(crate) fn masked(tape: &mut Tape, x: Node, mask: Vec<f32>) -> Result<Node> {
    #[cfg(feature = "cuda")]
    if tape.on_gpu() {
        return crate::gpu::masked(tape, x, mask);
    }
    if tape.in_graph() {
        let x = tape.tensor(x)?;
        return Ok(tape.put((x * Tensor::from_vec(mask, x.shape(), x.device())?)?));
    }
    let mut y = tape.read(x)?.to_vec();
    act::mul_assign(&mut y, &mask);
    Ok(tape.push(y, tape.shape(x).to_vec(), &[x], &[], Masked { x, mask }))
}

/// `x * mask`. For dropout of probability p the mask holds 0 with probability p and 1 / (1 - p) elsewhere.
///
/// # Shapes
/// `x` and `mask` alike; the mask has no gradient.
///
/// # Errors
/// [`Error::Shape`] when they differ.
pub fn dropout(x: &Tensor, mask: &Tensor) -> Result<Tensor> {
    if x.dims() != mask.dims() {
        let expected = format!("{:?}", x.dims());
        return Err(Error::Shape { what: "dropout mask", expected, found: mask.dims().to_vec() });
    }
    let mask = mask.flatten_all()?.to_vec1::<f32>()?;
    run(&[x], None, |t, n| masked(t, n[0], mask))
}

struct Repeat {
    x: Node,
    times: usize,
    width: usize,
}

impl Step for Repeat {
    fn backward(&self, _: &Values<'_>, dy: Vec<f32>, flow: &mut Flow) -> Result<()> {
        let mut g = vec![0.0; dy.len() / self.times];
        for (g, d) in g.chunks_exact_mut(self.width).zip(dy.chunks_exact(self.times * self.width)) {
            d.chunks_exact(self.width).for_each(|d| g.iter_mut().zip(d).for_each(|(g, d)| *g += d));
        }
        flow.add(self.x, g);
        Ok(())
    }
}

/// Every row `times` times in a row: one observation against several actions.
///
/// # Shapes
/// `(B, C)` to `(B times, C)`.
///
/// # Errors
/// [`Error::Shape`] when `x` is no non-empty matrix, [`Error::Config`] when `times` is zero.
pub fn repeat_rows(x: &Tensor, times: usize) -> Result<Tensor> {
    let (b, width) = match x.dims() {
        [b, c] if *c > 0 => (*b, *c),
        found => {
            return Err(Error::Shape {
                what: "rows to repeat",
                expected: "(B, C)".into(),
                found: found.to_vec(),
            });
        }
    };
    if times == 0 {
        return Err(Error::Config { what: "times to repeat", expected: "at least 1", found: "0".into() });
    }
    run(&[x], None, |t, n| {
        #[cfg(feature = "cuda")]
        if t.on_gpu() {
            return crate::gpu::repeat_rows(t, n[0], times);
        }
        if t.in_graph() {
            return Ok(t.put(graph::act::repeat_rows(t.tensor(n[0])?, times)?));
        }
        let mut y = Vec::with_capacity(b * times * width);
        for r in t.read(n[0])?.chunks_exact(width) {
            (0..times).for_each(|_| y.extend_from_slice(r));
        }
        Ok(t.push(y, [b * times, width], n, &[], Repeat { x: n[0], times, width }))
    })
}

/// Sines, then cosines, of each timestep at `dim / 2` frequencies from 1 down to 1e-4.
///
/// # Shapes
/// `B` timesteps to `(B, dim)`.
///
/// # Errors
/// [`Error::Config`] unless `dim` is even and at least 4.
///
/// # Source
/// `DiffusionSinusoidalPosEmb` of LeRobot 0.4.4; Vaswani et al., "Attention Is All You Need", section 3.5.
pub fn sinusoidal_embedding(timesteps: &[f32], dim: usize) -> Result<Tensor> {
    if dim < 4 || dim % 2 == 1 {
        let expected = "an even number from 4 on";
        return Err(Error::Config { what: "step embedding", expected, found: dim.to_string() });
    }
    let half = dim / 2;
    let rate = -(10_000f64.ln()) / (half - 1) as f64;
    // The frequencies and the products are rounded to f32 as in the reference, so that large timesteps agree.
    let frequencies: Vec<f32> = (0..half).map(|i| (i as f64 * rate).exp() as f32).collect();
    let mut out = Vec::with_capacity(timesteps.len() * dim);
    for t in timesteps {
        let angles = frequencies.iter().map(|f| f64::from(t * f));
        out.extend(angles.clone().map(|a| a.sin() as f32));
        out.extend(angles.map(|a| a.cos() as f32));
    }
    Ok(Tensor::from_vec(out, (timesteps.len(), dim), &Device::Cpu)?)
}
