//! Made-up results for tests.

use crate::filter::FilterPicture;
use crate::record::{Automatic, Collection, Evaluation, IterationRecord, ResetCause, RunResults, wilson95};
use e2h_core::{Direction, Episode, Image, Observation, Origin};
use e2h_refine::Fate;

/// A run whose success rate climbs, with `iterations` rows.
pub(crate) fn results(seed: u64, iterations: u32) -> RunResults {
    let row = |i: u32| {
        let n = i as usize;
        let k = [6, 14, 27, 33, 41, 46, 48, 49, 50][n.min(8)] - (seed as usize * 2).min(5);
        let stages = [("collect", 3.1), ("refine", 0.4), ("critic", 2.2), ("train", 7.5), ("evaluate", 1.3)];
        let skip = if i == 0 { 2 } else { 0 };
        IterationRecord {
            iteration: i,
            evaluation: Evaluation {
                successes: k,
                trials: 50,
                wilson95: wilson95(k, 50),
                mean_steps: 214.0 - 9.0 * f64::from(i),
                seconds: 80.0,
                outcomes: vec![],
            },
            minutes: 11.0 + 14.3 * f64::from(i),
            stage_minutes: stages
                .iter()
                .filter(|s| skip == 0 || s.0 == "train" || s.0 == "evaluate")
                .map(|(s, m)| ((*s).to_owned(), m + 0.2 * f64::from(i)))
                .collect(),
            collection: (i > 0).then(|| Collection {
                cycles: 40,
                hard_successes: 8 + 5 * n,
                easy_successes: 33 + n / 2,
                easy_rollouts: 40,
                steps: 12_000,
                resets: [
                    (ResetCause::Start, 8),
                    (ResetCause::HardFailed, 12 - n),
                    (ResetCause::EasyFailed, 4),
                    (ResetCause::Diverged, 1),
                ]
                .into(),
                explored: Automatic { cycles: 30, easy_successes: 24, resets: 8 },
                plain: Automatic { cycles: 10, easy_successes: 9, resets: 1 },
                accepted: 29 + n / 2,
                fates: [
                    (Fate::Kept, 5200 + 90 * n),
                    (Fate::Static, 1400 - 50 * n),
                    (Fate::Resampled, 900),
                    (Fate::LowAdvantage, if i == 1 { 0 } else { 1700 }),
                    (Fate::TooShort, 130),
                ]
                .into(),
                segments: 61 + n,
                frames_kept: 6000 + 90 * n,
                critic_loss: (i > 1).then_some(0.021 / f64::from(i)),
                notes: if i == 1 { vec!["critic: too few hard rollouts".to_owned()] } else { vec![] },
            }),
            loss: 0.04 / (1.0 + 0.6 * f64::from(i)),
            skipped: false,
            updates: 1500,
        }
    };
    RunResults {
        task: "nut_assembly".to_owned(),
        variant: "loose".to_owned(),
        preset: "laptop".to_owned(),
        method: "auto-e2h".to_owned(),
        seed,
        version: "0.1.0".to_owned(),
        demonstrations: 10,
        given: None,
        explored: true,
        overrides: vec![],
        machine: "2 threads, some processor".to_owned(),
        iterations: (0..iterations).map(row).collect(),
        demonstration_steps: 171.0,
        hard_demonstration_steps: None,
    }
}

/// Images of a square that moves over a shaded, still background.
pub(crate) fn rollout(frames: usize, height: usize, width: usize, seed: usize) -> Vec<Image> {
    let picture = |t: usize| {
        let (cx, cy) = ((t * 2 + seed * 3) % width, (t + seed * 5) % height);
        let colour = |y: usize, x: usize| -> [u8; 3] {
            if x.abs_diff(cx) < width / 8 && y.abs_diff(cy) < height / 8 {
                [230, 150, (seed * 60 % 256) as u8]
            } else {
                [(60 + y % 90) as u8, (70 + x % 90) as u8, 80 + (x * y % 7) as u8]
            }
        };
        let data = (0..height).flat_map(|y| (0..width).flat_map(move |x| colour(y, x))).collect();
        Image { height, width, data }
    };
    (0..frames).map(picture).collect()
}

/// An episode with one camera.
pub(crate) fn episode(rows: usize) -> Episode {
    let origin = Origin::demonstration("nut_assembly", Direction::Easy, 0, 1);
    let mut episode = Episode::new(origin, &["table".to_owned()]);
    for frame in rollout(rows, 8, 8, 1) {
        episode.push(&Observation { state: [0.0; 15], frames: vec![frame] }, &[0.0; 8]).unwrap();
    }
    episode
}

/// A rollout of twelve seconds with every common fate.
pub(crate) fn filter_picture() -> FilterPicture {
    let times: Vec<f32> = (0..240).map(|t| t as f32 / 20.0).collect();
    let fate = |t: usize| match t {
        40..=69 => "static",
        70..=94 => "resampled",
        150..=189 => "low_advantage",
        215..=226 => "too_short",
        _ => "kept",
    };
    let speed = |t: usize| match t {
        40..=69 => 0.012,
        70..=94 => 0.05,
        _ => 0.16 + 0.09 * (t as f32 / 11.0).sin(),
    };
    let value = |t: f32| 0.2 + 0.06 * t - if (7.5..9.5).contains(&t) { 0.3 * (t - 7.5) } else { 0.0 };
    FilterPicture {
        speed: (0..240).map(speed).collect(),
        value: Some(times.iter().map(|t| value(*t)).collect()),
        advantage: Some(times.iter().map(|t| 0.003 + 0.004 * (t * 0.8).cos()).collect()),
        advantage_threshold: Some(0.0005),
        static_speed: 0.04,
        slow_speed: 0.06,
        fates: (0..240).map(|t| fate(t).to_owned()).collect(),
        frames: rollout(8, 64, 64, 2),
        times,
        ..FilterPicture::default()
    }
}
