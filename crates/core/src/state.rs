//! Where the entries of a [`State`] are.
//!
//! ```
//! use e2h_core::{State, state};
//!
//! let mut row = State::default();
//! row[state::OBJECT_POSITION].copy_from_slice(&[0.1, 0.2, 0.3]);
//! row[state::OPENING] = 0.08;
//! assert_eq!(state::object_position(&row), [0.1, 0.2, 0.3]);
//! ```

use crate::State;
use std::ops::Range;

/// Pose of the tool centre point: position (m), quaternion (wxyz).
pub const EEF: Range<usize> = 0..7;
/// Its position, m.
pub const EEF_POSITION: Range<usize> = 0..3;
/// Its quaternion (wxyz).
pub const EEF_QUATERNION: Range<usize> = 3..7;
/// Pose of the object: position (m), quaternion (wxyz).
pub const OBJECT: Range<usize> = 7..14;
/// Its position, m.
pub const OBJECT_POSITION: Range<usize> = 7..10;
/// Its quaternion (wxyz).
pub const OBJECT_QUATERNION: Range<usize> = 10..14;
/// Gripper opening, m.
pub const OPENING: usize = 14;

/// Position of the tool centre point, m.
#[must_use]
pub fn eef_position(row: &State) -> [f32; 3] {
    std::array::from_fn(|i| row[EEF_POSITION.start + i])
}

/// Position of the object, m.
#[must_use]
pub fn object_position(row: &State) -> [f32; 3] {
    std::array::from_fn(|i| row[OBJECT_POSITION.start + i])
}
