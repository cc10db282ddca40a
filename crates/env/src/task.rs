use crate::tasks::ENTRIES;
use crate::{Error, Expert, PosturePull, Result, Sim, TaskOptions, config::DemonstratorConfig};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;
use std::sync::{Arc, LazyLock};

/// A pair of tasks that undo each other, in one scene.
///
/// Everything a task needs to know it is told: there is no hidden state, so one task serves any number of environments.
pub trait Task: Send + Sync {
    /// Name in the registry, for example `nut_assembly`.
    fn name(&self) -> &str;

    /// Name of the variant.
    fn variant(&self) -> &str {
        STANDARD[0]
    }

    /// The scene, MJCF.
    fn scene(&self) -> String;

    /// Name of the body whose pose is in the state.
    fn object(&self) -> &str;

    /// Quaternion (wxyz) whose hemisphere the gripper's orientation is kept in.
    fn eef_reference(&self) -> [f64; 4] {
        [0.0, 1.0, 0.0, 0.0] // pointing down
    }

    /// Quaternion (wxyz) whose hemisphere the object's orientation is kept in.
    fn object_reference(&self) -> [f64; 4] {
        [1.0, 0.0, 0.0, 0.0]
    }

    /// Pose of the tool centre point with the arm at home, the same for both directions.
    fn home(&self) -> Pose;

    /// Whether episodes start with the arm at home and the gripper open. False where the arm never lets go: it then starts
    /// wherever [`Self::place`] puts it, and there is no way home that would not undo the task.
    fn homes(&self) -> bool {
        true
    }

    /// When the inverse kinematics draws the arm towards its home posture.
    fn posture_pull(&self) -> PosturePull {
        PosturePull::Once
    }

    /// Control steps after which an episode should time out; what configurations start from.
    fn horizon(&self, direction: Direction) -> usize;

    /// Draws a start of `direction` and puts the object there. The arm is at home already.
    ///
    /// # Errors
    /// When the arm cannot reach a start, or the scene lacks a body; a sound task never fails.
    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng) -> Result<()>;

    /// Whether the scene is in a goal state of `direction` right now.
    fn success(&self, direction: Direction, sim: &Sim) -> bool;

    /// How far the object is from all that guides or holds it at its goals, m; 0 or less while something does. There is room for
    /// an excursion as far as this. By default, for pairs without a hole: how far it is beyond 5 cm from where the episode began.
    fn room(&self, sim: &Sim) -> f64 {
        (sim.object().position - sim.object_start().position).norm() - 0.05
    }

    /// Where the object may be put down at the end of the easy task, nearest to `p` on the level, m: an excursion is held
    /// within it as the object comes down. By default, for pairs that allow any place: `p`.
    fn put_down(&self, p: &Vector3<f64>) -> Vector3<f64> {
        *p
    }

    /// Whether the object has to be held throughout: dropping it then ends the episode.
    fn holds(&self) -> bool {
        false
    }

    /// A demonstrator for one episode.
    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert>;

    /// The demonstrator that the task was configured with.
    fn demonstrator(&self) -> &DemonstratorConfig;
}

/// Variants of a pair that comes in one form.
pub(crate) const STANDARD: [&str; 1] = ["standard"];

/// What the registry knows of a pair.
pub(crate) struct Entry {
    pub(crate) name: &'static str,
    /// The default first.
    pub(crate) variants: &'static [&'static str],
    /// None where there is no hole or holder.
    pub(crate) clearance: Option<Clearance>,
    pub(crate) build: fn(Choice) -> Arc<dyn Task>,
}

/// Free space between an object and the hole or holder that it goes into, m a side.
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
    /// m a side; 0 where the pair has none.
    pub(crate) clearance: f64,
    pub(crate) demonstrator: DemonstratorConfig,
}

/// Names of all task pairs.
#[must_use]
pub fn registry() -> &'static [&'static str] {
    static NAMES: LazyLock<Vec<&str>> = LazyLock::new(|| ENTRIES.iter().map(|e| e.name).collect());
    &NAMES
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
            refuse(format!("{low} to {high} m a side, or 0 for the default of {default}"))
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
