"""New boundary states for a new pose of the part: the same grasp and the same posture of the arm as the plan's."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.models.inverse_kinematics import inverse_kinematics_for, joint_velocity
from dyngrasp.models.srs_kinematics import SrsKinematics
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets, GraspTask, moved, swivel_velocity
from dyngrasp.signals import Array

# Where the arm angle of the running plan is forbidden at the new pose, others are tried, nearest first (rad).
_ARM_ANGLE_STEPS = np.deg2rad(np.arange(2.0, 61.0, 2.0))

# The wrist follows the part's yaw; a joint that turns farther (rad) has flipped to an equivalent angle beyond its
# limits.
_LARGEST_TURN = 2.5


class TargetUpdater:
    """Boundary states of one task for one pose after another; what does not depend on the pose is computed once."""

    def __init__(self, task: GraspTask) -> None:
        self.task = task
        self._kinematics = inverse_kinematics_for(task.robot)
        self._hands: dict[bytes, pin.SE3] = {}
        self._outward = self._hand(task.gripper.open_posture).inverse().rotation[:, 2]

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
        task, settings, grasp = self.task, self.task.settings, previous.grasp
        twist = np.zeros(6) if twist_world is None else np.asarray(twist_world, dtype=float)
        T_before = moved(T_world_object, twist, -grasp_duration) if twist.any() else T_world_object
        above = pin.SE3(np.eye(3), np.array([0.0, 0.0, settings.pregrasp_distance]))
        T_grasp = T_world_object * grasp.T_object_grasp * self._hand(previous.gripper_closed)
        T_pregrasp = T_before * grasp.T_object_grasp * above * self._hand(previous.gripper_open)

        q = self.posture(T_grasp, previous.grasped.position)
        q_before = self.posture(T_pregrasp, previous.pregrasp.position)
        approach_axis = (T_before * grasp.T_object_grasp).rotation[:, 2]
        approach = _carried(twist, T_before, T_pregrasp)
        approach[:3] -= settings.approach_speed * approach_axis
        lift = _carried(twist, T_world_object, T_grasp)
        lift[2] += settings.lift_speed
        try:
            velocity_before = joint_velocity(task.robot, q_before, approach)
            velocity = joint_velocity(task.robot, q, lift)
        except InvalidProblem as error:
            raise OutOfReach("the grasp", 0.0, str(error)) from error
        return GraspTargets(
            T_world_object=T_world_object,
            grasp=grasp,
            pregrasp=BoundaryState(q_before, velocity_before + self._swivel(q_before, previous.pregrasp.velocity)),
            grasped=BoundaryState(q, velocity + self._swivel(q, previous.grasped.velocity)),
            place=previous.place,
            gripper_open=previous.gripper_open,
            gripper_closed=previous.gripper_closed,
            grasp_time=grasp_time,
            grasp_duration=grasp_duration,
            twist_world=twist,
        )

    def _hand(self, posture: Array) -> pin.SE3:
        """T_grasp_flange with the gripper in a posture."""
        key = posture.tobytes()
        if key not in self._hands:
            gripper = self.task.gripper
            self._hands[key] = (gripper.T_flange_hand * gripper.T_hand_grasp(posture)).inverse()
        return self._hands[key]

    def _swivel(self, q: Array, like: Array) -> Array:
        return swivel_velocity(q, q, self.task, like=like)

    @property
    def approach_axis_in_flange(self) -> Array:
        """(3,) outward axis of the grasp frame as the hand holds it, in the flange frame."""
        return self._outward

    def posture(self, T_world_flange: pin.SE3, q_previous: Array) -> Array:
        """The configuration (n,) of the branch, and if the limits allow of the arm angle, of a previous one (n,) (rad).

        Raises:
            OutOfReach: There is none near.
        """
        kinematics = self._kinematics
        if not isinstance(kinematics, SrsKinematics):
            q = kinematics.nearest(T_world_flange, q_previous)
        else:
            branch, angle = kinematics.branch(q_previous), kinematics.arm_angle(q_previous)
            try:
                q = kinematics.solve(T_world_flange, angle, branch)
            except OutOfReach:
                q = self._nearest_arm_angle(T_world_flange, angle, branch)
        turn = float(np.abs(q - q_previous).max())
        if turn > _LARGEST_TURN:
            raise OutOfReach("the new pose", 0.0, f"a joint would have to turn by {np.rad2deg(turn):.0f}° to follow it")
        return q

    def _nearest_arm_angle(self, T_world_flange: pin.SE3, angle: float, branch: int) -> Array:
        steps = np.column_stack([_ARM_ANGLE_STEPS, -_ARM_ANGLE_STEPS]).ravel()
        found = self._kinematics.scan(T_world_flange, angle + steps)  # type: ignore[attr-defined]
        same = np.flatnonzero(found.branches == branch)
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


def _carried(twist: Array, T_world_object: pin.SE3, T_world_flange: pin.SE3) -> Array:
    """(6,) twist of the flange as it would be fixed to the part."""
    lever = T_world_flange.translation - T_world_object.translation
    carried = twist.copy()
    carried[:3] += pin.skew(twist[3:]) @ lever
    return carried
