"""The reference backend: IPOPT on the collocation problem with exact second derivatives."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from dyngrasp.planning.collocation import transcription
from dyngrasp.planning.collocation.closed_form import nearest_trajectory, unconstrained_optimum
from dyngrasp.planning.collocation.residuals import infeasible_at_once, objective, worst_violation
from dyngrasp.planning.problem import PhaseProblem, Solution, Status
from dyngrasp.trajectory import Trajectory


@dataclass(frozen=True)
class IpoptSettings:
    """Settings of `IpoptSolver`.

    Attributes:
        max_iterations: The paper's limit.
        time_limit: Wall time for one phase (s).
        tolerance: Optimality and feasibility in scaled units.
        violation_tolerance: A motion counts as converged only if no limit, measured apart from IPOPT in units of
            `NodeConstraint.scale`, is exceeded by more. IPOPT relaxes bounds by 1e-8, hence not tighter.
        initial_barrier: Start of the barrier parameter. The start is nearly optimal where few limits are active,
            and IPOPT's own 0.1 would first drive it away.
        linear_solver: "mumps" comes with CasADi; the paper used MA57.
    """

    max_iterations: int = 100
    time_limit: float = 30.0
    tolerance: float = 1e-8
    violation_tolerance: float = 1e-6
    initial_barrier: float = 1e-4
    linear_solver: str = "mumps"


_STATUS = {
    "Solve_Succeeded": Status.CONVERGED,
    "Solved_To_Acceptable_Level": Status.CONVERGED,
    "Feasible_Point_Found": Status.CONVERGED,
    "Infeasible_Problem_Detected": Status.INFEASIBLE,
    "Maximum_Iterations_Exceeded": Status.ITERATION_LIMIT,
    "Search_Direction_Becomes_Too_Small": Status.ITERATION_LIMIT,
    "Restoration_Failed": Status.ITERATION_LIMIT,
    "Error_In_Step_Computation": Status.ITERATION_LIMIT,
    "Maximum_WallTime_Exceeded": Status.DEADLINE_MISSED,
    "Maximum_CpuTime_Exceeded": Status.DEADLINE_MISSED,
    "Invalid_Number_Detected": Status.NONFINITE,
    "Diverging_Iterates": Status.NONFINITE,
}


class IpoptSolver:
    """Solves phases with IPOPT. Functions are built once for each problem structure and kept."""

    def __init__(self, settings: IpoptSettings | None = None) -> None:
        self.settings = settings or IpoptSettings()
        self._solvers: dict[tuple, tuple[transcription.NonlinearProgram, ca.Function]] = {}

    def solve(
        self, problem: PhaseProblem, guess: Trajectory | None = None, stop: Callable[[], bool] | None = None
    ) -> Solution:
        """Solve one phase.

        Args:
            problem: What is asked.
            guess: Where to start; without it, the optimum of the problem without its inequalities.
            stop: Asked once, before IPOPT begins; after that its own time limit holds.

        Returns:
            The solution. Failures are statuses; a trajectory is given even then, if there is a finite one, and it
            satisfies the dynamics and the boundary states.
        """
        clock = time.perf_counter
        began = clock()
        reason = infeasible_at_once(problem, self.settings.violation_tolerance)
        if not reason and stop is not None and stop():
            reason = "no time left"
        if reason:
            timings = {"total": 1e3 * (clock() - began)}
            return Solution(Status.INFEASIBLE, None, np.nan, 0, np.inf, timings, f"{problem.name}: {reason}")
        start = unconstrained_optimum(problem) if guess is None else _on_grid(problem, guess)
        guessed = clock()
        nlp = self._solver(problem)
        built = clock()
        answer = nlp(x0=transcription.pack(start), **transcription.numbers(problem))
        stats = nlp.stats()
        solved = clock()
        timings = {"start": 1e3 * (guessed - began), "build": 1e3 * (built - guessed), "solve": 1e3 * (solved - built)}
        code = str(stats["return_status"])
        return self._solution(problem, np.asarray(answer["x"]).ravel(), code, int(stats["iter_count"]), timings)

    def _solution(self, problem: PhaseProblem, x, code: str, iterations: int, timings: dict[str, float]) -> Solution:
        status = _STATUS.get(code, Status.ITERATION_LIMIT)
        began = time.perf_counter()
        curvature, duration = transcription.unpack(x, problem.intervals)
        if not (np.isfinite(curvature).all() and np.isfinite(duration) and duration > 0):
            timings["total"] = sum(timings.values())
            return Solution(
                Status.NONFINITE, None, np.nan, iterations, np.inf, timings, f"{problem.name}: IPOPT: {code}"
            )
        trajectory = nearest_trajectory(problem, curvature, duration)
        violation, worst = worst_violation(problem, trajectory)
        message = f"{problem.name}: IPOPT: {code}"
        if status is Status.CONVERGED and violation > self.settings.violation_tolerance:
            status = Status.ITERATION_LIMIT
        if worst:
            message += f"; worst: {worst} by {violation:.1e}"
        timings["check"] = 1e3 * (time.perf_counter() - began)
        timings["total"] = sum(timings.values())
        return Solution(status, trajectory, objective(problem, trajectory), iterations, violation, timings, message)

    def _solver(self, problem: PhaseProblem) -> ca.Function:
        key = transcription.structure_key(problem)
        if key not in self._solvers:
            program = transcription.build(problem)
            derivatives = {"grad_f": program.grad_f, "jac_g": program.jac_g, "hess_lag": program.hess_lag}
            self._solvers[key] = (
                program,
                ca.nlpsol("phase", "ipopt", program.problem, self.options() | derivatives),
            )
        return self._solvers[key][1]

    def options(self) -> dict[str, Any]:
        """Options of CasADi's interface to IPOPT, but for the derivatives."""
        settings = self.settings
        return {
            "error_on_fail": False,
            "print_time": False,
            "show_eval_warnings": False,
            "ipopt": {
                "print_level": 0,
                "sb": "yes",
                "linear_solver": settings.linear_solver,
                "max_iter": settings.max_iterations,
                "max_wall_time": settings.time_limit,
                "tol": settings.tolerance,
                "mu_init": settings.initial_barrier,
            },
        }


def _on_grid(problem: PhaseProblem, guess: Trajectory) -> Trajectory:
    """The guess on the problem's own grid, its boundary states and duration bounds met."""
    times = np.linspace(0.0, guess.duration, problem.intervals + 1)
    duration = float(np.clip(guess.duration, problem.min_duration, problem.max_duration))
    _, _, acceleration = guess.sample_many(times)
    return nearest_trajectory(problem, guess.duration**2 * acceleration, duration)
