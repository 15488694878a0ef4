"""New boundary states for a new pose of the part: the same grasp and the same posture of the arm as the plan's."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.models.inverse_kinematics import inverse_kinematics_for, joint_velocity
from dyngrasp.models.srs_kinematics import SrsKinematics
from dyngrasp.motion_arrays import largest_difference
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets, GraspTask, swivel_velocity
from dyngrasp.planning.replanning.boundary_states import flange_goals, srs_boundary_states
from dyngrasp.signals import Array, frozen, read_only

# Where the arm angle of the running plan is forbidden at the new pose, others are tried, nearest first (rad).
_ARM_ANGLE_STEPS = np.deg2rad(np.arange(2.0, 61.0, 2.0))

# The wrist follows the part's yaw; a joint that turns farther (rad) has flipped to an equivalent angle beyond its
# limits.
_LARGEST_TURN = 2.5

_AT_REST = frozen(np.zeros(6))
_REMEMBERED = 64


class TargetUpdater:
    """Boundary states of one task for one pose after another; what does not depend on the pose is computed once."""

    def __init__(self, task: GraspTask) -> None:
        self.task = task
        self._kinematics = inverse_kinematics_for(task.robot)
        self._hands: dict[bytes, pin.SE3] = {}
        self._flanges: dict[tuple[Grasp, bytes, bytes], tuple[Array, Array]] = {}
        settings, chain, self._closed_form = task.settings, task.robot.flange_chain, None
        self._speeds = float(settings.approach_speed), float(settings.lift_speed)
        if isinstance(self._kinematics, SrsKinematics):
            least = float(settings.swivel_rate), float(settings.swivel_speed_ratio)
            swivel = task.robot.limits.velocity, *least
            self._closed_form = self._kinematics.arrays, (chain.rotations, chain.offsets), swivel

    def update(
        self,
        previous: GraspTargets,
        T_world_object: pin.SE3,
        twist_world: Array | None = None,
        grasp_time: float = 0.0,
        grasp_duration: float = 0.0,
    ) -> GraspTargets:
        """Boundary states at a new pose.

        The branch of the inverse kinematics and the arm angle stay those of the running plan, so that the posture
        moves as little as the part does. Where a limit forbids that arm angle the nearest admissible one of the same
        branch is taken. Arms without a closed form descend from the posture of the running plan.

        Args:
            previous: What the running plan was made for.
            T_world_object: New pose of the part, at `grasp_time` if it moves.
            twist_world: (6,) velocity (m/s) and angular velocity (rad/s) of the part, world axes; at rest if left out.
            grasp_time: When the part is taken (s).
            grasp_duration: ΔT_2 (s); a moving part was that long ago at the pre-grasp.

        Raises:
            OutOfReach: No posture of this branch reaches the new pose.
        """
        twist = _AT_REST if twist_world is None else read_only(twist_world, (6,))
        before, at = previous.pregrasp, previous.grasped
        like = before.position, before.velocity, at.position, at.velocity
        aim = T_world_object.homogeneous, twist, float(grasp_duration), self._hands_at(previous), self._speeds
        states = np.empty((2, 2, before.position.size))
        if not (self._closed_form and srs_boundary_states(aim, like, _LARGEST_TURN, *self._closed_form, states)):
            poses, twists = flange_goals(aim)
            states[:, 0] = self.postures(poses, np.array(like[::2]))
            for (q, velocity), twist_flange, way in zip(states, twists, like[1::2], strict=True):
                velocity[:] = self._velocity(q, twist_flange, way)
        frozen(states)
        return GraspTargets(
            T_world_object,
            previous.grasp,
            BoundaryState(states[0, 0], states[0, 1]),
            BoundaryState(states[1, 0], states[1, 1]),
            previous.place,
            previous.gripper_open,
            previous.gripper_closed,
            grasp_time,
            grasp_duration,
            twist,
        )

    def _velocity(self, q: Array, twist_world: Array, like: Array) -> Array:
        """(n,) velocity for a twist of the flange, with a swing of the elbow the way of another velocity."""
        try:
            rate = joint_velocity(self.task.robot, q, twist_world)
        except InvalidProblem as error:
            raise OutOfReach("the grasp", 0.0, str(error)) from error
        return rate + swivel_velocity(q, q, self.task, like)

    def T_flange_grasp(self, posture: Array) -> pin.SE3:
        """The grasp frame as the hand holds it with its fingers in a posture (m,), in the flange frame."""
        key = posture.tobytes()
        if key not in self._hands:
            gripper = self.task.gripper
            # The fingers have few postures at the ends of phases, but moving ones need no memory of their own.
            if len(self._hands) >= _REMEMBERED:
                self._hands.clear()
            self._hands[key] = gripper.T_flange_hand * gripper.T_hand_grasp(posture)
        return self._hands[key]

    def _hands_at(self, targets: GraspTargets) -> tuple[Array, Array]:
        """The fourth of what `flange_goals` takes: they change with the fingers and the grasp alone."""
        key = targets.grasp, targets.gripper_open.tobytes(), targets.gripper_closed.tobytes()
        if key not in self._flanges:
            T_object_grasp = targets.grasp.T_object_grasp
            above = pin.SE3(np.eye(3), np.array([0.0, 0.0, self.task.settings.pregrasp_distance]))
            hand = self.T_flange_grasp(targets.gripper_open)
            flanges = (
                T_object_grasp * above * hand.inverse(),
                T_object_grasp * self.T_flange_grasp(targets.gripper_closed).inverse(),
            )
            poses = np.array([flange.homogeneous[:3] for flange in flanges])
            self._flanges[key] = poses, np.array(hand.rotation[:, 2])
        return self._flanges[key]

    def postures(self, poses: Array, like: Array) -> Array:
        """Configurations of the branches, and if the limits allow of the arm angles, of previous ones.

        Args:
            poses: (K, 3, 4) poses [R | p] of the flange.
            like: (K, n) previous configuration for each of them (rad).

        Returns:
            (K, n) rad.

        Raises:
            OutOfReach: There is none near one of them.
        """
        if isinstance(self._kinematics, SrsKinematics):
            q, turn = self._kinematics.follow(poses, like)
            if turn <= _LARGEST_TURN:
                return q
        else:
            q = np.full(like.shape, np.nan)
        for k, pose in enumerate(poses):
            if np.isnan(q[k]).any():
                q[k] = self._nearest(pin.SE3(pose[:, :3], pose[:, 3]), like[k])
            turn = largest_difference(q[k], like[k])
            if turn > _LARGEST_TURN:
                reason = f"a joint would have to turn by {np.rad2deg(turn):.0f}° to follow it"
                raise OutOfReach("the new pose", 0.0, reason)
        return q

    def _nearest(self, T_world_flange: pin.SE3, q_previous: Array) -> Array:
        """The configuration (n,) of the nearest admissible arm angle of the same branch; for other arms the nearest."""
        kinematics = self._kinematics
        if not isinstance(kinematics, SrsKinematics):
            return kinematics.nearest(T_world_flange, q_previous)
        steps = np.column_stack([_ARM_ANGLE_STEPS, -_ARM_ANGLE_STEPS]).ravel()
        found = kinematics.scan(T_world_flange, kinematics.arm_angle(q_previous) + steps)
        same = np.flatnonzero(found.branches == kinematics.branch(q_previous))
        if not len(same):
            raise OutOfReach("the new pose", 0.0, "no arm angle near that of the plan is within the limits")
        return found.configurations[same[0]]


def updated_targets(previous: GraspTargets, T_world_object: pin.SE3, task: GraspTask) -> GraspTargets:
    """`TargetUpdater.update` of a part at rest.

    Args:
        previous: What the running plan was made for.
        T_world_object: New pose of the part.
        task: Arm, gripper, part and target.

    Raises:
        OutOfReach: No posture of the plan's branch reaches the new pose.
    """
    return target_updater(task).update(previous, T_world_object)


@lru_cache(maxsize=8)
def target_updater(task: GraspTask) -> TargetUpdater:
    """The updater of a task, made once."""
    return TargetUpdater(task)
