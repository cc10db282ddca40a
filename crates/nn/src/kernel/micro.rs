//! The two products under every layer, as tiles that live in registers.
//!
//! `rows`: some rows of a result, each the sum of (gathered rows) times (a matrix). `outer`: a block of a weight gradient,
//! the sum over positions of (gathered row)ᵀ times (row). Rows are found through pointers, so that a convolution needs no
//! copy of its patches.

use super::vector::{Plain, Vector};
#[cfg(target_arch = "x86_64")]
use std::arch::x86_64::{__m256, __m512};

/// Most rows of a tile, over all instruction sets.
pub(super) const MAX_ROWS: usize = 12;

/// Products that are summed in registers before they are added to the result. One sum over thousands of products loses
/// digits with the root of their number; PyTorch's do not, because its products come in blocks too.
const BLOCK: usize = 128;

/// Which instructions the kernels use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Isa {
    #[cfg(target_arch = "x86_64")]
    Avx512,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Plain,
}

impl Isa {
    /// The best that this processor has.
    pub(crate) fn best() -> Self {
        static BEST: std::sync::OnceLock<Isa> = std::sync::OnceLock::new();
        *BEST.get_or_init(|| Self::all()[0])
    }

    /// All that this processor has, the best first.
    pub(crate) fn all() -> Vec<Self> {
        let mut all = Vec::with_capacity(3);
        #[cfg(target_arch = "x86_64")]
        {
            if std::arch::is_x86_feature_detected!("avx512f") && super::has_avx2() {
                all.push(Self::Avx512);
            }
            if super::has_avx2() {
                all.push(Self::Avx2);
            }
        }
        all.push(Self::Plain);
        all
    }

    /// What people call it.
    pub(crate) fn name(self) -> &'static str {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => "AVX-512",
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => "AVX2 and FMA",
            Self::Plain => "what every processor of this kind has",
        }
    }

    /// Numbers in a register.
    pub(super) fn lanes(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => 16,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => 8,
            Self::Plain => 8,
        }
    }

    /// Most rows of a tile: accumulators, a row of the matrix and one number fill the registers.
    pub(super) fn rows(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => 12,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => 6,
            Self::Plain => 4,
        }
    }
}

/// What a tile starts from.
#[derive(Clone, Copy)]
pub(super) enum Start {
    Zero,
    /// This row.
    Bias(*const f32),
}

/// One tile of `rows`: `to[i] = start + sum over tap and k of at[tap][i][k] * w[tap][k]`.
pub(super) struct Rows {
    pub(super) taps: usize,
    /// Numbers a gathered row.
    pub(super) k: usize,
    /// Gathered rows, [`MAX_ROWS`] places a tap.
    pub(super) at: *const *const f32,
    /// The matrix of each tap.
    pub(super) w: *const *const f32,
    /// From one row of a matrix to the next.
    pub(super) row_step: usize,
    pub(super) to: *const *mut f32,
    /// Added to every pointer of `w`, and of `to`.
    pub(super) w_column: usize,
    pub(super) column: usize,
    pub(super) start: Start,
}

/// One tile of `outer`: `to[i] (+)= sum over r of at[r][first + i] * b[r]`.
pub(super) struct Outer {
    pub(super) rows: usize,
    pub(super) at: *const *const f32,
    pub(super) first: usize,
    pub(super) b: *const f32,
    pub(super) b_step: usize,
    pub(super) to: *mut f32,
    pub(super) to_step: usize,
    pub(super) keep: bool,
}

/// Writes the sums of a tile, or with `add` adds them to the result.
#[inline(always)]
unsafe fn put<V: Vector, const MR: usize, const NV: usize>(sum: &[[V; NV]; MR], t: &Rows, add: bool) {
    // SAFETY: as in `rows`.
    unsafe {
        for (i, sum) in sum.iter().enumerate() {
            let y = (*t.to.add(i)).add(t.column);
            for (j, sum) in sum.iter().enumerate() {
                let y = y.add(j * V::LANES);
                if add { sum.add(V::load(y)).store(y) } else { sum.store(y) }
            }
        }
    }
}

#[allow(
    clippy::needless_range_loop,
    reason = "counts known at compile time unroll; iterators over two arrays hide that"
)]
#[inline(always)]
unsafe fn rows<V: Vector, const MR: usize, const NV: usize>(t: &Rows) {
    // SAFETY: the caller of `Isa::rows_tile` promises that every pointer is good for what the sizes reach.
    unsafe {
        let mut sum = [[V::zero(); NV]; MR];
        match t.start {
            Start::Zero => {}
            Start::Bias(b) => {
                for sum in &mut sum {
                    for (j, sum) in sum.iter_mut().enumerate() {
                        *sum = V::load(b.add(j * V::LANES));
                    }
                }
            }
        }
        // Products in `sum`, and whether the result holds a sum already.
        let (mut count, mut begun) = (0, false);
        for tap in 0..t.taps {
            let mut at = [std::ptr::null::<f32>(); MR];
            for (i, at) in at.iter_mut().enumerate() {
                *at = *t.at.add(tap * MAX_ROWS + i);
            }
            let mut w = (*t.w.add(tap)).add(t.w_column);
            let mut from = 0;
            while from < t.k {
                let to = t.k.min(from + BLOCK);
                if count + (to - from) > BLOCK {
                    put::<V, MR, NV>(&sum, t, begun);
                    sum = [[V::zero(); NV]; MR];
                    (count, begun) = (0, true);
                }
                for k in from..to {
                    let mut b = [V::zero(); NV];
                    for (j, b) in b.iter_mut().enumerate() {
                        *b = V::load(w.add(j * V::LANES));
                    }
                    for i in 0..MR {
                        let a = V::splat(at[i].add(k));
                        for j in 0..NV {
                            sum[i][j] = sum[i][j].fma(a, b[j]);
                        }
                    }
                    w = w.add(t.row_step);
                }
                count += to - from;
                from = to;
            }
        }
        put::<V, MR, NV>(&sum, t, begun);
    }
}

#[allow(
    clippy::needless_range_loop,
    reason = "counts known at compile time unroll; iterators over two arrays hide that"
)]
#[inline(always)]
unsafe fn outer<V: Vector, const MR: usize, const NV: usize>(t: &Outer) {
    // SAFETY: as in `rows`.
    unsafe {
        let mut sum = [[V::zero(); NV]; MR];
        let mut row = t.b;
        for r in 0..t.rows {
            let a = (*t.at.add(r)).add(t.first);
            let mut b = [V::zero(); NV];
            for (j, b) in b.iter_mut().enumerate() {
                *b = V::load(row.add(j * V::LANES));
            }
            for i in 0..MR {
                let a = V::splat(a.add(i));
                for j in 0..NV {
                    sum[i][j] = sum[i][j].fma(a, b[j]);
                }
            }
            row = row.add(t.b_step);
        }
        for (i, sum) in sum.iter().enumerate() {
            for (j, sum) in sum.iter().enumerate() {
                let y = t.to.add(i * t.to_step + j * V::LANES);
                if t.keep { sum.add(V::load(y)).store(y) } else { sum.store(y) }
            }
        }
    }
}

/// Compiles both kernels for one instruction set and every tile height, one or two registers wide.
macro_rules! tiles {
    ($rows:ident, $outer:ident, $vector:ty, [$($mr:literal)*], $(#[$feature:meta])?) => {
        $(#[$feature])?
        unsafe fn $rows(mr: usize, nv: usize, t: &Rows) {
            $(#[$feature])?
            #[inline(never)]
            unsafe fn one<const MR: usize, const NV: usize>(t: &Rows) {
                // SAFETY: passed on.
                unsafe { rows::<$vector, MR, NV>(t) }
            }
            // SAFETY: passed on.
            unsafe {
                match (mr, nv) {
                    $(($mr, 1) => one::<$mr, 1>(t), ($mr, 2) => one::<$mr, 2>(t),)*
                    _ => unreachable!("a tile of {mr} rows"),
                }
            }
        }
        $(#[$feature])?
        unsafe fn $outer(mr: usize, nv: usize, t: &Outer) {
            $(#[$feature])?
            #[inline(never)]
            unsafe fn one<const MR: usize, const NV: usize>(t: &Outer) {
                // SAFETY: passed on.
                unsafe { outer::<$vector, MR, NV>(t) }
            }
            // SAFETY: passed on.
            unsafe {
                match (mr, nv) {
                    $(($mr, 1) => one::<$mr, 1>(t), ($mr, 2) => one::<$mr, 2>(t),)*
                    _ => unreachable!("a tile of {mr} rows"),
                }
            }
        }
    };
}

#[cfg(target_arch = "x86_64")]
tiles!(rows_512, outer_512, __m512, [1 2 3 4 5 6 7 8 9 10 11 12], #[target_feature(enable = "avx512f,avx2,fma")]);
#[cfg(target_arch = "x86_64")]
tiles!(rows_256, outer_256, __m256, [1 2 3 4 5 6], #[target_feature(enable = "avx2,fma")]);
tiles!(rows_plain, outer_plain, Plain, [1 2 3 4],);

impl Isa {
    /// # Safety
    /// The processor has the instructions; every pointer of `t` is good for `mr` rows of `nv` registers.
    pub(super) unsafe fn rows_tile(self, mr: usize, nv: usize, t: &Rows) {
        // SAFETY: passed on.
        unsafe {
            match self {
                #[cfg(target_arch = "x86_64")]
                Self::Avx512 => rows_512(mr, nv, t),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => rows_256(mr, nv, t),
                Self::Plain => rows_plain(mr, nv, t),
            }
        }
    }

    /// # Safety
    /// As [`Isa::rows_tile`].
    pub(super) unsafe fn outer_tile(self, mr: usize, nv: usize, t: &Outer) {
        // SAFETY: passed on.
        unsafe {
            match self {
                #[cfg(target_arch = "x86_64")]
                Self::Avx512 => outer_512(mr, nv, t),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => outer_256(mr, nv, t),
                Self::Plain => outer_plain(mr, nv, t),
            }
        }
    }
}
