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
from numba import njit

from dyngrasp.errors import OutOfReach
from dyngrasp.models.flange_chain import place_frames
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import Trajectory

_KNOTS = 4

_AT_REST = read_only(np.tile(np.eye(3, 4), (_KNOTS - 1, 1, 1)))


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
    updater, chain = target_updater(task), task.robot.flange_chain
    N, T, position = reference.intervals, reference.duration, reference.position
    hand = updater.T_flange_grasp(targets.gripper_open)
    begin = settings.height * task.grasp_object.funnel.z_threshold - task.settings.pregrasp_distance
    below = _first_below(chain.rotations, chain.offsets, position, hand.translation, hand.rotation, begin)
    entry = min(max(below, round(settings.earliest * N)), N - _KNOTS)
    knots = _knots(entry, N)
    old, new = (_from_end(moves, start, T, N, knots) for moves in (previous, targets))
    poses, postures = np.empty((_KNOTS - 1, 3, 4)), np.empty((_KNOTS, position.shape[1]))
    postures[-1] = targets.pregrasp.position
    _carried_poses(chain.rotations, chain.offsets, position, knots, postures[-1], old, new, poses)
    try:
        for i, k in enumerate(knots[:-1]):
            postures[i] = updater.posture(pin.SE3(poses[i, :, :3], poses[i, :, 3]), position[k])
    except OutOfReach:
        return None
    motion, weights = np.empty((3, *position.shape)), np.zeros(N + 1)
    bent = (position, reference.velocity, reference.acceleration)
    _bend(bent, entry, T, _lagrange(entry, N), knots, postures, motion)
    weights[entry:] = (settings.stiffness / ((1 - entry / N) * T)) ** 4
    return Trajectory.of(T, motion), weights


def _from_end(targets: GraspTargets | None, start: float, duration: float, N: int, knots: tuple[int, ...]) -> Array:
    """(K−1, 3, 4) motion [R | p] of a part that takes its pose at the end to that at each knot but the last."""
    if targets is None or not targets.moving:
        return _AT_REST
    back = targets.T_world_object_at(start + duration).inverse()
    times = (start + k / N * duration for k in knots[:-1])
    return np.array([(targets.T_world_object_at(t) * back).homogeneous[:3] for t in times])


@njit(cache=True, error_model="numpy")
def _carried_poses(rotations, offsets, position, knots, q_end, old, new, poses):
    """Write the poses (K−1, 3, 4) of the flange at the knots of positions (N+1, n), carried along with the part.

    What takes the old end to the new one, at `q_end` (n,), takes the old motion to the new one as seen from the part.
    Parts that move were elsewhere then, as `_from_end` tells of the old and the new one.
    """
    frames = np.empty((q_end.size + 1, 3, 4))
    place_frames(rotations, offsets, position[-1], frames)
    old_end = frames[-1].copy()
    place_frames(rotations, offsets, q_end, frames)
    new_end = frames[-1].copy()
    seen = np.empty((3, 4))
    for i in range(poses.shape[0]):
        place_frames(rotations, offsets, position[knots[i]], frames)
        _before(old[i], frames[-1], seen)
        _before(old_end, seen, frames[0])
        _after(new_end, frames[0], seen)
        _after(new[i], seen, poses[i])


@njit(cache=True, error_model="numpy")
def _after(first, then, out):
    """Write the product of two poses (3, 4)."""
    for a in range(3):
        for b in range(4):
            out[a, b] = first[a, 3] if b == 3 else 0.0
            for c in range(3):
                out[a, b] += first[a, c] * then[c, b]


@njit(cache=True, error_model="numpy")
def _before(first, then, out):
    """Write the product of the inverse of a pose (3, 4) and another one."""
    for a in range(3):
        for b in range(4):
            out[a, b] = 0.0
            for c in range(3):
                out[a, b] += first[c, a] * (then[c, b] - (first[c, 3] if b == 3 else 0.0))


@njit(cache=True, error_model="numpy")
def _first_below(rotations, offsets, position, p_flange_grasp, R_flange_grasp, begin):
    """By bisection, the first grid point of positions (N+1, n) from which G is no higher above its last than `begin`.

    Heights (m) are along the axis of the grasp frame as the hand holds it at the last point.
    """
    frames = np.empty((position.shape[1] + 1, 3, 4))
    place_frames(rotations, offsets, position[-1], frames)
    axis = np.zeros(3)
    for a in range(3):
        for b in range(3):
            axis[a] += frames[-1, a, b] * R_flange_grasp[b, 2]
    last = _height(frames[-1], p_flange_grasp, axis)
    above, below = 0, position.shape[0] - 1
    place_frames(rotations, offsets, position[0], frames)
    if _height(frames[-1], p_flange_grasp, axis) - last <= begin:
        return 0
    while below - above > 1:
        middle = (above + below) // 2
        place_frames(rotations, offsets, position[middle], frames)
        if _height(frames[-1], p_flange_grasp, axis) - last > begin:
            above = middle
        else:
            below = middle
    return below


@njit(cache=True, error_model="numpy")
def _height(flange, p_flange_grasp, axis):
    height = 0.0
    for a in range(3):
        height += axis[a] * flange[a, 3]
        for b in range(3):
            height += axis[a] * flange[a, b] * p_flange_grasp[b]
    return height


@njit(cache=True, error_model="numpy")
def _bend(old, entry, T, polynomials, knots, postures, motion):
    """Write a motion (3, N+1, n): from `entry` on polynomials bend the old one to the postures (K, n) at the knots."""
    factor, difference = 1.0, postures.copy()
    for i in range(len(knots)):
        difference[i] -= old[0][knots[i]]
    for kind in range(3):
        motion[kind] = old[kind]
        for k in range(polynomials[kind].shape[0]):
            for i in range(difference.shape[0]):
                weight = factor * polynomials[kind][k, i]
                for j in range(difference.shape[1]):
                    motion[kind, entry + k, j] += weight * difference[i, j]
        factor /= T


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
