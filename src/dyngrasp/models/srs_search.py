"""Configurations of an S-R-S arm within its joint limits, compiled: those of given arm angles, and the nearest one.

`SrsKinematics` is what calls this; `srs_chain` holds the geometry.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.models.srs_chain import ALIGNED, ROUNDING, arm_angle_of, circle_at, configurations

_REFINED = 4  # local minima on the grid of arm angles that are looked into
_FOUND = 1e-9  # how near to a minimum its search ends (rad)
_GOLDEN = (3.0 - 5.0**0.5) / 2.0


@njit(cache=True, error_model="numpy")
def nearest_configuration(elbow, rotations, grid, step, branches, reference, weight, middle, lower, upper):
    """The configuration (7,) nearest to a reference, and its distance squared; inf if none on the grid is admissible.

    `branches` (m, b) are those tried at each angle of the grid (m,), a full turn in steps of `step` (rad).
    The best local minima of the grid are searched by golden section.
    """
    q, within = configurations_within(elbow, rotations, grid, branches, middle, lower, upper)
    cost = _weighted_squares(q, within, reference, weight)
    count, columns = branches.shape
    minima = np.full((count, columns), np.inf)
    for m in range(count):
        for k in range(columns):
            if cost[m, k] <= cost[m - 1, k] and cost[m, k] <= cost[(m + 1) % count, k]:
                minima[m, k] = cost[m, k]
    best_q, best = np.empty(7), np.inf
    psi, branch = np.empty(1), np.empty((1, 1), np.int64)
    for _ in range(_REFINED):
        at = minima.argmin()
        m, k = at // columns, at % columns
        if not np.isfinite(minima[m, k]):
            break
        minima[m, k] = np.inf
        left, angle, right = grid[m] - step, grid[m], grid[m] + step
        branch[0, 0], least, found = branches[m, k], cost[m, k], q[m, k].copy()
        while right - left > 2.0 * _FOUND:
            longer = right - angle if right - angle > angle - left else left - angle
            psi[0] = angle + _GOLDEN * longer
            trial, within = configurations_within(elbow, rotations, psi, branch, middle, lower, upper)
            now = _weighted_squares(trial, within, reference, weight)[0, 0]
            # The better of the two stays in the middle; the other is the new end on its side.
            if now < least:
                ended, angle, least, found = angle, psi[0], now, trial[0, 0].copy()
            else:
                ended = psi[0]
            left, right = (ended, right) if ended < angle else (left, ended)
            # By then all that is left to gain is far below this.
            if right - left < 2e-3 and least > 1.05 * best + 1e-9:
                break
        if least < best:
            best, best_q = least, found
    return best_q, best


@njit(cache=True, error_model="numpy")
def follow_configuration(R, p, q_reference, lengths, nearest, farthest, middle, lower, upper, out):
    """Write `SrsKinematics.follow`; whether there is such a configuration."""
    elbow, rotations, L = circle_at(R, p, lengths, nearest, farthest)
    if not (L >= ALIGNED and nearest - ROUNDING <= L <= farthest + ROUNDING):
        return False
    psi, branch = np.empty(1), np.empty((1, 1), np.int64)
    psi[0] = arm_angle_of(q_reference, lengths[1], lengths[2])
    branch[0, 0] = (q_reference[1] < 0.0) + 2 * (q_reference[3] < 0.0) + 4 * (q_reference[5] < 0.0)
    q, within = configurations_within(elbow, rotations, psi, branch, middle, lower, upper)
    out[:] = q[0, 0]
    return within[0, 0]


@njit(cache=True, error_model="numpy")
def admissible_configurations(elbow, rotations, psi, branches, middle, lower, upper):
    """Those of `configurations_within` that keep the limits, (k, 7), and the arm angle and the branch of each, (k,)."""
    q, within = configurations_within(elbow, rotations, psi, branches, middle, lower, upper)
    most, count = branches.size, 0
    kept, angles, of_branch = np.empty((most, 7)), np.empty(most), np.empty(most, np.int64)
    for m in range(branches.shape[0]):
        for k in range(branches.shape[1]):
            if within[m, k]:
                kept[count], angles[count], of_branch[count] = q[m, k], psi[m], branches[m, k]
                count += 1
    return kept[:count], angles[:count], of_branch[:count]


@njit(cache=True, error_model="numpy")
def configurations_within(elbow, rotations, psi, branches, middle, lower, upper):
    """`srs_chain.configurations` turned to the middle of the ranges, and whether each keeps the limits, (m, b)."""
    q = configurations(elbow, rotations, psi, branches)
    return q, _turned_within(q, middle, lower, upper)


@njit(cache=True, error_model="numpy")
def _turned_within(q, middle, lower, upper):
    """Turn joints (m, b, 7) by full turns to the middle of their ranges, in place; whether all are in their ranges.

    What is outside by rounding is put on the edge.
    """
    within = np.ones(q.shape[:2], dtype=np.bool_)
    for m in range(q.shape[0]):
        for k in range(q.shape[1]):
            for i in range(7):
                x = q[m, k, i] - 2.0 * np.pi * np.rint((q[m, k, i] - middle[i]) / (2.0 * np.pi))
                edge = min(max(x, lower[i]), upper[i])
                within[m, k] = within[m, k] and abs(x - edge) <= ROUNDING
                q[m, k, i] = edge if abs(x - edge) <= ROUNDING else x
    return within


@njit(cache=True, error_model="numpy")
def _weighted_squares(q, within, reference, weight):
    """Σ ((q − reference) · weight)² of configurations (m, b, 7), inf where a limit is broken."""
    cost = np.full(within.shape, np.inf)
    for m in range(q.shape[0]):
        for k in range(q.shape[1]):
            if within[m, k]:
                total = 0.0
                for i in range(7):
                    total += ((q[m, k, i] - reference[i]) * weight[i]) ** 2
                cost[m, k] = total
    return cost
