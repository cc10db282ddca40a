//! Loops over `f32` slices, channels last. The only place with `unsafe`: tiles that live in registers, buffers that are
//! written before they are read, and functions compiled for AVX2 and AVX-512.
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

/// Below this many elements a loop stays on the calling thread: waking another costs more than it saves.
const PARALLEL_FROM: usize = 1 << 14;

/// A buffer of `n` numbers with unspecified content. Every caller writes all of it before reading any.
pub(crate) fn scratch(n: usize) -> Vec<f32> {
    let mut v = Vec::with_capacity(n);
    #[allow(clippy::uninit_vec, reason = "zeroing costs a pass over memory that the caller overwrites")]
    // SAFETY: the capacity is n, every bit pattern is an f32, and callers overwrite before they read.
    unsafe {
        v.set_len(n);
    }
    v
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
