//! Frames per second that refinement passes: reversal and the kinematic filter, and with the critic's filters after them. The
//! critic's own time is not in it: values are given.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use e2h_core::{Direction, Episode, Frames, Observation, Origin};
use e2h_refine::{
    AdvantageConfig, KinematicConfig, ReverseConfig, SuffixConfig, critic_filter, kinematic_filter, reverse,
};
use std::hint::black_box;

const ROWS: usize = 300;

/// Pauses, slow and fast stretches and one grasp. `side`: of its two cameras' images, pixels; 0 for none.
fn episode(side: usize) -> Episode {
    let origin = Origin::demonstration("bench", Direction::Easy, 0, 1);
    let mut episode = Episode::new(origin, &[]);
    let mut x = 0.3_f32;
    for t in 0..ROWS {
        x += [0.01, 0.0025, 0.0005][t / 30 % 3];
        let turn = 0.002 * t as f32;
        let width = if (100..200).contains(&t) { 0.05 } else { 0.08 };
        let state = [x, 0.0, 0.2, turn.sin(), turn.cos(), 0.0, 0.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, width];
        if episode.push(&Observation { state, frames: vec![] }, &[0.0; 8]).is_err() {
            return episode;
        }
    }
    if side > 0 {
        let camera = |name: &str| Frames::new(name, side, side, &vec![7; ROWS * side * side * 3]);
        episode.frames = vec![camera("table"), camera("wrist")];
    }
    episode
}

fn bench(c: &mut Criterion) {
    let mut group = c.benchmark_group("refine");
    group.throughput(Throughput::Elements(ROWS as u64));
    let reversal = ReverseConfig::default();
    let laptop =
        KinematicConfig { static_frames: 4, speed_window: 3, smooth_frames: 5, ..KinematicConfig::default() };
    for (images, side) in [("no images", 0), ("2 x 64 x 64", 64)] {
        let easy = episode(side);
        for (name, kinematic) in [("paper", &KinematicConfig::default()), ("laptop", &laptop)] {
            group.bench_function(format!("{name}, {images}"), |b| {
                b.iter(|| kinematic_filter(&reverse(black_box(&easy), &reversal), kinematic, &reversal));
            });
        }
        let (suffix, advantage) = (SuffixConfig::default(), AdvantageConfig::default());
        group.bench_function(format!("laptop with values, {images}"), |b| {
            b.iter(|| {
                let first = kinematic_filter(&reverse(black_box(&easy), &reversal), &laptop, &reversal);
                let rise = |rows: usize| (0..rows).map(|t| (0.1 * t as f32).sin()).collect();
                let values: Vec<Vec<f32>> = first.segments.iter().map(|s| rise(s.len())).collect();
                critic_filter(vec![first], &values, &suffix, &advantage)
            });
        });
    }
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
