"""Configurations of an S-R-S arm within its joint limits, compiled: those of given arm angles, and the nearest one.

`SrsKinematics` is what calls this; `srs_chain` holds the geometry.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.models.srs_chain import ALIGNED, BRANCHES, ROUNDING, angles_at, arm_angle_of, circle_at, put_on_branch
from dyngrasp.motion_arrays import largest_difference

_REFINED = 4  # local minima on the grid of arm angles that are looked into
_FOUND = 1e-9  # how near to a minimum its search ends (rad)
_GOLDEN = (3.0 - 5.0**0.5) / 2.0


@njit(cache=True, error_model="numpy")
def nearest_configuration(elbow, rotations, grid, step, reference, weight, middle, lower, upper):
    """The configuration (7,) nearest to a reference, and its distance squared; inf if none on the grid is admissible.

    The grid of arm angles (m,) is a full turn in steps of `step` (rad); all branches are tried at each of them. The
    best local minima of the grid are searched by golden section.
    """
    count, angles, q = grid.size, np.empty(7), np.empty(7)
    cost, minima = np.empty((count, BRANCHES)), np.full((count, BRANCHES), np.inf)
    for m in range(count):
        aligned = angles_at(elbow, rotations, grid[m], angles)
        for k in range(BRANCHES):
            cost[m, k] = _distance(angles, aligned, k, reference, weight, middle, lower, upper, q)
    for m in range(count):
        for k in range(BRANCHES):
            if cost[m, k] <= cost[m - 1, k] and cost[m, k] <= cost[(m + 1) % count, k]:
                minima[m, k] = cost[m, k]
    best_angle, best_branch, best = 0.0, 0, np.inf
    for _ in range(_REFINED):
        m, k = divmod(minima.argmin(), BRANCHES)
        least = minima[m, k]
        if not np.isfinite(least):
            break
        minima[m, k] = np.inf
        left, angle, right = grid[m] - step, grid[m], grid[m] + step
        while right - left > 2.0 * _FOUND:
            trial = angle + _GOLDEN * (right - angle if right - angle > angle - left else left - angle)
            aligned = angles_at(elbow, rotations, trial, angles)
            now = _distance(angles, aligned, k, reference, weight, middle, lower, upper, q)
            # The better of the two stays in the middle; the other is the new end on its side.
            end = trial
            if now < least:
                end, angle, least = angle, trial, now
            left, right = (end, right) if end < angle else (left, end)
            # By then all that is left to gain is far below this.
            if right - left < 2e-3 and least > 1.05 * best + 1e-9:
                break
        if least < best:
            best_angle, best_branch, best = angle, k, least
    aligned = angles_at(elbow, rotations, best_angle, angles)
    _is_within(angles, aligned, best_branch, middle, lower, upper, q)
    return q, best


@njit(cache=True, error_model="numpy")
def follow_configurations(poses, references, arm, out):
    """`SrsKinematics.follow`: write the configurations (K, 7), return the largest turn of a joint."""
    for k in range(len(poses)):
        if not follow_configuration(poses[k], references[k], arm, out[k]):
            out[k] = np.nan
    return largest_difference(out.ravel(), references.ravel())


@njit(cache=True, error_model="numpy")
def follow_configuration(pose, reference, arm, out):
    """Write the configuration (7,) of one pose [R | p]; whether there is one. `arm` is `SrsKinematics.arrays`."""
    lengths, nearest, farthest, middle, lower, upper = arm
    elbow, rotations, L = circle_at(pose[:, :3], pose[:, 3], lengths, nearest, farthest)
    if not (L >= ALIGNED and nearest - ROUNDING <= L <= farthest + ROUNDING):
        return False
    angles, psi = np.empty(7), arm_angle_of(reference, lengths[1], lengths[2])
    branch = (reference[1] < 0.0) + 2 * (reference[3] < 0.0) + 4 * (reference[5] < 0.0)
    return _is_within(angles, angles_at(elbow, rotations, psi, angles), branch, middle, lower, upper, out)


@njit(cache=True, error_model="numpy")
def admissible_configurations(elbow, rotations, grid, middle, lower, upper):
    """Configurations (k, 7) within the limits at arm angles (m,), and the arm angle and the branch of each, (k,)."""
    most, count, angles = grid.size * BRANCHES, 0, np.empty(7)
    q, psi, branch = np.empty((most, 7)), np.empty(most), np.empty(most, np.int64)
    for m in range(grid.size):
        aligned = angles_at(elbow, rotations, grid[m], angles)
        for k in range(BRANCHES):
            if _is_within(angles, aligned, k, middle, lower, upper, q[count]):
                psi[count], branch[count] = grid[m], k
                count += 1
    return q[:count], psi[:count], branch[:count]


@njit(cache=True, error_model="numpy")
def configurations_on(branch, elbow, rotations, psi, middle, lower, upper):
    """Configurations (m, 7) at arm angles (m,) on one branch, and whether each keeps the limits, (m,)."""
    q, within, angles = np.empty((psi.size, 7)), np.empty(psi.size, np.bool_), np.empty(7)
    for m in range(psi.size):
        aligned = angles_at(elbow, rotations, psi[m], angles)
        within[m] = _is_within(angles, aligned, branch, middle, lower, upper, q[m])
    return q, within


@njit(cache=True, error_model="numpy", inline="always")
def _is_within(angles, aligned, branch, middle, lower, upper, q):
    """Write `srs_chain.put_on_branch` turned by full turns to the middle of the ranges; whether all are in their range.

    What is outside by rounding is put on the edge.
    """
    put_on_branch(angles, aligned, branch, q)
    within = True
    for i in range(7):
        x = q[i] - 2.0 * np.pi * np.rint((q[i] - middle[i]) / (2.0 * np.pi))
        edge = min(max(x, lower[i]), upper[i])
        kept = abs(x - edge) <= ROUNDING
        within, q[i] = within and kept, edge if kept else x
    return within


@njit(cache=True, error_model="numpy", inline="always")
def _distance(angles, aligned, branch, reference, weight, middle, lower, upper, q):
    """Σ ((q − reference) · weight)² of the configuration of `_is_within`, inf if it breaks a limit."""
    if not _is_within(angles, aligned, branch, middle, lower, upper, q):
        return np.inf
    total = 0.0
    for i in range(7):
        total += ((q[i] - reference[i]) * weight[i]) ** 2
    return total
