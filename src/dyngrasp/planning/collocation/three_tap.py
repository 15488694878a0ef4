"""The change of variables that removes the dynamics: one sequence r a joint, of which q, w and a are three-tap filters.

With s = t/T, w = T q̇, a = T² q̈ and h = 1/N the trapezoidal rule, eq. (3b), is linear, constant and free of T. Its
solutions are exactly those of a sequence r[−1 … N+1]:

    q[k] = (r[k−1] + 2 r[k] + r[k+1]) / 4,
    w[k] = (r[k+1] − r[k−1]) / (2 h),
    a[k] = (r[k+1] − 2 r[k] + r[k−1]) / h².

The boundary states at k = 0 fix the neighbours of r[0],

    r[±1] = 2 q_S − r[0] ± h T q̇_S,

and likewise those of r[N]. What is left are the N − 1 unknowns x = (r[0], r[2], …, r[N−2], r[N]) a joint, and T,
without any equality constraint. Every grid point depends on at most three consecutive unknowns, the ones near the ends
also on T:

    z[k] = Σ_b taps[k, b] x[first[k] + b] + offset[k] + T slope[k]      for z = q, w and a.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.planning.problem import PhaseProblem
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory

Indices = NDArray[np.intp]
TAPS = 3  # unknowns that a grid point depends on
POSITION, RATE, CURVATURE = 0, 1, 2  # order of q, w, a wherever the three are an axis of an array


class ThreeTap(NamedTuple):
    """The affine map from x and T to q, w, a on the grid of one problem; compiled functions take it whole.

    Attributes:
        first: (N+1,) index of the first unknown that a grid point depends on.
        taps: (N+1, 3, 3) coefficients [k, tap, q/w/a], the same for every joint.
        offset: (3, N+1, n) constant part [q/w/a, k, joint].
        slope: (3, N+1, n) coefficient of T [q/w/a, k, joint]; zero but at the three grid points nearest to each end.
    """

    first: Indices
    taps: Array
    offset: Array
    slope: Array

    @classmethod
    def of(cls, problem: PhaseProblem) -> ThreeTap:
        """The map of a problem's grid and boundary states."""
        first, taps, by_position, by_rate = _filters(problem.intervals)
        ends = np.stack([problem.start_position, problem.end_position])
        rates = np.stack([problem.start_velocity, problem.end_velocity])
        shape = (3, problem.intervals + 1, problem.joints)
        return cls(first, taps, (by_position @ ends).reshape(shape), (by_rate @ rates).reshape(shape))

    def unknowns(self, trajectory: Trajectory) -> Array:
        """(N−1, n) x of a motion on this grid: r[k] = q[k] − h² a[k] / 4."""
        h = 1.0 / trajectory.intervals
        r = trajectory.position - h**2 / 4 * trajectory.duration**2 * trajectory.acceleration
        return np.vstack([r[:1], r[2:-2], r[-1:]])

    def expand(self, x: Array, duration: float) -> Array:
        """(3, N+1, n) q, w and a of unknowns x (N−1, n) and a duration T."""
        z = np.empty_like(self.offset)
        expand(self, x, duration, z)
        return z


@lru_cache(maxsize=64)
def _filters(intervals: int) -> tuple[Indices, Array, Array, Array]:
    """`first`, `taps`, and how `offset` and `slope`, as (3 (N+1), n), follow from both ends' q and q̇ (2, n)."""
    N, h = intervals, 1.0 / intervals
    weights = np.array([[0.25, -0.5 / h, 1 / h**2], [0.5, 0.0, -2 / h**2], [0.25, 0.5 / h, 1 / h**2]])
    first = np.clip(np.arange(N + 1) - 2, 0, N - 4)
    # Coefficients of the four eliminated values [z, k, end, before/after].
    taps, reach = np.zeros((N + 1, TAPS, 3)), np.zeros((3, N + 1, 2, 2))
    eliminated = {-1: (0, 0), 1: (0, 1), N - 1: (1, 0), N + 1: (1, 1)}
    column = {0: 0, N: N - 2} | {i: i - 1 for i in range(2, N - 1)}
    for k in range(N + 1):
        for step, weight in zip((-1, 0, 1), weights, strict=True):
            i = k + step
            if i in eliminated:
                end, side = eliminated[i]
                reach[:, k, end, side] += weight
                # r[±1] = … − r[0], and the same at the far end: an eliminated value also counts for its neighbour.
                taps[k, column[N * end] - first[k]] -= weight
            else:
                taps[k, column[i] - first[k]] += weight
    # r[−1], r[1] = 2 q_S − r[0] ∓ h T q̇_S, and the same at the far end.
    by_position = (2 * (reach[..., 0] + reach[..., 1])).reshape(-1, 2)
    by_rate = (h * (reach[..., 1] - reach[..., 0])).reshape(-1, 2)
    for array in (first, taps):
        array.setflags(write=False)
    return first, taps, by_position, by_rate


@njit(cache=True)
def expand(tap: ThreeTap, x: Array, duration: float, z: Array) -> None:
    """Write z = offset + T slope + taps applied to x."""
    first, taps, offset, slope = tap
    kinds, points, n = z.shape
    for kind in range(kinds):
        for k in range(points):
            here, constant, rate = z[kind, k], offset[kind, k], slope[kind, k]
            before, at, after = x[first[k]], x[first[k] + 1], x[first[k] + 2]
            w_before, w_at, w_after = taps[k, 0, kind], taps[k, 1, kind], taps[k, 2, kind]
            for j in range(n):
                filtered = w_before * before[j] + w_at * at[j] + w_after * after[j]
                here[j] = constant[j] + duration * rate[j] + filtered


@njit(cache=True)
def place(tap: ThreeTap, x: Array, duration: float, z: Array, v: Array) -> None:
    """`expand`, and the accelerations v = a / T²."""
    expand(tap, x, duration, z)
    scale = 1.0 / duration**2
    for k in range(v.shape[0]):
        for j in range(v.shape[1]):
            v[k, j] = scale * z[CURVATURE, k, j]


@njit(cache=True)
def expand_step(tap: ThreeTap, dx: Array, dT: float, dz: Array) -> None:
    """The linear part of `expand`: how q, w and a change with dx and dT."""
    first, taps, _, slope = tap
    kinds, points, n = dz.shape
    for kind in range(kinds):
        for k in range(points):
            here, rate = dz[kind, k], slope[kind, k]
            before, at, after = dx[first[k]], dx[first[k] + 1], dx[first[k] + 2]
            w_before, w_at, w_after = taps[k, 0, kind], taps[k, 1, kind], taps[k, 2, kind]
            for j in range(n):
                here[j] = dT * rate[j] + w_before * before[j] + w_at * at[j] + w_after * after[j]


@njit(cache=True)
def pull_back(tap: ThreeTap, dual: Array, gradient: Array) -> float:
    """The transpose of `expand_step`: derivatives by q, w and a become derivatives by x.

    Args:
        tap: The map.
        dual: (3, N+1, n) derivatives of a scalar by q, w and a.
        gradient: (N−1, n), overwritten by the derivatives by x.

    Returns:
        The derivative by T through `slope`.
    """
    first, taps, _, slope = tap
    kinds, points, n = dual.shape
    gradient[:] = 0.0
    by_duration = 0.0
    for k in range(points):
        for b in range(TAPS):
            q, w, a = taps[k, b, POSITION], taps[k, b, RATE], taps[k, b, CURVATURE]
            here = gradient[first[k] + b]
            for j in range(n):
                here[j] += q * dual[POSITION, k, j] + w * dual[RATE, k, j] + a * dual[CURVATURE, k, j]
    for kind in range(kinds):
        for k in range(points):
            if 2 < k < points - 3:
                continue
            for j in range(n):
                by_duration += slope[kind, k, j] * dual[kind, k, j]
    return by_duration
