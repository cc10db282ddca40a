//! Episodes for tests.

use crate::ReverseConfig;
use e2h_core::{Direction, Episode, Frames, Observation, Origin};

/// A hand that points down and moves along x through `x`, m; gripper open, object at rest, an image a row that names it.
pub(crate) fn along(x: &[f64]) -> Episode {
    let mut episode = Episode::new(Origin::demonstration("test", Direction::Easy, 0, 1), &[]);
    for &x in x {
        let mut state = [0.0; 15];
        (state[0], state[4], state[7], state[10], state[14]) = (x as f32, 1.0, 0.5, 1.0, 0.08);
        episode.push(&Observation { state, frames: vec![] }, &[9.0; 8]).unwrap();
    }
    let bytes: Vec<u8> = (0..x.len()).flat_map(|t| [t as u8; 3]).collect();
    episode.frames = vec![Frames::new("table", 1, 1, &bytes)];
    episode.validate().unwrap();
    episode
}

/// Positions that follow from steps, m; one more than steps.
pub(crate) fn walk(steps: &[(usize, f64)]) -> Vec<f64> {
    let mut x = vec![0.0];
    for &(count, step) in steps {
        for _ in 0..count {
            x.push(x[x.len() - 1] + step);
        }
    }
    x
}

pub(crate) fn reversal() -> ReverseConfig {
    ReverseConfig::default()
}
