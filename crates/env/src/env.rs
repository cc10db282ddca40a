use crate::arm::JOINTS;
use crate::expert::gauss;
use crate::render::Renderer;
use crate::{EnvConfig, Error, Result, Sim, Style, Task, logging};
use e2h_core::state::{self, EEF, OBJECT};
use e2h_core::{Action, Direction, Image, Observation, Outcome, Pose, Rng, State, align_hemisphere};
use mujoco_rs::prelude::MjModel;
use std::sync::Arc;

/// Names of the cameras that every scene has, in the order in which observations bring them.
pub const CAMERAS: [&str; 2] = ["table", "wrist"];
/// Control steps that a new start gets to come to rest.
const SETTLE: usize = 4;
/// Control steps in which the gripper opens for certain.
const OPENING: usize = 8;
/// Speed of the arm when it homes, m/s.
const HOMING_SPEED: f64 = 0.4;

/// One environment: a scene, its controller, and the bookkeeping of an episode.
pub struct Env {
    task: Arc<dyn Task>,
    config: EnvConfig,
    cameras: Vec<String>,
    sim: Sim,
    renderer: Renderer,
    episode: Progress,
}

/// The whole state of an environment at one instant, to come back to.
///
/// As numbers it can be kept in a file; what each of them means is the environment's own affair, and may change with the version.
#[derive(Debug, Clone, PartialEq)]
pub struct Snapshot(Vec<f64>);

impl Snapshot {
    /// Its numbers.
    #[must_use]
    pub fn numbers(&self) -> &[f64] {
        &self.0
    }
}

impl From<Vec<f64>> for Snapshot {
    fn from(numbers: Vec<f64>) -> Self {
        Self(numbers)
    }
}

/// Where an episode stands.
#[derive(Debug, Clone, Copy)]
struct Progress {
    direction: Direction,
    steps: usize,
    held: usize,
    /// Quaternions (wxyz) of the hand and the object as they were last observed: the next ones are written in their
    /// hemispheres, so that none jumps to its negative in the middle of an episode.
    signs: [[f64; 4]; 2],
}

impl Env {
    /// An environment of a task.
    ///
    /// # Errors
    /// When settings cannot work, MuJoCo refuses the scene, or the scene lacks what the environment needs.
    pub fn new(task: Arc<dyn Task>, config: &EnvConfig) -> Result<Self> {
        let problems = config.validate();
        if !problems.is_empty() {
            return Err(Error::Config(problems.join("; ")));
        }
        logging::install();
        let model = MjModel::from_xml_string(&task.scene()).map_err(|e| Error::MuJoCo(e.to_string()))?;
        Self::with_model(task, config, Arc::new(model))
    }

    /// Another environment of the same task that shares the compiled model; it starts from a scene of its own.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn clone_shared(&self) -> Result<Self> {
        let mut other = Self::with_model(self.task.clone(), &self.config, self.sim.model.clone())?;
        other.cameras.clone_from(&self.cameras);
        Ok(other)
    }

    /// From now on observations bring the images of these cameras, in this order; without [`EnvConfig::cameras`] none does.
    ///
    /// # Errors
    /// An unknown camera. Nothing has changed then.
    pub fn select_cameras(&mut self, names: &[String]) -> Result<()> {
        if let Some(name) = names.iter().find(|n| !CAMERAS.contains(&n.as_str())) {
            return Err(Error::Camera { name: name.clone(), known: known_cameras() });
        }
        if self.config.cameras {
            self.cameras = names.to_vec();
        }
        Ok(())
    }

    fn with_model(task: Arc<dyn Task>, config: &EnvConfig, model: Arc<MjModel>) -> Result<Self> {
        let sim = Sim::new(model, task.object(), &task.home(), task.posture_pull())?;
        let cameras = if config.cameras { CAMERAS.map(str::to_owned).to_vec() } else { vec![] };
        let signs = [task.eef_reference(), task.object_reference()];
        let episode = Progress { direction: Direction::Hard, steps: 0, held: 0, signs };
        Ok(Self { task, config: config.clone(), cameras, sim, renderer: Renderer::default(), episode })
    }

    /// The task.
    #[must_use]
    pub fn task(&self) -> &Arc<dyn Task> {
        &self.task
    }

    /// The configuration.
    #[must_use]
    pub fn config(&self) -> &EnvConfig {
        &self.config
    }

    /// Names of the cameras in observations; none when images are off.
    #[must_use]
    pub fn cameras(&self) -> &[String] {
        &self.cameras
    }

    /// The scene, for demonstrators and diagnosis.
    #[must_use]
    pub fn sim(&self) -> &Sim {
        &self.sim
    }

    /// Control steps after which an episode times out.
    #[must_use]
    pub fn horizon(&self, direction: Direction) -> usize {
        match direction {
            Direction::Hard => self.config.horizon_hard,
            Direction::Easy => self.config.horizon_easy,
        }
    }

    /// Control steps of this episode so far.
    #[must_use]
    pub fn steps(&self) -> usize {
        self.episode.steps
    }

    /// An external reset: the arm at home (with a little noise), the object at a start of `direction`; begins an episode.
    ///
    /// # Errors
    /// [`Error::Diverged`] when the start does, which another draw may not; when the arm cannot reach the start. A sound task never
    /// does either.
    pub fn reset(&mut self, direction: Direction, rng: &mut Rng) -> Result<()> {
        let home = self.sim.home_joints();
        let joints: [f64; JOINTS] = std::array::from_fn(|j| home[j] + gauss(rng, self.config.home_noise_rad));
        self.sim.clear(&joints);
        let placed = self.task.place(direction, &mut self.sim, rng);
        if placed.is_ok() {
            self.sim.settle(SETTLE);
        }
        // None was left by `clear`, and each empties the counts of those before: any number means one since.
        if self.sim.trouble() != 0 {
            return Err(Error::Diverged("the start of an episode"));
        }
        placed?;
        self.begin(direction)
    }

    /// Begins an episode of `direction` from the scene as it is.
    ///
    /// # Errors
    /// None at present; kept for environments that refuse some states.
    pub fn begin(&mut self, direction: Direction) -> Result<()> {
        let signs = [self.task.eef_reference(), self.task.object_reference()];
        self.episode = Progress { direction, steps: 0, held: 0, signs };
        self.sim.begin();
        self.continue_signs();
        Ok(())
    }

    /// Takes the arm home without a reset: opens the gripper, rises straight up, goes to the home posture. Not part of
    /// an episode, so its counters stand still. Where episodes do not start from there ([`Task::homes`]) nothing moves.
    ///
    /// # Errors
    /// [`Error::Diverged`] when the simulation does on the way; a [`Self::reset`] goes on from there.
    pub fn home(&mut self) -> Result<()> {
        if !self.task.homes() {
            return Ok(());
        }
        let (trouble, time) = (self.sim.trouble(), self.sim.time());
        self.sim.settle_open(OPENING);
        let home = self.sim.home();
        let mut above = self.sim.goal();
        above.position.z = above.position.z.max(home.position.z);
        for goal in [above, home] {
            self.travel(&goal);
        }
        // The null space is not fixed by the pose: finish at the very posture of a reset.
        let joints = self.sim.home_joints();
        for _ in 0..200 {
            if self.sim.approach_joints(&joints) {
                break;
            }
        }
        self.sim.settle(SETTLE);
        // Divergence sets both back.
        let sound = self.sim.trouble() == trouble && self.sim.time() > time;
        if sound { Ok(()) } else { Err(Error::Diverged("the way home")) }
    }

    fn travel(&mut self, goal: &Pose) {
        let (step, turn) = (HOMING_SPEED / e2h_core::CONTROL_HZ, self.config.max_goal_step_rad);
        for _ in 0..200 {
            let here = self.sim.goal();
            if (here.position - goal.position).norm() < 1e-6
                && here.orientation.angle_to(&goal.orientation) < 1e-6
            {
                break;
            }
            self.sim.drive(goal, true, step, turn);
        }
    }

    /// What a policy sees now.
    ///
    /// # Errors
    /// When a camera is missing from the scene.
    pub fn observe(&mut self) -> Result<Observation> {
        let side = self.config.image_size;
        let mut frames = Vec::with_capacity(self.cameras.len());
        for camera in &self.cameras {
            frames.push(self.renderer.draw(&self.sim.data, camera, side, side, Style::default())?);
        }
        Ok(Observation { state: self.state(), frames })
    }

    /// The low-dimensional state: tool centre point, object, distance between the fingers (0 to 0.08 m).
    #[must_use]
    pub fn state(&self) -> State {
        let mut row = State::default();
        let [eef, object] = &self.episode.signs;
        row[EEF].copy_from_slice(&self.sim.tcp().to_row(eef));
        row[OBJECT].copy_from_slice(&self.sim.object().to_row(object));
        // Recorded states are f32.
        let opening = self.sim.opening() as f32;
        row[state::OPENING] = opening;
        row
    }

    /// One control step. The outcome is there when the episode ended with it: success held for
    /// [`EnvConfig::hold_steps`], the horizon, an object that was dropped where it must be held, or a simulation that ran
    /// away (these two need a [`Self::reset`]).
    ///
    /// # Errors
    /// An action with a number that is not finite, or a quaternion without direction. Nothing has moved then.
    pub fn step(&mut self, action: &Action) -> Result<Option<Outcome>> {
        if let Some(accident) = self.advance(action)? {
            return Ok(Some(accident));
        }
        let timeout = self.episode.steps >= self.horizon(self.episode.direction);
        Ok(self.held().or(timeout.then_some(Outcome::Timeout)))
    }

    /// Takes the quaternions as they are now for the hemispheres of the next ones.
    fn continue_signs(&mut self) {
        let poses = [self.sim.tcp(), self.sim.object()];
        for (before, pose) in self.episode.signs.iter_mut().zip(poses) {
            let q = pose.orientation.quaternion();
            *before = align_hemisphere([q.w, q.i, q.j, q.k], before);
        }
    }

    /// Success, if the goal was held long enough up to now.
    pub(crate) fn held(&self) -> Option<Outcome> {
        let Progress { steps, held, .. } = self.episode;
        (held >= self.config.hold_steps.max(1)).then(|| Outcome::Success { at: steps - held })
    }

    /// One control step that ends only by accident: a simulation that diverged, an object that was dropped.
    pub(crate) fn advance(&mut self, action: &Action) -> Result<Option<Outcome>> {
        check(action)?;
        let (trouble, time) = (self.sim.trouble(), self.sim.time());
        let goal = Pose::from_row(&action[..7]);
        let open = action[7] > 0.5;
        self.sim.drive(&goal, open, self.config.max_goal_step_m, self.config.max_goal_step_rad);
        self.episode.steps += 1;
        self.continue_signs();
        if self.sim.trouble() != trouble || self.sim.time() <= time {
            return Ok(Some(Outcome::Diverged));
        }
        if self.task.holds() && !self.sim.touching() {
            return Ok(Some(Outcome::Dropped));
        }
        let good = self.task.success(self.episode.direction, &self.sim);
        self.episode.held = if good { self.episode.held + 1 } else { 0 };
        Ok(None)
    }

    /// Whether the scene is in a goal state of `direction` right now.
    #[must_use]
    pub fn success(&self, direction: Direction) -> bool {
        self.task.success(direction, &self.sim)
    }

    /// The whole state, physics, controller and counters: [`Self::restore`] continues from it bit for bit.
    #[must_use]
    pub fn save(&self) -> Snapshot {
        let mut state = self.sim.save();
        let Progress { direction, steps, held, signs } = self.episode;
        state.extend([f64::from(u8::from(direction == Direction::Easy)), steps as f64, held as f64]);
        state.extend(signs.as_flattened());
        Snapshot(state)
    }

    /// Back to a state of [`Self::save`], of this or another environment of the same task.
    ///
    /// # Errors
    /// When it is not of this task.
    pub fn restore(&mut self, snapshot: &Snapshot) -> Result<()> {
        let state = &snapshot.0[..];
        let expected = self.save().0.len();
        if state.len() != expected {
            return Err(Error::State { expected, found: state.len() });
        }
        let [easy, steps, held, ref signs @ ..] = *self.sim.restore(state)? else {
            return Err(Error::State { expected, found: state.len() });
        };
        let signs = signs.to_vec(); // eight numbers: the length was checked
        let direction = if easy > 0.5 { Direction::Easy } else { Direction::Hard };
        // Saved from usize.
        let (steps, held) = (steps as usize, held as usize);
        let quaternion = |i: usize| std::array::from_fn(|k| signs[4 * i + k]);
        self.episode = Progress { direction, steps, held, signs: [quaternion(0), quaternion(1)] };
        Ok(())
    }

    /// A picture of any size, drawn as in observations.
    ///
    /// # Errors
    /// An unknown camera, or sides that are not 1 to [`crate::MOST_PIXELS`].
    pub fn render(&mut self, camera: &str, width: usize, height: usize) -> Result<Image> {
        self.render_styled(camera, width, height, Style::default())
    }

    /// A picture of any size for a report, for example with shadows.
    ///
    /// # Errors
    /// An unknown camera, or sides that are not 1 to [`crate::MOST_PIXELS`].
    pub fn render_styled(
        &mut self,
        camera: &str,
        width: usize,
        height: usize,
        style: Style,
    ) -> Result<Image> {
        self.renderer.draw(&self.sim.data, camera, width, height, style)
    }
}

/// The cameras in words.
pub(crate) fn known_cameras() -> String {
    format!("the cameras `{}`", CAMERAS.join("` and `"))
}

/// Refuses actions before anything moves.
fn check(action: &Action) -> Result<()> {
    if !action.iter().all(|v| v.is_finite()) {
        return Err(Error::Action { expected: "finite numbers", found: *action });
    }
    if action[3..7].iter().map(|v| v * v).sum::<f32>() < 1e-6 {
        return Err(Error::Action {
            expected: "a quaternion (wxyz) at 3..7 that is not zero",
            found: *action,
        });
    }
    Ok(())
}
