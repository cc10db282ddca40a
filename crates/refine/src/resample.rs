use crate::reverse::continue_path;
use crate::{Error, Result};
use e2h_core::state::{EEF, OPENING};
use e2h_core::{Episode, Pose};

/// An episode at another rate, Hz. Poses lie between their neighbours (position linear, orientation slerp), the gripper's
/// opening too; images, object and `source` are those of the nearest row, never blended. Actions are those of the nearest row
/// and are to be rebuilt.
///
/// # Errors
/// When a rate is not positive.
pub fn resample(episode: &Episode, from_hz: f64, to_hz: f64, reference: &[f64; 4]) -> Result<Episode> {
    for found in [from_hz, to_hz] {
        if !(found.is_finite() && found > 0.0) {
            return Err(Error::Rate { found });
        }
    }
    if episode.is_empty() || from_hz.to_bits() == to_hz.to_bits() {
        return Ok(episode.clone());
    }
    let last = episode.len() - 1;
    let step = from_hz / to_hz;
    // A hair more, so that the last row is met when the rates divide.
    // Not negative.
    let rows = (last as f64 / step + 1e-9) as usize + 1;
    let place = |k: usize| (k as f64 * step).min(last as f64);
    // 0 <= place <= last.
    let nearest: Vec<usize> = (0..rows).map(|k| place(k).round() as usize).collect();
    let mut out = episode.select(&nearest);
    // The last row may be passed by less than a step; it is still the end of the task.
    out.terminal = episode.terminal;
    for (k, state) in out.state.iter_mut().enumerate() {
        // 0 <= place <= last.
        let before = place(k).floor() as usize;
        let (after, f) = ((before + 1).min(last), place(k) - before as f64);
        if f > 1e-9 {
            let pose: Pose = episode.eef(before).interpolate(&episode.eef(after), f);
            state[EEF].copy_from_slice(&pose.to_row(reference));
            let (a, b) = (f64::from(episode.opening(before)), f64::from(episode.opening(after)));
            // Stored episodes are f32.
            let width = (a + (b - a) * f) as f32;
            state[OPENING] = width;
        }
    }
    continue_path(&mut out, reference, None);
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::{along, walk};
    use proptest::prelude::*;

    const DOWN: [f64; 4] = [0.0, 1.0, 0.0, 0.0];

    #[test]
    fn thirty_hertz_become_twenty() {
        // 3 mm per frame at 30 Hz are 4.5 mm at 20 Hz.
        let at_20 = resample(&along(&walk(&[(6, 0.003)])), 30.0, 20.0, &DOWN).unwrap();
        assert_eq!(at_20.source, [0, 2, 3, 5, 6]);
        assert_eq!(*at_20.frames[0].image(1).unwrap(), [2; 3]);
        for (t, state) in at_20.state.iter().enumerate() {
            assert!((state[0] - 0.0045 * t as f32).abs() < 1e-6, "{t}: {}", state[0]);
        }
        assert!(at_20.terminal);
    }

    #[test]
    fn slower_recordings_repeat_images_and_nothing_else() {
        let twice = resample(&along(&[0.0, 0.02]), 10.0, 20.0, &DOWN).unwrap();
        assert_eq!(twice.state.iter().map(|s| s[0]).collect::<Vec<_>>(), [0.0, 0.01, 0.02]);
        assert_eq!(twice.source, [0, 1, 1]);
    }

    #[test]
    fn rates_must_be_rates() {
        for (a, b) in [(0.0, 20.0), (20.0, f64::NAN), (-1.0, 20.0)] {
            assert!(matches!(resample(&along(&[0.0]), a, b, &DOWN), Err(Error::Rate { .. })));
        }
        assert!(resample(&along(&[]), 30.0, 20.0, &DOWN).unwrap().is_empty());
    }

    proptest! {
        #[test]
        fn time_and_place_are_kept(steps in 1_usize..90, from in 5_u8..120, to in 5_u8..120) {
            let (from, to) = (f64::from(from), f64::from(to));
            let path = along(&walk(&[(steps, 0.001)]));
            let out = resample(&path, from, to, &DOWN).unwrap();
            let (before, after) = (steps as f64 / from, (out.len() - 1) as f64 / to);
            prop_assert!(after <= before + 1e-6 && before - after < 1.0 / to, "{before} s became {after} s");
            for (k, s) in out.state.iter().enumerate() {
                let expected = (k as f64 * from / to * 0.001) as f32;
                prop_assert!((s[0] - expected).abs() < 1e-5);
            }
            prop_assert!(out.source.windows(2).all(|w| w[0] <= w[1]));
        }
    }
}
