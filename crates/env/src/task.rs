use crate::{Error, Expert, Result, Sim, TaskOptions, config::DemonstratorConfig, nut};
use e2h_core::{Direction, Pose, Rng};
use std::sync::Arc;

/// A pair of tasks that undo each other, in one scene.
///
/// Everything a task needs to know it is told: there is no hidden state, so one task serves any number of environments.
pub trait Task: Send + Sync {
    /// Name in the registry, for example `nut_assembly`.
    fn name(&self) -> &str;

    /// Name of the variant.
    fn variant(&self) -> &str;

    /// The scene, MJCF.
    fn scene(&self) -> String;

    /// Name of the body whose pose is in the state.
    fn object(&self) -> &str;

    /// Quaternion (wxyz) whose hemisphere the gripper's orientation is kept in.
    fn eef_reference(&self) -> [f64; 4] {
        [0.0, 1.0, 0.0, 0.0] // pointing down
    }

    /// Quaternion (wxyz) whose hemisphere the object's orientation is kept in.
    fn object_reference(&self) -> [f64; 4];

    /// Pose of the tool centre point with the arm at home, the same for both directions.
    fn home(&self) -> Pose;

    /// Control steps after which an episode should time out; what configurations start from.
    fn horizon(&self, direction: Direction) -> usize;

    /// Draws a start of `direction` and puts the object there. The arm is at home already.
    fn place(&self, direction: Direction, sim: &mut Sim, rng: &mut Rng);

    /// Whether the scene is in a goal state of `direction` right now.
    fn success(&self, direction: Direction, sim: &Sim) -> bool;

    /// A demonstrator for one episode.
    fn expert(&self, direction: Direction, config: &DemonstratorConfig, rng: &mut Rng) -> Box<dyn Expert>;

    /// The demonstrator that the task was configured with.
    fn demonstrator(&self) -> &DemonstratorConfig;
}

/// Names of all task pairs.
#[must_use]
pub fn registry() -> &'static [&'static str] {
    &["nut_assembly"]
}

/// Names of a task's variants, the default first; empty for an unknown task.
#[must_use]
pub fn variants(name: &str) -> &'static [&'static str] {
    match name {
        "nut_assembly" => &nut::VARIANTS,
        _ => &[],
    }
}

/// A task by name.
///
/// # Errors
/// Unknown names and variants; the message has the nearest known one.
pub fn task(name: &str, options: &TaskOptions) -> Result<Arc<dyn Task>> {
    let known = registry();
    if !known.contains(&name) {
        return Err(unknown("task", name, known));
    }
    let variants = variants(name);
    let variant = match options.variant.as_str() {
        "" => variants.first().copied().unwrap_or_default(),
        given => match variants.iter().find(|v| **v == given) {
            Some(v) => v,
            None => return Err(unknown("variant", given, variants)),
        },
    };
    Ok(Arc::new(nut::NutAssembly::new(variant, options.demonstrator.clone())))
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
