use crate::tasks::STANDARD;
use crate::{DemonstratorConfig, Expert, PosturePull, Result, Sim};
use e2h_core::{Direction, Pose, Rng};
use nalgebra::Vector3;

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

    /// Up to which turn from the home pose, rad to either side, the hand may put the object down at the end of the easy task: where
    /// the hard task's objects start with any yaw, all the turns that grasp them. By default, for pairs whose objects start one
    /// way or may be grasped any way: 0.
    fn put_down_turn(&self) -> f64 {
        0.0
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
