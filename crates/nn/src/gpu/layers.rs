//! The layers: what each launches forward, and on the way back.

use super::{Arg, Gpu, Sizes, cudnn, shaped};
use crate::builder::Weight;
use crate::error::Result;
use crate::kernel::conv::Geo;
use crate::kernel::norm::{Dims, Post};
use crate::kernel::pool::Map;
use crate::tape::{Node, Tape};
use candle_core::Tensor;

/// Columns up to this many bytes are kept for the way back. Larger ones are gathered again, or left to cuDNN.
pub(super) const KEPT: usize = 64 << 20;
/// Numbers that a block of a gather makes, about.
const GATHERED: usize = 2048;

/// Which rows meet which weights, and in which number type.
#[derive(Clone, Copy)]
struct Way {
    sizes: Sizes,
    transposed: bool,
    bf16: bool,
    taps: usize,
    /// Channels, and rows of a sample, of the input and of the result.
    from: usize,
    to: usize,
    from_rows: usize,
    to_rows: usize,
    batch: usize,
    /// Every row reads itself alone.
    itself: bool,
}

impl Way {
    fn new(g: &Geo, transposed: bool, bf16: bool) -> Self {
        let (wide, narrow) = ((g.c, g.h * g.w), (g.n, g.out_h() * g.out_w()));
        let ((from, from_rows), (to, to_rows)) = if transposed { (narrow, wide) } else { (wide, narrow) };
        let itself = g.kh * g.kw == 1 && g.sh == 1 && g.sw == 1 && g.ph == 0 && g.pw == 0;
        let (sizes, taps, batch) = (Sizes::new(g), g.kh * g.kw, g.b);
        Self { sizes, transposed, bf16, taps, from, to, from_rows, to_rows, batch, itself }
    }

    fn rows(&self) -> usize {
        self.batch * self.to_rows
    }

    fn factor(&self, gpu: &Gpu, x: &Tensor) -> Result<Tensor> {
        Ok(if self.bf16 { gpu.bf16(x)? } else { x.clone() })
    }

    /// The rows under the taps, side by side.
    fn columns(&self, gpu: &Gpu, x: &Tensor) -> Result<Tensor> {
        if self.itself {
            return self.factor(gpu, x);
        }
        let (c, rows, wide) = (self.from, self.rows(), self.taps * self.from);
        let four = c % 4 == 0 && gpu.address(x)?.is_multiple_of(16);
        let name = match (self.transposed, self.bf16, four) {
            (false, false, false) => "under_f32_1",
            (false, false, true) => "under_f32_4",
            (false, true, false) => "under_bf16_1",
            (false, true, true) => "under_bf16_4",
            (true, false, false) => "over_f32_1",
            (true, false, true) => "over_f32_4",
            (true, true, false) => "over_bf16_1",
            (true, true, true) => "over_bf16_4",
        };
        let y = if self.bf16 { gpu.empty_bf16((rows, wide))? } else { gpu.empty((rows, wide))? };
        let per = (GATHERED / (if four { wide / 4 } else { wide })).max(1);
        let sizes = [Arg::I(c), Arg::I(self.to_rows), Arg::I(self.from_rows), Arg::I(rows), Arg::I(per)];
        let arguments = [Arg::T(x), Arg::T(&y), Arg::G(&self.sizes)].into_iter().chain(sizes);
        gpu.launch(name, rows.div_ceil(per), (256, 1), 0, &arguments.collect::<Vec<_>>())?;
        Ok(y)
    }

    /// The gradient of the input, from that of [`Way::columns`].
    fn collected(&self, gpu: &Gpu, d: Tensor, shape: &[usize]) -> Result<Tensor> {
        if self.itself {
            return shaped(&d, shape);
        }
        let (c, rows) = (self.from, self.batch * self.from_rows);
        let four = c % 4 == 0;
        let name = match (self.transposed, self.bf16, four) {
            (false, false, false) => "collect_under_f32_1",
            (false, false, true) => "collect_under_f32_4",
            (false, true, false) => "collect_under_bf16_1",
            (false, true, true) => "collect_under_bf16_4",
            (true, false, false) => "collect_over_f32_1",
            (true, false, true) => "collect_over_f32_4",
            (true, true, false) => "collect_over_bf16_1",
            (true, true, true) => "collect_over_bf16_4",
        };
        let dx = gpu.empty(shape)?;
        let per = (GATHERED / 4 / (if four { c / 4 } else { c })).max(1);
        let sizes = [Arg::I(c), Arg::I(self.to_rows), Arg::I(self.from_rows), Arg::I(rows), Arg::I(per)];
        let arguments = [Arg::T(&d), Arg::T(&dx), Arg::G(&self.sizes)].into_iter().chain(sizes);
        gpu.launch(name, rows.div_ceil(per), (256, 1), 0, &arguments.collect::<Vec<_>>())?;
        Ok(dx)
    }
}

/// A convolution, a linear layer, or with `transposed` the input gradient of the convolution `g` as a layer.
pub(crate) fn convolution(
    tape: &mut Tape,
    x: Node,
    (weight, bias): (&Weight, Option<&Weight>),
    g: &Geo,
    transposed: bool,
    shape: Vec<usize>,
) -> Result<Node> {
    let way = Way::new(g, transposed, weight.bf16);
    let xt = tape.tensor(x)?.clone();
    let gpu = Gpu::of(&xt)?;
    if !transposed && let Some(plan) = cudnn::plan(&gpu, g, &xt, way.bf16)? {
        return cudnn::convolution(tape, x, (weight, bias), plan, shape);
    }
    let columns = way.columns(&gpu, &xt)?;
    let w = way.factor(&gpu, &weight.tensor.detach())?;
    let y = gpu.empty(shape)?;
    let (m, k, n) = (way.rows(), way.taps * way.from, way.to);
    gpu.product((&columns, &w, &y), (m, k, n), (false, false))?;
    if let Some(bias) = bias {
        let all = y.elem_count();
        gpu.each("add_bias", all, &[Arg::T(&y), Arg::T(&bias.tensor.detach()), Arg::N(all), Arg::I(n)])?;
    }
    let size = if way.bf16 { 2 } else { 4 };
    let kept = (way.itself || columns.elem_count() * size <= KEPT).then_some(columns);
    let (weight, bias) = (weight.clone(), bias.cloned());
    let (wanted, trained) = (tape.grad(x), weight.train || bias.as_ref().is_some_and(|b| b.train));
    Ok(tape.push_device(y, wanted || trained, move |dy, flow| {
        let gpu = flow.gpu.clone();
        let d = way.factor(&gpu, dy)?;
        if weight.train {
            let columns = kept.map_or_else(|| way.columns(&gpu, &xt), Ok)?;
            let dw = gpu.empty(weight.tensor.shape())?;
            gpu.product((&columns, &d, &dw), (k, m, n), (true, false))?;
            flow.weight(&weight, dw);
        }
        if let Some(bias) = bias.filter(|b| b.train) {
            let sums = gpu.column_sums(dy, n)?;
            flow.weight(&bias, sums);
        }
        if wanted {
            // What is summed again may be rounded first; what leaves is f32.
            let rounded = way.bf16 && !way.itself;
            let dc = if rounded { gpu.empty_bf16((m, k))? } else { gpu.empty((m, k))? };
            gpu.product((&d, &w, &dc), (m, n, k), (false, true))?;
            flow.add(x, way.collected(&gpu, dc, xt.dims())?)?;
        }
        Ok(())
    }))
}

/// Group normalisation with what follows it.
pub(crate) fn group_norm(
    tape: &mut Tape,
    x: Node,
    other: Option<Node>,
    (gain, bias): (&Weight, &Weight),
    post: Post,
    dims: &Dims,
) -> Result<Node> {
    let (xt, extra) = (tape.tensor(x)?.clone(), other.map(|o| tape.tensor(o).cloned()).transpose()?);
    let gpu = Gpu::of(&xt)?;
    let Dims { b, s, c, groups } = *dims;
    let (y, stats) = (gpu.empty(xt.shape())?, gpu.empty((b, groups, 2))?);
    // Four numbers a thread, in whole warps, and no fewer than a row of the group.
    let threads = (s * (c / groups) / 4).max(c / groups).next_power_of_two().clamp(32, 1024) as u32;
    let code = match post {
        Post::None => 0,
        Post::Relu => 1,
        Post::AddRelu => 2,
        Post::Mish => 3,
        Post::MishFilm => 4,
        Post::MishAdd => 5,
    };
    let sizes = || [Arg::I(s), Arg::I(c), Arg::I(groups), Arg::I(code)].into_iter();
    let (gt, bt) = (gain.tensor.detach(), bias.tensor.detach());
    let arguments =
        [Arg::T(&xt), Arg::T(&gt), Arg::T(&bt), Arg::Maybe(extra.as_ref()), Arg::T(&y), Arg::T(&stats)];
    let arguments: Vec<_> = arguments.into_iter().chain(sizes()).collect();
    gpu.launch("norm_forward", b * groups, (threads, 1), 0, &arguments)?;
    let (gain, bias, yt) = (gain.clone(), bias.clone(), y.clone());
    let (wanted, other) = (tape.grad(x), other.filter(|o| tape.grad(*o)));
    let something = wanted || other.is_some() || gain.train;
    Ok(tape.push_device(y, something, move |dy, flow| {
        let gpu = flow.gpu.clone();
        let sums = gpu.empty((b, 2 * c))?;
        let dx = wanted.then(|| gpu.empty(xt.shape())).transpose()?;
        // What is added after the activation has the gradient of the result.
        let apart = extra.as_ref().filter(|_| other.is_some() && post != Post::MishAdd);
        let d_extra = apart.map(|e| gpu.empty(e.shape())).transpose()?;
        let arguments = [
            Arg::T(&xt),
            Arg::T(&yt),
            Arg::T(&gt),
            Arg::T(&bt),
            Arg::Maybe(extra.as_ref()),
            Arg::T(&stats),
            Arg::T(dy),
            Arg::Maybe(dx.as_ref()),
            Arg::T(&sums),
            Arg::Maybe(d_extra.as_ref()),
        ];
        let sizes = [Arg::I(s), Arg::I(c), Arg::I(groups), Arg::I(code)];
        let arguments: Vec<_> = arguments.into_iter().chain(sizes).collect();
        gpu.launch("norm_backward", b * groups, (threads, 1), 16 * threads, &arguments)?;
        if gain.train {
            let both = gpu.column_sums(&sums, 2 * c)?;
            flow.weight(&gain, both.narrow(0, 0, c)?);
            flow.weight(&bias, both.narrow(0, c, c)?);
        }
        if let Some(other) = other {
            flow.add(other, d_extra.unwrap_or_else(|| dy.clone()))?;
        }
        match dx {
            Some(dx) => flow.add(x, dx),
            None => Ok(()),
        }
    }))
}

/// A function of each number, whose gradient reads its input or, with `of_result`, its result.
fn elementwise(
    tape: &mut Tape,
    x: Node,
    (forward, backward): (&'static str, &'static str),
    of_result: bool,
) -> Result<Node> {
    let xt = tape.tensor(x)?.clone();
    let gpu = Gpu::of(&xt)?;
    let (y, n) = (gpu.empty(xt.shape())?, xt.elem_count());
    gpu.each(forward, n, &[Arg::T(&xt), Arg::T(&y), Arg::N(n)])?;
    let (wanted, read) = (tape.grad(x), if of_result { y.clone() } else { xt });
    Ok(tape.push_device(y, wanted, move |dy, flow| {
        let dx = flow.gpu.empty(read.shape())?;
        flow.gpu.each(backward, n, &[Arg::T(&read), Arg::T(dy), Arg::T(&dx), Arg::N(n)])?;
        flow.add(x, dx)
    }))
}

pub(crate) fn mish(tape: &mut Tape, x: Node) -> Result<Node> {
    elementwise(tape, x, ("mish_forward", "mish_backward"), false)
}

pub(crate) fn relu(tape: &mut Tape, x: Node) -> Result<Node> {
    elementwise(tape, x, ("relu_forward", "relu_backward"), true)
}

pub(crate) fn add(tape: &mut Tape, a: Node, b: Node) -> Result<Node> {
    let y = Gpu::of(tape.tensor(a)?)?.add(tape.tensor(a)?, tape.tensor(b)?)?;
    let wanted = [a, b].map(|n| tape.grad(n));
    Ok(tape.push_device(y, wanted != [false, false], move |dy, flow| {
        for (n, _) in [a, b].into_iter().zip(wanted).filter(|(_, w)| *w) {
            flow.add(n, dy.clone())?;
        }
        Ok(())
    }))
}

pub(crate) fn masked(tape: &mut Tape, x: Node, mask: Vec<f32>) -> Result<Node> {
    let xt = tape.tensor(x)?;
    let (gpu, mask) = (Gpu::of(xt)?, Tensor::from_vec(mask, xt.shape(), xt.device())?);
    let product = move |gpu: &Gpu, x: &Tensor, mask: &Tensor| -> Result<Tensor> {
        let (y, n) = (gpu.empty(x.shape())?, x.elem_count());
        gpu.each("multiply", n, &[Arg::T(x), Arg::T(mask), Arg::T(&y), Arg::N(n)])?;
        Ok(y)
    };
    let y = product(&gpu, xt, &mask)?;
    let wanted = tape.grad(x);
    Ok(tape.push_device(y, wanted, move |dy, flow| {
        let dx = product(&flow.gpu, dy, &mask)?;
        flow.add(x, dx)
    }))
}

pub(crate) fn film(tape: &mut Tape, x: Node, e: Node, steps: usize, c: usize) -> Result<Node> {
    let (xt, et) = (tape.tensor(x)?.clone(), tape.tensor(e)?.clone());
    let gpu = Gpu::of(&xt)?;
    let (y, n) = (gpu.empty(xt.shape())?, xt.elem_count());
    gpu.each(
        "film_forward",
        n,
        &[Arg::T(&xt), Arg::T(&et), Arg::T(&y), Arg::N(n), Arg::I(steps), Arg::I(c)],
    )?;
    let wanted = [x, e].map(|n| tape.grad(n));
    Ok(tape.push_device(y, wanted != [false, false], move |dy, flow| {
        let (dx, de, n) = (flow.gpu.empty(xt.shape())?, flow.gpu.empty(et.shape())?, n / steps);
        let tensors = [Arg::T(&xt), Arg::T(&et), Arg::T(dy), Arg::T(&dx), Arg::T(&de)];
        let sizes = [Arg::N(n), Arg::I(steps), Arg::I(c)];
        flow.gpu.each("film_backward", n, &tensors.into_iter().chain(sizes).collect::<Vec<_>>())?;
        if wanted[0] {
            flow.add(x, dx)?;
        }
        if wanted[1] {
            flow.add(e, de)?;
        }
        Ok(())
    }))
}

/// Joins parts, each with its width, along the last axis; `shape` is the result's.
pub(crate) fn concat(tape: &mut Tape, parts: &[(Node, usize)], shape: &[usize]) -> Result<Node> {
    let width = shape.last().copied().unwrap_or(1);
    let mut y = None;
    let (mut at, mut back) = (0, Vec::new());
    for (node, w) in parts {
        let x = tape.tensor(*node)?;
        let gpu = Gpu::of(x)?;
        let y = match &y {
            Some(y) => y,
            None => y.insert(gpu.empty(shape)?),
        };
        let n = x.elem_count();
        gpu.each("join", n, &[Arg::T(x), Arg::T(y), Arg::N(n), Arg::I(*w), Arg::I(width), Arg::I(at)])?;
        if tape.grad(*node) {
            back.push((*node, x.shape().clone(), *w, at));
        }
        at += w;
    }
    let Some(y) = y else { return Err(crate::Error::NotRecording) };
    Ok(tape.push_device(y, !back.is_empty(), move |dy, flow| {
        for (node, shape, w, at) in back {
            let n = shape.elem_count();
            let dx = flow.gpu.empty(shape)?;
            flow.gpu.each(
                "split",
                n,
                &[Arg::T(dy), Arg::T(&dx), Arg::N(n), Arg::I(w), Arg::I(width), Arg::I(at)],
            )?;
            flow.add(node, dx)?;
        }
        Ok(())
    }))
}

pub(crate) fn repeat_rows(tape: &mut Tape, x: Node, times: usize) -> Result<Node> {
    let xt = tape.tensor(x)?.clone();
    let (b, w) = xt.dims2()?;
    let gpu = Gpu::of(&xt)?;
    let (y, n) = (gpu.empty((b * times, w))?, b * times * w);
    gpu.each("repeat_forward", n, &[Arg::T(&xt), Arg::T(&y), Arg::N(n), Arg::I(times), Arg::I(w)])?;
    let wanted = tape.grad(x);
    Ok(tape.push_device(y, wanted, move |dy, flow| {
        let dx = flow.gpu.empty((b, w))?;
        flow.gpu.each(
            "repeat_backward",
            b * w,
            &[Arg::T(dy), Arg::T(&dx), Arg::N(b * w), Arg::I(times), Arg::I(w)],
        )?;
        flow.add(x, dx)
    }))
}

pub(crate) fn max_pool(tape: &mut Tape, x: Node, m: &Map) -> Result<Node> {
    let xt = tape.tensor(x)?.clone();
    let gpu = Gpu::of(&xt)?;
    let p = m.pooled();
    let g = Geo { b: m.b, h: m.h, w: m.w, c: m.c, n: m.c, kh: 3, kw: 3, sh: 2, sw: 2, ph: 1, pw: 1 };
    let (sizes, n) = (Sizes::new(&g), p.b * p.h * p.w * p.c);
    let y = gpu.empty((p.b, p.h, p.w, p.c))?;
    gpu.each("max_forward", n, &[Arg::T(&xt), Arg::T(&y), Arg::G(&sizes), Arg::N(n)])?;
    let (wanted, yt) = (tape.grad(x), y.clone());
    Ok(tape.push_device(y, wanted, move |dy, flow| {
        let (dx, n) = (flow.gpu.empty(xt.shape())?, xt.elem_count());
        let arguments = [Arg::T(&xt), Arg::T(&yt), Arg::T(dy), Arg::T(&dx), Arg::G(&sizes), Arg::N(n)];
        flow.gpu.each("max_backward", n, &arguments)?;
        flow.add(x, dx)
    }))
}

/// Expected positions (b, 2c) of logits (b, h, w, c).
pub(crate) fn keypoints(tape: &mut Tape, logits: Node, m: &Map) -> Result<Node> {
    let xt = tape.tensor(logits)?.clone();
    let gpu = Gpu::of(&xt)?;
    let (h, w, c, pairs) = (m.h, m.w, m.c, m.b * m.c);
    let (attention, y) = (gpu.empty(xt.shape())?, gpu.empty((m.b, 2 * c))?);
    let sizes = move || [Arg::I(h), Arg::I(w), Arg::I(c)].into_iter();
    let tensors = [Arg::T(&xt), Arg::T(&attention), Arg::T(&y)];
    gpu.each(
        "keypoints_forward",
        pairs,
        &tensors.into_iter().chain(sizes()).chain([Arg::N(pairs)]).collect::<Vec<_>>(),
    )?;
    let (wanted, yt) = (tape.grad(logits), y.clone());
    Ok(tape.push_device(y, wanted, move |dy, flow| {
        let (dx, n) = (flow.gpu.empty(attention.shape())?, attention.elem_count());
        let tensors = [Arg::T(&attention), Arg::T(&yt), Arg::T(dy), Arg::T(&dx)];
        let all: Vec<_> = tensors.into_iter().chain(sizes()).chain([Arg::N(n)]).collect();
        flow.gpu.each("keypoints_backward", n, &all)?;
        flow.add(logits, dx)
    }))
}

/// The weighted sum of squared differences times `scale`; `weights` for rows of `width`, or none.
pub(crate) fn squared_error(
    tape: &mut Tape,
    (a, b): (Node, Node),
    weights: &[f32],
    width: usize,
    scale: f32,
) -> Result<Node> {
    let (at, bt) = (tape.tensor(a)?.clone(), tape.tensor(b)?.clone());
    let gpu = Gpu::of(&at)?;
    let given = !weights.is_empty();
    let weights = given.then(|| Tensor::from_slice(weights, weights.len(), at.device())).transpose()?;
    let (y, n) = (gpu.empty(())?, at.elem_count());
    let tensors = [Arg::T(&at), Arg::T(&bt), Arg::Maybe(weights.as_ref()), Arg::T(&y)];
    let sizes = [Arg::N(n), Arg::I(width), Arg::F(scale)];
    let all: Vec<_> = tensors.into_iter().chain(sizes).collect();
    gpu.launch("squared_error", 1, (1024, 1), 0, &all)?;
    let wanted = [a, b].map(|n| tape.grad(n));
    Ok(tape.push_device(y, wanted != [false, false], move |dy, flow| {
        let pairs = [(a, &at, &bt), (b, &bt, &at)];
        for ((node, x, y), _) in pairs.into_iter().zip(wanted).filter(|(_, w)| *w) {
            let dx = flow.gpu.empty(x.shape())?;
            let tensors = [Arg::T(x), Arg::T(y), Arg::Maybe(weights.as_ref()), Arg::T(dy), Arg::T(&dx)];
            let sizes = [Arg::N(n), Arg::I(width), Arg::F(scale)];
            let all: Vec<_> = tensors.into_iter().chain(sizes).collect();
            flow.gpu.each("squared_error_backward", n, &all)?;
            flow.add(node, dx)?;
        }
        Ok(())
    }))
}
