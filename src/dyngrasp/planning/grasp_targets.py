"""From the pose of a part to the boundary states x_S, x_T of the three phases, arm and gripper on one clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin

from dyngrasp.errors import GraspRefused, OutOfReach
from dyngrasp.models.grasp_object import Grasp, GraspObject
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.inverse_kinematics import InverseKinematics, inverse_kinematics_for, joint_velocity
from dyngrasp.models.pinch import Pinch
from dyngrasp.models.robot import RobotModel
from dyngrasp.signals import Array, read_only

GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class TaskSettings:
    """How a part is approached, pinched and lifted.

    Attributes:
        pregrasp_distance: Height of G above the grasp frame where the approach ends (m; the paper draws about 20 mm).
        approach_speed: Speed of G along the approach axis at the pre-grasp (m/s).
        lift_speed: Speed of the closed hand along world z at the end of the grasp (m/s), ≥ 0 by eq. (7).
        swivel_rate: Least arm-angle rate through both ends of the grasp (rad/s). The reversal from approach to lift
            would stop every joint at the same instant; a redundant arm keeps moving by this null-space motion.
        swivel_speed_ratio: Least max-norm of q̇/q̇max that the null-space motion alone must give; raises the swivel
            rate where the arm's posture makes it slow.
        grasp_duration_min, grasp_duration_max: Bounds on ΔT_2 (s). Longer reversals overshoot below the grasp
            frame, and the fingers would clamp there.
        over_close: How much narrower than the part the planned closed gap is (m), so that contact comes before the
            lift and the position loop already presses when the force ramp begins.
        side_clearance_min: Least free gap on either side of the part with the gripper open (m).
        grip_share: Part of the finger force that the hand presses with; the rest is left to its position loop, which
            keeps the part from moving sideways.
        holding_safety: Factor by which the pinch must exceed what the part asks of it (torsion and friction).
        lateral_tolerance, dip_tolerance: How far G may leave the grasp axis, and pass below the grasp frame, while the
            hand closes (m).
        tilt_tolerance: How far the hand may tilt against the grasp frame while it closes (rad).
        limit_margin: Distance that grasp postures keep from the joint limits (rad).
        dexterity_min: Least singular value of the Jacobian (translation in m/rad) at a grasp posture.
    """

    pregrasp_distance: float = 0.020
    approach_speed: float = 0.05
    lift_speed: float = 0.03
    swivel_rate: float = 0.06
    swivel_speed_ratio: float = 0.03
    grasp_duration_min: float = 0.5
    grasp_duration_max: float = 0.8
    over_close: float = 0.001
    side_clearance_min: float = 0.010
    grip_share: float = 0.8
    holding_safety: float = 2.0
    lateral_tolerance: float = 0.0015
    dip_tolerance: float = 0.003
    tilt_tolerance: float = np.deg2rad(1.0)
    limit_margin: float = np.deg2rad(5.0)
    dexterity_min: float = 0.04


@dataclass(frozen=True, eq=False)
class GraspTask:
    """What is to be done: which arm and gripper take which part, and where to.

    Attributes:
        robot: The bare arm.
        gripper: The gripper on its flange.
        grasp_object: The part.
        place: (n,) target configuration q_T (rad), reached at rest.
        settings: How the part is approached, pinched and lifted.
    """

    robot: RobotModel
    gripper: GripperModel
    grasp_object: GraspObject
    place: Array
    settings: TaskSettings = field(default_factory=TaskSettings)

    def __post_init__(self) -> None:
        object.__setattr__(self, "place", read_only(self.place, (self.robot.n,)))

    @cached_property
    def kinematics(self) -> InverseKinematics:
        """Inverse kinematics of the arm."""
        return inverse_kinematics_for(self.robot)

    @cached_property
    def robot_empty(self) -> RobotModel:
        """The arm with the open gripper as a rigid payload."""
        return self._carrying_gripper(self.gripper.open_posture)

    def robot_loaded(self, grasp: Grasp) -> RobotModel:
        """The arm with the closed gripper and the part in `grasp` as rigid payloads."""
        if grasp not in self._loaded:
            closed = self.closed_posture(grasp)
            T_flange_object = self.T_flange_closed(grasp) * grasp.T_object_grasp.inverse()
            loaded = self._carrying_gripper(closed).with_payload(T_flange_object.act(self.grasp_object.spatial_inertia))
            self._loaded[grasp] = loaded
        return self._loaded[grasp]

    def pinch(self, grasp: Grasp) -> Pinch:
        """How the hand presses on the part in `grasp`."""
        friction, force = self.grasp_object.friction, self.settings.grip_share * self.gripper.pinch_force
        return Pinch(force, friction.sliding, friction.torsional, grasp.width)

    def closed_posture(self, grasp: Grasp) -> Array:
        """(m,) posture of the gripper around the part, a little narrower than the part so that it presses.

        Raises:
            GraspRefused: The gripper does not close or open that far.
        """
        if grasp.width not in self._closed:
            posture = self.gripper.posture_for(grasp.width - self.settings.over_close)
            self._closed[grasp.width] = read_only(posture)
        return self._closed[grasp.width]

    @cached_property
    def T_flange_open(self) -> pin.SE3:
        """The grasp frame in the flange frame with the gripper open."""
        return self.gripper.T_flange_hand * self.gripper.T_hand_grasp(self.gripper.open_posture)

    def T_flange_closed(self, grasp: Grasp) -> pin.SE3:
        """The grasp frame in the flange frame with the gripper closed around the part."""
        closed = self.closed_posture(grasp)
        if grasp.width not in self._T_flange_closed:
            self._T_flange_closed[grasp.width] = self.gripper.T_flange_hand * self.gripper.T_hand_grasp(closed)
        return self._T_flange_closed[grasp.width]

    # Planning asks for these again and again: they change with the grasp alone.
    @cached_property
    def _loaded(self) -> dict[Grasp, RobotModel]:
        return {}

    @cached_property
    def _closed(self) -> dict[float, Array]:
        return {}

    @cached_property
    def _T_flange_closed(self) -> dict[float, pin.SE3]:
        return {}

    def _carrying_gripper(self, posture: Array) -> RobotModel:
        return self.robot.with_payload(self.gripper.T_flange_hand.act(self.gripper.inertia(posture)))


@dataclass(frozen=True)
class BoundaryState:
    """Position (rad) and velocity (rad/s) of the arm at the end of a phase, each (n,)."""

    position: Array
    velocity: Array

    def __post_init__(self) -> None:
        for name in ("position", "velocity"):
            object.__setattr__(self, name, read_only(getattr(self, name), (-1,)))


@dataclass(frozen=True, eq=False)
class GraspTargets:
    """Boundary states of the three phases for one pose of the part.

    Attributes:
        T_world_object: The pose they were made for.
        grasp: Which grasp of the part is taken.
        pregrasp: End of the approach: open gripper, G above the grasp frame, moving in.
        grasped: End of the grasp: closed gripper, G on the grasp frame, moving up along world z.
        place: End of the delivery: the target configuration, at rest.
        gripper_open, gripper_closed: (m,) gripper postures before and after the grasp (rad).
        grasp_time: When a moving part is at `T_world_object`: at the grasp (s). Without meaning for a part at rest.
        grasp_duration: How long before that the hand is at the pre-grasp (s), for a moving part.
        twist_world: (6,) velocity of the object frame's origin (m/s) and angular velocity (rad/s) of the part, in world
            axes.
    """

    T_world_object: pin.SE3
    grasp: Grasp
    pregrasp: BoundaryState
    grasped: BoundaryState
    place: BoundaryState
    gripper_open: Array
    gripper_closed: Array
    grasp_time: float = 0.0
    grasp_duration: float = 0.0
    twist_world: Array = field(default_factory=lambda: np.zeros(6))

    def __post_init__(self) -> None:
        object.__setattr__(self, "twist_world", read_only(self.twist_world, (6,)))

    @property
    def T_world_grasp(self) -> pin.SE3:
        """The grasp frame in the world: z outward along the approach axis, y along the closing axis."""
        return self.T_world_object * self.grasp.T_object_grasp

    @cached_property
    def moving(self) -> bool:
        """Whether the part moves."""
        return bool(np.any(self.twist_world))

    def T_world_object_at(self, t: float) -> pin.SE3:
        """Pose of the part at time t (s): it keeps its velocities until it is taken at `grasp_time`."""
        if not self.moving or t >= self.grasp_time:
            return self.T_world_object
        return moved(self.T_world_object, self.twist_world, t - self.grasp_time)

    def part_poses(self, times: Array) -> tuple[Array, Array]:
        """`T_world_object_at` for many times (M,): rotations (M, 3, 3) and positions (M, 3)."""
        R, p = self.T_world_object.rotation, self.T_world_object.translation
        if not self.moving:
            return np.broadcast_to(R, (times.size, 3, 3)), np.broadcast_to(p, (times.size, 3))
        dt = np.minimum(times - self.grasp_time, 0.0)
        velocity, spin = self.twist_world[:3], pin.skew(self.twist_world[3:])
        rate = float(np.linalg.norm(self.twist_world[3:]))
        if rate > 0.0:
            axis = spin / rate
            angle = (rate * dt)[:, None, None]
            turn = np.eye(3) + np.sin(angle) * axis + 2 * np.sin(angle / 2) ** 2 * (axis @ axis)
        else:
            turn = np.broadcast_to(np.eye(3), (times.size, 3, 3))
        return turn @ R, p + dt[:, None] * velocity


def moved(T_world_object: pin.SE3, twist_world: Array, dt: float) -> pin.SE3:
    """Where a body is after `dt` (s), before for dt < 0, with constant velocities of its origin and about it."""
    return pin.SE3(
        pin.exp3(dt * twist_world[3:]) @ T_world_object.rotation, T_world_object.translation + dt * twist_world[:3]
    )


def grasp_targets(T_world_object: pin.SE3, task: GraspTask, q_start: Array) -> GraspTargets:
    """The best boundary states by the criterion of `ranked_grasp_targets`.

    Args:
        T_world_object: Pose of the part.
        task: Arm, gripper, part and target.
        q_start: (n,) present configuration of the arm (rad).

    Raises:
        OutOfReach: No configuration brings the hand to the grasp and the pre-grasp.
        GraspRefused: The gripper cannot take or hold the part.
    """
    return next(ranked_grasp_targets(T_world_object, task, q_start))


def ranked_grasp_targets(T_world_object: pin.SE3, task: GraspTask, q_start: Array) -> Iterator[GraspTargets]:
    """Boundary states for distinct arm postures and grasps, best first.

    The redundancy of the arm and the choice among the part's grasps are settled by one criterion: the time that the
    slowest joint needs, at its top speed, from the start to the grasp posture and on to the target. Postures
    close to joint limits or singularities are left out.

    Raises:
        OutOfReach, GraspRefused: As `grasp_targets`, before the first item.
    """
    refusals: list[GraspRefused] = []
    unreachable: list[OutOfReach] = []
    postures: list[Array] = []
    grasps: list[Grasp] = []
    for grasp in task.grasp_object.grasps:
        try:
            check_grasp(grasp, T_world_object, task)
            postures.append(_grasp_postures(grasp, T_world_object, task))
        except GraspRefused as refusal:
            refusals.append(refusal)
        except OutOfReach as failure:
            unreachable.append(failure)
        else:
            grasps += [grasp] * len(postures[-1])
    if not grasps:
        raise unreachable[0] if unreachable else refusals[0]
    candidates = np.concatenate(postures)
    yielded: list[Array] = []
    failure = None
    for k in np.argsort(_travel_times(candidates, q_start, task), kind="stable"):
        q, grasp = candidates[k], grasps[k]
        if any(np.abs(q - other).max() < _DISTINCT for other in yielded):
            continue
        # Asked only of those that are wanted: it costs more than the rest of the choice.
        if np.linalg.svd(task.robot.jacobian(q), compute_uv=False)[-1] < task.settings.dexterity_min:
            continue
        try:
            targets = _targets_at(q, grasp, T_world_object, task, q_start)
        except OutOfReach as error:
            failure = error
            continue
        yielded.append(q)
        yield targets
    if not yielded:
        raise failure or _no_posture(grasps[0], task)


# Postures closer than this (rad, max-norm) lead to the same motion; the next candidate should be another one.
_DISTINCT = 0.5


def check_grasp(grasp: Grasp, T_world_object: pin.SE3, task: GraspTask) -> None:
    """Refuse a grasp that the gripper cannot open for or cannot hold against gravity.

    Two pads of torsional friction t (m) pressed with N hold a moment 2 t N about the closing axis; the part asks for
    m g d, d its centre of mass' horizontal offset from that axis.

    Raises:
        GraspRefused: With the number that says so.
    """
    part, gripper, settings = task.grasp_object, task.gripper, task.settings
    needed = grasp.width + 2 * settings.side_clearance_min
    if gripper.aperture(gripper.open_posture) < needed:
        raise GraspRefused(
            f"{gripper.name} opens {gripper.aperture(gripper.open_posture) * 1e3:.1f} mm; grasp {grasp.name!r} of "
            f"{part.name} is {grasp.width * 1e3:.1f} mm wide and needs {needed * 1e3:.1f} mm with clearance"
        )
    T_world_grasp = T_world_object * grasp.T_object_grasp
    lever = T_world_object.act(part.centre_of_mass) - T_world_grasp.translation
    weight = part.mass * np.array([0.0, 0.0, -GRAVITY])
    moment = abs(float(T_world_grasp.rotation[:, 1] @ pin.skew(lever) @ weight))
    pinch = task.pinch(grasp)
    capacity = 2 * pinch.torsional * pinch.force
    if capacity < settings.holding_safety * moment:
        raise GraspRefused(
            f"{gripper.name} holds {capacity:.3f} Nm of torsion on {part.name}; its weight asks {moment:.3f} Nm about "
            f"the pinch axis, and a safety factor of {settings.holding_safety:g} is required"
        )
    grip = 2 * pinch.sliding * pinch.force
    if grip < settings.holding_safety * part.mass * GRAVITY:
        raise GraspRefused(
            f"{gripper.name} carries {grip:.1f} N by friction; {part.name} weighs {part.mass * GRAVITY:.1f} N, and a "
            f"safety factor of {settings.holding_safety:g} is required"
        )


def flange_poses(grasp: Grasp, T_world_object: pin.SE3, task: GraspTask) -> tuple[pin.SE3, pin.SE3]:
    """Flange poses at the pre-grasp (open gripper) and at the grasp (closed): they differ by the travel of G."""
    T_world_grasp = T_world_object * grasp.T_object_grasp
    above = pin.SE3(np.eye(3), np.array([0.0, 0.0, task.settings.pregrasp_distance]))
    closed = task.T_flange_closed(grasp)
    return T_world_grasp * above * task.T_flange_open.inverse(), T_world_grasp * closed.inverse()


def _grasp_postures(grasp: Grasp, T_world_object: pin.SE3, task: GraspTask) -> Array:
    """(k, n) configurations at the grasp that keep clear of the joint limits, k ≥ 1."""
    limits, margin = task.robot.limits, task.settings.limit_margin
    _, T_world_flange = flange_poses(grasp, T_world_object, task)
    postures = task.kinematics.solutions(T_world_flange)
    inside = (postures >= limits.position_lower + margin) & (postures <= limits.position_upper - margin)
    postures = postures[inside.all(axis=1)]
    if not len(postures):
        raise _no_posture(grasp, task)
    return postures


def _no_posture(grasp: Grasp, task: GraspTask) -> OutOfReach:
    margin = np.rad2deg(task.settings.limit_margin)
    reason = f"no posture keeps {margin:.0f}° from the joint limits and clear of singularities"
    return OutOfReach(f"grasp {grasp.name!r} of {task.grasp_object.name}", 0.0, reason)


def _travel_times(postures: Array, q_start: Array, task: GraspTask) -> Array:
    """(k,) time of the slowest joint at top speed from the start to each posture (k, n) and on to the target (s)."""
    speed = task.robot.limits.velocity
    return (np.abs(postures - q_start) / speed).max(axis=1) + (np.abs(task.place - postures) / speed).max(axis=1)


def _targets_at(q: Array, grasp: Grasp, T_world_object: pin.SE3, task: GraspTask, q_start: Array) -> GraspTargets:
    robot, settings = task.robot, task.settings
    T_pregrasp, _ = flange_poses(grasp, T_world_object, task)
    approach_axis = (T_world_object * grasp.T_object_grasp).rotation[:, 2]

    swivel = swivel_velocity(q, q_start, task)
    # A symmetric reversal covers the swivel rate times the duration; the pre-grasp posture lies that far back.
    q_before = q - swivel * (settings.grasp_duration_min + settings.grasp_duration_max) / 2
    q_pregrasp = task.kinematics.nearest(T_pregrasp, q_before)

    lift = np.array([0.0, 0.0, settings.lift_speed, 0.0, 0.0, 0.0])
    approach = np.concatenate([-settings.approach_speed * approach_axis, np.zeros(3)])
    swivel_before = swivel_velocity(q_pregrasp, q_start, task, like=swivel)
    return GraspTargets(
        T_world_object=T_world_object,
        grasp=grasp,
        pregrasp=BoundaryState(q_pregrasp, joint_velocity(robot, q_pregrasp, approach) + swivel_before),
        grasped=BoundaryState(q, joint_velocity(robot, q, lift) + swivel),
        place=BoundaryState(task.place, np.zeros(robot.n)),
        gripper_open=task.gripper.open_posture,
        gripper_closed=task.closed_posture(grasp),
    )


def swivel_velocity(q: Array, q_start: Array, task: GraspTask, like: Array | None = None) -> Array:
    """(n,) null-space velocity that keeps the arm moving through the grasp (rad/s); zero if there is no null space.

    It turns the way the motion from start to target goes on the whole, or the way of `like` if given.
    """
    rate = task.kinematics.null_space_rate(q)
    ratio = float(np.abs(rate / task.robot.limits.velocity).max())
    if ratio == 0.0:
        return np.zeros_like(q)
    direction = like if like is not None else (task.place - q_start) / task.robot.limits.velocity**2
    sign = 1.0 if float(rate @ direction) >= 0 else -1.0
    return sign * rate * max(task.settings.swivel_rate, task.settings.swivel_speed_ratio / ratio)
