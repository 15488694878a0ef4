"""A plan at some of its times: on its grids, inside intervals between two grid points, and at steps of the joints."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dyngrasp.motion_arrays import interpolate, interval_at, position_weights
from dyngrasp.signals import Array

# Samples of an interval between two grid points in which a constraint could be broken: a velocity, quadratic in
# between, is then seen to 1/256 of its height.
SUBSTEPS = 16

# The hand moves at most this far (rad of any joint) between two waypoints: about a centimetre at the finger tips.
JOINT_STEP = 0.015


class PlanSamples(NamedTuple):
    """A plan at some times: on its clock (M,), states of arm (3, n, M) and gripper (3, m, M).

    The three are position, velocity and acceleration; `stops` says where each of the three phases ends in M.
    """

    times: Array
    arm: Array
    gripper: Array
    stops: tuple[int, int, int]


@njit(cache=True, error_model="numpy")
def at_grid_points(arm, gripper, ends, since):
    """`PlanSamples` on the grids of `GraspPlan.arrays`, and at `since` (s).

    On the finer one where arm and gripper have different grids; none of what comes before `since`.
    """
    first, stops = np.zeros(3, np.int64), np.zeros(3, np.int64)
    for i in range(3):
        points, step, past = _grid_of(arm[i], gripper[i], ends[i], since)
        count = 0
        if since < ends[i]:
            while past > 0.0 and first[i] < points - 1 and first[i] * step <= past:
                first[i] += 1
            count = points - first[i] + (past > 0.0)
        stops[i] = count + (stops[i - 1] if i > 0 else 0)
    samples = _room_for(arm, gripper, stops)
    for i in range(3):
        points, step, past = _grid_of(arm[i], gripper[i], ends[i], since)
        start = stops[i - 1] if i > 0 else 0
        if start == stops[i]:
            continue
        local = step * np.arange(points)
        local[-1] = arm[i][0]
        if past > 0.0:
            _write_states(arm, gripper, ends, i, np.full(1, past), start, samples)
            start += 1
        if arm[i][1].shape[0] == points and gripper[i][1].shape[0] == points:
            for trajectory, out in ((arm[i], samples.arm), (gripper[i], samples.gripper)):
                for kind, values in enumerate(trajectory[1:]):
                    out[kind, :, start : stops[i]] = values[first[i] :].T
            samples.times[start : stops[i]] = ends[i] - arm[i][0] + local[first[i] :]
        else:
            _write_states(arm, gripper, ends, i, local[first[i] :], start, samples)
    return samples


@njit(cache=True, inline="always")
def _grid_of(arm, gripper, end, since):
    """Grid points of a phase, their distance (s), and how long before `since` it began (s)."""
    points = max(arm[1].shape[0], gripper[1].shape[0])
    return points, arm[0] / (points - 1), since - (end - arm[0])


@njit(cache=True, error_model="numpy")
def between(arm, gripper, ends, grid, suspects):
    """`PlanSamples` inside the intervals that begin at the marked ones (M,) of those at the grid points."""
    local, stops = np.empty(SUBSTEPS * suspects.sum()), np.zeros(3, np.int64)
    count = start = 0
    for i in range(3):
        begin = ends[i] - arm[i][0]
        for k in range(start, grid.stops[i]):
            if suspects[k]:
                for part in range(1, SUBSTEPS):
                    local[count] = grid.times[k] - begin + part / SUBSTEPS * (grid.times[k + 1] - grid.times[k])
                    count += 1
        start, stops[i] = grid.stops[i], count
    samples = _room_for(arm, gripper, stops)
    start = 0
    for i in range(3):
        _write_states(arm, gripper, ends, i, local[start : stops[i]], start, samples)
        start = stops[i]
    return samples


@njit(cache=True, error_model="numpy")
def waypoints(arm, gripper, ends, since, rows):
    """A plan where its paths are looked at: from `since` (s) on, `JOINT_STEP` or less apart, both ends of each phase.

    Args:
        arm: Trajectories of the arm in `GraspPlan.arrays`,
        gripper: those of the gripper,
        ends: and when the phases end (s).
        since: s.
        rows: (n,), (m,) where in an array the positions of each joint of arm and gripper go.

    Returns:
        Times (S,) on the plan's clock, positions (n + m, S), and two samples: from the first one on the pads may touch
        the part, from the second on it hangs in the gripper.
    """
    local, stops = np.empty(0), np.zeros(3, np.int64)
    for i in range(3):
        if since < ends[i]:
            steps = _steps(arm[i], gripper[i], max(since - (ends[i] - arm[i][0]), 0.0))
            local = np.concatenate((local, steps))
        stops[i] = local.size
    times, q, start = np.empty(local.size), np.empty((rows[0].size + rows[1].size, local.size)), 0
    for i in range(3):
        own = slice(start, stops[i])
        times[own] = ends[i] - arm[i][0] + local[own]
        _write_positions(arm[i], local[own], rows[0], q[:, own])
        _write_positions(gripper[i], local[own], rows[1], q[:, own])
        start = stops[i]
    return times, q, stops[0], stops[1]


@njit(cache=True, error_model="numpy")
def _write_positions(trajectory, times, rows, out):
    """Write positions of joints, those of `interpolate`, at times (M,) into rows (n,) of an array (≥ n, M)."""
    duration, position, velocity, acceleration = trajectory
    N = position.shape[0] - 1
    step = duration / N
    for m in range(times.size):
        k, s = interval_at(times[m], duration, N)
        if s == 0.0 or s == 1.0:
            for i in range(rows.size):
                out[rows[i], m] = position[k + int(s), i]
            continue
        by_rate, half, sixth = position_weights(step, s)
        for i in range(rows.size):
            v_k = acceleration[k, i]
            straight = position[k, i] + by_rate * velocity[k, i]
            out[rows[i], m] = straight + half * v_k + sixth * (acceleration[k + 1, i] - v_k)


@njit(cache=True)
def _room_for(arm, gripper, stops):
    """`PlanSamples` to be written."""
    n, m, size = arm[0][1].shape[1], gripper[0][1].shape[1], stops[2]
    return PlanSamples(np.empty(size), np.empty((3, n, size)), np.empty((3, m, size)), (stops[0], stops[1], stops[2]))


@njit(cache=True, error_model="numpy")
def _write_states(arm, gripper, ends, i, local, start, samples):
    """Write samples of a phase, from `start` on, at times counted from its beginning (s)."""
    stop = start + local.size
    samples.times[start:stop] = ends[i] - arm[i][0] + local
    for trajectory, out in ((arm[i], samples.arm), (gripper[i], samples.gripper)):
        interpolate(trajectory, local, out[:, :, start:stop].transpose(0, 2, 1))


@njit(cache=True, error_model="numpy")
def _steps(arm, gripper, start):
    """Times of a phase from `start` (s) to its end, equidistant on the path of its joints.

    The path counts in the largest step of arm and of gripper from grid point to grid point (rad).
    """
    last = max(arm[1].shape[0], gripper[1].shape[0]) - 1
    grid = np.arange(last + 1) * (arm[0] / last)
    grid[last] = arm[0]
    # Where both stand still the path needs a slope too, for times to be read from it.
    path = np.full(grid.size, 1e-9)
    path[0] = 0.0
    for trajectory in (arm, gripper):
        if trajectory[1].shape[0] == grid.size:
            _add_steps(trajectory[1], path)
        else:
            states = np.empty((3, grid.size, trajectory[1].shape[1]))
            interpolate(trajectory, grid, states)
            _add_steps(states[0], path)
    path = np.cumsum(path)
    if not path[last] < np.inf:
        # A number that is none is looked at.
        return grid[grid >= start]
    k = 0
    while grid[k + 1] <= start and k + 1 < last:
        k += 1
    begin = path[k] + (path[k + 1] - path[k]) * (start - grid[k]) / (grid[k + 1] - grid[k])
    count = max(int(np.ceil((path[last] - begin) / JOINT_STEP)), 1)
    stride, times = (path[last] - begin) / count, np.empty(count + 1)
    times[0], times[count] = start, grid[last]
    for i in range(1, count):
        along = begin + stride * i
        while path[k + 1] < along and k + 1 < last:
            k += 1
        times[i] = grid[k] + (grid[k + 1] - grid[k]) * (along - path[k]) / (path[k + 1] - path[k])
    return times


@njit(cache=True, error_model="numpy")
def _add_steps(position, path):
    """Add the largest step of any joint to each grid point of positions (M, n) to path (M,)."""
    for k in range(1, path.size):
        largest = nothing = 0.0
        for i in range(position.shape[1]):
            step = abs(position[k, i] - position[k - 1, i])
            # A NaN is lost in the comparison and kept in the sum.
            largest, nothing = max(largest, step), nothing + 0.0 * step
        path[k] += largest + nothing
