//! Convolutions as sums of matrix products, one a tap, over rows that are found through pointers: no patches are copied.
//!
//! Weights lie in panels of columns ([`panel`]): `(n / width, taps, c, width)`. A product reads a panel from front to back,
//! where rows a power of two apart would fall into the same few places of the caches.

use super::micro::{Isa, MAX_ROWS, Outer, Rows, Start};
use super::{add_assign, made, threads};
use rayon::prelude::*;
use std::ptr::null;

/// Tiles of rows in a task: as many as share a panel of the matrix while it is in the second-level cache.
const TILES: usize = 8;
/// Below so many tasks over the rows, the columns are shared out too.
const TASKS: usize = 8;
/// Multiplications from which another thread is worth waking.
const WORTHWHILE: usize = 1 << 18;
/// Positions of a weight gradient that are summed before the next block of it.
const BLOCK: usize = 256;
/// From so many numbers on, a weight gradient is shared out by its own numbers; below, by positions.
const LARGE: usize = 1 << 16;
/// Into how many sums a small weight gradient is split.
const PARTS: usize = 8;
/// Below so many channels the taps of a row are read as one run, from a copy with its border.
const NARROW: usize = 16;

/// Sizes of a convolution from `(b, h, w, c)` to `(b, out_h, out_w, n)`. One dimension: `h` and `kh` are 1.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Geo {
    pub(crate) b: usize,
    pub(crate) h: usize,
    pub(crate) w: usize,
    pub(crate) c: usize,
    pub(crate) n: usize,
    pub(crate) kh: usize,
    pub(crate) kw: usize,
    pub(crate) sh: usize,
    pub(crate) sw: usize,
    pub(crate) ph: usize,
    pub(crate) pw: usize,
}

impl Geo {
    /// A product of `rows` rows of `c` with a matrix of `c` by `n`.
    pub(crate) fn linear(rows: usize, c: usize, n: usize) -> Self {
        Self { b: rows, h: 1, w: 1, c, n, kh: 1, kw: 1, sh: 1, sw: 1, ph: 0, pw: 0 }
    }
    pub(crate) fn out_h(&self) -> usize {
        (self.h + 2 * self.ph).saturating_sub(self.kh) / self.sh + 1
    }
    pub(crate) fn out_w(&self) -> usize {
        (self.w + 2 * self.pw).saturating_sub(self.kw) / self.sw + 1
    }
    /// Output positions of one sample.
    fn per(&self) -> usize {
        self.out_h() * self.out_w()
    }
    /// Output positions of all samples.
    fn m(&self) -> usize {
        self.b * self.per()
    }
    /// Numbers of a sample of the input.
    fn size(&self) -> usize {
        self.h * self.w * self.c
    }
    fn taps(&self) -> usize {
        self.kh * self.kw
    }
    /// The padded input covers the kernel, or taps would lie outside it; and places in a sample fit [`narrow`].
    fn check(&self) {
        let (h, w) = (self.h + 2 * self.ph, self.w + 2 * self.pw);
        assert!(self.sh > 0 && self.sw > 0 && self.taps() > 0, "strides and taps of {self:?}");
        assert!(self.kh <= h && self.kw <= w, "a kernel larger than the padded input: {self:?}");
        assert!(
            u32::try_from((h * w * self.c).max(self.per() * self.n)).is_ok(),
            "too large a sample: {self:?}"
        );
    }
}

/// The positions of a result that sum over the same taps.
struct Class {
    taps: Vec<usize>,
    /// For each tap, for each position: where the row begins in its sample, or none.
    from: Vec<Option<u32>>,
    /// For each position: where its row begins in its sample of the result.
    to: Vec<u32>,
}

impl Class {
    /// Calls `f(i, pointer)` for the row of tap number `t` that each of the rows `rows` of all samples reads.
    #[inline(always)]
    fn gather(
        &self,
        t: usize,
        rows: std::ops::Range<usize>,
        (src, size): (&[f32], usize),
        zero: &[f32],
        mut f: impl FnMut(usize, *const f32),
    ) {
        let positions = self.to.len();
        let from = &self.from[t * positions..][..positions];
        let (mut sample, mut position) = (rows.start / positions, rows.start % positions);
        let mut base = src[(sample * size).min(src.len())..].as_ptr();
        for i in 0..rows.len() {
            // In bounds: `product` and `outer` check `src` against the samples, and `from` stays inside one.
            f(i, from[position].map_or(zero.as_ptr(), |o| base.wrapping_add(o as usize)));
            position += 1;
            if position == positions {
                (sample, position) = (sample + 1, 0);
                base = src[(sample * size).min(src.len())..].as_ptr();
            }
        }
    }
}

#[allow(clippy::cast_possible_truncation, reason = "a sample has fewer than 2^32 numbers: `Geo::check`")]
fn narrow(x: usize) -> u32 {
    x as u32
}

/// Which input rows every output position reads.
fn reach(g: &Geo) -> Class {
    let (oh, ow) = (g.out_h(), g.out_w());
    let mut from = Vec::with_capacity(g.taps() * g.per());
    for tap in 0..g.taps() {
        for oy in 0..oh {
            let y = (oy * g.sh + tap / g.kw).checked_sub(g.ph).filter(|y| *y < g.h);
            for ox in 0..ow {
                let x = (ox * g.sw + tap % g.kw).checked_sub(g.pw).filter(|x| *x < g.w);
                from.push(y.zip(x).map(|(y, x)| narrow((y * g.w + x) * g.c)));
            }
        }
    }
    Class { taps: (0..g.taps()).collect(), from, to: (0..g.per()).map(|p| narrow(p * g.n)).collect() }
}

/// Which rows of the gradient of the output every input position reads: one class for every remainder of the strides.
fn reach_back(g: &Geo) -> Vec<Class> {
    let (oh, ow) = (g.out_h(), g.out_w());
    // Output coordinate that tap `k` connects with input coordinate `i`.
    let meets = |i: usize, k: usize, pad: usize, stride: usize, out: usize| {
        (i + pad).checked_sub(k).map(|d| d / stride).filter(|o| *o < out)
    };
    let mut all = Vec::with_capacity(g.sh * g.sw);
    for (ry, rx) in (0..g.sh.min(g.h)).flat_map(|y| (0..g.sw.min(g.w)).map(move |x| (y, x))) {
        let fits = |tap: &usize| {
            let same = |r: usize, pad: usize, k: usize, s: usize| (r + pad) % s == k % s;
            same(ry, g.ph, tap / g.kw, g.sh) && same(rx, g.pw, tap % g.kw, g.sw)
        };
        let taps: Vec<usize> = (0..g.taps()).filter(fits).collect();
        let positions = || (ry..g.h).step_by(g.sh).flat_map(|y| (rx..g.w).step_by(g.sw).map(move |x| (y, x)));
        let mut from = Vec::new();
        for tap in &taps {
            from.extend(positions().map(|(y, x)| {
                let (oy, ox) = (meets(y, tap / g.kw, g.ph, g.sh, oh), meets(x, tap % g.kw, g.pw, g.sw, ow));
                oy.zip(ox).map(|(y, x)| narrow((y * ow + x) * g.n))
            }));
        }
        all.push(Class { taps, from, to: positions().map(|(y, x)| narrow((y * g.w + x) * g.c)).collect() });
    }
    all
}

/// For few channels: the input with its border, and the convolution over it whose taps are whole rows of a patch.
fn merged(x: &[f32], g: &Geo) -> Option<(Vec<f32>, usize, Class)> {
    if g.c >= NARROW || g.kw == 1 {
        return None;
    }
    let (h, w) = (g.h + 2 * g.ph, g.w + 2 * g.pw);
    let size = h * w * g.c;
    let mut wide = vec![0.0; g.b * size];
    super::each(&mut wide, size, |i, wide| {
        for y in 0..g.h {
            let row = &x[i * g.size() + y * g.w * g.c..][..g.w * g.c];
            wide[((y + g.ph) * w + g.pw) * g.c..][..row.len()].copy_from_slice(row);
        }
    });
    let mut from = Vec::with_capacity(g.kh * g.per());
    for ky in 0..g.kh {
        for oy in 0..g.out_h() {
            from.extend((0..g.out_w()).map(|ox| Some(narrow(((oy * g.sh + ky) * w + ox * g.sw) * g.c))));
        }
    }
    let to = (0..g.per()).map(|p| narrow(p * g.n)).collect();
    Some((wide, size, Class { taps: (0..g.kh).collect(), from, to }))
}

/// A place that tasks write different parts of.
#[derive(Clone, Copy)]
struct Place(*mut f32);
// SAFETY: every task writes rows and columns of its own.
unsafe impl Send for Place {}
// SAFETY: as above.
unsafe impl Sync for Place {}
impl Place {
    fn at(self, i: usize) -> *mut f32 {
        self.0.wrapping_add(i)
    }
}

/// What a result is the product of.
struct Product<'a> {
    src: &'a [f32],
    /// Numbers of a sample of `src`, and of the result.
    src_size: usize,
    size: usize,
    samples: usize,
    /// Matrices `k` by `n`, one a tap, in panels.
    w: &'a [f32],
    taps: usize,
    k: usize,
    n: usize,
    bias: Option<&'a [f32]>,
}

/// `n` split as evenly as can be into parts of at most `most`: part `i` of `parts`.
fn share(n: usize, parts: usize, i: usize) -> std::ops::Range<usize> {
    let (each, more) = (n / parts, n % parts);
    let first = i * each + i.min(more);
    first..first + each + usize::from(i < more)
}

fn for_each(tasks: usize, work: usize, f: impl Fn(usize) + Sync + Send) {
    if tasks > 1 && work >= WORTHWHILE && threads() > 1 {
        (0..tasks).into_par_iter().for_each(f);
    } else {
        (0..tasks).for_each(f);
    }
}

/// The instruction set for rows of `n` numbers.
fn isa_for(isa: Isa, n: usize) -> Isa {
    match isa {
        #[cfg(target_arch = "x86_64")]
        Isa::Avx512 if n < 16 => Isa::Avx2,
        isa => isa,
    }
}

/// Columns in a panel of a matrix of `n`.
pub(crate) fn panel(n: usize) -> usize {
    [32, 16].into_iter().find(|w| n.is_multiple_of(*w)).unwrap_or(n)
}

/// Copies between a matrix of `n` columns row by row and its panels: into them, or with `out` back.
pub(crate) fn in_panels(x: &[f32], n: usize, out: bool) -> Vec<f32> {
    let width = panel(n);
    let rows = x.len() / n.max(1);
    debug_assert_eq!(x.len(), rows * n, "numbers in rows of {n}");
    let mut y = Vec::with_capacity(x.len());
    let (first, second) = if out { (rows, n / width) } else { (n / width, rows) };
    for (a, b) in (0..first).flat_map(|a| (0..second).map(move |b| (a, b))) {
        let from = if out { (b * rows + a) * width } else { b * n + a * width };
        y.extend_from_slice(&x[from..from + width]);
    }
    y
}

/// The matrices of all taps transposed, `rows` by `cols` to `cols` by `rows`, panels to panels.
fn flip(w: &[f32], taps: usize, rows: usize, cols: usize) -> Vec<f32> {
    let (rw, cw) = (panel(rows), panel(cols));
    debug_assert_eq!(w.len(), taps * rows * cols, "numbers of {taps} matrices {rows} by {cols}");
    made(w.len(), cols * rw, |i, y| {
        let (r0, t) = (i / taps * rw, i % taps);
        for (p, y) in y.chunks_exact_mut(cw * rw).enumerate() {
            let block = &w[((p * taps + t) * rows + r0) * cw..][..rw * cw];
            for (j, y) in y.chunks_exact_mut(rw).enumerate() {
                for (y, row) in y.iter_mut().zip(block.chunks_exact(cw)) {
                    *y = row[j];
                }
            }
        }
    })
}

/// Room for `n` numbers; in debug builds each is [`MARK`].
fn room(n: usize) -> Vec<f32> {
    let mut v = Vec::with_capacity(n);
    if cfg!(debug_assertions) {
        v.spare_capacity_mut()[..n].fill(std::mem::MaybeUninit::new(f32::from_bits(MARK)));
    }
    v
}

/// Bits of a NaN that no sum has.
const MARK: u32 = 0x7fc0_e2e2;

/// The `n` numbers of a [`room`].
///
/// # Safety
/// All of them were written.
unsafe fn written(mut v: Vec<f32>, n: usize) -> Vec<f32> {
    // SAFETY: by the contract; `room` made the capacity.
    unsafe { v.set_len(n) };
    debug_assert!(v.iter().all(|v| v.to_bits() != MARK), "a number that no task wrote");
    v
}

/// The last columns of rows of `width`, padded to `lanes`.
fn padded(x: &[f32], width: usize, first: usize, lanes: usize) -> Vec<f32> {
    let mut out = vec![0.0; x.len() / width.max(1) * lanes];
    for (o, x) in out.chunks_exact_mut(lanes).zip(x.chunks_exact(width)) {
        o[..width - first].copy_from_slice(&x[first..]);
    }
    out
}

fn product(isa: Isa, classes: &[Class], p: &Product<'_>) -> Vec<f32> {
    let isa = isa_for(isa, p.n);
    let lanes = isa.lanes();
    let width = panel(p.n);
    // Only a matrix of one panel can have columns that fill no register.
    let whole = width / lanes * lanes;
    let rest = width - whole;
    assert!(
        p.w.len() == p.taps * p.k * p.n && p.src.len() == p.samples * p.src_size,
        "product outside its slices: {} and {} numbers for {} taps of {} by {}, {} samples of {}",
        p.w.len(),
        p.src.len(),
        p.taps,
        p.k,
        p.n,
        p.samples,
        p.src_size
    );
    assert!(p.bias.is_none_or(|b| b.len() == p.n), "a bias of {:?} for {}", p.bias.map(<[f32]>::len), p.n);
    let covered: usize = classes.iter().map(|c| c.to.len() * p.n).sum();
    assert_eq!(covered, p.size, "numbers of a sample that some class computes");
    let tail = if rest > 0 { padded(p.w, width, whole, lanes) } else { Vec::new() };
    let tail_bias = p.bias.filter(|_| rest > 0).map(|b| padded(b, width, whole, lanes));
    let zero = vec![0.0; p.k];
    let mut y = room(p.samples * p.size);
    let place = Place(y.as_mut_ptr());
    let per_panel = width.div_ceil(2 * lanes);
    let strips = p.n / width * per_panel;
    for class in classes {
        let positions = class.to.len();
        let rows = p.samples * positions;
        if rows == 0 {
            continue;
        }
        let chunks = rows.div_ceil(TILES * isa.rows());
        let groups = TASKS.div_ceil(chunks).min(strips);
        let count = class.taps.len();
        let task = |i: usize| {
            let (rows, strips) = (share(rows, chunks, i / groups), share(strips, groups, i % groups));
            let tiles = rows.len().div_ceil(isa.rows());
            let mut at = vec![null(); tiles * count * MAX_ROWS];
            let mut to = vec![place.at(0); tiles * MAX_ROWS];
            for tile in 0..tiles {
                let own = share(rows.len(), tiles, tile);
                let own = rows.start + own.start..rows.start + own.end;
                for t in 0..count {
                    let at = &mut at[(tile * count + t) * MAX_ROWS..][..MAX_ROWS];
                    class.gather(t, own.clone(), (p.src, p.src_size), &zero, |i, row| at[i] = row);
                }
                for (to, r) in to[tile * MAX_ROWS..].iter_mut().zip(own) {
                    *to = place.at(r / positions * p.size + class.to[r % positions] as usize);
                }
            }
            let tails: Vec<*const f32> = if rest > 0 {
                class.taps.iter().map(|t| tail[t * p.k * lanes..].as_ptr()).collect()
            } else {
                Vec::new()
            };
            for strip in strips {
                let (number, first) = (strip / per_panel, strip % per_panel * 2 * lanes);
                let own = &p.w[number * p.taps * p.k * width..];
                let matrices: Vec<*const f32> =
                    class.taps.iter().map(|t| own[t * p.k * width..].as_ptr()).collect();
                let columns = (whole - first.min(whole)).min(2 * lanes) / lanes;
                let column = number * width + first;
                for tile in 0..tiles {
                    let height = share(rows.len(), tiles, tile).len();
                    let (at, to) = (&at[tile * count * MAX_ROWS..], &to[tile * MAX_ROWS..]);
                    if columns > 0 {
                        let t = Rows {
                            taps: count,
                            k: p.k,
                            at: at.as_ptr(),
                            w: matrices.as_ptr(),
                            w_column: first,
                            row_step: width,
                            to: to.as_ptr(),
                            column,
                            start: p.bias.map_or(Start::Zero, |b| Start::Bias(b[column..].as_ptr())),
                        };
                        // SAFETY: rows of `src` and `w` were checked against their slices above, and of the result
                        // each task has rows and columns of its own.
                        unsafe { isa.rows_tile(height, columns, &t) };
                    }
                    if rest > 0 && first + 2 * lanes >= width {
                        let mut own = [0.0f32; MAX_ROWS * 16];
                        let own_to: [*mut f32; MAX_ROWS] =
                            std::array::from_fn(|i| own.as_mut_ptr().wrapping_add(i * 16));
                        let t = Rows {
                            taps: count,
                            k: p.k,
                            at: at.as_ptr(),
                            w: tails.as_ptr(),
                            w_column: 0,
                            row_step: lanes,
                            to: own_to.as_ptr(),
                            column: 0,
                            start: tail_bias.as_ref().map_or(Start::Zero, |b| Start::Bias(b.as_ptr())),
                        };
                        // SAFETY: as above; `own` has room for every row of a register.
                        unsafe { isa.rows_tile(height, 1, &t) };
                        for (to, own) in to[..height].iter().zip(own.chunks_exact(16)) {
                            for (j, v) in own[..rest].iter().enumerate() {
                                // SAFETY: columns of this task's rows.
                                unsafe { *to.add(whole + j) = *v };
                            }
                        }
                    }
                }
            }
        };
        for_each(chunks * groups, rows * count * p.k * p.n, task);
    }
    // SAFETY: the classes cover every row of every sample, once, and the strips every column of a row.
    unsafe { written(y, p.samples * p.size) }
}

/// y = conv(x, w) + bias, with `w` of `(kh, kw, c)` by `n`.
pub(crate) fn forward(x: &[f32], w: &[f32], bias: Option<&[f32]>, g: &Geo) -> Vec<f32> {
    forward_with(Isa::best(), x, w, bias, g)
}

fn forward_with(isa: Isa, x: &[f32], w: &[f32], bias: Option<&[f32]>, g: &Geo) -> Vec<f32> {
    g.check();
    let size = g.per() * g.n;
    let of = |src, src_size, taps, k| Product { src, src_size, size, samples: g.b, w, taps, k, n: g.n, bias };
    match merged(x, g) {
        Some((wide, size, class)) => product(isa, &[class], &of(&wide, size, g.kh, g.kw * g.c)),
        None => product(isa, &[reach(g)], &of(x, g.size(), g.taps(), g.c)),
    }
}

/// The gradient of the input.
pub(crate) fn input_grad(w: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    input_grad_with(Isa::best(), w, dy, g)
}

fn input_grad_with(isa: Isa, w: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    g.check();
    let wt = flip(w, g.taps(), g.c, g.n);
    let p = Product {
        src: dy,
        src_size: g.per() * g.n,
        size: g.size(),
        samples: g.b,
        w: &wt,
        taps: g.taps(),
        k: g.n,
        n: g.c,
        bias: None,
    };
    product(isa, &reach_back(g), &p)
}

/// The gradient of the weights, `(kh, kw, c)` by `n`.
pub(crate) fn weight_grad(x: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    weight_grad_with(Isa::best(), x, dy, g)
}

fn weight_grad_with(isa: Isa, x: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    g.check();
    match merged(x, g) {
        Some((wide, size, class)) => outer(isa, &class, (&wide, size, g.kw * g.c), dy, g),
        None => outer(isa, &reach(g), (x, g.size(), g.c), dy, g),
    }
}

/// For every tap of `class`, the sum over positions of (row of `x`)ᵀ (row of `dy`). `x`: numbers, of a sample, of a row.
fn outer(isa: Isa, class: &Class, x: (&[f32], usize, usize), dy: &[f32], g: &Geo) -> Vec<f32> {
    let (x, size, c) = x;
    let (n, m) = (g.n, g.m());
    let isa = isa_for(isa, n);
    let lanes = isa.lanes();
    let width = panel(n);
    let whole = width / lanes * lanes;
    let tail = if whole < width { padded(dy, n, whole, lanes) } else { Vec::new() };
    let zero = vec![0.0; c];
    let blocks = c.div_ceil(isa.rows());
    assert!(
        dy.len() == m * n && x.len() == g.b * size,
        "weight gradient outside its slices: {} and {} numbers for {g:?}",
        x.len(),
        dy.len()
    );
    let taps = class.taps.len();
    if m == 0 {
        // No block would write them.
        return vec![0.0; taps * c * n];
    }
    // Sums tap `t`, channels `channels`, over the rows of `at` into the gradient at `dw`.
    let block = |at: &[*const f32],
                 r0: usize,
                 t: usize,
                 channels: std::ops::Range<usize>,
                 dw: *mut f32,
                 keep: bool| {
        for number in 0..n / width {
            let to = dw.wrapping_add(((number * taps + t) * c + channels.start) * width);
            let mut t = Outer {
                rows: at.len(),
                at: at.as_ptr(),
                first: channels.start,
                b: null(),
                b_step: n,
                to,
                to_step: width,
                keep,
            };
            for column in (0..whole).step_by(2 * lanes) {
                t.b = dy[r0 * n + number * width + column..].as_ptr();
                t.to = to.wrapping_add(column);
                // SAFETY: `at` holds rows of `c` numbers, `dy` has the rows, and `to` rows of `width` numbers that are this
                // task's own.
                unsafe { isa.outer_tile(channels.len(), ((whole - column) / lanes).min(2), &t) };
            }
            if whole < width {
                let mut own = [0.0f32; MAX_ROWS * 16];
                t = Outer {
                    b: tail[r0 * lanes..].as_ptr(),
                    b_step: lanes,
                    to: own.as_mut_ptr(),
                    to_step: 16,
                    keep: false,
                    ..t
                };
                // SAFETY: as above; `own` has room for every row of a register.
                unsafe { isa.outer_tile(channels.len(), 1, &t) };
                for (i, own) in own.chunks_exact(16).take(channels.len()).enumerate() {
                    for (j, v) in own[..width - whole].iter().enumerate() {
                        let to = to.wrapping_add(i * width + whole + j);
                        // SAFETY: a number of this task's own rows.
                        unsafe { *to = if keep { *to + *v } else { *v } };
                    }
                }
            }
        }
    };
    let rows_of = |at: &mut Vec<*const f32>, t: usize, r0: usize, r1: usize| {
        at.clear();
        class.gather(t, r0..r1, (x, size), &zero, |_, row| at.push(row));
    };
    let work = m * taps * c * n;
    if taps * c * n >= LARGE || m <= BLOCK {
        let mut dw = room(taps * c * n);
        let place = Place(dw.as_mut_ptr());
        for_each(taps * blocks, work, |i| {
            let (t, channels) = (i / blocks, share(c, blocks, i % blocks));
            let mut at = Vec::with_capacity(BLOCK);
            for r0 in (0..m).step_by(BLOCK) {
                rows_of(&mut at, t, r0, (r0 + BLOCK).min(m));
                block(&at, r0, t, channels.clone(), place.at(0), r0 > 0);
            }
        });
        // SAFETY: the first block of positions, of which there is one, writes the blocks of all channels and taps.
        return unsafe { written(dw, taps * c * n) };
    }
    let parts = PARTS.min(m.div_ceil(BLOCK));
    let mut sums = room(parts * taps * c * n);
    let place = Place(sums.as_mut_ptr());
    for_each(parts, work, |part| {
        let rows = share(m, parts, part);
        let mut at = Vec::with_capacity(BLOCK);
        for r0 in rows.clone().step_by(BLOCK) {
            for t in 0..taps {
                rows_of(&mut at, t, r0, (r0 + BLOCK).min(rows.end));
                for channels in (0..blocks).map(|i| share(c, blocks, i)) {
                    block(&at, r0, t, channels.clone(), place.at(part * taps * c * n), r0 > rows.start);
                }
            }
        }
    });
    // SAFETY: as above; no part is without positions, for there are as many blocks at least.
    let mut sums = unsafe { written(sums, parts * taps * c * n) };
    let more = sums.split_off(taps * c * n);
    for part in more.chunks_exact(taps * c * n) {
        add_assign(&mut sums, part);
    }
    sums
}

/// Transposed convolution from `(b, out_h, out_w, n)` to `(b, h, w, c)`: the input gradient of the convolution `g`, here
/// with `w` of `(kh, kw, n)` by `c` and a bias of `c`.
pub(crate) fn transposed_forward(x: &[f32], w: &[f32], bias: &[f32], g: &Geo) -> Vec<f32> {
    transposed_forward_with(Isa::best(), x, w, bias, g)
}

fn transposed_forward_with(isa: Isa, x: &[f32], w: &[f32], bias: &[f32], g: &Geo) -> Vec<f32> {
    g.check();
    let p = Product {
        src: x,
        src_size: g.per() * g.n,
        size: g.size(),
        samples: g.b,
        w,
        taps: g.taps(),
        k: g.n,
        n: g.c,
        bias: Some(bias),
    };
    product(isa, &reach_back(g), &p)
}

/// The gradient of the input of [`transposed_forward`].
pub(crate) fn transposed_input_grad(w: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    forward(dy, &flip(w, g.taps(), g.n, g.c), None, g)
}

/// The gradient of the weights of [`transposed_forward`].
pub(crate) fn transposed_weight_grad(x: &[f32], dy: &[f32], g: &Geo) -> Vec<f32> {
    // The roles of x and dy are those of the plain convolution exchanged, so the result comes out transposed.
    flip(&weight_grad(dy, x, g), g.taps(), g.c, g.n)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn geometries() -> Vec<Geo> {
        let d2 = |b, side, c, n, k, s, p| Geo {
            b,
            h: side,
            w: side + 1,
            c,
            n,
            kh: k,
            kw: k,
            sh: s,
            sw: s,
            ph: p,
            pw: p,
        };
        let d1 = |b, w, c, n, k, s, p| Geo { b, h: 1, w, c, n, kh: 1, kw: k, sh: 1, sw: s, ph: 0, pw: p };
        vec![
            d2(3, 9, 3, 16, 7, 2, 3),
            d2(2, 8, 16, 16, 3, 1, 1),
            d2(2, 7, 17, 33, 3, 2, 1),
            d2(2, 6, 32, 48, 1, 2, 0),
            d2(1, 2, 20, 70, 3, 1, 1),
            d2(40, 5, 16, 24, 3, 1, 1),
            d1(5, 16, 8, 64, 5, 1, 2),
            d1(3, 16, 24, 8, 1, 1, 0),
            d1(2, 8, 40, 40, 3, 2, 1),
            d1(4, 16, 12, 20, 4, 2, 1),
            d1(1, 4, 300, 130, 5, 1, 2),
            Geo::linear(130, 70, 90),
        ]
    }

    fn random(n: usize, rng: &mut ChaCha8Rng) -> Vec<f32> {
        (0..n).map(|_| rng.random::<f32>() - 0.5).collect()
    }

    /// Calls `f(input, output, weight)` with the indices of every product, in `f64` loops.
    fn naive(g: &Geo, mut f: impl FnMut(usize, usize, usize)) {
        for b in 0..g.b {
            for (oy, ox) in (0..g.out_h()).flat_map(|y| (0..g.out_w()).map(move |x| (y, x))) {
                for tap in 0..g.taps() {
                    let y = (oy * g.sh + tap / g.kw).checked_sub(g.ph).filter(|y| *y < g.h);
                    let x = (ox * g.sw + tap % g.kw).checked_sub(g.pw).filter(|x| *x < g.w);
                    let Some((y, x)) = y.zip(x) else { continue };
                    for (c, n) in (0..g.c).flat_map(|c| (0..g.n).map(move |n| (c, n))) {
                        f(
                            ((b * g.h + y) * g.w + x) * g.c + c,
                            ((b * g.out_h() + oy) * g.out_w() + ox) * g.n + n,
                            (tap * g.c + c) * g.n + n,
                        );
                    }
                }
            }
        }
    }

    fn close(what: &str, g: &Geo, isa: Isa, found: &[f32], expected: &[f64]) {
        assert_eq!(found.len(), expected.len());
        let scale = expected.iter().fold(1e-3f64, |m, v| m.max(v.abs()));
        for (i, (a, b)) in found.iter().zip(expected).enumerate() {
            assert!((f64::from(*a) - b).abs() < 2e-6 * scale, "{what} {g:?} {isa:?} at {i}: {a} for {b}");
        }
    }

    #[test]
    fn every_instruction_set_computes_the_plain_sums() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for g in geometries() {
            let x = random(g.b * g.size(), &mut rng);
            let w = random(g.taps() * g.c * g.n, &mut rng);
            let bias = random(g.n, &mut rng);
            let dy = random(g.m() * g.n, &mut rng);
            let mut y: Vec<f64> = (0..dy.len()).map(|i| f64::from(bias[i % g.n])).collect();
            let mut dx = vec![0.0; x.len()];
            let mut dw = vec![0.0; w.len()];
            naive(&g, |i, o, k| {
                y[o] += f64::from(x[i]) * f64::from(w[k]);
                dx[i] += f64::from(dy[o]) * f64::from(w[k]);
                dw[k] += f64::from(dy[o]) * f64::from(x[i]);
            });
            let dw = dw.iter().map(|v| *v as f32).collect::<Vec<_>>();
            let dw: Vec<f64> = in_panels(&dw, g.n, false).into_iter().map(f64::from).collect();
            let w = in_panels(&w, g.n, false);
            // The same numbers as the transposed layer has them: (taps, n) by c.
            let wt = flip(&w, g.taps(), g.c, g.n);
            let bias_c = random(g.c, &mut rng);
            let up: Vec<f64> = dx.iter().enumerate().map(|(i, v)| v + f64::from(bias_c[i % g.c])).collect();
            for isa in Isa::all() {
                close("forward", &g, isa, &forward_with(isa, &x, &w, Some(&bias), &g), &y);
                close("input", &g, isa, &input_grad_with(isa, &w, &dy, &g), &dx);
                close("weight", &g, isa, &weight_grad_with(isa, &x, &dy, &g), &dw);
                close("transposed", &g, isa, &transposed_forward_with(isa, &dy, &wt, &bias_c, &g), &up);
            }
        }
    }

    /// Numbers of a normal distribution, nearly.
    fn normal(n: usize, scale: f32, rng: &mut ChaCha8Rng) -> Vec<f32> {
        (0..n).map(|_| (0..12).map(|_| rng.random::<f32>() - 0.5).sum::<f32>() * scale).collect()
    }

    /// The norm of the difference over the norm.
    fn off(found: &[f32], expected: &[f64]) -> f64 {
        let d: f64 = found.iter().zip(expected).map(|(a, b)| (f64::from(*a) - b).powi(2)).sum();
        (d / expected.iter().map(|v| v * v).sum::<f64>()).sqrt()
    }

    /// Sums over thousands of products, against those in `f64`. torch 2.15 is 2.0e-7 off in results and gradients of inputs,
    /// and 2.3e-6 in such gradients of weights; one sum without blocks is 8.7e-7 and 8.4e-7 off.
    #[test]
    fn long_sums_keep_their_digits() {
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let d2 = |b, h, w, c, n| Geo { b, h, w, c, n, kh: 3, kw: 3, sh: 1, sw: 1, ph: 1, pw: 1 };
        for (g, long) in
            [(d2(2, 3, 2, 512, 48), true), (d2(2, 3, 2, 48, 512), false), (d2(64, 18, 16, 8, 9), false)]
        {
            let x = normal(g.b * g.size(), 1.0, &mut rng);
            let w = normal(g.taps() * g.c * g.n, 0.02, &mut rng);
            let dy = normal(g.m() * g.n, 1.0, &mut rng);
            let (mut y, mut dx, mut dw) = (vec![0.0; dy.len()], vec![0.0; x.len()], vec![0.0; w.len()]);
            naive(&g, |i, o, k| {
                y[o] += f64::from(x[i]) * f64::from(w[k]);
                dx[i] += f64::from(dy[o]) * f64::from(w[k]);
                dw[k] += f64::from(dy[o]) * f64::from(x[i]);
            });
            let w = in_panels(&w, g.n, false);
            for isa in Isa::all() {
                // Without a fused multiplication every product is rounded, too.
                let most = if isa == Isa::Plain && !cfg!(target_arch = "aarch64") { 3.6e-7 } else { 2.6e-7 };
                let check = |what: &str, off: f64, most: f64| {
                    assert!(off < most, "{what} of {g:?} with {isa:?}: off by {off:.1e}");
                };
                if long {
                    check("result", off(&forward_with(isa, &x, &w, None, &g), &y), most);
                } else if g.b < 64 {
                    check("input", off(&input_grad_with(isa, &w, &dy, &g), &dx), most);
                } else {
                    let found = in_panels(&weight_grad_with(isa, &x, &dy, &g), g.n, true);
                    check("weight", off(&found, &dw), 1.5 * most);
                }
            }
        }
    }

    #[test]
    fn nothing_in_gives_nothing_out_and_no_gradient() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        for g in geometries().into_iter().map(|g| Geo { b: 0, ..g }) {
            let w = in_panels(&random(g.taps() * g.c * g.n, &mut rng), g.n, false);
            let bias = random(g.n, &mut rng);
            for isa in Isa::all() {
                // The allocator hands out what was just given back.
                drop(vec![f32::NAN; w.len()]);
                let dw = weight_grad_with(isa, &[], &[], &g);
                assert!(dw.len() == w.len() && dw.iter().all(|v| *v == 0.0), "{g:?} {isa:?}");
                assert!(forward_with(isa, &[], &w, Some(&bias), &g).is_empty());
                assert!(input_grad_with(isa, &w, &[], &g).is_empty());
            }
        }
    }

    /// Calls that would read or write outside their slices are refused in every build.
    #[test]
    fn wrong_sizes_are_refused() {
        let g = Geo { b: 2, h: 4, w: 5, c: 3, n: 20, kh: 3, kw: 3, sh: 1, sw: 1, ph: 0, pw: 0 };
        let (x, w, bias, dy) = (vec![0.0; 120], vec![0.0; 540], vec![0.0; 20], vec![0.0; 240]);
        let refused = |what: &str, f: &(dyn Fn() + std::panic::RefUnwindSafe)| {
            let message = std::panic::catch_unwind(f).unwrap_err();
            let text = message.downcast::<String>().map_or_else(|_| String::new(), |s| *s);
            assert!(text.contains(what), "{what}: {text}");
        };
        drop(forward(&x, &w, Some(&bias), &g));
        refused("bias of Some(19)", &|| drop(forward(&x, &w, Some(&bias[1..]), &g)));
        refused("outside its slices", &|| {
            drop(forward(&x[1..], &w, None, &Geo { c: 16, kh: 1, kw: 1, ..g }))
        });
        refused("outside its slices", &|| drop(forward(&x, &w[..519], None, &g)));
        refused("outside its slices", &|| drop(weight_grad(&x, &dy[1..], &g)));
        let small = Geo { h: 2, ..g };
        refused("larger than the padded input", &|| drop(forward(&x[..60], &w, None, &small)));
        refused("larger than the padded input", &|| drop(weight_grad(&x[..60], &dy, &small)));
        refused("larger than the padded input", &|| drop(input_grad(&w, &dy, &small)));
        refused("larger than the padded input", &|| drop(transposed_forward(&dy, &w, &bias[..3], &small)));
        refused("too large a sample", &|| drop(forward(&x, &w, None, &Geo { h: 1 << 16, w: 1 << 16, ..g })));
    }

    #[test]
    fn sums_do_not_depend_on_the_threads() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for g in geometries() {
            let x = random(g.b * g.size(), &mut rng);
            let w = in_panels(&random(g.taps() * g.c * g.n, &mut rng), g.n, false);
            let dy = random(g.m() * g.n, &mut rng);
            let all = || (forward(&x, &w, None, &g), input_grad(&w, &dy, &g), weight_grad(&x, &dy, &g));
            let run = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(all);
            let one = run(1);
            assert!(one == run(2) && one == run(3), "{g:?}");
        }
    }
}
