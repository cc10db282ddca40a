//! The task pairs, one file and its scene each.

mod brush;
mod cube_pick_place;
mod cube_stack;
mod cylinder_pick_place;
mod disk;
mod mouse;
mod nut_assembly;
mod peg_insertion;
mod rod_insertion;
mod test_tube;

use crate::task::Entry;
pub use brush::Brush;
pub use cube_pick_place::CubePickPlace;
pub use cube_stack::CubeStack;
pub use cylinder_pick_place::CylinderPickPlace;
pub use disk::Disk;
pub use mouse::Mouse;
pub use nut_assembly::NutAssembly;
pub use peg_insertion::PegInsertion;
pub use rod_insertion::RodInsertion;
pub use test_tube::TestTube;

/// Every pair, in the order in which they are listed.
pub(crate) const ENTRIES: [&Entry; 10] = [
    &cube_pick_place::ENTRY,
    &cylinder_pick_place::ENTRY,
    &cube_stack::ENTRY,
    &rod_insertion::ENTRY,
    &nut_assembly::ENTRY,
    &peg_insertion::ENTRY,
    &disk::ENTRY,
    &mouse::ENTRY,
    &test_tube::ENTRY,
    &brush::ENTRY,
];
