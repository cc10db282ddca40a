//! The task pairs, one file and its scene each, and the registry of them.

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

use crate::{DemonstratorConfig, Error, Result, Task, TaskOptions};
use std::sync::{Arc, LazyLock};

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

/// Variants of a pair that comes in one form.
pub(crate) const STANDARD: [&str; 1] = ["standard"];

/// What the registry knows of a pair.
pub(crate) struct Entry {
    pub(crate) name: &'static str,
    /// Text of its configuration file.
    pub(crate) config: &'static str,
    /// The default first.
    pub(crate) variants: &'static [&'static str],
    /// None where there is no hole or holder.
    pub(crate) clearance: Option<Clearance>,
    pub(crate) build: fn(Choice) -> Arc<dyn Task>,
}

/// Free space between an object and the hole or holder that it goes into, m per side.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Clearance {
    pub(crate) default: f64,
    /// What the scene has room for, and what the contacts can tell from a press fit.
    pub(crate) range: [f64; 2],
}

/// [`TaskOptions`] that were checked.
#[derive(Debug, Clone)]
pub(crate) struct Choice {
    pub(crate) variant: &'static str,
    /// m per side; 0 where the pair has none.
    pub(crate) clearance: f64,
    pub(crate) demonstrator: DemonstratorConfig,
}

/// Names of all task pairs.
#[must_use]
pub fn registry() -> &'static [&'static str] {
    static NAMES: LazyLock<Vec<&str>> = LazyLock::new(|| ENTRIES.iter().map(|e| e.name).collect());
    &NAMES
}

/// Text of a task's configuration file, which is laid over a preset; none for an unknown task.
#[must_use]
pub fn configuration(name: &str) -> Option<&'static str> {
    ENTRIES.iter().find(|e| e.name == name).map(|e| e.config)
}

/// Names of a task's variants, the default first; empty for an unknown task.
#[must_use]
pub fn variants(name: &str) -> &'static [&'static str] {
    ENTRIES.iter().find(|e| e.name == name).map_or(&[], |e| e.variants)
}

/// A task by name.
///
/// # Errors
/// Unknown names and variants (the message has the nearest known one), a clearance that the scene has no room for, and a
/// demonstrator whose settings cannot work.
pub fn task(name: &str, options: &TaskOptions) -> Result<Arc<dyn Task>> {
    let Some(entry) = ENTRIES.iter().find(|e| e.name == name) else {
        return Err(unknown("task", name, registry()));
    };
    let variant = match options.variant.as_str() {
        "" => entry.variants.first().copied().unwrap_or_default(),
        given => match entry.variants.iter().find(|v| **v == given) {
            Some(v) => v,
            None => return Err(unknown("variant", given, entry.variants)),
        },
    };
    let clearance = clearance(entry, options.clearance)?;
    let problems = options.demonstrator.validate();
    if !problems.is_empty() {
        let problems: Vec<String> = problems.into_iter().map(|p| format!("demonstrator.{p}")).collect();
        return Err(Error::Config(problems.join("; ")));
    }
    Ok((entry.build)(Choice { variant, clearance, demonstrator: options.demonstrator.clone() }))
}

fn clearance(entry: &Entry, given: f64) -> Result<f64> {
    let refuse = |expected| Err(Error::Clearance { task: entry.name, expected, found: given });
    match entry.clearance {
        Some(c) if given == 0.0 => Ok(c.default),
        Some(c) if (c.range[0]..=c.range[1]).contains(&given) => Ok(given),
        Some(Clearance { default, range: [low, high] }) => {
            refuse(format!("{low} to {high} m per side, or 0 for the default of {default}"))
        }
        None if given == 0.0 => Ok(0.0),
        None => refuse("0, because the pair has no hole or holder of variable size".to_owned()),
    }
}

fn unknown(what: &'static str, name: &str, known: &[&str]) -> Error {
    let nearest = e2h_core::nearest(name, known.iter().copied()).unwrap_or_default();
    Error::Unknown { what, name: name.to_owned(), nearest: nearest.to_owned(), known: known.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_name_gets_the_nearest_known_one() {
        let message = task("nut_asembly", &TaskOptions::default()).err().unwrap().to_string();
        assert!(message.contains("did you mean `nut_assembly`"), "{message}");
        let options = TaskOptions { variant: "squire".into(), ..TaskOptions::default() };
        let message = task("nut_assembly", &options).err().unwrap().to_string();
        assert!(message.contains("did you mean `square`"), "{message}");
    }
}
