"""Where the funnel is narrow the hand repeats its old motion relative to the part.

The quadratic program knows nothing of the funnel. But the old motion came down inside the old funnel, and carried
along rigidly with the part it comes down inside the new one. So below the height z_th, where the funnel's wall
begins, the reference of the program is the carried motion and its positions have weight; above, the correction is
free to spread. Eq. (14) has weights Q_k that may differ from grid point to grid point.

The carried motion is solved for at a few grid points by inverse kinematics of the same branch and arm angle; between
them its difference to the old motion is a polynomial.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.errors import OutOfReach
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import Trajectory

_KNOTS = 4


@dataclass(frozen=True)
class DescentSettings:
    """How the descent through the funnel is tracked.

    Attributes:
        height: The descent begins where G is at this multiple of z_th above the grasp frame.
        earliest: Part of the rest of the approach that is left free at least: a correction needs its time.
        stiffness: Rate of the tracking, in multiples of one over the time of the descent: Q_q = (stiffness / time)⁴
            Q_v.
    """

    height: float = 1.05
    earliest: float = 0.2
    stiffness: float = 50.0


def carried_descent(
    reference: Trajectory,
    start: float,
    targets: GraspTargets,
    previous: GraspTargets | None,
    task: GraspTask,
    settings: DescentSettings,
) -> tuple[Trajectory, Array] | None:
    """The reference with its descent carried along with the part, and the weights of its positions.

    Args:
        reference: What is left of the approach.
        start: When it begins (s).
        targets: The new ones.
        previous: What the running plan was made for; if left out, a part at rest.
        task: Arm, gripper, part.
        settings: How.

    Returns:
        Reference and weights (N+1,) in units of Q_v (1/s⁴); None if the arm cannot follow the carried motion.
    """
    robot, updater = task.robot, target_updater(task)
    q_pregrasp = targets.pregrasp.position
    p_flange_grasp = task.gripper.T_flange_hand.act(task.gripper.grasp_point(targets.gripper_open))
    N = reference.intervals
    old_end = robot.forward_kinematics(reference.position[-1])
    at_end = robot.forward_kinematics(q_pregrasp) * old_end.inverse()

    def shift(k: int) -> pin.SE3:
        """Where the carried motion is at a grid point, seen from the old one: parts that move were elsewhere then."""
        now, end = start + k / N * reference.duration, start + reference.duration
        return _since(targets, now, end) * at_end * _since(previous, now, end).inverse()

    axis = old_end.rotation @ updater.outward(targets.gripper_open)
    lowest = float(axis @ old_end.act(p_flange_grasp)) - task.settings.pregrasp_distance
    top = lowest + settings.height * task.grasp_object.funnel.z_threshold

    def height(k: int) -> float:
        return float(axis @ robot.forward_kinematics(reference.position[k]).act(p_flange_grasp))

    above, below = 0, N
    if height(0) <= top:
        below = 0
    while below - above > 1:
        middle = (above + below) // 2
        above, below = (middle, below) if height(middle) > top else (above, middle)
    entry = min(max(below, round(settings.earliest * N)), N - _KNOTS)
    knots = _knots(entry, N)
    try:
        carried = [
            updater.posture(shift(k) * robot.forward_kinematics(reference.position[k]), reference.position[k])
            for k in knots[:-1]
        ]
    except OutOfReach:
        return None
    difference = np.array([*carried, q_pregrasp]) - reference.position[list(knots)]
    position, velocity, acceleration = (
        array.copy() for array in (reference.position, reference.velocity, reference.acceleration)
    )
    basis, rate, curvature = _lagrange(entry, N)
    T = reference.duration
    position[entry:] += basis @ difference
    velocity[entry:] += rate @ difference / T
    acceleration[entry:] += curvature @ difference / T**2
    weights = np.zeros(N + 1)
    weights[entry:] = (settings.stiffness / ((1 - entry / N) * T)) ** 4
    return Trajectory(T, position, velocity, acceleration), weights


def _since(targets: GraspTargets | None, now: float, end: float) -> pin.SE3:
    """The motion of a part that takes its pose at `end` (s) to that at `now` (s)."""
    if targets is None or not targets.moving:
        return pin.SE3.Identity()
    return targets.T_world_object_at(now) * targets.T_world_object_at(end).inverse()


def _knots(entry: int, N: int) -> tuple[int, ...]:
    """`_KNOTS` grid points from `entry` to N."""
    return tuple(entry + round(i * (N - entry) / (_KNOTS - 1)) for i in range(_KNOTS))


@lru_cache(maxsize=512)
def _lagrange(entry: int, N: int) -> tuple[Array, Array, Array]:
    """Values, first and second derivatives of the Lagrange polynomials of `_knots` (M, K), at grid points from `entry`.

    The argument is the share of the duration.
    """
    knots, s = np.array(_knots(entry, N)) / N, np.arange(entry, N + 1) / N
    # About their middle, for powers of numbers near one are nearly alike.
    middle = knots.mean()
    inverse = np.linalg.inv(np.vander(knots - middle, increasing=True))
    powers = np.vander(s - middle, len(knots), increasing=True)
    order = np.arange(1, len(knots))
    first = powers[:, :-1] * order
    second = first[:, :-1] * order[:-1]
    return read_only(powers @ inverse), read_only(first @ inverse[1:]), read_only(second @ inverse[2:])
