//! Episodes for tests.

use e2h_core::{Direction, Episode, Frames, Observation, Origin, Outcome};

/// Rows that differ in every entry, with two cameras of different size.
pub(crate) fn episode(rows: usize) -> Episode {
    let mut e = Episode::new(Origin::demonstration("test", Direction::Easy, 3, u64::MAX), &[]);
    for t in 0..rows {
        let state = std::array::from_fn(|i| t as f32 + 0.01 * i as f32);
        e.push(&Observation { state, frames: vec![] }, &[t as f32; 8]).unwrap();
    }
    let camera = |name: &str, height: usize, width: usize| {
        let bytes: Vec<u8> = (0..rows * height * width * 3).map(|i| i as u8).collect();
        Frames::new(name, height, width, &bytes)
    };
    e.frames = vec![camera("wrist", 2, 3), camera("table", 4, 4)];
    e.outcome = Outcome::Success { at: rows / 2 };
    e
}
