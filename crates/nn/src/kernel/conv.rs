//! Convolutions as sums of matrix products, one per tap, over rows that are found through pointers: no patches are copied.
//!
//! Weights lie in panels of columns ([`panel`]): `(n / width, taps, c, width)`. A product reads a panel from front to back,
//! where rows a power of two apart would fall into the same few places of the caches.

mod geometry;

pub(crate) use geometry::Geo;

use super::micro::{Isa, MAX_ROWS, Outer, Rows, Start};
use super::{add_assign, made, threads};
use geometry::{Class, narrow, reach, reach_back};
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
    /// Matrices `k` by `n`, one per tap, in panels.
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
mod tests;
