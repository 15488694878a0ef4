"""The last part of a phase as a problem of its own, for rows that are active there alone.

Where no row is active the motion between two states is the one of least effort. All grid points before k0 can so be
eliminated: whatever r[k0−1] and r[k0] are (`three_tap`), the least Σ_{k<k0} |a_k|² of a joint is

    eᵀ C e,      e = (r[k0−1], r[k0]) less the same of coasting from the start,      C = (M Mᵀ)⁻¹, (2, 2),

with e = M (a_0, …, a_{k0−1}). It enters the window as two grid points more, of the accelerations Lᵀ e with C = L Lᵀ and
of no other effect. What solves the whole phase so solves the window, with a number of unknowns that depends on its
length alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dyngrasp.planning.collocation.three_tap import CURVATURE, RATE, Indices, ThreeTap
from dyngrasp.planning.problem import NodeConstraint, PhaseProblem
from dyngrasp.signals import Array

EARLIEST, LATEST = 3, 5  # the window begins at this grid point or later, and at this one before the last or earlier
STANDING_FOR = 2  # grid points that stand for all before the window


@dataclass(frozen=True)
class Window:
    """The grid points from `first` on.

    Attributes:
        first: k0.
        map: From the unknowns of the window to q, w, a at its grid points, after the two that stand for the others.
        parameters: Of each constraint at the same grid points.
        effort_weight: ρ, for the sum over this number of grid points.
    """

    first: int
    map: ThreeTap
    parameters: tuple[Array, ...]
    effort_weight: float

    @classmethod
    def of(cls, problem: PhaseProblem, whole: ThreeTap, constraints: list[NodeConstraint], first: int) -> Window:
        """The window of a problem, `whole` its map, with some of its constraints."""
        rows, _, factor, at = _before(problem.intervals, first)
        index, taps = whole.first[rows] - (first - STANDING_FOR), whole.taps[rows]
        offset, slope = whole.offset.take(rows, axis=1), whole.slope.take(rows, axis=1)
        # Their position is that of the first grid point of the window, so that rows hold there if they hold here.
        taps[:STANDING_FOR, :, RATE:] = offset[RATE:, :STANDING_FOR] = 0.0
        taps[:STANDING_FOR, :STANDING_FOR, CURVATURE] = factor
        offset[CURVATURE, :STANDING_FOR] = -factor.sum(axis=1, keepdims=True) * problem.start_position
        slope[CURVATURE, :STANDING_FOR] = -(factor @ at) * problem.start_velocity
        weight = problem.effort_weight * (rows.size - 1) / problem.intervals
        # As those of the whole grid are: compiled code is made for read-only arrays, once.
        index.setflags(write=False)
        taps.setflags(write=False)
        return cls(first, ThreeTap(index, taps, offset, slope), tuple(c.parameters[rows] for c in constraints), weight)

    def unknowns(self, x: Array) -> Array:
        """Those of the window among the unknowns (N−1, n) of the whole phase."""
        return x[self.first - 2 :]

    def curvature(self, problem: PhaseProblem, x: Array, T: float) -> Array:
        """(N+1, n) accelerations in normalised time of the whole phase, from the unknowns of the window."""
        _, inverse, _, at = _before(problem.intervals, self.first)
        e = x[:STANDING_FOR] - problem.start_position - at * T * problem.start_velocity
        inside = self.map.expand(x, T)[CURVATURE, STANDING_FOR:]
        return np.concatenate([inverse @ e, inside])


@lru_cache(maxsize=64)
def _before(intervals: int, first: int) -> tuple[Indices, Array, Array, Array]:
    """Which grid points the window has, (W,), Mᵀ C (k0, 2), Lᵀ (2, 2), and when r[k0−1] and r[k0] are passed (2, 1)."""
    i, ends = np.arange(first), np.array([first - 1, first])
    matrix = np.array([np.where(i > 0, np.maximum(m - i, 0.0), m / 2 - 0.25) for m in ends]) / intervals**2
    C = np.asarray(np.linalg.inv(matrix @ matrix.T), dtype=float)
    rows = np.concatenate([[first] * STANDING_FOR, np.arange(first, intervals + 1)])
    return rows, matrix.T @ C, np.asarray(np.linalg.cholesky(C), dtype=float).T, ends[:, None] / intervals
