use crate::sim::site_pose;
use e2h_core::Pose;
use mujoco_rs::prelude::{MjData, MjModel};
use nalgebra::{Matrix6, SMatrix, SVector, Vector3, Vector6};
use std::sync::Arc;

/// Joints of the arm.
pub(crate) const JOINTS: usize = 7;

/// A bent, comfortable posture of a Panda over the table, rad: where the search for the home posture starts.
const READY: [f64; JOINTS] = [0.0, -0.35, 0.0, -2.25, 0.0, 1.9, 0.785];
/// Fastest that a joint target moves, rad a control step (2.5 rad/s, a little above the Panda's 2.175).
const MAX_JOINT_STEP: f64 = 0.125;
const POSITION_TOLERANCE: f64 = 1e-5; // m
const ROTATION_TOLERANCE: f64 = 1e-4; // rad
const POSTURE_PULL: f64 = 0.05; // share of the way to the posture in the null space, each time that it is drawn there

/// When the inverse kinematics draws the arm towards its home posture in the null space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PosturePull {
    /// Once a control step, in the first iteration: the null space moves evenly, and the iterations after it converge.
    #[default]
    Once,
    /// In every iteration. How many there are (3 or 20) hangs on the last digits of the error, so the null space moves by
    /// fits and starts; near an upright shoulder, where joints 1 and 3 turn about the same axis, such a start can drive both
    /// into their force limits and the hand centimetres off its goal. Kept for policies that were trained with it.
    Repeated,
}

/// Inverse kinematics, on data of its own so that the simulation is not touched.
pub(crate) struct Arm {
    scratch: MjData<Arc<MjModel>>,
    tcp: usize,
    posture: [f64; JOINTS],
    ranges: [[f64; 2]; JOINTS],
    lead: [f64; JOINTS],
    pull: PosturePull,
}

impl Arm {
    pub(crate) fn new(model: &Arc<MjModel>, tcp: usize, pull: PosturePull) -> Self {
        let mut ranges = [[0.0; 2]; JOINTS];
        let mut lead = [0.0; JOINTS];
        for j in 0..JOINTS {
            ranges[j] = model.jnt_range()[j];
            // A position actuator's force is kp (ctrl - q) - kv qd; the joint brakes with its own damping besides.
            let [kp, kv] = [model.actuator_gainprm()[j][0], -model.actuator_biasprm()[j][2]];
            lead[j] = (kv + 1.0) / kp;
        }
        Self { scratch: MjData::new(model.clone()), tcp, posture: READY, ranges, lead, pull }
    }

    pub(crate) fn posture(&self) -> [f64; JOINTS] {
        self.posture
    }

    pub(crate) fn set_posture(&mut self, joints: [f64; JOINTS]) {
        self.posture = joints;
    }

    /// Feed-forward of each joint, s: how far ahead of its target a position actuator must aim.
    pub(crate) fn lead(&self) -> [f64; JOINTS] {
        self.lead
    }

    /// Pose of the tool centre point at joint angles.
    pub(crate) fn pose(&mut self, joints: &[f64; JOINTS]) -> Pose {
        self.scratch.qpos_mut()[..JOINTS].copy_from_slice(joints);
        self.scratch.kinematics();
        site_pose(&self.scratch, self.tcp)
    }

    /// Scales a step of the joint targets so that no joint is asked to move too fast.
    pub(crate) fn limit(&self, to: &[f64; JOINTS], from: &[f64; JOINTS]) -> [f64; JOINTS] {
        let most = to.iter().zip(from).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let share = if most > MAX_JOINT_STEP { MAX_JOINT_STEP / most } else { 1.0 };
        std::array::from_fn(|j| from[j] + (to[j] - from[j]) * share)
    }

    /// Joint angles for a pose, near `from`, and the distance left over (m plus rad). Damped least squares with a pull
    /// towards the posture in the null space; a pose out of reach gets the nearest that was found.
    pub(crate) fn solve(
        &mut self,
        goal: &Pose,
        from: &[f64; JOINTS],
        iterations: usize,
    ) -> ([f64; JOINTS], f64) {
        let posture = SVector::from(self.posture);
        let mut q = SVector::from(*from);
        let mut left = f64::INFINITY;
        for iteration in 0..iterations {
            let here = self.pose(&q.into());
            let move_by = goal.position - here.position;
            let turn_by = (goal.orientation * here.orientation.inverse()).scaled_axis();
            left = move_by.norm() + turn_by.norm();
            if move_by.norm() < POSITION_TOLERANCE && turn_by.norm() < ROTATION_TOLERANCE {
                break;
            }
            let jacobian = self.jacobian(&here.position);
            let error = Vector6::new(move_by.x, move_by.y, move_by.z, turn_by.x, turn_by.y, turn_by.z);
            let damping = 1e-4 + 1e-2 * error.norm_squared();
            let square = jacobian * jacobian.transpose() + Matrix6::identity() * damping;
            let Some(factor) = square.cholesky() else { break }; // positive definite unless a goal is not finite
            let drawn = iteration == 0 || self.pull == PosturePull::Repeated;
            let pull = (posture - q) * if drawn { POSTURE_PULL } else { 0.0 };
            let mut step = jacobian.transpose() * factor.solve(&(error - jacobian * pull)) + pull;
            let most = step.amax();
            if most > 0.2 {
                step *= 0.2 / most;
            }
            q += step;
            for j in 0..JOINTS {
                q[j] = q[j].clamp(self.ranges[j][0], self.ranges[j][1]);
            }
        }
        (q.into(), left)
    }

    /// Velocity of a point on the hand for each joint's speed, at the posture of the last [`Self::pose`].
    fn jacobian(&self, point: &Vector3<f64>) -> SMatrix<f64, 6, JOINTS> {
        let mut jacobian = SMatrix::<f64, 6, JOINTS>::zeros();
        for j in 0..JOINTS {
            let axis = Vector3::from(self.scratch.xaxis()[j]);
            let arm = point - Vector3::from(self.scratch.xanchor()[j]);
            jacobian.fixed_view_mut::<3, 1>(0, j).copy_from(&axis.cross(&arm));
            jacobian.fixed_view_mut::<3, 1>(3, j).copy_from(&axis);
        }
        jacobian
    }
}
