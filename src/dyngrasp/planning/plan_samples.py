"""A plan at some of its times: on its grids, inside intervals between two grid points, and at steps of the joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan, Trajectory, interpolate, largest_difference

# Samples of an interval between two grid points in which a constraint could be broken: a velocity, quadratic in
# between, is then seen to 1/256 of its height.
SUBSTEPS = 16

# The hand moves at most this far (rad of any joint) between two waypoints: about a centimetre at the finger tips.
JOINT_STEP = 0.015


@dataclass(frozen=True, eq=False)
class PlanSamples:
    """A plan at some times: on its clock (M,), states of arm (3, n, M) and gripper (3, m, M).

    The three are position, velocity and acceleration; `stops` says where each of the three phases ends in M.
    """

    times: Array
    arm: Array
    gripper: Array
    stops: tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Waypoints:
    """Where a plan is looked at: times (S,) on its clock, arm (n, S) and gripper (m, S) positions.

    From sample `closing` on the pads may touch the part, from `lifted` on it hangs in the gripper.
    """

    times: Array
    q: Array
    q_h: Array
    closing: int
    lifted: int


def at_grid_points(plan: GraspPlan, since: float) -> PlanSamples:
    """The plan on its grids, and at `since`; on the finer one where arm and gripper have different grids."""
    chosen = []
    for arm, gripper, T in zip(plan.arm, plan.gripper, plan.phase_ends.tolist(), strict=True):
        local = _finer_grid(arm, gripper)
        cut = since - (T - arm.duration)
        if cut > 0.0:
            local = np.concatenate(([cut], local[np.searchsorted(local, cut, "right") :])) if since < T else local[:0]
        chosen.append(local)
    return _sampled(plan, chosen)


def _finer_grid(arm: Trajectory, gripper: Trajectory) -> Array:
    N = max(arm.intervals, gripper.intervals)
    grid: Array = np.arange(N + 1.0) * (arm.duration / N)
    grid[N] = arm.duration
    return grid


def between(plan: GraspPlan, grid: PlanSamples, suspects: NDArray[np.bool_]) -> PlanSamples:
    """Samples inside the intervals that begin at the marked ones (M,) of the samples `grid`."""
    chosen, first = [], 0
    for arm, T, stop in zip(plan.arm, plan.phase_ends.tolist(), grid.stops, strict=True):
        local = grid.times[first:stop] - (T - arm.duration)
        k = np.flatnonzero(suspects[first:stop])
        inside = local[k, None] + np.diff(local)[k, None] * (np.arange(1, SUBSTEPS) / SUBSTEPS)
        chosen.append(inside.ravel())
        first = stop
    return _sampled(plan, chosen)


def _sampled(plan: GraspPlan, chosen: list[Array]) -> PlanSamples:
    """The plan at times of each phase, counted from its beginning (s)."""
    closing = chosen[0].size
    lifted = closing + chosen[1].size
    samples = lifted + chosen[2].size
    times = np.empty(samples)
    both = [np.empty((3, len(names), samples)) for names in (plan.arm_joints, plan.gripper_joints)]
    first = 0
    for arm, gripper, T, local in zip(plan.arm, plan.gripper, plan.phase_ends.tolist(), chosen, strict=True):
        if local.size:
            times[first : first + local.size] = T - arm.duration + local
            for x, out in zip((arm, gripper), both, strict=True):
                _write(*_states(x, local), out, first)
        first += local.size
    return PlanSamples(times, both[0], both[1], (closing, lifted, samples))


def _states(trajectory: Trajectory, local: Array) -> tuple[Array, Array, Array]:
    """`Trajectory.sample_many`, for nothing where all grid points are asked for."""
    if local.size == trajectory.intervals + 1 and local[0] == 0.0:
        return trajectory.position, trajectory.velocity, trajectory.acceleration
    return trajectory.sample_many(local)


@njit(cache=True)
def _write(q, w, v, out, first):
    """Write states (M, n) into out (3, n, ≥ M) from column `first` on."""
    for i in range(q.shape[1]):
        for k in range(q.shape[0]):
            out[0, i, first + k], out[1, i, first + k], out[2, i, first + k] = q[k, i], w[k, i], v[k, i]


def waypoints_of(plan: GraspPlan, since: float = -np.inf) -> Waypoints:
    """Samples of a plan from `since` (s) on, `JOINT_STEP` or less apart, with both ends of each phase."""
    tables, counts = [], []
    for arm, gripper, T in zip(plan.arm, plan.gripper, plan.phase_ends.tolist(), strict=True):
        begin = T - arm.duration
        if since >= T:
            counts.append(0)
            continue
        grid = _finer_grid(arm, gripper)
        both = [x.position if len(x.position) == grid.size else x.sample_many(grid)[0] for x in (arm, gripper)]
        local = _steps(grid, both[0], both[1], max(since - begin, 0.0))
        tables.append(
            (
                begin + local,
                _positions(arm.duration, arm.position, arm.velocity, arm.acceleration, local),
                _positions(gripper.duration, gripper.position, gripper.velocity, gripper.acceleration, local),
            )
        )
        counts.append(local.size)
    times, q, q_h = (np.concatenate(column, axis=-1) for column in zip(*tables, strict=True))
    return Waypoints(times, q, q_h, counts[0], counts[0] + counts[1])


@njit(cache=True, error_model="numpy")
def _positions(duration, position, velocity, acceleration, local):
    """Positions (n, M) at local times (M,) (s)."""
    states = np.empty((3, local.size, position.shape[1]))
    interpolate(duration, position, velocity, acceleration, local, states)
    return states[0].T.copy()


@njit(cache=True, error_model="numpy")
def _steps(grid, q, q_h, start):
    """Times from `start` to the last of `grid` (M,), equidistant on the path of q (M, n) and q_h (M, m).

    The path counts in the largest joint step of each interval (rad).
    """
    last = grid.size - 1
    path = np.zeros(grid.size)
    for k in range(last):
        # Where both stand still the path needs a slope too, for times to be read from it.
        path[k + 1] = path[k] + largest_difference(q[k + 1], q[k]) + largest_difference(q_h[k + 1], q_h[k]) + 1e-9
    if not np.isfinite(path[last]):
        # A number that is none is looked at.
        return grid[grid >= start]
    k = 0
    while grid[k + 1] <= start and k + 1 < last:
        k += 1
    begin = path[k] + (path[k + 1] - path[k]) * (start - grid[k]) / (grid[k + 1] - grid[k])
    count = max(int(np.ceil((path[last] - begin) / JOINT_STEP)), 1)
    times = np.empty(count + 1)
    times[0], times[count] = start, grid[last]
    for i in range(1, count):
        along = begin + (path[last] - begin) / count * i
        while path[k + 1] < along and k + 1 < last:
            k += 1
        times[i] = grid[k] + (grid[k + 1] - grid[k]) * (along - path[k]) / (path[k + 1] - path[k])
    return times
