//! The network that is compared with PyTorch, under criterion: training step, forward pass and sampling at both sizes.
//!
//! ```text
//! cargo bench --bench train_step
//! ```
#![allow(clippy::expect_used, reason = "a bench that cannot be set up should stop")]
#![allow(missing_docs, reason = "criterion's macros make undocumented items")]

#[allow(dead_code, reason = "the peer example uses the rest")]
#[path = "peers/workload.rs"]
mod workload;

use auto_e2h::nn::Compute;
use criterion::{Criterion, criterion_group, criterion_main};
use workload::{Size, Workload};

fn train_step(c: &mut Criterion) {
    auto_e2h::nn::tune_allocator();
    for size in [Size::Laptop, Size::Paper] {
        let mut work = Workload::new(size, None, None, &Compute::cpu()).expect("a network");
        let mut group = c.benchmark_group(size.name());
        group.sample_size(10);
        group.bench_function("step", |b| b.iter(|| work.step().expect("a step")));
        group.bench_function("forward", |b| b.iter(|| work.forward().expect("a forward pass")));
        for n in [1, 8] {
            let mut sample = work.sampler(n).expect("an observation");
            group.bench_function(format!("ddim{n}"), |b| b.iter(|| sample().expect("a chunk")));
        }
        group.finish();
    }
}

criterion_group!(benches, train_step);
criterion_main!(benches);
