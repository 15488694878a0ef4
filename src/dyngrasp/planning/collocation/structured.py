"""The default backend: the optimum in closed form where no limit is active, else a structured interior point method.

Cost and memory grow linearly with the number of grid points. Every array is allocated once for each problem structure.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from dyngrasp.planning.collocation import closed_form
from dyngrasp.planning.collocation.interior_point import InteriorPoint, InteriorPointSettings, Outcome
from dyngrasp.planning.collocation.phase_model import PhaseModel, WorkArrays
from dyngrasp.planning.collocation.three_tap import CURVATURE
from dyngrasp.planning.problem import PhaseProblem, Solution, Status
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory


@dataclass(frozen=True)
class StructuredSettings:
    """Settings of `StructuredSolver`.

    Attributes:
        tolerance: Estimated distance to the optimal objective, relative.
        violation_tolerance: Largest violation that counts as none, in units of each limit.
        max_iterations: Of the interior point method.
        time_limit: Wall time for one phase (s); after it the best iterate is returned.
        initial_barrier: Barrier parameter of a cold start, relative to the objective.
    """

    tolerance: float = 1e-9
    violation_tolerance: float = 1e-9
    max_iterations: int = 200
    time_limit: float = 5.0
    initial_barrier: float = 1e-3


_STATUS = {
    Outcome.OPTIMAL: Status.CONVERGED,
    Outcome.INFEASIBLE: Status.INFEASIBLE,
    Outcome.ITERATION_LIMIT: Status.ITERATION_LIMIT,
    Outcome.STALLED: Status.ITERATION_LIMIT,
    Outcome.DEADLINE: Status.DEADLINE_MISSED,
    Outcome.NONFINITE: Status.NONFINITE,
}

_WORDS = {
    Outcome.OPTIMAL: "optimal",
    Outcome.INFEASIBLE: "no motion near the last one violates less",
    Outcome.ITERATION_LIMIT: "iteration limit",
    Outcome.STALLED: "no descent left within rounding",
    Outcome.DEADLINE: "time limit",
    Outcome.NONFINITE: "a number is not finite",
}


class StructuredSolver:
    """Solves phases; keeps work arrays and compiled functions from one phase to the next."""

    def __init__(self, settings: StructuredSettings | None = None) -> None:
        self.settings = settings or StructuredSettings()
        self._work: dict[tuple, WorkArrays] = {}
        self._methods: dict[tuple, InteriorPoint] = {}

    def solve(self, problem: PhaseProblem, guess: Trajectory | None = None) -> Solution:
        """Solve one phase.

        Args:
            problem: What is asked.
            guess: Where to start if limits are active: a motion of any duration on any grid, as the rest of a plan.

        Returns:
            The solution. Failures are statuses; a trajectory is given even then, if there is a finite one, and it
            satisfies the dynamics and the boundary states.
        """
        # Numbers beyond the range of floats are an outcome here, reported as a status.
        with np.errstate(all="ignore"):
            return self._solve(problem, guess)

    def _solve(self, problem: PhaseProblem, guess: Trajectory | None) -> Solution:
        began = time.perf_counter()
        settings = self.settings
        model = PhaseModel(problem, self._work)
        g = np.empty(model.rows)
        optimum = closed_form.unconstrained_optimum(problem)
        x, T = model.map.unknowns(optimum), optimum.duration
        objective = model.values(x, T, g)
        at_ends, name = model.violation_at_the_ends()
        shortest = float((np.abs(problem.end_position - problem.start_position) / problem.velocity_limit).max())
        if not np.isfinite(at_ends):
            return self._refused(problem, began, f"{name} is not finite at a boundary", Status.NONFINITE)
        if at_ends > settings.violation_tolerance:
            return self._refused(problem, began, f"{name} is violated at a boundary by {at_ends:.1e} of its scale")
        if shortest > problem.max_duration * (1 + settings.violation_tolerance):
            return self._refused(problem, began, f"takes {shortest:.3f} s at top speed")
        prepared = time.perf_counter()
        timings = {"start": 1e3 * (prepared - began)}
        violation, name = model.limits.violation(g, T)
        if violation <= settings.violation_tolerance:
            timings["total"] = 1e3 * (time.perf_counter() - began)
            message = f"{problem.name}: optimal in closed form"
            return Solution(Status.CONVERGED, optimum, objective, 0, violation, timings, message)

        start = self._stretched(problem, T) if guess is None else on_grid(problem, guess)
        method = self._method(model)
        outcome, best, iterations = method.solve(
            model, model.map.unknowns(start), start.duration, began + settings.time_limit
        )
        timings["solve"] = 1e3 * (time.perf_counter() - prepared)
        curvature = model.map.expand(best.x, best.T)[CURVATURE]
        if not (np.isfinite(curvature).all() and np.isfinite(best.T) and best.T > 0 and np.isfinite(best.objective)):
            timings["total"] = 1e3 * (time.perf_counter() - began)
            message = f"{problem.name}: {_WORDS[Outcome.NONFINITE]}"
            return Solution(Status.NONFINITE, None, np.nan, iterations, np.inf, timings, message)
        trajectory = closed_form.nearest_trajectory(problem, curvature, best.T)
        objective = model.values(model.map.unknowns(trajectory), best.T, g)
        violation, name = model.limits.violation(g, best.T)
        message = f"{problem.name}: {_WORDS[outcome]}"
        if violation > settings.violation_tolerance:
            message += f"; worst: {name} by {violation:.1e}"
        timings["total"] = 1e3 * (time.perf_counter() - began)
        return Solution(_STATUS[outcome], trajectory, objective, iterations, violation, timings, message)

    @staticmethod
    def _refused(problem: PhaseProblem, began: float, why: str, status: Status = Status.INFEASIBLE) -> Solution:
        timings = {"total": 1e3 * (time.perf_counter() - began)}
        return Solution(status, None, np.nan, 0, np.inf, timings, f"{problem.name}: {why}")

    def _stretched(self, problem: PhaseProblem, T: float) -> Trajectory:
        """The motion of least effort, slow enough to keep the speed limits at the grid points if it may be."""
        for _ in range(3):
            motion = closed_form.least_effort(problem, T)
            ratio = float((np.abs(motion.velocity) / problem.velocity_limit).max())
            if ratio <= 1.001:
                break
            # Exact from rest to rest; with moving ends the ratio falls more slowly than 1/T, hence the repetition.
            T = min(T * ratio, problem.max_duration)
        return closed_form.least_effort(problem, T)

    def _method(self, model: PhaseModel) -> InteriorPoint:
        size = (model.problem.intervals, model.problem.joints, model.rows)
        if size not in self._methods:
            settings = self.settings
            self._methods[size] = InteriorPoint(
                InteriorPointSettings(
                    settings.tolerance,
                    settings.violation_tolerance,
                    settings.max_iterations,
                    settings.initial_barrier,
                )
            )
        return self._methods[size]


def on_grid(problem: PhaseProblem, guess: Trajectory) -> Trajectory:
    """The guess on the problem's own grid, its boundary states and duration bounds met."""
    times = np.linspace(0.0, guess.duration, problem.intervals + 1)
    shortest = max(problem.min_duration, min(closed_form.SHORTEST_DURATION, problem.max_duration))
    duration = float(np.clip(guess.duration, shortest, problem.max_duration))
    _, _, acceleration = guess.sample_many(times)
    curvature: Array = guess.duration**2 * acceleration
    return closed_form.nearest_trajectory(problem, curvature, duration)
