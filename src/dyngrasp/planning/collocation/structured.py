"""The default backend: the optimum in closed form where no limit is active, else a structured interior point method.

Cost and memory grow linearly with the number of grid points. Every array is allocated once for each problem structure.
"""

from __future__ import annotations

import functools
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import casadi as ca
import numpy as np

from dyngrasp.planning.collocation import closed_form
from dyngrasp.planning.collocation.interior_point import InteriorPoint
from dyngrasp.planning.collocation.iterates import InteriorPointSettings, Outcome
from dyngrasp.planning.collocation.limit_rows import LimitRows
from dyngrasp.planning.collocation.node_functions import InterpretedNodeFunctions, NodeFunctions, node_functions
from dyngrasp.planning.collocation.phase_model import PhaseModel
from dyngrasp.planning.collocation.three_tap import CURVATURE
from dyngrasp.planning.collocation.window import EARLIEST, LATEST, Window
from dyngrasp.planning.collocation.work_arrays import WorkArrays
from dyngrasp.planning.problem import MIN_INTERVALS, NodeConstraint, PhaseProblem, Solution, Status
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StructuredSettings:
    """Settings of `StructuredSolver`.

    Attributes:
        tolerance: Estimated distance to the optimal objective, relative.
        violation_tolerance: Largest violation that counts as none, in units of each limit.
        max_iterations: Of the interior point method.
        time_limit: Wall time for one phase (s); after it the best iterate is returned.
        initial_barrier: Barrier parameter at the start, relative to the objective.
        second_barrier: The same for the second attempt that a problem gets which the first does not solve.
        window_barrier: The same where only the end of the motion is sought, under few rows.
    """

    tolerance: float = 1e-7
    violation_tolerance: float = 1e-9
    max_iterations: int = 500
    time_limit: float = 5.0
    initial_barrier: float = 1e-4
    second_barrier: float = 1e-3
    window_barrier: float = 1e-5


_STATUS = {
    Outcome.OPTIMAL: Status.CONVERGED,
    Outcome.INFEASIBLE: Status.INFEASIBLE,
    Outcome.ITERATION_LIMIT: Status.ITERATION_LIMIT,
    Outcome.STALLED: Status.ITERATION_LIMIT,
    Outcome.DEADLINE: Status.DEADLINE_MISSED,
    Outcome.NONFINITE: Status.NONFINITE,
}

_UNSOLVED = (Outcome.INFEASIBLE, Outcome.ITERATION_LIMIT, Outcome.STALLED)

_WORDS = {
    Outcome.OPTIMAL: "optimal",
    Outcome.INFEASIBLE: "no motion near the last one violates less",
    Outcome.ITERATION_LIMIT: "iteration limit",
    Outcome.STALLED: "no descent left within rounding",
    Outcome.DEADLINE: "time limit",
    Outcome.NONFINITE: "a number is not finite",
}


BENT = 8.0  # full steps leave walls that bend more sharply; the funnel's bend by 17 and more, the floor's by 4 at most
TOO_FAST = 1.05  # speed over its limit above which a guess is slowed down
KEPT = 16  # problem sizes whose arrays are kept


class StructuredSolver:
    """Solves phases; keeps work arrays from one phase to the next."""

    def __init__(self, settings: StructuredSettings | None = None) -> None:
        self.settings = settings or StructuredSettings()
        self._methods: dict[tuple, tuple[WorkArrays, InteriorPoint]] = {}

    def solve(
        self, problem: PhaseProblem, guess: Trajectory | None = None, stop: Callable[[], bool] | None = None
    ) -> Solution:
        """Solve one phase.

        Args:
            problem: What is asked.
            guess: Where to start if limits are active: a motion of any duration on any grid, as the rest of a plan.
            stop: Asked at every iteration; once it says yes the best iterate is returned, as at the time limit.

        Returns:
            The solution. Failures are statuses; a trajectory is given even then, if there is a finite one, and it
            satisfies the dynamics and the boundary states. Functions that have to be compiled first do not count
            towards the time limit.
        """
        # Numbers beyond the range of floats are an outcome here, reported as a status.
        with np.errstate(all="ignore"):
            functions = [node_functions(constraint) for constraint in problem.constraints]
            compile_kernels()
            return self._solve(problem, functions, guess, stop)

    def _solve(
        self,
        problem: PhaseProblem,
        functions: list[NodeFunctions],
        guess: Trajectory | None,
        stop: Callable[[], bool] | None,
    ) -> Solution:
        began = time.perf_counter()
        settings = self.settings
        limits = LimitRows.of(problem, functions)
        work, method = self._kept(problem.intervals + 1, problem.joints, limits)
        model = PhaseModel(problem, functions, limits, work)
        g = np.empty(model.rows)
        optimum = closed_form.unconstrained_optimum(problem)
        x, T = model.map.unknowns(optimum), optimum.duration
        objective = model.values(x, T, g)
        at_ends, name = model.violation_at_the_ends()
        shortest = float((np.abs(problem.end_position - problem.start_position) / problem.velocity_limit).max())
        if not np.isfinite(at_ends):
            return _refused(problem, began, f"{name} is not finite at a boundary", Status.NONFINITE)
        if at_ends > settings.violation_tolerance:
            return _refused(problem, began, f"{name} is violated at a boundary by {at_ends:.1e} of its scale")
        if shortest > problem.max_duration * (1 + settings.violation_tolerance):
            return _refused(problem, began, f"takes {shortest:.3f} s at top speed")
        violation, _ = limits.violation(g, T)
        prepared = time.perf_counter()
        timings = {"start": 1e3 * (prepared - began)}
        if violation <= settings.violation_tolerance:
            timings["total"] = 1e3 * (time.perf_counter() - began)
            message = f"{problem.name}: optimal in closed form"
            return Solution(Status.CONVERGED, optimum, objective, 0, violation, timings, message)

        start = closed_form.within_speed_limits(problem, T) if guess is None else on_grid(problem, guess)
        deadline = began + settings.time_limit

        def late() -> bool:
            return time.perf_counter() > deadline or (stop is not None and stop())

        narrow = self._solve_window(model, g, start, late, guess is not None)
        if narrow is not None:
            trajectory, iterations = narrow
            objective = model.values(model.map.unknowns(trajectory), trajectory.duration, g)
            violation, _ = limits.violation(g, trajectory.duration)
            if violation <= settings.violation_tolerance:
                timings["total"] = 1e3 * (time.perf_counter() - began)
                message = f"{problem.name}: optimal, limits active at the end only"
                return Solution(Status.CONVERGED, trajectory, objective, iterations, violation, timings, message)
        x, T = model.map.unknowns(start), start.duration
        # A guess stands on the right side of walls: where they bend, full steps would leave it.
        cautious = guess is not None and model.bend(x, T) > BENT
        outcome, best, iterations = method.solve(model, x, T, late, settings.initial_barrier, cautious)
        if outcome in _UNSOLVED:
            # One in a thousand problems must keep farther from its limits at first; the others are faster so.
            outcome, best, iterations = method.solve(model, x, T, late, settings.second_barrier, cautious)
        timings["solve"] = 1e3 * (time.perf_counter() - prepared)
        curvature = model.map.expand(best.x, best.T)[CURVATURE]
        if not (np.isfinite(curvature).all() and np.isfinite(best.T) and best.T > 0 and np.isfinite(best.objective)):
            return _refused(problem, began, _WORDS[Outcome.NONFINITE], Status.NONFINITE, iterations)
        trajectory = closed_form.nearest_trajectory(problem, curvature, best.T)
        objective = model.values(model.map.unknowns(trajectory), best.T, g)
        violation, name = limits.violation(g, best.T)
        message = f"{problem.name}: {_WORDS[outcome]}"
        if violation > settings.violation_tolerance:
            message += f"; worst: {name} by {violation:.1e}"
        timings["total"] = 1e3 * (time.perf_counter() - began)
        return Solution(_STATUS[outcome], trajectory, objective, iterations, violation, timings, message)

    def _solve_window(
        self, model: PhaseModel, g: Array, start: Trajectory, stop: Callable[[], bool], cautious: bool
    ) -> tuple[Trajectory, int] | None:
        """The optimum under those constraints alone that g violates, late and by its positions; None if that is not so.

        Returns:
            The motion, an optimum of the phase if it satisfies all rows of the model, and the iterations.
        """
        problem, limits = model.problem, model.limits
        violated = limits.violated_rows(g, self.settings.violation_tolerance)
        if violated is None or limits.free_at_ends[violated[0]].any():
            return None
        step = max(problem.intervals // 20, 1)
        first = step * (violated[1] // step - 1)
        if not EARLIEST <= first <= problem.intervals - LATEST:
            return None
        owner = np.repeat(np.arange(len(model.functions)), [function.rows for function in model.functions])
        chosen = np.unique(owner[violated[0]])
        constraints = [problem.constraints[i] for i in chosen]
        functions = [model.functions[i] for i in chosen]
        window = Window.of(problem, model.map, constraints, first)
        inside = LimitRows.without_boxes(problem, constraints, functions)
        work, method = self._kept(window.map.first.size, problem.joints, inside)
        part = PhaseModel(problem, functions, inside, work, window)
        x = window.unknowns(model.map.unknowns(start))
        outcome, best, iterations = method.solve(part, x, start.duration, stop, self.settings.window_barrier, cautious)
        if outcome is not Outcome.OPTIMAL:
            return None
        curvature = window.curvature(problem, best.x, best.T)
        return closed_form.nearest_trajectory(problem, curvature, best.T), iterations

    def _kept(self, points: int, joints: int, limits: LimitRows) -> tuple[WorkArrays, InteriorPoint]:
        """Arrays of this problem size; those used longest ago make room."""
        size = (points, joints, limits.constraint_rows, limits.rows_per_point)
        kept = self._methods.pop(size, None)
        if kept is None:
            settings = self.settings
            numbers = (settings.tolerance, settings.violation_tolerance, settings.max_iterations)
            kept = WorkArrays.of(*size[:3]), InteriorPoint(InteriorPointSettings(*numbers))
        self._methods[size] = kept
        while len(self._methods) > KEPT:
            del self._methods[next(iter(self._methods))]
        return kept


def _refused(
    problem: PhaseProblem, began: float, why: str, status: Status = Status.INFEASIBLE, iterations: int = 0
) -> Solution:
    timings = {"total": 1e3 * (time.perf_counter() - began)}
    return Solution(status, None, np.nan, iterations, np.inf, timings, f"{problem.name}: {why}")


def on_grid(problem: PhaseProblem, guess: Trajectory) -> Trajectory:
    """The guess on the problem's own grid, its boundary states and duration bounds met."""
    shortest = max(problem.min_duration, min(closed_form.SHORTEST_DURATION, problem.max_duration))
    duration = min(max(guess.duration, shortest), problem.max_duration)
    acceleration = guess.acceleration
    if guess.intervals != problem.intervals:
        _, _, acceleration = guess.sample_many(np.linspace(0.0, guess.duration, problem.intervals + 1))
    curvature = guess.duration**2 * acceleration
    motion = closed_form.nearest_trajectory(problem, curvature, duration)
    # A guess that is too fast keeps its path and takes its time.
    ratio = float((np.abs(motion.velocity) / problem.velocity_limit).max())
    if ratio <= TOO_FAST:
        return motion
    return closed_form.nearest_trajectory(problem, curvature, min(ratio * duration, problem.max_duration))


@functools.cache
def compile_kernels() -> None:
    """Have every compiled loop of this folder ready: one small problem, once a process.

    The first time on a machine this takes seconds, afterwards the loops come from the cache beside the sources.
    """
    _log.info("preparing the structured solver (some seconds the first time on a machine)")
    one = np.ones(1)
    row = ca.Function("row", [q := ca.SX.sym("q", 1), ca.SX.sym("v", 1), ca.SX.sym("p", 0)], [q])
    rows = NodeConstraint("row", row, np.zeros((MIN_INTERVALS + 1, 0)), -one, 0.9 * one, one)
    problem = PhaseProblem(
        "preparation", 0 * one, 0 * one, 0.5 * one, 0 * one, -one, one, 0.2 * one, one, (rows,), MIN_INTERVALS
    )
    functions: list[NodeFunctions] = [InterpretedNodeFunctions(row)]
    limits = LimitRows.of(problem, functions)
    work = WorkArrays.of(MIN_INTERVALS + 1, 1, limits.constraint_rows)
    model = PhaseModel(problem, functions, limits, work)
    start = closed_form.unconstrained_optimum(problem)
    x = model.map.unknowns(start)
    model.map.expand(x, 1.0)
    for adaptive in (True, False):
        method = InteriorPoint(InteriorPointSettings(max_iterations=3, adaptive=adaptive))
        method.solve(model, x, 1.0)
