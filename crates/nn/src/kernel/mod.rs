//! Loops over `f32` slices, channels last. The only place with `unsafe`: tiles that live in registers, buffers that become
//! numbers only once all of them are written, and functions compiled for AVX2 and AVX-512.
//!
//! What keeps a kernel inside its slices is asserted in every build, once a call; its other preconditions in debug builds.
//! The profile `checked` runs the tests with those.
//!
//! Work is cut by the sizes of the data, never by the number of threads, and partial sums are added in that fixed order:
//! the same inputs give the same bytes in any pool.
#![allow(
    unsafe_code,
    reason = "tiles take pointers, and vector code must be called behind a check of the processor"
)]

pub(crate) mod act;
pub(crate) mod conv;
mod micro;
pub(crate) mod norm;
pub(crate) mod optim;
pub(crate) mod pool;
mod vector;

use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Below this many elements a loop stays on the calling thread: waking another costs more than it saves.
const PARALLEL_FROM: usize = 1 << 14;

/// Numbers that are made in parts. Each part is handed out as zeros, filled in just before it is written and so while it is
/// in the cache: zeroing the whole first would cost a pass over memory.
pub(crate) struct Fresh {
    numbers: Vec<f32>,
    len: usize,
    /// Numbers of all parts handed out so far.
    filled: AtomicUsize,
    /// Whether the parts were asked for: a second time would count them twice.
    given: bool,
}

fn zeroed<'a>(part: &'a mut [MaybeUninit<f32>], filled: &AtomicUsize) -> &'a mut [f32] {
    part.fill(MaybeUninit::new(0.0));
    filled.fetch_add(part.len(), Ordering::Relaxed);
    // SAFETY: filled above.
    unsafe { part.assume_init_mut() }
}

impl Fresh {
    pub(crate) fn new(len: usize) -> Self {
        Self { numbers: Vec::with_capacity(len), len, filled: AtomicUsize::new(0), given: false }
    }

    fn places(&mut self) -> (&mut [MaybeUninit<f32>], &AtomicUsize) {
        assert!(!self.given, "the parts of a buffer are handed out once");
        self.given = true;
        (&mut self.numbers.spare_capacity_mut()[..self.len], &self.filled)
    }

    /// The parts of `size` numbers, one after the other.
    pub(crate) fn parts(&mut self, size: usize) -> impl Iterator<Item = &mut [f32]> {
        let (places, filled) = self.places();
        places.chunks_mut(size.max(1)).map(|part| zeroed(part, filled))
    }

    /// The parts of `size` numbers, shared among the threads.
    pub(crate) fn par_parts(&mut self, size: usize) -> impl IndexedParallelIterator<Item = &mut [f32]> {
        let (places, filled) = self.places();
        places.par_chunks_mut(size.max(1)).map(|part| zeroed(part, filled))
    }

    /// The numbers, when every part was handed out.
    pub(crate) fn done(self) -> Vec<f32> {
        let Self { mut numbers, len, filled, .. } = self;
        assert_eq!(filled.into_inner(), len, "numbers that were handed out");
        // SAFETY: parts do not overlap and are handed out once, so all of them together were filled with numbers.
        unsafe { numbers.set_len(len) };
        numbers
    }
}

/// `n` numbers made by `f(index, part)` in parts of `size`; `f` finds zeros.
pub(crate) fn made(n: usize, size: usize, f: impl Fn(usize, &mut [f32]) + Sync) -> Vec<f32> {
    let mut y = Fresh::new(n);
    if n > size && worthwhile(n) {
        y.par_parts(size).enumerate().for_each(|(i, y)| f(i, y));
    } else {
        y.parts(size).enumerate().for_each(|(i, y)| f(i, y));
    }
    y.done()
}

/// Threads of the pool this call runs in.
pub(crate) fn threads() -> usize {
    rayon::current_num_threads()
}

/// Whether a loop over so many elements is worth more than one thread.
pub(crate) fn worthwhile(elements: usize) -> bool {
    elements >= PARALLEL_FROM && threads() > 1
}

pub(crate) fn has_avx2() -> bool {
    #[cfg(target_arch = "x86_64")]
    {
        std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
    }
    #[cfg(not(target_arch = "x86_64"))]
    {
        false
    }
}

/// The vector instructions that this processor has and the kernels use, in words.
#[must_use]
pub fn vector_unit() -> &'static str {
    micro::Isa::best().name()
}

/// `a * b + c`, in one instruction where the processor has it.
#[inline(always)]
pub(crate) fn fma<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Compiles a loop twice, for the baseline and for AVX2 with FMA, and picks at run time. The body may use the constant
/// `FMA`.
macro_rules! simd {
    ($(#[$meta:meta])* fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $body:block) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments, reason = "a kernel is its slices")]
        pub(crate) fn $name($($arg: $ty),*) {
            #[inline(always)]
            fn body<const FMA: bool>($($arg: $ty),*) $body
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                fn wide($($arg: $ty),*) {
                    body::<true>($($arg),*);
                }
                if $crate::kernel::has_avx2() {
                    // SAFETY: the processor was just found to have both features.
                    return unsafe { wide($($arg),*) };
                }
            }
            body::<{ cfg!(target_arch = "aarch64") }>($($arg),*);
        }
    };
}
pub(crate) use simd;

simd! {
/// `a += b`.
fn add_in_place(a: &mut [f32], b: &[f32]) {
    let _ = FMA;
    for (a, b) in a.iter_mut().zip(b) {
        *a += *b;
    }
}
}

/// `a += b`, shared among the threads where it is long.
pub(crate) fn add_assign(a: &mut [f32], b: &[f32]) {
    debug_assert_eq!(a.len(), b.len(), "numbers to add");
    each(a, PARALLEL_FROM, |i, a| add_in_place(a, &b[i * PARALLEL_FROM..][..a.len()]));
}

/// Runs `f(index, chunk)` over chunks of `size` elements.
pub(crate) fn each(y: &mut [f32], size: usize, f: impl Fn(usize, &mut [f32]) + Sync) {
    if y.len() > size && worthwhile(y.len()) {
        y.par_chunks_mut(size).enumerate().for_each(|(i, y)| f(i, y));
    } else {
        y.chunks_mut(size.max(1)).enumerate().for_each(|(i, y)| f(i, y));
    }
}

simd! {
fn add_rows(sum: &mut [f32], rows: &[f32]) {
    let _ = FMA;
    let n = sum.len();
    for r in rows.chunks_exact(n) {
        for (s, v) in sum.iter_mut().zip(r) {
            *s += *v;
        }
    }
}
}

/// The sum of rows of `n` numbers.
pub(crate) fn column_sums(rows: &[f32], n: usize) -> Vec<f32> {
    const ROWS: usize = 512;
    let mut total = vec![0.0; n];
    if n == 0 {
        return total;
    }
    debug_assert!(rows.len().is_multiple_of(n), "{} numbers in rows of {n}", rows.len());
    let chunks = rows.len().div_ceil(ROWS * n);
    let mut parts = vec![0.0; chunks * n];
    let part =
        |i: usize, p: &mut [f32]| add_rows(p, &rows[i * ROWS * n..((i + 1) * ROWS * n).min(rows.len())]);
    if worthwhile(rows.len()) {
        parts.par_chunks_mut(n).enumerate().for_each(|(i, p)| part(i, p));
    } else {
        parts.chunks_mut(n).enumerate().for_each(|(i, p)| part(i, p));
    }
    add_rows(&mut total, &parts);
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_made_in_parts() {
        for (n, size) in [(0, 4), (3, 4), (4, 4), (10, 4), (10, 0), (1 << 15, 1000)] {
            let y =
                made(n, size, |i, y| y.iter_mut().enumerate().for_each(|(j, y)| *y += (i * size + j) as f32));
            let expected: Vec<f32> = (0..n).map(|i| if size == 0 { 0.0 } else { i as f32 }).collect();
            assert!(size == 0 && y.len() == n || y == expected, "{n} in parts of {size}");
        }
    }

    #[test]
    #[should_panic(expected = "handed out")]
    fn a_part_that_nobody_took_is_no_number() {
        let mut y = Fresh::new(10);
        assert_eq!(y.parts(4).take(2).flatten().count(), 8);
        y.done();
    }

    #[test]
    #[should_panic(expected = "once")]
    fn no_part_is_counted_twice() {
        let mut y = Fresh::new(8);
        assert_eq!(y.parts(4).take(1).flatten().count(), 4);
        let _ = y.parts(4);
    }
}
