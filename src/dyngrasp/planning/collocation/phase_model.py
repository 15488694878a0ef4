"""One phase as an interior point method sees it: f(x, T), rows g(x, T) ≥ 0, derivatives, and the Newton system."""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.collocation import banded, limit_rows, newton_matrix, three_tap
from dyngrasp.planning.collocation.limit_rows import LimitRows
from dyngrasp.planning.collocation.node_functions import NodeFunctions
from dyngrasp.planning.collocation.three_tap import CURVATURE, POSITION, ThreeTap
from dyngrasp.planning.collocation.window import Window
from dyngrasp.planning.collocation.work_arrays import WorkArrays
from dyngrasp.planning.problem import PhaseProblem
from dyngrasp.signals import Array


class PhaseModel:
    """Functions of one problem at a current point; all results are written into given or internal arrays.

    Attributes:
        factor: Weight of the objective: 1, or 0 where only the violation is minimised.
        corner: Entry of T in the Newton matrix.
        complement: What is left of it when x is eliminated.
    """

    def __init__(
        self,
        problem: PhaseProblem,
        functions: list[NodeFunctions],
        limits: LimitRows,
        work: WorkArrays,
        window: Window | None = None,
    ) -> None:
        """A problem, or a window of it with those of its constraints that `functions` and `limits` are of."""
        self.problem, self.functions, self.limits, self.work = problem, functions, limits, work
        if window is None:
            self.map, self.effort_weight = ThreeTap.of(problem), problem.effort_weight
            self.parameters = tuple(constraint.parameters for constraint in problem.constraints)
        else:
            self.map, self.effort_weight, self.parameters = window.map, window.effort_weight, window.parameters
        arrays = (work.weights, work.c, work.jacobian, work.hessian)
        self._evaluations, column = [], 0
        for parameters, function in zip(self.parameters, functions, strict=True):
            self._evaluations.append(function.bound(work.z[POSITION], work.v, parameters, *arrays, column))
            column += function.rows
        self.factor = 1.0
        self.corner = self.complement = np.nan
        self._arguments = limits.arguments
        self._T = 1.0

    @property
    def intervals(self) -> int:
        """Intervals between the grid points of the model."""
        return self.work.v.shape[0] - 1

    @property
    def rows(self) -> int:
        """Number of one-sided rows."""
        return self.work.v.shape[0] * self.limits.rows_per_point + 2

    def _place(self, x: Array, T: float) -> None:
        three_tap.place(self.map, x, T, self.work.z, self.work.v)
        self._T = T

    def values(self, x: Array, T: float, g: Array) -> float:
        """Move to a point, write its rows g, and return the objective."""
        self._place(x, T)
        work = self.work
        for evaluate, _ in self._evaluations:
            evaluate()
        return _rows_and_objective(work.z, T, work.c, self._arguments, self.effort_weight, g)

    def violation_at_the_ends(self) -> tuple[float, str]:
        """Worst violation of rows that the boundary positions alone decide, at the current point, and their name."""
        limits = self.limits
        g = self.work.c[[0, -1]] * limits.inverse_scale
        outside = np.maximum(limits.lower - g, g - limits.upper)[:, limits.free_at_ends == 0.0]
        worst = float(outside.max(initial=0.0))
        if worst <= 0.0:
            return 0.0, ""
        # Which constraint it is matters in messages alone. A NaN is the largest number there is.
        row = np.flatnonzero(limits.free_at_ends == 0.0)[int(outside.max(axis=0).argmax())]
        names = [c.name for c, f in zip(self.problem.constraints, self.functions, strict=True) for _ in range(f.rows)]
        return worst, names[row]

    def bend(self, x: Array, T: float) -> float:
        """How sharply the walls of rows of positions alone bend at the inner grid points, 0 without such rows.

        The length of ∂²Σg over the square of the largest |∂g| at a grid point: by how much the slope of a wall changes,
        relative to itself, along a step that changes the row by its unit.
        """
        self._place(x, T)
        work, inverse_scale = self.work, self.limits.inverse_scale
        work.hessian[:], column, slopes = 0.0, 0, []
        for (_, evaluate), function in zip(self._evaluations, self.functions, strict=True):
            rows = slice(column, column + function.rows)
            column += function.rows
            if function.depends_on_acceleration.any():
                continue
            work.weights[rows] = inverse_scale[rows, None]
            evaluate()
            inner = work.jacobian[rows, :, 1 : self.intervals]
            slopes.append(((inner * inverse_scale[rows, None, None]) ** 2).sum(axis=1))
        if not slopes:
            return 0.0
        steepest = np.concatenate(slopes).max(axis=0)
        return float((np.sqrt((work.hessian[:, :, 1 : self.intervals] ** 2).sum(axis=(0, 1))) / steepest).max())

    def derivatives(self, x: Array, T: float, multiplier: Array, g: Array) -> float:
        """As `values`, and prepare everything below for this point and these multipliers."""
        self._place(x, T)
        work = self.work
        limit_rows.constraint_weights(multiplier, len(work.v), self._arguments, work.weights)
        work.hessian[:] = 0.0
        for _, evaluate in self._evaluations:
            evaluate()
        return _rows_and_objective(work.z, T, work.c, self._arguments, self.effort_weight, g)

    def descent(self, y: Array, out: Array) -> float:
        """Write −∇f + Jᵀ y by x into `out` (N−1, n), return it by T."""
        return _descent(y, self._T, self.work, self.map, self._arguments, self.effort_weight, self.factor, out)

    def objective_slope(self, dT: float) -> float:
        """Derivative of the weighted objective along the step that `newton_step` found last; dT is its change of T."""
        work, rho = self.work, self.effort_weight
        return self.factor * newton_matrix.objective_slope(work.z[CURVATURE], work.dz[CURVATURE], self._T, dT, rho)

    def newton_step(self, y: Array, dx: Array, dg: Array, longest: float) -> tuple[float, float]:
        """The step of the factorised system for multipliers y, and how the rows change with it.

        Args:
            y: (K · R + 2,) multipliers after the step if the rows stayed as they are.
            dx: (N−1, n), overwritten by the step.
            dg: (K · R + 2,), overwritten by J d.
            longest: A step of T beyond it is cut to that and dx solved for it: as if the corner had been larger.

        Returns:
            dT, and the product of the step with the right-hand side −∇f + Jᵀ y.
        """
        model = (self.work, self.map, self._arguments, self.effort_weight, self.factor)
        return _newton_step(y, self._T, *model, self.complement, longest, dx, dg)

    def factorise(self, omega: Array, multiplier: Array, curvature: float, shift: float) -> bool:
        """Assemble and factorise H + Jᵀ Ω J + shift · ∂²|a|²/2; whether the banded part is positive definite."""
        model = (self.work, self._T, self.map, self._arguments)
        weights = (omega, multiplier, self.effort_weight, self.factor, curvature, shift)
        definite, self.corner, self.complement = _factorise(*model, *weights)
        return definite

    def solve(self, x: Array, by_T: float) -> float:
        """Overwrite a right-hand side x (N−1, n) by the solution; return its last unknown."""
        return _solve(self.work, self.complement, x, by_T, np.inf, self.limits.fixed_duration)


@njit(cache=True, error_model="numpy")
def _rows_and_objective(z: Array, T: float, c: Array, limits: tuple, rho: float, g: Array) -> float:
    limit_rows.row_values(z, T, c, limits, g)
    return newton_matrix.objective(z[CURVATURE], T, rho)


@njit(cache=True, error_model="numpy")
def _factorise(
    work: WorkArrays,
    T: float,
    tap: ThreeTap,
    limits: tuple,
    omega: Array,
    multiplier: Array,
    rho: float,
    factor: float,
    curvature: float,
    shift: float,
) -> tuple[bool, float, float]:
    """Whether the banded part is positive definite, the corner, and its Schur complement."""
    corner = newton_matrix.assemble(work, T, tap, limits, omega, multiplier, rho, factor, curvature, shift)
    if not banded.cholesky(work.band):
        return False, corner, np.nan
    banded.forward(work.band, work.border)
    complement = corner - banded.product(work.border, work.border)
    return bool(np.isfinite(complement)), corner, complement


@njit(cache=True, error_model="numpy")
def _solve(work: WorkArrays, complement: float, x: Array, by_T: float, longest: float, fixed: bool) -> float:
    """Overwrite x (N−1, n) by the solution; return the last unknown, `longest` at most, or 0 if it is fixed."""
    rows, n = x.shape
    for i in range(rows):
        for j in range(n):
            work.x[i, j] = x[i, j]
    longest = 0.0 if fixed else longest
    step = banded.solve_bordered(work.band, work.border, complement, work.x, by_T, longest)
    for i in range(rows):
        for j in range(n):
            x[i, j] = work.x[i, j]
    return step


@njit(cache=True, error_model="numpy")
def _newton_step(
    y: Array,
    T: float,
    work: WorkArrays,
    tap: ThreeTap,
    limits: tuple,
    rho: float,
    factor: float,
    complement: float,
    longest: float,
    dx: Array,
    dg: Array,
) -> tuple[float, float]:
    rhs = np.empty(dx.shape)
    by_T = _descent(y, T, work, tap, limits, rho, factor, rhs)
    dx[:] = rhs
    fixed = limits[-1]
    dT = _solve(work, complement, dx, by_T, longest, fixed)
    three_tap.expand_step(tap, dx, dT, work.dz)
    limit_rows.row_steps(work.dz, dT, T, work.v, work.jacobian, limits, dg)
    product = by_T * dT
    for k in range(dx.shape[0]):
        for j in range(dx.shape[1]):
            product += rhs[k, j] * dx[k, j]
    return dT, product


@njit(cache=True, error_model="numpy")
def _descent(
    y: Array, T: float, work: WorkArrays, tap: ThreeTap, limits: tuple, rho: float, factor: float, out: Array
) -> float:
    dual, weights = np.zeros(work.z.shape), np.empty(work.weights.shape)
    limit_rows.constraint_weights(y, work.v.shape[0], limits, weights)
    by_T = limit_rows.rows_transposed(y, T, work.v, work.jacobian, limits, weights, dual)
    by_T += newton_matrix.add_objective_gradient(work.z[CURVATURE], T, rho, -factor, dual)
    return by_T + three_tap.pull_back(tap, dual, out)
