"""A plan at its grid points, and between two of them where a constraint could be broken there.

A function of the motion departs from the chord between two grid points by about an eighth of its second difference
there. An interval in which several times that could break a constraint is looked into.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from dyngrasp.planning.problem import AuditEntry
from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan, Trajectory

# Samples of an interval between two grid points in which a constraint could be broken: a velocity, quadratic in
# between, is then seen to 1/256 of its height.
SUBSTEPS = 16

# Of the second difference: four times the departure from the chord.
CURVATURE_FACTOR = 4.0 / 8.0


@dataclass(frozen=True)
class PlanSamples:
    """A plan at some times: on its clock (M,), arm (n, M) and gripper (m, M) states.

    `phases` are the three slices of M.
    """

    phases: tuple[slice, slice, slice]
    times: Array
    q: Array
    w: Array
    v: Array
    q_h: Array
    w_h: Array
    v_h: Array

    def arm(self, part: slice) -> tuple[Array, Array, Array]:
        """Position, velocity and acceleration of the arm in some of the samples."""
        return tuple(np.ascontiguousarray(x[:, part]) for x in (self.q, self.w, self.v))  # type: ignore[return-value]


@dataclass(frozen=True)
class Row:
    """One constraint at the samples from `first` on: values (k, m) that must not exceed a bound, or not fall below.

    `names` are those of the k values. `straight` says that between two grid points they are linear.
    """

    name: str
    values: Array
    first: int
    bound: float
    tolerance: float
    unit: str
    at_least: bool = False
    names: tuple[str, ...] = ()
    straight: bool = False

    def entry(self, times: Array) -> AuditEntry:
        """The worst value; `times` (M,) are those of all samples."""
        # numpy's argmax and argmin stop at a NaN: it is the worst value there can be.
        flat = int(self.values.argmin() if self.at_least else self.values.argmax())
        which, k = divmod(flat, self.values.shape[1])
        time, detail = float(times[self.first + k]), self.names[which] if self.names else ""
        worst = float(self.values[which, k])
        return AuditEntry(self.name, worst, self.bound, self.at_least, self.tolerance, self.unit, time, detail)


def at_grid_points(plan: GraspPlan, since: float) -> PlanSamples:
    """The plan on its grids, and at `since`; on the finer one where arm and gripper have different grids."""
    chosen = []
    for arm, gripper, T in zip(plan.arm, plan.gripper, plan.phase_ends.tolist(), strict=True):
        local = arm.times if arm.intervals >= gripper.intervals else gripper.times
        cut = since - (T - arm.duration)
        if cut > 0.0:
            local = np.concatenate([[cut], local[local > cut]]) if since < T else np.empty(0)
        chosen.append(local)
    return _sampled(plan, chosen)


def _sampled(plan: GraspPlan, chosen: list[Array]) -> PlanSamples:
    """The plan at times of each phase, counted from its beginning (s)."""
    tables, phases, end = [], [], 0
    for arm, gripper, T, local in zip(plan.arm, plan.gripper, plan.phase_ends.tolist(), chosen, strict=True):
        tables.append((T - arm.duration + local, *_states(arm, local), *_states(gripper, local)))
        phases.append(slice(end, end + local.size))
        end += local.size
    return PlanSamples(
        tuple(phases), *(np.ascontiguousarray(np.concatenate(column).T) for column in zip(*tables, strict=True))
    )


def _states(trajectory: Trajectory, local: Array) -> tuple[Array, Array, Array]:
    """`Trajectory.sample_many`, for nothing where all grid points are asked for."""
    if local.size == trajectory.intervals + 1 and local[0] == 0.0:
        return trajectory.position, trajectory.velocity, trajectory.acceleration
    return trajectory.sample_many(local)


def between(plan: GraspPlan, grid: PlanSamples, rows: list[Row]) -> PlanSamples | None:
    """Samples inside the intervals in which a constraint could be broken; None if there is no such interval."""
    suspects = np.zeros(grid.times.size, dtype=np.bool_)
    for row in rows:
        if not row.straight:
            sign = -1.0 if row.at_least else 1.0
            _mark_suspects(row.values, row.bound, sign, suspects[row.first : row.first + row.values.shape[1]])
    for part in grid.phases:
        # What follows the last sample of a phase is a join: no time passes there.
        suspects[part.stop - 1 : part.stop] = False
    if not suspects.any():
        return None
    chosen = []
    for arm, T, part in zip(plan.arm, plan.phase_ends.tolist(), grid.phases, strict=True):
        local = grid.times[part] - (T - arm.duration)
        k = np.flatnonzero(suspects[part])
        inside = local[k, None] + np.diff(local)[k, None] * (np.arange(1, SUBSTEPS) / SUBSTEPS)
        chosen.append(inside.ravel())
    return _sampled(plan, chosen)


@njit(cache=True)
def _mark_suspects(values, bound, sign, suspects):
    """Mark the intervals between samples of values (k, m) in which the bound is not farther than they may bend."""
    last = values.shape[1] - 1
    for j in range(values.shape[0]):
        row = values[j]
        for k in range(last):
            bend = 0.0
            if k > 0:
                bend = abs(row[k - 1] - 2.0 * row[k] + row[k + 1])
            if k + 2 <= last:
                bend = max(bend, abs(row[k] - 2.0 * row[k + 1] + row[k + 2]))
            slack = min(sign * (bound - row[k]), sign * (bound - row[k + 1]))
            # A NaN is suspect as well.
            if not slack >= CURVATURE_FACTOR * bend:
                suspects[k] = True


def worse(one: AuditEntry, other: AuditEntry) -> AuditEntry:
    """The entry with the worse value, of one constraint; NaN is worst."""
    sign = -1.0 if one.at_least else 1.0
    return one if not sign * other.worst > sign * one.worst and not np.isnan(other.worst) else other
