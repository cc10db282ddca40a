//! What holds for every path.

#![allow(clippy::unwrap_used, reason = "helpers of tests")]

use e2h_core::{Direction, Episode, Frames, Observation, Origin};
use e2h_refine::{
    AdvantageConfig, Fate, KinematicConfig, RefineReport, Refined, ReverseConfig, SuffixConfig,
    critic_filter, kinematic_filter, merge_fates, reverse,
};
use proptest::prelude::*;

/// A path of stretches, each with its length in frames, its step, its turn and whether the gripper is open in it.
fn episodes() -> impl Strategy<Value = Episode> {
    let stretch =
        (1_usize..40, prop::array::uniform3(-0.006_f32..0.006), -0.04_f32..0.04, any::<bool>(), 0_u8..3);
    prop::collection::vec(stretch, 0..8).prop_map(|stretches| {
        let mut episode = Episode::new(Origin::demonstration("test", Direction::Easy, 0, 1), &[]);
        let (mut p, mut angle, mut width, mut object) =
            ([0.3_f32, 0.0, 0.2], 0.0_f32, 0.08_f32, [0.3_f32, 0.0, 0.0]);
        for (frames, step, turn, open, pace) in stretches {
            for _ in 0..frames {
                // Paces: stands still, slow, as drawn.
                let f = [0.02, 0.4, 1.5][usize::from(pace)];
                for i in 0..3 {
                    p[i] += f * step[i];
                    object[i] += if open { 0.0 } else { f * step[i] };
                }
                angle += if pace == 1 { turn } else { 0.0 };
                width = if open { (width + 0.02).min(0.08) } else { (width - 0.03).max(0.05) };
                let (s, c) = (0.5 * angle).sin_cos();
                let [x, y, z] = object;
                let state = [p[0], p[1], p[2], s, c, 0.0, 0.0, x, y, z, 1.0, 0.0, 0.0, 0.0, width];
                episode.push(&Observation { state, frames: vec![] }, &[0.0; 8]).unwrap();
            }
        }
        let bytes: Vec<u8> = (0..episode.len()).flat_map(|t| [(t % 251) as u8; 3]).collect();
        episode.frames = vec![Frames::new("table", 1, 1, &bytes)];
        episode
    })
}

fn configs() -> impl Strategy<Value = KinematicConfig> {
    (any::<bool>(), any::<bool>(), 0_usize..5, 0_usize..8, prop::sample::select(vec![4_usize, 16])).prop_map(
        |(literal, retime_all, speed_window, smooth_frames, static_frames)| KinematicConfig {
            retime_all,
            speed_window,
            smooth_frames,
            static_frames,
            ..if literal { KinematicConfig::literal() } else { KinematicConfig::default() }
        },
    )
}

fn distance(a: &[f32], b: &[f32]) -> f64 {
    (0..3).map(|i| f64::from(a[i] - b[i]).powi(2)).sum::<f64>().sqrt()
}

fn length(e: &Episode) -> f64 {
    e.state.windows(2).map(|w| distance(&w[0], &w[1])).sum()
}

fn longest_step(e: &Episode) -> f64 {
    e.state.windows(2).map(|w| distance(&w[0], &w[1])).fold(0.0, f64::max)
}

fn check_bookkeeping(input: &Episode, refined: &Refined) {
    assert_eq!(refined.fates.len(), input.len());
    assert_eq!(refined.report, RefineReport::new(&refined.fates, refined.segments.len()));
    let r = &refined.report;
    let total =
        r.kept + r.still + r.resampled + r.low_advantage + r.too_short + r.after_goal + r.dynamics_error;
    assert_eq!(total, input.len());
    // The rows of the segments are the kept frames, in order.
    let kept = (0..input.len()).filter(|&t| refined.fates[t] == Fate::Kept).map(|t| input.source[t]);
    let rows: Vec<u32> = refined.segments.iter().flat_map(|s| s.source.clone()).collect();
    assert_eq!(rows, kept.collect::<Vec<_>>());
    for segment in &refined.segments {
        segment.validate().unwrap();
        for (t, &source) in segment.source.iter().enumerate() {
            assert_eq!(
                segment.frames[0].image(t).unwrap()[0],
                (source % 251) as u8,
                "an image is that of its source row"
            );
        }
    }
}

proptest! {
    #[test]
    fn backwards_twice_is_forwards(e in episodes()) {
        let twice = reverse(&reverse(&e, &ReverseConfig::default()), &ReverseConfig::default());
        prop_assert_eq!((&twice.state, &twice.source, &twice.frames), (&e.state, &e.source, &e.frames));
        prop_assert_eq!(&twice.origin, &e.origin);
    }

    #[test]
    fn the_kinematic_filter_accounts_for_every_frame(e in episodes(), config in configs()) {
        let config_r = ReverseConfig::default();
        let hard = reverse(&e, &config_r);
        let refined = kinematic_filter(&hard, &config, &config_r);
        check_bookkeeping(&hard, &refined);
        for segment in &refined.segments {
            prop_assert!(segment.source.windows(2).all(|w| w[0] > w[1]), "time never turns round");
            prop_assert_eq!(segment.state.first(), hard.state.first());
            prop_assert_eq!(segment.state.last(), hard.state.last());
            prop_assert!(segment.terminal);
        }
    }

    #[test]
    fn nothing_jumps_at_a_splice(e in episodes(), config in configs()) {
        let config = KinematicConfig { smooth_frames: 0, ..config };
        let refined = kinematic_filter(&e, &config, &ReverseConfig::default());
        let most = longest_step(&e).max(config.static_drift) + 2.0 * config.resample_step;
        for segment in &refined.segments {
            prop_assert!(longest_step(segment) <= most);
        }
    }

    #[test]
    fn retiming_keeps_the_way(e in episodes(), retime_all: bool) {
        let config = KinematicConfig { static_frames: usize::MAX, retime_all, ..KinematicConfig::default() };
        let refined = kinematic_filter(&e, &config, &ReverseConfig::default());
        for segment in &refined.segments {
            let (before, after) = (length(&e), length(segment));
            // Chords are shorter than the corners that they cut: one step a stretch at most.
            prop_assert!(after <= before + 1e-4 && after >= before - 8.0 * 0.01, "{} of {}", after, before);
        }
    }

    #[test]
    fn a_gripper_at_work_is_left_alone(e in episodes(), config in configs()) {
        let config = KinematicConfig { protect_gripper: true, ..config };
        let refined = kinematic_filter(&e, &config, &ReverseConfig::default());
        for t in 1..e.len() {
            if (e.opening(t) - e.opening(t - 1)).abs() > 0.001 {
                prop_assert!(refined.fates[t] == Fate::Kept && refined.fates[t - 1] == Fate::Kept);
            }
        }
    }

    #[test]
    fn the_critic_accounts_for_the_frames_of_the_recording(
        recordings in prop::collection::vec(episodes(), 1..5), config in configs(), wave in 0.01_f32..0.3,
        suffix: bool, min_run in 1_usize..40,
    ) {
        let config_r = ReverseConfig::default();
        let hard: Vec<Episode> = recordings.iter().map(|e| reverse(e, &config_r)).collect();
        let first: Vec<Refined> = hard.iter().map(|e| kinematic_filter(e, &config, &config_r)).collect();
        let values: Vec<Vec<f32>> = first
            .iter()
            .flat_map(|r| &r.segments)
            .map(|s| (0..s.len()).map(|t| (wave * t as f32).sin()).collect())
            .collect();
        let suffix = SuffixConfig { enabled: suffix, frames: 3, ..SuffixConfig::default() };
        let advantage = AdvantageConfig { min_run, ..AdvantageConfig::default() };
        let refined = critic_filter(first.clone(), &values, &suffix, &advantage).unwrap();
        prop_assert_eq!(refined.len(), hard.len());
        for ((input, before), after) in hard.iter().zip(&first).zip(&refined) {
            check_bookkeeping(input, after);
            for (b, a) in before.fates.iter().zip(&after.fates) {
                prop_assert!(*b == Fate::Kept || a == b, "a frame that is gone stays gone");
            }
            if let Some(value) = &after.value {
                for (b, v) in before.fates.iter().zip(value) {
                    prop_assert_eq!(*b == Fate::Kept, v.is_finite());
                }
            }
            // Segments act as the unsplit episode did.
            for segment in &after.segments {
                for (t, source) in segment.source.iter().enumerate() {
                    let Some(whole) = before.segments.first() else { continue };
                    let row = whole.source.iter().position(|s| s == source).unwrap();
                    prop_assert_eq!(segment.action[t], whole.action[row]);
                }
            }
        }
    }
}

#[test]
fn fates_of_the_wrong_number_of_frames_are_refused() {
    let mut e = Episode::new(Origin::demonstration("test", Direction::Easy, 0, 1), &[]);
    e.push(&Observation { state: [0.0; 15], frames: vec![] }, &[0.0; 8]).unwrap();
    let refined = Refined::untouched(&e);
    let message = merge_fates(&refined, &[]).unwrap_err().to_string();
    assert_eq!(message, "expected fates for the 1 frame(s) that the stage before kept, got 0");
}
