//! What a laptop run spends its time on: a training step, sampling, a control step, an image.
//!
//! ```text
//! cargo bench --bench laptop
//! ```
#![allow(clippy::expect_used, reason = "a bench that cannot be set up should stop")]
#![allow(missing_docs, reason = "criterion's macros make undocumented items")]

use auto_e2h::core::{Direction, Episode, Observation, Origin, stream};
use auto_e2h::data::{Normaliser, NormaliserConfig};
use auto_e2h::env::{Env, demonstrate, task};
use auto_e2h::learn::RunConfig;
use auto_e2h::policy::{DiffusionPolicy, Trainer, TrainingData};
use criterion::{Criterion, criterion_group, criterion_main};
use std::sync::Arc;

fn laptop(c: &mut Criterion) {
    auto_e2h::nn::tune_allocator();
    let config = RunConfig::resolve("laptop", "nut_assembly", &[]).expect("the preset").config;
    let pair = task(&config.task.name, &config.task.options()).expect("the task");
    let mut env = Env::new(pair, &config.env).expect("a simulation");
    let origin = Origin::demonstration(&config.task.name, Direction::Easy, 0, 0);
    let mut rng = stream(0, "bench", 0, 0);
    let episode = demonstrate(&mut env, Direction::Easy, &config.task.demonstrator, origin, &mut rng)
        .expect("a demonstration");
    let episodes: Vec<Arc<Episode>> = vec![Arc::new(episode)];
    let normaliser = Normaliser::fit(&[&*episodes[0]], &NormaliserConfig::default()).expect("a normaliser");

    let mut group = c.benchmark_group("laptop");
    group.sample_size(20);
    let sources = [auto_e2h::data::Source::whole(episodes.clone())];
    let data = TrainingData::new(&sources, &config.policy, &normaliser).expect("windows");
    let mut trainer =
        Trainer::new(&config.policy, &config.train.step, 1000, None, 0, "bench").expect("a trainer");
    group.bench_function("train_step", |b| b.iter(|| trainer.step(&data).expect("a step")));

    let policy = DiffusionPolicy::untrained(&config.policy, &normaliser, 0).expect("a policy");
    env.reset(Direction::Hard, &mut rng).expect("a reset");
    let observation: Observation = env.observe().expect("an observation");
    for n in [1, 10] {
        let histories = vec![vec![&observation; config.policy.n_obs_steps]; n];
        group.bench_function(format!("sample_chunk_{n}"), |b| {
            let mut rngs: Vec<_> = (0..n).map(|i| stream(0, "bench", 1, i as u64)).collect();
            b.iter(|| policy.sample(&histories, &mut rngs).expect("a chunk"));
        });
    }

    let action = episodes[0].action[0];
    env.begin(Direction::Hard).expect("an episode");
    group.bench_function("control_step", |b| {
        b.iter(|| {
            if env.step(&action).expect("a step").is_some() {
                env.begin(Direction::Hard).expect("an episode");
            }
        });
    });
    group.bench_function("observation_two_cameras", |b| b.iter(|| env.observe().expect("an observation")));
    group.finish();
}

criterion_group!(benches, laptop);
criterion_main!(benches);
