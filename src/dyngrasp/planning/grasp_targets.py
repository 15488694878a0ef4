"""From the pose of a part to the boundary states x_S, x_T of the three phases, arm and gripper on one clock."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin
from numba import njit

from dyngrasp.errors import GraspRefused, OutOfReach
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.models.inverse_kinematics import joint_velocity, null_space_velocity
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.signals import Array, read_only, vector

__all__ = [
    "BoundaryState",
    "GraspTargets",
    "check_grasp",
    "grasp_targets",
    "moved",
    "ranked_grasp_targets",
    "swivel_velocity",
]

GRAVITY = 9.81  # m/s²


@dataclass(frozen=True)
class BoundaryState:
    """Position (rad) and velocity (rad/s) of the arm at the end of a phase, each (n,)."""

    position: Array
    velocity: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "position", vector(self.position))
        object.__setattr__(self, "velocity", vector(self.velocity))


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
        return bool(self.twist_world.any())

    def T_world_object_at(self, t: float) -> pin.SE3:
        """Pose of the part at time t (s): it keeps its velocities until it is taken at `grasp_time`."""
        if not self.moving or t >= self.grasp_time:
            return self.T_world_object
        return moved(self.T_world_object, self.twist_world, t - self.grasp_time)


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
    q_start = read_only(q_start, (task.robot.n,))
    refusals: list[GraspRefused] = []
    unreachable: list[OutOfReach] = []
    found: list[tuple[Grasp, Array, Array]] = []
    for grasp in task.grasp_object.grasps:
        try:
            check_grasp(grasp, T_world_object, task)
            found.append((grasp, *_grasp_postures(grasp, T_world_object, task, q_start)))
        except GraspRefused as refusal:
            refusals.append(refusal)
        except OutOfReach as failure:
            unreachable.append(failure)
    if not found:
        raise unreachable[0] if unreachable else refusals[0]
    yielded: list[Array] = []
    failure = None
    for grasp, q in _fastest_first(found):
        if any(np.abs(q - other).max() < _DISTINCT for other in yielded):
            continue
        # Asked only of those that are wanted: it costs more than the rest of the choice.
        if not task.robot.flange_chain.is_dexterous(q, task.settings.dexterity_min):
            continue
        try:
            targets = _targets_at(q, grasp, T_world_object, task, q_start)
        except OutOfReach as error:
            failure = error
            continue
        yielded.append(q)
        yield targets
    if not yielded:
        raise failure or _no_posture(found[0][0], task)


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
    if gripper.max_aperture < needed:
        raise GraspRefused(
            f"{gripper.name} opens {gripper.max_aperture * 1e3:.1f} mm; grasp {grasp.name!r} of "
            f"{part.name} is {grasp.width * 1e3:.1f} mm wide and needs {needed * 1e3:.1f} mm with clearance"
        )
    T_world_grasp = T_world_object * grasp.T_object_grasp
    lever = T_world_object.act(part.centre_of_mass) - T_world_grasp.translation
    axis = T_world_grasp.rotation[:, 1]
    moment = part.mass * GRAVITY * abs(float(axis[0] * lever[1] - axis[1] * lever[0]))
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


def _grasp_postures(grasp: Grasp, T_world_object: pin.SE3, task: GraspTask, q_start: Array) -> tuple[Array, Array]:
    """(k, n) configurations at the grasp and their travel times (k,) (s), at least one of them finite."""
    limits, margin = task.robot.limits, task.settings.limit_margin
    T_world_grasp = T_world_object * grasp.T_object_grasp
    postures = task.kinematics.solutions(T_world_grasp * task.T_flange_closed(grasp).inverse())
    inside = limits.position_lower + margin, limits.position_upper - margin
    times = _travel_times(postures, *inside, q_start, task.place, limits.velocity)
    if times.min() == np.inf:
        raise _no_posture(grasp, task)
    return postures, times


@njit(cache=True, error_model="numpy")
def _travel_times(postures: Array, lower: Array, upper: Array, start: Array, place: Array, speed: Array) -> Array:
    """(k,) time of the slowest joint at top speed from the start to each posture (k, n) and on to the target (s).

    Infinite for a posture outside the limits.
    """
    times = np.empty(len(postures))
    for k in range(len(postures)):
        there, on, inside = 0.0, 0.0, True
        for j in range(postures.shape[1]):
            q = postures[k, j]
            inside = inside and lower[j] <= q <= upper[j]
            there = max(there, abs(q - start[j]) / speed[j])
            on = max(on, abs(place[j] - q) / speed[j])
        times[k] = there + on if inside else np.inf
    return times


def _fastest_first(found: list[tuple[Grasp, Array, Array]]) -> Iterator[tuple[Grasp, Array]]:
    """Grasps with postures in the order of their travel times: most often only the first is asked for."""
    while True:
        grasp, postures, times = min(found, key=lambda one: one[2].min())
        k = int(times.argmin())
        if times[k] == np.inf:
            return
        times[k] = np.inf
        yield grasp, postures[k]


def _no_posture(grasp: Grasp, task: GraspTask) -> OutOfReach:
    margin = np.rad2deg(task.settings.limit_margin)
    reason = f"no posture keeps {margin:.0f}° from the joint limits and clear of singularities"
    return OutOfReach(f"grasp {grasp.name!r} of {task.grasp_object.name}", 0.0, reason)


def _targets_at(q: Array, grasp: Grasp, T_world_object: pin.SE3, task: GraspTask, q_start: Array) -> GraspTargets:
    robot, settings = task.robot, task.settings
    T_world_grasp = T_world_object * grasp.T_object_grasp
    above = pin.SE3(np.eye(3), np.array([0.0, 0.0, settings.pregrasp_distance]))

    swivel = swivel_velocity(q, q_start, task)
    # A symmetric reversal covers the swivel rate times the duration; the pre-grasp posture lies that far back.
    q_before = q - swivel * (settings.grasp_duration_min + settings.grasp_duration_max) / 2
    q_pregrasp = task.kinematics.nearest(T_world_grasp * above * task.T_flange_open.inverse(), q_before)

    lift = np.array([0.0, 0.0, settings.lift_speed, 0.0, 0.0, 0.0])
    approach = np.zeros(6)
    approach[:3] = -settings.approach_speed * T_world_grasp.rotation[:, 2]
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
    limit, settings = task.robot.limits.velocity, task.settings
    direction = like if like is not None else (task.place - q_start) / limit**2
    return null_space_velocity(rate, direction, limit, settings.swivel_rate, settings.swivel_speed_ratio)
