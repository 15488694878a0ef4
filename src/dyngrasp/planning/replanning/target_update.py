"""New boundary states for a new pose of the part: the same grasp and the same posture of the arm as the plan's."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.models.inverse_kinematics import TWIST_TOLERANCE, inverse_kinematics_for, joint_velocity
from dyngrasp.models.srs_kinematics import SrsKinematics
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets, GraspTask, moved, swivel_velocity
from dyngrasp.signals import Array, frozen
from dyngrasp.trajectory import largest_difference

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
        self._flanges: dict[tuple[Grasp, bytes, float], pin.SE3] = {}

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
        moving = twist_world is not None and bool(np.any(twist_world))
        twist = _AT_REST if twist_world is None else np.asarray(twist_world, dtype=float)
        T_before = moved(T_world_object, twist, -grasp_duration) if moving else T_world_object
        T_grasp = T_world_object * self._flange_at(grasp, previous.gripper_closed, 0.0)
        T_pregrasp = T_before * self._flange_at(grasp, previous.gripper_open, settings.pregrasp_distance)

        q = self.posture(T_grasp, previous.grasped.position)
        q_before = self.posture(T_pregrasp, previous.pregrasp.position)
        approach, lift = np.zeros(6), np.zeros(6)
        if moving:
            approach, lift = _carried(twist, T_before, T_pregrasp), _carried(twist, T_world_object, T_grasp)
        approach[:3] -= settings.approach_speed * (T_pregrasp.rotation @ self.outward(previous.gripper_open))
        lift[2] += settings.lift_speed
        try:
            velocity_before, velocity = self._rates(q_before, approach), self._rates(q, lift)
        except InvalidProblem as error:
            raise OutOfReach("the grasp", 0.0, str(error)) from error
        velocity_before += swivel_velocity(q_before, q_before, task, like=previous.pregrasp.velocity)
        velocity += swivel_velocity(q, q, task, like=previous.grasped.velocity)
        return GraspTargets(
            T_world_object=T_world_object,
            grasp=grasp,
            pregrasp=BoundaryState(frozen(q_before), frozen(velocity_before)),
            grasped=BoundaryState(frozen(q), frozen(velocity)),
            place=previous.place,
            gripper_open=previous.gripper_open,
            gripper_closed=previous.gripper_closed,
            grasp_time=grasp_time,
            grasp_duration=grasp_duration,
            twist_world=twist,
        )

    def _rates(self, q: Array, twist_world: Array) -> Array:
        """Joint rates (n,) for a twist of the flange; far from singular postures there is nothing to be looked at."""
        found = self.task.robot.flange_chain.least_rates(q, twist_world)
        if found is not None and found[1] <= TWIST_TOLERANCE:
            return found[0]
        return joint_velocity(self.task.robot, q, twist_world)

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

    def outward(self, posture: Array) -> Array:
        """(3,) axis of the grasp frame that points away from the part, in the flange frame."""
        return self.T_flange_grasp(posture).rotation[:, 2]

    def _flange_at(self, grasp: Grasp, posture: Array, height: float) -> pin.SE3:
        """The flange in the object frame with the hand at a height above the grasp frame (m)."""
        key = grasp, posture.tobytes(), height
        if key not in self._flanges:
            above = pin.SE3(np.eye(3), np.array([0.0, 0.0, height]))
            self._flanges[key] = grasp.T_object_grasp * above * self.T_flange_grasp(posture).inverse()
        return self._flanges[key]

    def posture(self, T_world_flange: pin.SE3, q_previous: Array) -> Array:
        """`postures` of one pose."""
        return self.postures(T_world_flange.homogeneous[None, :3], q_previous[None])[0]

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


def _carried(twist: Array, T_world_object: pin.SE3, T_world_flange: pin.SE3) -> Array:
    """(6,) twist of the flange as it would be fixed to the part."""
    lever = T_world_flange.translation - T_world_object.translation
    carried = twist.copy()
    carried[:3] += pin.skew(twist[3:]) @ lever
    return carried
