"""All limits of a phase as one-sided rows g(x, T) ≥ 0, and their products with vectors.

Rows of one grid point, in units of their own scale:

    (q − q_min) / half-width,   (q_max − q) / half-width,      n each
    T + w / q̇_max,              T − w / q̇_max,                 n each
    T² + a / v_max,             T² − a / v_max,                n each, only if some v_max is finite
    (c − lower) / scale,        (upper − c) / scale            of the constraints' rows c(q, v), v = a / T²

and after the last grid point the two bounds of T. The boundary states make some rows at both ends constant; they are
checked beforehand and stand here as the constant 1, which an interior point method does not notice.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.planning.collocation.closed_form import SHORTEST_DURATION
from dyngrasp.planning.collocation.node_functions import NodeFunctions
from dyngrasp.planning.collocation.three_tap import CURVATURE, POSITION, RATE, Indices
from dyngrasp.planning.problem import NodeConstraint, PhaseProblem
from dyngrasp.signals import Array

UNBOUNDED = 1e12  # an infinite limit as a number: its row then never comes near zero
# An interval must have an interior: a narrower one is widened to this, in units of its scale.
NARROWEST = 1e-9


@dataclass(frozen=True)
class LimitRows:
    """Data of the rows of one problem.

    Attributes:
        middle, half_width, velocity: (n,) of the limits of positions (rad) and velocities (rad/s), or empty.
        acceleration: (n,) limits, empty if there is none.
        lower_index, upper_index: Which of the constraints' rows have a finite lower or upper bound.
        lower, upper: (m,) bounds divided by the scale.
        inverse_scale: (m,)
        free_at_ends: (m,) 1.0 where a row depends on v, so that it is not constant at the ends.
        shortest, longest: Bounds of T (s).
        fixed_duration: Whether they leave T no freedom.
        of_row: Names of the constraints that the m rows belong to.
    """

    middle: Array
    half_width: Array
    velocity: Array
    acceleration: Array
    lower_index: Indices
    upper_index: Indices
    lower: Array
    upper: Array
    inverse_scale: Array
    free_at_ends: Array
    shortest: float
    longest: float
    fixed_duration: bool
    of_row: tuple[str, ...]

    @classmethod
    def of(cls, problem: PhaseProblem, functions: list[NodeFunctions]) -> LimitRows:
        """The rows of a problem whose constraints are evaluated by `functions`, in the same order."""
        return cls._of(problem, problem.constraints, functions, slice(None))

    @classmethod
    def without_boxes(
        cls, problem: PhaseProblem, constraints: Sequence[NodeConstraint], functions: list[NodeFunctions]
    ) -> LimitRows:
        """The rows of some of a problem's constraints alone, and the bounds of the duration."""
        return cls._of(problem, constraints, functions, slice(0))

    @classmethod
    def _of(
        cls,
        problem: PhaseProblem,
        constraints: Sequence[NodeConstraint],
        functions: list[NodeFunctions],
        boxes: slice,
    ) -> LimitRows:
        q_min = np.maximum(problem.position_lower, -UNBOUNDED)[boxes]
        q_max = np.minimum(problem.position_upper, UNBOUNDED)[boxes]
        velocity = np.minimum(problem.velocity_limit, UNBOUNDED)[boxes]
        acceleration = np.minimum(problem.acceleration_limit, UNBOUNDED)[boxes]
        if not (acceleration < UNBOUNDED).any():
            acceleration = np.empty(0)
        none = [np.empty(0)]
        scale = np.concatenate([c.scale for c in constraints] or none)
        lower = np.concatenate([c.lower for c in constraints] or none) / scale
        upper = np.concatenate([c.upper for c in constraints] or none) / scale
        widening = np.maximum(0.0, NARROWEST - (upper - lower)) / 2
        free = np.concatenate([f.depends_on_acceleration for f in functions] or none)
        lower_index, upper_index = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
        shortest = max(problem.min_duration, min(SHORTEST_DURATION, problem.max_duration))
        return cls(
            (q_max + q_min) / 2,
            np.maximum((q_max - q_min) / 2, NARROWEST),
            velocity,
            acceleration,
            lower_index,
            upper_index,
            lower - widening,
            upper + widening,
            1.0 / scale,
            free.astype(float),
            shortest,
            problem.max_duration,
            problem.max_duration - shortest <= NARROWEST * problem.max_duration,
            tuple(c.name for c in constraints for _ in range(c.lower.size)),
        )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """What each of the R rows of a grid point limits, and at last the duration."""
        boxes = 2 * self.velocity.size * ("position",) + 2 * self.velocity.size * ("velocity",)
        boxes += 2 * self.acceleration.size * ("acceleration",)
        return (*boxes, *(self.of_row[i] for i in (*self.lower_index, *self.upper_index)), "duration")

    @property
    def constraint_rows(self) -> int:
        """m, number of rows c of the constraints at a grid point."""
        return self.lower.size

    @property
    def rows_per_point(self) -> int:
        """R, number of one-sided rows at a grid point."""
        boxes = 4 * self.velocity.size + 2 * self.acceleration.size
        return boxes + self.lower_index.size + self.upper_index.size

    def violation(self, g: Array, T: float) -> tuple[float, str]:
        """Largest violation among the rows g (K · R + 2,), in units of each limit, and its name; (0, "") if none.

        Args:
            g: Rows from `row_values`.
            T: Duration (s), which scales the rows of velocity and acceleration.
        """
        n, accelerations = self.velocity.size, 2 * self.acceleration.size
        least = g[:-2].reshape(-1, self.rows_per_point).min(axis=0)
        least[2 * n : 4 * n] /= T
        least[4 * n : 4 * n + accelerations] /= T**2
        least = np.append(least, g[-2:].min())
        worst = int(least.argmin())
        if not np.isfinite(least[worst]):
            return np.inf, self.names[worst]
        return (-float(least[worst]), self.names[worst]) if least[worst] < 0 else (0.0, "")

    def violated_rows(self, g: Array, tolerance: float) -> tuple[NDArray[np.intp], int] | None:
        """Which of the rows c are violated, and the first grid point where one is; None if other limits are too."""
        at_points = g[:-2].reshape(-1, self.rows_per_point) < -tolerance
        boxes = self.rows_per_point - self.lower_index.size - self.upper_index.size
        if (g[-2:] < -tolerance).any() or at_points[:, :boxes].any():
            return None
        sides = np.flatnonzero(at_points[:, boxes:].any(axis=0))
        rows = np.concatenate([self.lower_index, self.upper_index])[sides]
        return np.unique(rows), int(at_points.any(axis=1).argmax())

    @property
    def arguments(self) -> tuple:
        """What the compiled functions below take as `limits`."""
        bounds = (self.lower_index, self.upper_index, self.lower, self.upper, self.inverse_scale, self.free_at_ends)
        duration = (self.shortest, self.longest, self.fixed_duration)
        return self.middle, self.half_width, self.velocity, self.acceleration, *bounds, *duration


@njit(cache=True, error_model="numpy")
def row_values(z: Array, T: float, c: Array, limits: tuple, g: Array) -> None:
    """Write all rows g (K · R + 2,) from q, w, a (3, K, n), T and the constraints' rows c (K, m)."""
    middle, half_width, velocity, acceleration, lo, up, lower, upper, scale, free, shortest, longest, fixed = limits
    _, K, _ = z.shape
    n = velocity.size
    R = (g.size - 2) // K
    for k in range(K):
        end = k == 0 or k == K - 1
        at = k * R
        for j in range(n):
            q = (z[POSITION, k, j] - middle[j]) / half_width[j]
            w = z[RATE, k, j] / velocity[j]
            g[at + j] = 1.0 if end else 1.0 + q
            g[at + n + j] = 1.0 if end else 1.0 - q
            g[at + 2 * n + j] = 1.0 if end else T + w
            g[at + 3 * n + j] = 1.0 if end else T - w
        at += 4 * n
        for j in range(acceleration.size):
            a = z[CURVATURE, k, j] / acceleration[j]
            g[at + j] = T * T + a
            g[at + n + j] = T * T - a
        at += 2 * acceleration.size
        for i in range(lo.size):
            j = lo[i]
            g[at + i] = 1.0 if end and free[j] == 0.0 else c[k, j] * scale[j] - lower[j]
        at += lo.size
        for i in range(up.size):
            j = up[i]
            g[at + i] = 1.0 if end and free[j] == 0.0 else upper[j] - c[k, j] * scale[j]
    g[-2] = 1.0 if fixed else (T - shortest) / longest
    g[-1] = 1.0 if fixed else (longest - T) / longest


@njit(cache=True, error_model="numpy")
def row_steps(dz: Array, dT: float, T: float, v: Array, jacobian: Array, limits: tuple, dg: Array) -> None:
    """Write J d, the change of all rows with q, w, a and T to first order.

    Args:
        dz: (3, K, n) changes of q, w, a.
        dT: Change of T.
        T: Where the rows are linearised (s).
        v: (K, n) accelerations there, a / T².
        jacobian: (m, 2n, P) of the constraints' rows by q and v.
        limits: `LimitRows.arguments`.
        dg: (K · R + 2,), overwritten.
    """
    _, half_width, velocity, acceleration, lo, up, _, _, scale, free, _, longest, fixed = limits
    _, K, n = dz.shape
    boxes, (m, _, P) = velocity.size, jacobian.shape
    R = (dg.size - 2) // K
    du = np.zeros((2 * n, P))
    for k in range(K):
        for j in range(n):
            du[j, k] = dz[POSITION, k, j]
            du[n + j, k] = dz[CURVATURE, k, j] / (T * T) - 2.0 / T * v[k, j] * dT
    dc = np.zeros((m, P))
    for r in range(m):
        change = dc[r]
        for j in range(2 * n):
            slope, du_j = jacobian[r, j], du[j]
            for k in range(P):
                change[k] += slope[k] * du_j[k]
        for k in range(P):
            change[k] *= scale[r]
        if free[r] == 0.0:
            change[0], change[K - 1] = 0.0, 0.0
    for k in range(K):
        end = k == 0 or k == K - 1
        at = k * R
        for j in range(boxes):
            q = 0.0 if end else dz[POSITION, k, j] / half_width[j]
            w = 0.0 if end else dz[RATE, k, j] / velocity[j]
            dT_here = 0.0 if end else dT
            dg[at + j] = q
            dg[at + boxes + j] = -q
            dg[at + 2 * boxes + j] = dT_here + w
            dg[at + 3 * boxes + j] = dT_here - w
        at += 4 * boxes
        for j in range(acceleration.size):
            a = dz[CURVATURE, k, j] / acceleration[j]
            dg[at + j] = 2 * T * dT + a
            dg[at + n + j] = 2 * T * dT - a
        at += 2 * acceleration.size
        for i in range(lo.size):
            dg[at + i] = dc[lo[i], k]
        at += lo.size
        for i in range(up.size):
            dg[at + i] = -dc[up[i], k]
    dg[-2] = 0.0 if fixed else dT / longest
    dg[-1] = 0.0 if fixed else -dT / longest


@njit(cache=True, error_model="numpy")
def constraint_weights(y: Array, points: int, limits: tuple, weights: Array) -> None:
    """Write the factor of every constraint's row c in Σ y g: (y of its lower side − y of its upper side) / scale.

    Args:
        y: (K · R + 2,) factors of the one-sided rows.
        points: K.
        limits: `LimitRows.arguments`.
        weights: (m, P), overwritten; zero for rows that are constant at an end.
    """
    _, _, velocity, acceleration, lo, up, _, _, scale, free, _, _, _ = limits
    R = (y.size - 2) // points
    weights[:] = 0.0
    for k in range(points):
        at = k * R + 4 * velocity.size + 2 * acceleration.size
        for i in range(lo.size):
            weights[lo[i], k] += y[at + i] * scale[lo[i]]
        at += lo.size
        for i in range(up.size):
            weights[up[i], k] -= y[at + i] * scale[up[i]]
    for i in range(weights.shape[0]):
        weights[i, 0] *= free[i]
        weights[i, points - 1] *= free[i]


@njit(cache=True, error_model="numpy")
def rows_transposed(y: Array, T: float, v: Array, jacobian: Array, limits: tuple, weights: Array, dual: Array) -> float:
    """Add Jᵀ y, as derivatives by q, w, a to `dual` (3, K, n); return the derivative by T.

    Args:
        y: (K · R + 2,) factors of the rows.
        T: As for `row_steps`, and so are the next three.
        v: (K, n)
        jacobian: (m, 2n, P)
        limits: `LimitRows.arguments`.
        weights: (m, P) from `constraint_weights` of the same y.
        dual: (3, K, n), added to.
    """
    _, half_width, velocity, acceleration, _, _, _, _, _, _, _, longest, fixed = limits
    _, K, n = dual.shape
    boxes, (m, _, P) = velocity.size, jacobian.shape
    R = (y.size - 2) // K
    by_u = np.zeros((2 * n, P))
    for j in range(2 * n):
        sum_j = by_u[j]
        for r in range(m):
            weight, slope = weights[r], jacobian[r, j]
            for k in range(P):
                sum_j[k] += weight[k] * slope[k]
    by_T = 0.0
    for k in range(K):
        at = k * R
        if 0 < k < K - 1:
            for j in range(boxes):
                dual[POSITION, k, j] += (y[at + j] - y[at + boxes + j]) / half_width[j]
                dual[RATE, k, j] += (y[at + 2 * boxes + j] - y[at + 3 * boxes + j]) / velocity[j]
                by_T += y[at + 2 * boxes + j] + y[at + 3 * boxes + j]
        at += 4 * boxes
        for j in range(acceleration.size):
            dual[CURVATURE, k, j] += (y[at + j] - y[at + n + j]) / acceleration[j]
            by_T += 2 * T * (y[at + j] + y[at + n + j])
        for j in range(n):
            dual[POSITION, k, j] += by_u[j, k]
            dual[CURVATURE, k, j] += by_u[n + j, k] / (T * T)
            by_T -= 2.0 / T * v[k, j] * by_u[n + j, k]
    if not fixed:
        by_T += (y[y.size - 2] - y[y.size - 1]) / longest
    return float(by_T)
