//! Every rule of the kinematic filter on a path small enough to count by hand.

use super::*;
use crate::fixture::{along, reversal, walk};

fn filter(episode: &Episode, config: &KinematicConfig) -> Refined {
    let refined = kinematic_filter(episode, config, &reversal());
    refined.segments[0].validate().unwrap();
    assert_eq!(refined.report.kept, refined.segments[0].len());
    assert_eq!(refined.segments[0].terminal, episode.terminal);
    refined
}

#[test]
fn a_pause_of_more_than_16_frames_keeps_its_first_and_last() {
    for (pause, cut) in [(16, 0), (17, 15), (40, 38)] {
        let refined =
            filter(&along(&walk(&[(10, 0.01), (pause, 0.001), (10, 0.01)])), &KinematicConfig::default());
        assert_eq!(refined.report.still, cut, "pause of {pause}");
        assert_eq!(refined.report.resampled, 0);
        if cut > 0 {
            assert_eq!((refined.fates[10], refined.fates[11]), (Fate::Kept, Fate::Static));
            assert_eq!((refined.fates[8 + pause], refined.fates[9 + pause]), (Fate::Static, Fate::Kept));
            // The goal of the row before the splice is the row after it.
            let segment = &refined.segments[0];
            assert_eq!(segment.source[10..12], [10, 9 + pause as u32]);
            assert_eq!(segment.action[10][0], segment.state[11][0]);
        }
    }
}

#[test]
fn a_creeping_run_is_split_where_it_has_drifted_too_far() {
    // 1.9 mm per frame pass 50 mm with the 27th step: pieces of 27, 27 and 6 frames, of which 25 + 25 go.
    let refined = filter(&along(&walk(&[(60, 0.0019), (10, 0.01)])), &KinematicConfig::default());
    assert_eq!(refined.report.still, 50);
    assert_eq!(refined.fates[25..29], [Fate::Static, Fate::Kept, Fate::Kept, Fate::Static]);
}

#[test]
fn turning_in_place_is_motion_except_to_the_letter() {
    let mut e = along(&[0.0; 30]);
    for (t, s) in e.state.iter_mut().enumerate() {
        let half = 0.5 * 0.03 * t as f32;
        (s[4], s[5]) = (half.cos(), half.sin());
    }
    assert_eq!(filter(&e, &KinematicConfig::default()).report.still, 0);
    assert_eq!(filter(&e, &KinematicConfig::literal()).report.still, 28);
}

#[test]
fn a_grasp_survives_except_to_the_letter() {
    let mut e = along(&[0.0; 60]);
    for s in e.state.iter_mut().skip(30) {
        s[14] = 0.05;
    }
    let refined = filter(&e, &KinematicConfig::default());
    // Rows 24 to 35 are protected; of 0..24 and 36..60 the first and last stay.
    assert_eq!(refined.segments[0].source, [&[0][..], &(23..37).collect::<Vec<_>>(), &[59]].concat());
    assert_eq!(filter(&e, &KinematicConfig::literal()).report.still, 58);
}

#[test]
fn the_object_does_not_jump_at_a_splice() {
    // It falls 3 cm within a pause of 60 frames, at 3 mm per frame.
    let mut e = along(&[0.0; 60]);
    for (t, s) in e.state.iter_mut().enumerate() {
        s[9] = -0.003 * (t as f32 - 30.0).clamp(0.0, 10.0);
    }
    let segment = filter(&e, &KinematicConfig::default()).segments.remove(0);
    let jump = segment.state.windows(2).map(|w| (w[1][9] - w[0][9]).abs()).fold(0.0, f32::max);
    assert!(jump <= 0.0101, "{jump}");
    let literal = filter(&e, &KinematicConfig::literal()).segments.remove(0);
    assert_eq!(literal.len(), 2);
}

#[test]
fn an_object_in_the_hand_does_not_split_a_creeping_run() {
    let mut e = along(&walk(&[(20, 0.0015)]));
    for s in &mut e.state {
        s[7] = s[0] + 0.02;
    }
    assert_eq!(filter(&e, &KinematicConfig::default()).report.still, 19);
}

#[test]
fn slow_motion_is_retimed_to_steps_of_5_mm() {
    // 20 steps of 2.5 mm are 50 mm: 10 steps. The fast frames around stay.
    let e = along(&walk(&[(5, 0.01), (20, 0.0025), (5, 0.01)]));
    let refined = filter(&e, &KinematicConfig::default());
    let segment = &refined.segments[0];
    assert_eq!((refined.report.kept, refined.report.resampled), (21, 10));
    for t in 5..15 {
        assert!((segment.state[t + 1][0] - segment.state[t][0] - 0.005).abs() < 1e-6);
        assert_eq!(segment.action[t][..7], segment.state[t + 1][..7]);
        assert_eq!(segment.frames[0].image(t).unwrap()[0], segment.source[t] as u8);
    }
    assert_eq!((segment.source[5], segment.source[15]), (5, 25));
    assert_eq!(segment.state[15], e.state[25]);
}

#[test]
fn slow_runs_shorter_than_the_minimum_stay() {
    let e = along(&walk(&[(5, 0.01), (2, 0.0025), (5, 0.01)]));
    assert_eq!(filter(&e, &KinematicConfig::default()).report.kept, 13);
}

#[test]
fn what_is_slower_than_slow_but_too_short_to_be_static_stays() {
    let e = along(&walk(&[(5, 0.01), (10, 0.001), (5, 0.01)]));
    assert_eq!(filter(&e, &KinematicConfig::default()).report.kept, 21);
}

#[test]
fn retiming_everything_speeds_up_the_slow_and_never_slows_the_fast() {
    let e = along(&walk(&[(5, 0.01), (10, 0.001), (5, 0.01)]));
    let config = KinematicConfig { retime_all: true, ..KinematicConfig::default() };
    let segment = filter(&e, &config).segments.remove(0);
    // 5 + 10 mm / 5 mm + 5 steps.
    assert_eq!(segment.len(), 13);
    assert_eq!(segment.state[12], e.state[20]);
    let fast = along(&walk(&[(20, 0.01)]));
    assert_eq!(filter(&fast, &config).segments[0].state, fast.state);
}

#[test]
fn smoothing_moves_goals_and_leaves_observations() {
    let x: Vec<f64> = (0..21).map(|t| 0.01 * f64::from(t) + 0.002 * f64::from(t % 2)).collect();
    let e = along(&x);
    let config = KinematicConfig { smooth_frames: 5, ..KinematicConfig::default() };
    let segment = filter(&e, &config).segments.remove(0);
    assert_eq!(segment.state, e.state);
    let steps: Vec<f32> = segment.action[2..17].windows(2).map(|w| w[1][0] - w[0][0]).collect();
    // Jitter of 2 mm becomes 2/5 mm.
    assert!(steps.iter().all(|s| (s - 0.01).abs() < 4.1e-4), "{steps:?}");
    assert_eq!(segment.action[20][0], e.state[20][0]);
}

#[test]
fn hovering_with_jitter_needs_the_window() {
    let mut x = walk(&[(10, 0.01)]);
    x.extend((0..30).map(|t| 0.1 + 0.003 * f64::from(t % 2)));
    let e = along(&x);
    assert_eq!(filter(&e, &KinematicConfig::default()).report.still, 0);
    let config = KinematicConfig { speed_window: 3, ..KinematicConfig::default() };
    assert!(filter(&e, &config).report.still > 20);
}

#[test]
fn tiny_episodes_pass() {
    assert!(kinematic_filter(&along(&[]), &KinematicConfig::default(), &reversal()).segments.is_empty());
    assert_eq!(filter(&along(&[0.1]), &KinematicConfig::default()).report.kept, 1);
}

#[test]
fn configuration_reads_and_refuses() {
    let config: KinematicConfig = toml::from_str("static_frames = 4").unwrap();
    assert_eq!(config, KinematicConfig { static_frames: 4, ..KinematicConfig::default() });
    assert!(toml::from_str::<KinematicConfig>("static_frame = 4").is_err());
    let bad = KinematicConfig { resample_step: 0.0, slow_speed: 0.01, ..KinematicConfig::default() };
    assert_eq!(bad.validate().len(), 2);
    assert!(KinematicConfig::literal().validate().is_empty());
}

#[test]
fn thresholds_hold_at_another_rate() {
    // The same motion, seen twice as often: a pause of one second, a slow stretch, ordinary motion.
    let seen =
        |k: usize| along(&walk(&[(10 * k, 0.01 / k as f64), (20 * k, 0.0), (20 * k, 0.0025 / k as f64)]));
    let (once, twice) = (seen(1), seen(2));
    let at_20 = filter(&once, &KinematicConfig::default()).report;
    let at_40 = filter(&twice, &KinematicConfig::default().at_rate(40.0)).report;
    assert!(at_20.still > 10 && at_20.resampled > 5, "{at_20:?}");
    for (a, b) in [(at_20.still, at_40.still), (at_20.resampled, at_40.resampled), (at_20.kept, at_40.kept)] {
        assert!((2 * a).abs_diff(b) <= 3, "{at_20:?} {at_40:?}");
    }
    assert_eq!(KinematicConfig::default().at_rate(20.0), KinematicConfig::default());
}
