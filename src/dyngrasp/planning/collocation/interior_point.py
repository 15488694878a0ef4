"""A primal-dual interior point method with elastic rows, in two modes.

Free mode: Mehrotra's predictor–corrector chooses the barrier parameter anew in every iteration, and full steps to the
boundary are taken as long as the error estimate E falls within a few iterations. Monotone mode: the barrier parameter
is fixed until its problem is solved, and Armijo's rule on the barrier merit function accepts steps. Where a free step
raises E it is taken back and the monotone mode goes on, until E is a tenth (Nocedal, Wächter, Waltz 2009,
"Adaptive barrier update strategies for nonlinear interior methods"). A given start that lies between curved walls, as
in a funnel, would be thrown out of them by the first free steps: it begins in monotone mode and the free one only
speeds up the end. In monotone mode every step is a descent step of a
smooth function bounded below, hence the iterates approach its stationary points (Gould, Orban, Toint 2015, for elastic
rows). Where such a point violates a row, the violation alone is minimised; if it cannot be brought to zero the problem
is reported as infeasible.

The Newton matrix is made positive definite: the banded part by leaving out part of the curvature of the rows until its
Cholesky factorisation succeeds, then by adding multiples of the second derivative of Σ|a|²; the row of T by replacing a
Schur complement that is not positive.

E = dᵀ K d + Σ s λ + Σ t (ν − λ), with K the Newton matrix and d the step for μ = 0, in monotone mode for the fixed μ,
which spares a direction: near a solution twice what a full step lowers the objective by, plus the duality gap. It has
the unit of the objective whatever the grid.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dyngrasp.planning.collocation import elastic_barrier as rows
from dyngrasp.planning.collocation.iterates import Best, InteriorPointSettings, Outcome
from dyngrasp.planning.collocation.phase_model import PhaseModel
from dyngrasp.signals import Array

KEEP = 0.995  # a step takes at most this share of a slack or multiplier
MEMORY = 5  # iterations within which E must fall in free mode
FALL = 0.9999  # by which factor
ENOUGH = 0.1  # by which factor it must fall in monotone mode before the free one is tried again
NEAR = 3e-3  # E, relative to the objective, below which a cautious start may leave monotone mode
ARMIJO = 1e-4
ROUNDING = 1e-13  # of the merit, relative
SHORTEST = 1e-10  # step length at which the line search gives up
SPREAD = 1e10  # multipliers stay within this factor of μ / s, as the convergence proof wants
LARGEST_CHANGE = 0.5  # of T in one step, relative: 1/T³ knows nothing of the other side of zero
DEARER = 10.0  # factor of ν where it proves too low to enforce the rows
STATIONARY = 1e-6  # E at a least violation, relative to the price of that violation
LEAST_CURVATURE = 0.1  # part of the rows' curvature below which it is left out
CLOSE = 0.3  # share of ν that a multiplier may reach before ν is raised
DEAREST = 1e6  # largest ν, relative to the objective
SLOW = 25  # iterations in monotone mode after which it begins anew with the first barrier parameter
LONGER = 5  # by how many more the next time
PATIENCE = 60  # iterations within which the violation must fall by the factor PROGRESS
PROGRESS = 0.9
ACCEPTABLE = 1e3  # multiple of the tolerance that counts as solved where rounding allows no further descent


class InteriorPoint:
    """The method; arrays are kept from one solve to the next of the same size."""

    def __init__(self, settings: InteriorPointSettings) -> None:
        self.settings = settings
        self._size = (0, 0, 0)

    def _allocate(self, model: PhaseModel, x: Array) -> None:
        size = (*x.shape, model.rows)
        if size == self._size:
            return
        self._size = size
        self.x, self.dx, self.x_new = (np.zeros(x.shape) for _ in range(3))
        M = model.rows
        self.s, self.t, self.multiplier, self.ds, self.dt, self.dmultiplier = (np.zeros(M) for _ in range(6))
        self.g, self.dg, self.omega, self.y, self.e_s, self.e_t = (np.zeros(M) for _ in range(6))
        self.s_new, self.t_new, self.g_new, self.multiplier_old, self.multiplier_new = (np.zeros(M) for _ in range(5))

    def solve(
        self,
        model: PhaseModel,
        x: Array,
        T: float,
        stop: Callable[[], bool] | None = None,
        barrier: float = 1e-3,
        cautious: bool = False,
    ) -> tuple[Outcome, Best, int]:
        """Minimise from x (N−1, n) and T.

        Args:
            model: The problem.
            x: Start, unknowns of `ThreeTap`.
            T: Start, duration (s).
            stop: Asked at every iteration; once it says yes the best iterate until then is returned.
            barrier: μ at the start, relative to the objective.
            cautious: Whether to begin in monotone mode, so that the start is not left far behind.

        Returns:
            How it ended, the best iterate, and the number of Newton systems.
        """
        self.model = model
        self._allocate(model, x)
        settings = self.settings
        self.x[:], self.T = x, T
        self.objective = model.values(self.x, self.T, self.g)
        if not np.isfinite(self.objective):
            return Outcome.NONFINITE, Best(self.x.copy(), T), 0
        self.unit = max(abs(self.objective), 1e-3)
        self.price = settings.price * self.unit
        self.first_mu = barrier * self.unit
        self.best = Best(self.x.copy(), T)
        self.slow_limit, self.cautious = SLOW, cautious
        self._restart(1.0, 0)
        for iteration in range(settings.max_iterations + 1):
            violation = -float(self.g.min())
            if not np.isfinite(self.objective + violation):
                if self.free and self.history:
                    self._leave_free_mode()
                    self._undo_step()
                    continue
                return Outcome.NONFINITE, self.best, iteration
            violation = max(0.0, violation)
            self.best.offer(self.x, self.T, self.objective, violation, settings.violation_tolerance)
            feasible = violation <= settings.violation_tolerance
            if model.factor == 0.0 and feasible:
                # There is a feasible point after all: the price of a violation had been too low.
                self.price *= DEARER
                self._restart(1.0, iteration)
            self._raise_price()
            if not self._factorise():
                return Outcome.NONFINITE, self.best, iteration
            decrement = self._direction(0.0 if self.free else self.mu, corrected=False)
            mean, elastic = self._complementarity(0.0, 0.0)
            error = decrement + mean * self.s.size + elastic
            if not np.isfinite(error):
                return Outcome.NONFINITE, self.best, iteration
            if feasible and error <= settings.tolerance * self.unit:
                return Outcome.OPTIMAL, self.best, iteration
            if iteration == settings.max_iterations:
                break
            if stop is not None and stop():
                return Outcome.DEADLINE, self.best, iteration
            if not feasible and self._violation_stays(violation, error, iteration):
                if model.factor == 0.0:
                    return Outcome.INFEASIBLE, self.best, iteration
                # The cheapest point violates a row: is there any that does not?
                self._restart(0.0, iteration)
                continue
            if settings.adaptive and self.slow >= self.slow_limit:
                # Close to the bounds the way along a curved valley is short steps; away from them it is not. Each time
                # the monotone mode gets longer, so that in the end it has as long as it needs.
                self.slow_limit += LONGER
                self._restart(model.factor, iteration)
                continue
            was_free = self.free
            if not self._choose_mode(error, mean):
                self._undo_step()
            elif self.free:
                if not was_free:
                    self._direction(0.0, corrected=False)
                self._mehrotra_step(mean)
            elif not self._armijo_step(decrement):
                if feasible:
                    solved = error <= ACCEPTABLE * settings.tolerance * self.unit
                    return Outcome.OPTIMAL if solved else Outcome.STALLED, self.best, iteration
                if model.factor == 0.0:
                    return Outcome.INFEASIBLE, self.best, iteration
                self._restart(0.0, iteration)
        return Outcome.ITERATION_LIMIT, self.best, settings.max_iterations

    def _restart(self, factor: float, iteration: int) -> None:
        """Slacks and multipliers for the present point, and the first mode; `factor` weighs the objective."""
        settings = self.settings
        self.model.factor = factor
        self.mu = self.first_mu
        rows.start(self.g, self.mu, self.price, settings.least_slack, self.s, self.t, self.multiplier)
        self._evaluate()
        self.free, self.history, self.mean = settings.adaptive and not self.cautious, [], self.mu
        self.reference = NEAR * self.unit if self.cautious else np.inf
        self.last_shift, self.slow = 0.0, 0
        self.least_violation, self.since = np.inf, iteration

    def _evaluate(self) -> None:
        """Objective, rows and derivatives at the present point."""
        self.objective = self.model.derivatives(self.x, self.T, self.multiplier, self.g)

    def _violation_stays(self, violation: float, error: float, iteration: int) -> bool:
        """Whether this point is stationary although it violates a row, or the violation has long ceased to fall."""
        if violation < PROGRESS * self.least_violation:
            self.least_violation, self.since = violation, iteration
        never_feasible = self.best.violation > self.settings.violation_tolerance
        return error <= STATIONARY * self.price * violation or (never_feasible and iteration - self.since >= PATIENCE)

    def _raise_price(self) -> None:
        """Keep ν well above the multipliers: rows then hold strictly, and ν matters only where they do not."""
        if self.multiplier.max() > CLOSE * self.price and self.price < DEAREST * self.unit:
            self.price *= DEARER
            # Errors measured with the old price are of no use for comparison.
            self.history, self.reference = [], np.inf

    def _choose_mode(self, error: float, mean: float) -> bool:
        """Decide between the modes; False if the last step was a free one that led astray."""
        if not self.free and error <= self.reference:
            self.free, self.history, self.slow = self.settings.adaptive, [], 0
        if not self.free:
            self.slow += 1
            return True
        if error > FALL * max(self.history[-MEMORY:], default=np.inf):
            self._leave_free_mode()
            return False
        self.history.append(error)
        self.mean = mean
        return True

    def _leave_free_mode(self) -> None:
        self.free, self.reference, self.mu = False, ENOUGH * self.history[-1], 0.8 * self.mean

    def _undo_step(self) -> None:
        """Back to where the last free step began; the arrays of the new point still hold that point."""
        self._exchange()
        self.multiplier[:] = self.multiplier_old
        self._evaluate()

    def _complementarity(self, primal: float, dual: float) -> tuple[float, float]:
        """Mean of s λ and sum of t (ν − λ) after steps of these lengths."""
        pair = (self.s, self.t, self.multiplier, self.price)
        return rows.complementarity(*pair, self.ds, self.dt, self.dmultiplier, primal, dual)

    def _factorise(self) -> bool:
        """Newton matrix at the current point, its inertia corrected; False if that fails beyond repair."""
        rows.stiffness(self.s, self.t, self.multiplier, self.price, self.omega)
        model = self.model
        unit = self.unit / (model.intervals * self.T**2)
        curvature, shift = 1.0, 0.0
        while not model.factorise(self.omega, self.multiplier, curvature, shift):
            # Without the curvature of the rows all that is left is convex but for T; with some of it steps are better.
            if curvature > LEAST_CURVATURE:
                curvature /= 4.0
            elif curvature > 0:
                curvature = 0.0
            else:
                shift = 8.0 * shift if shift > 0 else max(self.last_shift / 3, 1e-6 * unit)
            if shift > 1e20 * unit or not np.isfinite(model.corner):
                return False
        if shift > 0:
            self.last_shift = shift
        least = 1e-8 * self.unit / self.T**2
        if model.complement < least:
            model.complement = max(-model.complement, 1e5 * least)
        return True

    def _direction(self, mu: float, corrected: bool) -> float:
        """Newton direction for a barrier parameter; returns dᵀ K d, which is dᵀ times the right-hand side.

        Args:
            mu: Aim of all complementarity products.
            corrected: Whether to add the second-order terms of the present direction, Mehrotra's corrector.
        """
        if corrected:
            rows.second_order_terms(self.ds, self.dt, self.dmultiplier, self.e_s, self.e_t)
        else:
            self.e_s[:], self.e_t[:] = 0.0, 0.0
        model = self.model
        pair = (self.s, self.t, self.multiplier, self.price)
        aim = (mu, self.e_s, self.e_t, self.omega, self.y)
        rows.target_multipliers(*pair, *aim)
        self.dT, product = model.newton_step(self.y, self.dx, self.dg, LARGEST_CHANGE * self.T)
        rows.row_direction(self.dg, *pair, *aim, self.ds, self.dt, self.dmultiplier)
        return product

    def _lengths(self, keep: float) -> tuple[float, float]:
        """Lengths of the step of x, T and slacks, and of the step of the multipliers."""
        pair = (self.s, self.t, self.multiplier, self.price)
        return rows.longest_steps(*pair, self.ds, self.dt, self.dmultiplier, keep)

    def _mehrotra_step(self, mean: float) -> None:
        """Full step to the boundary; the barrier parameter is the cube of what the step for μ = 0 would leave."""
        after, _ = self._complementarity(*self._lengths(1.0))
        floor = 0.1 * self.settings.tolerance * self.unit / self.s.size
        mu = max(min((after / mean) ** 3, 1.0) * mean, floor)
        self._direction(mu, corrected=True)
        primal, dual = self._lengths(KEEP)
        self.multiplier_old[:] = self.multiplier
        objective = self._look_ahead(primal, dual)
        steps = (self.ds, self.dt, primal, self.price, mu)
        rows.moved_slacks(self.g_new, self.s, self.t, *steps, self.s_new, self.t_new)
        self._accept(objective, dual, mu, 0.0)

    def _armijo_step(self, decrement: float) -> bool:
        """A step along the direction for the present μ; False if rounding allows no descent."""
        factor, mu = self.model.factor, self.mu
        products = self.s.size * mu
        mean, _ = self._complementarity(0.0, 0.0)
        slope = self.model.objective_slope(self.dT)
        slope += rows.barrier_slope(self.s, self.t, self.ds, self.dt, self.price, mu)
        merit = factor * self.objective + rows.barrier(self.s, self.t, self.price, mu)
        length, dual = self._lengths(KEEP)
        while length > SHORTEST:
            objective = self._look_ahead(length, dual)
            steps = (self.ds, self.dt, length, self.price, mu)
            rows.moved_slacks(self.g_new, self.s, self.t, *steps, self.s_new, self.t_new)
            trial = factor * objective + rows.barrier(self.s_new, self.t_new, self.price, mu)
            if trial <= merit + ARMIJO * length * slope + ROUNDING * abs(merit):
                break
            length /= 2
        else:
            return False
        self._accept(objective, dual, mu, SPREAD)
        if decrement + abs(mean * self.s.size - products) <= products:
            least = 1e-3 * self.settings.tolerance * self.unit / self.s.size
            self.mu = max(min(0.2 * mu, mu**1.5), least)
        return True

    def _look_ahead(self, primal: float, dual: float) -> float:
        """Objective, rows and derivatives after a step; most often it is taken, and nothing is evaluated twice."""
        np.multiply(self.dx, primal, out=self.x_new)
        self.x_new += self.x
        np.multiply(self.dmultiplier, dual, out=self.multiplier_new)
        self.multiplier_new += self.multiplier
        self.T_new = self.T + primal * self.dT
        return self.model.derivatives(self.x_new, self.T_new, self.multiplier_new, self.g_new)

    def _accept(self, objective: float, dual: float, mu: float, spread: float) -> None:
        """Move to the new point."""
        self.objective = objective
        self._exchange()
        rows.move_multipliers(self.multiplier, self.dmultiplier, dual, self.s, self.t, self.price, mu, spread)

    def _exchange(self) -> None:
        """The new point becomes the present one and the other way round; nothing is copied."""
        self.x, self.x_new = self.x_new, self.x
        self.T, self.T_new = self.T_new, self.T
        self.g, self.g_new = self.g_new, self.g
        self.s, self.s_new = self.s_new, self.s
        self.t, self.t_new = self.t_new, self.t
