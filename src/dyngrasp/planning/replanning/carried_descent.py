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

import numpy as np
from numba import njit

from dyngrasp.errors import OutOfReach
from dyngrasp.lanes import LANES, lanes_of, load, store
from dyngrasp.models.flange_chain import place_frames
from dyngrasp.motion_arrays import PhaseArrays, write_state
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.part_motion import PartMotion, part_motion, part_poses
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.signals import Array, read_only

KNOTS = 4

# The grid point where the descent begins, postures (KNOTS, n) at its knots (rad), and the weight of its positions in
# units of Q_v (1/s⁴).
Descent = tuple[int, Array, float]
NO_DESCENT: Descent = 0, np.empty((0, 0)), 0.0

_STANDING: PartMotion = np.eye(3), np.zeros(3), read_only(np.zeros(6)), 0.0


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
    approach: PhaseArrays,
    start: float,
    splice: float,
    targets: GraspTargets,
    previous: GraspTargets | None,
    task: GraspTask,
    settings: DescentSettings,
) -> Descent:
    """Where the descent of an approach passes when it is carried along with the part.

    Args:
        approach: Of the running plan.
        start: When the rest of it begins, counted from its own beginning (s).
        splice: The same on the clock of the part (s).
        targets: The new ones.
        previous: What the running plan was made for; if left out, a part at rest.
        task: Arm, gripper, part.
        settings: How.

    Returns:
        `NO_DESCENT` if the arm cannot follow the carried motion.
    """
    updater, chain = target_updater(task), task.robot.flange_chain
    N, n = approach[1].shape[0] - 1, approach[1].shape[1]
    begin = settings.height * task.grasp_object.funnel.z_threshold - task.settings.pregrasp_distance
    parts = tuple(part_motion(t) if t is not None and t.moving else _STANDING for t in (previous, targets))
    poses, old, postures = np.empty((KNOTS - 1, 3, 4)), np.empty((KNOTS - 1, n)), np.empty((KNOTS, n))
    entry = _carried_poses(
        approach,
        start,
        splice,
        (chain.rotations, chain.offsets),
        updater.T_flange_grasp(targets.gripper_open).homogeneous,
        begin,
        round(settings.earliest * N),
        targets.pregrasp.position,
        parts,
        poses,
        old,
    )
    try:
        postures[:-1] = updater.postures(poses, old)
    except OutOfReach:
        return NO_DESCENT
    postures[-1] = targets.pregrasp.position
    return entry, postures, (settings.stiffness / ((1 - entry / N) * (approach[0] - start))) ** 4


@njit(cache=True, error_model="numpy")
def _knot(entry, N, i):
    """The grid point of one of the knots: the first at `entry`, the last at N."""
    return entry + int(np.rint(i * (N - entry) / (KNOTS - 1)))


@njit(cache=True, error_model="numpy")
def _carried_poses(approach, start, splice, chain, T_flange_grasp, begin, earliest, q_end, parts, poses, postures):
    """Write poses (KNOTS−1, 3, 4) of the flange and the old postures (KNOTS−1, n) at all knots but the last.

    What takes the old end to the new one, at `q_end` (n,), takes the old motion to the new one as seen from the part.
    Parts that move were elsewhere then.

    Returns:
        The grid point of the rest of the approach where the descent begins.
    """
    rotations, offsets = chain
    N, n = approach[1].shape[0] - 1, approach[1].shape[1]
    state, frames, seen = np.empty((3, n)), np.empty((n + 1, 3, 4)), np.empty((3, 4))
    step = (approach[0] - start) / N
    below = _first_below(approach, start, step, rotations, offsets, T_flange_grasp, begin, state, frames)
    entry = min(max(below, earliest), N - KNOTS)

    times = np.empty(KNOTS)
    for i in range(KNOTS):
        times[i] = splice + _knot(entry, N, i) * step
    moves = np.empty((2, KNOTS, 3, 4))
    _from_end(parts[0], times, moves[0])
    _from_end(parts[1], times, moves[1])
    place_frames(rotations, offsets, approach[1][-1], frames)
    old_end = frames[-1].copy()
    place_frames(rotations, offsets, q_end, frames)
    new_end = frames[-1].copy()
    for i in range(KNOTS - 1):
        write_state(approach, start + step * _knot(entry, N, i), False, state)
        postures[i] = state[0]
        place_frames(rotations, offsets, state[0], frames)
        _before(moves[0, i], frames[-1], seen)
        _before(old_end, seen, frames[0])
        _after(new_end, frames[0], seen)
        _after(moves[1, i], seen, poses[i])
    return entry


@njit(cache=True, error_model="numpy")
def _from_end(part, times, moves):
    """Write the motions (M, 3, 4) that take a part from its pose at the last of some times (M,) to that at each."""
    R, p = np.empty((3, 3, times.size)), np.empty((3, times.size))
    part_poses(part, times, R, p)
    back, there = np.zeros((3, 4)), np.empty((3, 4))
    for a in range(3):
        for b in range(3):
            back[a, b] = R[b, a, -1]
            back[a, 3] -= R[b, a, -1] * p[b, -1]
    for i in range(times.size):
        there[:, :3], there[:, 3] = R[:, :, i], p[:, i]
        _after(there, back, moves[i])


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
def _first_below(approach, start, step, rotations, offsets, T_flange_grasp, begin, state, frames):
    """By bisection, the first grid point of the rest of an approach from which G is at most `begin` above its last.

    Heights (m) are along the axis of the grasp frame as the hand holds it at the last point. State (3, n) and frames
    (n+1, 3, 4) are for scratch.
    """
    above, below, middle = -1, approach[1].shape[0] - 1, 0
    place_frames(rotations, offsets, approach[1][-1], frames)
    axis = np.zeros(3)
    for a in range(3):
        for b in range(3):
            axis[a] += frames[-1, a, b] * T_flange_grasp[b, 2]
    last = _height(frames[-1], T_flange_grasp, axis)
    while below - above > 1:
        write_state(approach, start + step * middle, False, state)
        place_frames(rotations, offsets, state[0], frames)
        if _height(frames[-1], T_flange_grasp, axis) - last > begin:
            above = middle
        else:
            below = middle
        middle = (above + below) // 2
    return below


@njit(cache=True, error_model="numpy")
def _height(flange, T_flange_grasp, axis):
    height = 0.0
    for a in range(3):
        height += axis[a] * flange[a, 3]
        for b in range(3):
            height += axis[a] * flange[a, b] * T_flange_grasp[b, 3]
    return height


@njit(cache=True, error_model="numpy")
def bend(entry: int, postures: Array, T: float, motion: Array) -> None:
    """Bend q, q̇, q̈ (3, N+1, W) of a motion of n joints, from grid point `entry` on, to postures (KNOTS, n).

    What is added is a polynomial of each joint, in Newton's form over the share of the duration T (s).
    """
    N, width = motion.shape[1] - 1, motion.shape[2]
    knots, table = np.empty(KNOTS), np.zeros((KNOTS, width))
    for i in range(KNOTS):
        k = _knot(entry, N, i)
        knots[i] = k / N
        for j in range(postures.shape[1]):
            table[i, j] = postures[i, j] - motion[0, k, j]
    for order in range(1, KNOTS):
        for i in range(KNOTS - 1, order - 1, -1):
            for j in range(width):
                table[i, j] = (table[i, j] - table[i - 1, j]) / (knots[i] - knots[i - order])
    flat, q, w, a = table.ravel(), motion[0].ravel(), motion[1].ravel(), motion[2].ravel()
    for j in range(0, width, LANES):
        for k in range(entry, N + 1):
            value, rate, curvature = load(flat, (KNOTS - 1) * width + j, LANES), lanes_of(0.0), lanes_of(0.0)
            for i in range(KNOTS - 2, -1, -1):
                s = k / N - knots[i]
                curvature = s * curvature + 2.0 * rate
                rate = s * rate + value
                value = s * value + load(flat, i * width + j, LANES)
            at = k * width + j
            store(load(q, at, LANES) + value, q, at, LANES)
            store(load(w, at, LANES) + (1.0 / T) * rate, w, at, LANES)
            store(load(a, at, LANES) + (1.0 / T**2) * curvature, a, at, LANES)
