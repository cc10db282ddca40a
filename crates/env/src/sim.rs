use crate::arm::{Arm, JOINTS, PosturePull};
use crate::{Error, Result};
use e2h_core::Pose;
use mujoco_rs::prelude::{MjData, MjModel, MjtJoint, MjtObjBase, MjtState, MjtWarning};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use std::sync::Arc;

/// Opening of the gripper with both fingers fully apart, m.
pub const MAX_OPENING: f64 = 0.08;

const FINGER_OPEN: f64 = 0.04; // m a finger
const FINGER_CLOSED: f64 = -0.01; // m; past contact, so that the actuator squeezes
const STATE: u32 = MjtState::mjSTATE_INTEGRATION as u32; // the one that replays bit-exactly
const GRIP: usize = JOINTS; // index of the gripper's actuator, and of the first finger joint

/// Where the controller stands: what it commanded last.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Command {
    /// Goal pose of the tool centre point.
    pub(crate) goal: Pose,
    /// Joint targets, rad.
    pub(crate) joints: [f64; JOINTS],
    /// Gripper command.
    pub(crate) open: bool,
}

/// One simulated scene: what tasks place and judge, and what scripted demonstrators see (all of it).
///
/// # Units
/// Metres, radians, seconds, in the frame of the robot's base.
pub struct Sim {
    pub(crate) model: Arc<MjModel>,
    pub(crate) data: MjData<Arc<MjModel>>,
    pub(crate) command: Command,
    arm: Arm,
    home: Command,
    tcp: usize,
    object: usize,
    /// None where the arm carries a tool instead.
    gripper: bool,
    /// Pose of the object when the episode began.
    object_start: Pose,
    robot_geoms: Vec<bool>,
    object_geoms: Vec<bool>,
}

impl Sim {
    /// A scene with the arm at the posture that holds the tool centre point at `home`.
    pub(crate) fn new(model: Arc<MjModel>, object: &str, home: &Pose, pull: PosturePull) -> Result<Self> {
        let find = |kind, what, name: &str| {
            model.name_to_id(kind, name).ok_or_else(|| Error::Missing { what, name: name.to_owned() })
        };
        let tcp = find(MjtObjBase::mjOBJ_SITE, "site", "tcp")?;
        let body = find(MjtObjBase::mjOBJ_BODY, "body", object)?;
        let hand = find(MjtObjBase::mjOBJ_BODY, "body", "hand")?;
        let on = |body: usize| model.geom_bodyid().iter().map(|&b| b == body as i32).collect::<Vec<_>>();
        // What hangs on the hand, fingers or a tool, belongs to the robot.
        let parent =
            |body: i32| usize::try_from(body).ok().and_then(|b| model.body_parentid().get(b).copied());
        let of_hand = |body: i32| {
            std::iter::successors(Some(body), |&b| parent(b).filter(|_| b > 0)).any(|b| b == hand as i32)
        };
        let robot_geoms = model.geom_bodyid().iter().map(|&b| of_hand(b)).collect();
        let object_geoms = on(body);

        let mut arm = Arm::new(&model, tcp, pull);
        let (joints, error) = arm.solve(home, &arm.posture(), 200);
        if error > 1e-4 {
            return Err(Error::Unreachable { what: "home pose", error });
        }
        arm.set_posture(joints);
        let gripper = model.name_to_id(MjtObjBase::mjOBJ_ACTUATOR, "grip").is_some();
        let command = Command { goal: *home, joints, open: true };
        let data = MjData::new(model.clone());
        let mut sim = Self {
            data,
            command,
            arm,
            home: command,
            tcp,
            object: body,
            gripper,
            object_start: *home,
            robot_geoms,
            object_geoms,
            model,
        };
        sim.clear(&joints);
        Ok(sim)
    }

    /// Puts everything at rest: the arm at `joints`, the gripper open, the object where the scene has it.
    pub(crate) fn clear(&mut self, joints: &[f64; JOINTS]) {
        self.data.reset();
        self.set_arm(joints);
        self.set_gripper(2.0 * FINGER_OPEN, true);
        self.refresh();
    }

    /// Brings poses and contacts up to date with the joint positions; leaves the dynamics alone, so that a saved state
    /// replays bit-exactly.
    pub(crate) fn refresh(&mut self) {
        self.data.fwd_position();
    }

    /// Pose of the tool centre point (between the finger pads), measured.
    #[must_use]
    pub fn tcp(&self) -> Pose {
        site_pose(&self.data, self.tcp)
    }

    /// The goal pose that the controller follows at the moment.
    #[must_use]
    pub fn goal(&self) -> Pose {
        self.command.goal
    }

    /// Pose of the tool centre point when the arm is at home.
    #[must_use]
    pub fn home(&self) -> Pose {
        self.home.goal
    }

    /// The gripper command that holds at the moment: true for open.
    #[must_use]
    pub fn opens(&self) -> bool {
        self.command.open
    }

    pub(crate) fn home_joints(&self) -> [f64; JOINTS] {
        self.home.joints
    }

    /// Pose of the object.
    #[must_use]
    pub fn object(&self) -> Pose {
        self.pose(self.object)
    }

    /// Pose of the object when the episode began.
    #[must_use]
    pub fn object_start(&self) -> Pose {
        self.object_start
    }

    pub(crate) fn begin(&mut self) {
        self.object_start = self.object();
    }

    /// Pose of a body of the scene.
    ///
    /// # Errors
    /// When there is no such body.
    pub fn body(&self, name: &str) -> Result<Pose> {
        Ok(self.pose(self.body_id(name)?))
    }

    /// Speed of the frame of a free body, m/s.
    ///
    /// # Errors
    /// When there is no such body, or it is not free.
    pub fn speed(&self, name: &str) -> Result<f64> {
        let (_, dof) = self.free_joint(self.body_id(name)?)?;
        Ok(Vector3::from_row_slice(&self.data.qvel()[dof..dof + 3]).norm())
    }

    fn pose(&self, body: usize) -> Pose {
        let (p, q) = (self.data.xpos()[body], self.data.xquat()[body]);
        let q = Quaternion::new(q[0], q[1], q[2], q[3]);
        Pose::new(Vector3::from(p), UnitQuaternion::try_new(q, 1e-9).unwrap_or_else(UnitQuaternion::identity))
    }

    fn body_id(&self, name: &str) -> Result<usize> {
        self.model
            .name_to_id(MjtObjBase::mjOBJ_BODY, name)
            .ok_or_else(|| Error::Missing { what: "body", name: name.to_owned() })
    }

    /// Where positions and velocities of a free body begin.
    fn free_joint(&self, body: usize) -> Result<(usize, usize)> {
        let index = |v: Option<&i32>| v.and_then(|&v| usize::try_from(v).ok());
        index(self.model.body_jntadr().get(body))
            .filter(|&j| self.model.jnt_type().get(j) == Some(&MjtJoint::mjJNT_FREE))
            .and_then(|j| {
                Some((index(self.model.jnt_qposadr().get(j))?, index(self.model.jnt_dofadr().get(j))?))
            })
            .ok_or_else(|| {
                let name = self.model.id_to_name(MjtObjBase::mjOBJ_BODY, body).unwrap_or_default();
                Error::Missing { what: "free joint of body", name: name.to_owned() }
            })
    }

    /// Distance between the fingers, m, in [0, [`MAX_OPENING`]]; 0 without a gripper.
    #[must_use]
    pub fn opening(&self) -> f64 {
        if !self.gripper {
            return 0.0;
        }
        let q = self.data.qpos();
        (q[GRIP] + q[GRIP + 1]).clamp(0.0, MAX_OPENING)
    }

    /// Whether hand or fingers touch the object.
    #[must_use]
    pub fn touching(&self) -> bool {
        let of = |set: &[bool], geom: i32| {
            usize::try_from(geom).is_ok_and(|g| set.get(g).copied().unwrap_or(false))
        };
        self.data.contact().iter().any(|c| {
            let [a, b] = c.geom;
            c.dist < 0.0
                && ((of(&self.robot_geoms, a) && of(&self.object_geoms, b))
                    || (of(&self.robot_geoms, b) && of(&self.object_geoms, a)))
        })
    }

    /// Depth of the deepest contact, m.
    #[must_use]
    pub fn penetration(&self) -> f64 {
        self.data.contact().iter().map(|c| -c.dist).fold(0.0, f64::max)
    }

    /// Whether the gripper is open and clear of the object.
    #[must_use]
    pub fn released(&self) -> bool {
        self.opening() > 0.9 * MAX_OPENING && !self.touching()
    }

    /// Puts the object at rest at a pose.
    ///
    /// # Errors
    /// When the object is not a free body.
    pub fn set_object(&mut self, pose: &Pose) -> Result<()> {
        self.set(self.object, pose)
    }

    /// Puts a free body at rest at a pose.
    ///
    /// # Errors
    /// When there is no such body, or it is not free.
    pub fn set_body(&mut self, name: &str, pose: &Pose) -> Result<()> {
        self.set(self.body_id(name)?, pose)
    }

    fn set(&mut self, body: usize, pose: &Pose) -> Result<()> {
        let (qpos, dof) = self.free_joint(body)?;
        let q = pose.orientation.quaternion();
        let row = [pose.position.x, pose.position.y, pose.position.z, q.w, q.i, q.j, q.k];
        self.data.qpos_mut()[qpos..qpos + 7].copy_from_slice(&row);
        self.data.qvel_mut()[dof..dof + 6].fill(0.0);
        self.refresh();
        Ok(())
    }

    /// Puts the arm at rest with the tool centre point at a pose, and the object between its fingers at a pose; the
    /// fingers close from `opening`, m.
    ///
    /// # Errors
    /// When the arm cannot reach the pose, or the object is not a free body.
    pub fn set_holding(&mut self, tcp: &Pose, object: &Pose, opening: f64) -> Result<()> {
        self.set_tcp(tcp)?;
        self.set_gripper(opening, false);
        self.set_object(object)
    }

    /// Puts the arm at rest with the tool centre point at a pose.
    ///
    /// # Errors
    /// When the arm cannot reach it.
    pub fn set_tcp(&mut self, tcp: &Pose) -> Result<()> {
        let joints = self.joints_for(tcp)?;
        self.set_arm(&joints);
        self.refresh();
        Ok(())
    }

    /// Joint angles, rad, with which the arm holds its tool centre point at a pose; for a second arm like it, in the frame
    /// of that one's base.
    ///
    /// # Errors
    /// When the arm cannot reach it.
    pub fn joints_for(&mut self, tcp: &Pose) -> Result<[f64; JOINTS]> {
        let (joints, error) = self.arm.solve(tcp, &self.home.joints, 200);
        if error > 1e-3 {
            return Err(Error::Unreachable { what: "start pose of the hand", error });
        }
        Ok(joints)
    }

    /// Puts the second arm of a scene of two at rest at joint angles, which it then holds.
    ///
    /// # Errors
    /// When the scene has no second arm.
    pub fn set_second_arm(&mut self, joints: &[f64; JOINTS]) -> Result<()> {
        let missing = || Error::Missing { what: "actuator", name: "second_a1".to_owned() };
        let actuator = self.model.name_to_id(MjtObjBase::mjOBJ_ACTUATOR, "second_a1").ok_or_else(missing)?;
        let joint = self.model.name_to_id(MjtObjBase::mjOBJ_JOINT, "second_joint1").ok_or_else(missing)?;
        let qpos = self.model.jnt_qposadr().get(joint).and_then(|&q| usize::try_from(q).ok());
        let qpos = qpos.ok_or_else(missing)?;
        self.data.qpos_mut()[qpos..qpos + JOINTS].copy_from_slice(joints);
        self.data.ctrl_mut()[actuator..actuator + JOINTS].copy_from_slice(joints);
        self.refresh();
        Ok(())
    }

    fn set_gripper(&mut self, opening: f64, open: bool) {
        self.command.open = open;
        if self.gripper {
            self.data.qpos_mut()[GRIP..GRIP + 2].fill(0.5 * opening);
            self.data.ctrl_mut()[GRIP] = if open { FINGER_OPEN } else { FINGER_CLOSED };
        }
    }

    fn set_arm(&mut self, joints: &[f64; JOINTS]) {
        self.data.qpos_mut()[..JOINTS].copy_from_slice(joints);
        self.data.ctrl_mut()[..JOINTS].copy_from_slice(joints);
        self.command.goal = self.arm.pose(joints);
        self.command.joints = *joints;
    }

    /// Lets the scene come to rest with the arm held where it is.
    pub fn settle(&mut self, control_steps: usize) {
        let Command { joints, open, .. } = self.command;
        for _ in 0..control_steps {
            self.drive_joints(&joints, open);
        }
    }

    /// Waits until the object is at rest, for at most so many control steps: what leans or rocks takes a while.
    ///
    /// # Errors
    /// When the object is not a free body.
    pub fn settle_object(&mut self, most: usize) -> Result<()> {
        let (_, dof) = self.free_joint(self.object)?;
        for _ in 0..most {
            self.settle(1);
            if self.data.qvel()[dof..dof + 6].iter().all(|v| v.abs() < 1e-3) {
                break;
            }
        }
        Ok(())
    }

    /// As [`Self::settle`], with the gripper open.
    pub(crate) fn settle_open(&mut self, control_steps: usize) {
        self.command.open = true;
        self.settle(control_steps);
    }

    /// One control step towards joint targets at a safe speed; true when they are reached.
    pub(crate) fn approach_joints(&mut self, joints: &[f64; JOINTS]) -> bool {
        if self.command.joints == *joints {
            return true;
        }
        let most = self.command.joints.iter().zip(joints).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let share = (0.04 / most.max(1e-12)).min(1.0); // 0.8 rad/s
        let from = self.command.joints;
        let next = std::array::from_fn(|j| {
            if share < 1.0 { from[j] + (joints[j] - from[j]) * share } else { joints[j] }
        });
        let open = self.command.open;
        self.drive_joints(&next, open);
        self.command.goal = self.arm.pose(&next);
        false
    }

    /// One control step towards a goal pose that moves and turns at most as far as allowed.
    pub(crate) fn drive(&mut self, goal: &Pose, open: bool, max_move: f64, max_turn: f64) {
        let from = self.command.goal;
        let move_by = (goal.position - from.position).norm();
        let turn_by = from.orientation.angle_to(&goal.orientation);
        let share = |by: f64, max: f64| if by > max { max / by } else { 1.0 };
        let goal = Pose::new(
            from.interpolate(goal, share(move_by, max_move)).position,
            from.interpolate(goal, share(turn_by, max_turn)).orientation,
        );
        let (joints, _) = self.arm.solve(&goal, &self.command.joints, 20);
        let joints = self.arm.limit(&joints, &self.command.joints);
        self.command.goal = goal;
        self.drive_joints(&joints, open);
    }

    /// One control step to joint targets, interpolated over the physics steps. The velocity feed-forward cancels the
    /// damping of actuator and joint, which is what would make the arm lag.
    pub(crate) fn drive_joints(&mut self, joints: &[f64; JOINTS], open: bool) {
        let from = self.command.joints;
        let lead = self.arm.lead();
        let dt = self.model.opt().timestep;
        // A whole number in every scene.
        let steps = (1.0 / (e2h_core::CONTROL_HZ * dt)).round();
        for k in 1..=steps as usize {
            let ctrl = self.data.ctrl_mut();
            for j in 0..JOINTS {
                let step = joints[j] - from[j];
                ctrl[j] = from[j] + step * (k as f64 / steps) + lead[j] * step / (steps * dt);
            }
            if self.gripper {
                ctrl[GRIP] = if open { FINGER_OPEN } else { FINGER_CLOSED };
            }
            self.data.step();
        }
        self.command.joints = *joints;
        self.command.open = open;
        self.refresh();
    }

    /// Counts of the warnings with which MuJoCo reports a simulation that ran away; it then resets the state silently.
    pub(crate) fn trouble(&self) -> i32 {
        let kinds = [
            MjtWarning::mjWARN_BADQPOS,
            MjtWarning::mjWARN_BADQVEL,
            MjtWarning::mjWARN_BADQACC,
            MjtWarning::mjWARN_BADCTRL,
        ];
        let all = self.data.warning();
        kinds.into_iter().map(|kind| all[kind as usize].number).sum()
    }

    /// Simulated time, s.
    #[must_use]
    pub fn time(&self) -> f64 {
        self.data.time()
    }

    /// Physics and controller as numbers.
    pub(crate) fn save(&self) -> Vec<f64> {
        let mut state = self.data.state(STATE).into_vec();
        let q = self.command.goal.orientation.quaternion();
        state.extend(self.command.goal.position.iter());
        state.extend([q.w, q.i, q.j, q.k]);
        state.extend(self.command.joints);
        state.push(f64::from(u8::from(self.command.open)));
        let q = self.object_start.orientation.quaternion();
        state.extend(self.object_start.position.iter());
        state.extend([q.w, q.i, q.j, q.k]);
        state
    }

    /// Back to a state of [`Self::save`]; the numbers after it are returned.
    pub(crate) fn restore<'a>(&mut self, state: &'a [f64]) -> Result<&'a [f64]> {
        let physics = self.model.state_size(STATE);
        let expected = physics + 7 + JOINTS + 1 + 7;
        if state.len() < expected {
            return Err(Error::State { expected, found: state.len() });
        }
        let (physics, rest) = state.split_at(physics);
        self.data.set_state(physics, STATE).map_err(|e| Error::MuJoCo(e.to_string()))?;
        self.command.goal = pose_from(rest);
        self.command.joints.copy_from_slice(&rest[7..7 + JOINTS]);
        self.command.open = rest[7 + JOINTS] > 0.5;
        self.object_start = pose_from(&rest[8 + JOINTS..]);
        self.refresh();
        Ok(&rest[15 + JOINTS..])
    }
}

/// A pose from seven numbers. Unchecked: normalising again would change the last bit of a quaternion that was saved
/// normalised.
fn pose_from(row: &[f64]) -> Pose {
    let orientation = UnitQuaternion::new_unchecked(Quaternion::new(row[3], row[4], row[5], row[6]));
    Pose::new(Vector3::new(row[0], row[1], row[2]), orientation)
}

/// Pose of a site.
pub(crate) fn site_pose(data: &MjData<Arc<MjModel>>, site: usize) -> Pose {
    let rotation = nalgebra::Matrix3::from_row_slice(&data.site_xmat()[site]);
    // Not Rotation3::scaled_axis and friends, which give NaN at half turns; the quaternion conversion is sound.
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(rotation);
    Pose::new(Vector3::from(data.site_xpos()[site]), UnitQuaternion::from_rotation_matrix(&rotation))
}
