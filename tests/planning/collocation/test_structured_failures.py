"""The structured solver where there is no solution, or no time to find it: what it says, and what it returns."""

import time
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from dyngrasp.planning.collocation.residuals import worst_violation
from dyngrasp.planning.collocation.structured import StructuredSettings, StructuredSolver
from dyngrasp.planning.problem import Status

from .phase_cases import FEASIBLE, between_postures, require_valid, row


def test_too_short_a_duration_is_infeasible(structured, iiwa):
    problem = between_postures(iiwa, 3)
    least = float((np.abs(problem.end_position - problem.start_position) / problem.velocity_limit).max())
    for factor in (0.5, 0.99, 1.005):
        solution = structured.solve(replace(problem, max_duration=factor * least))
        assert solution.status is Status.INFEASIBLE, solution.message
        assert solution.worst_violation > FEASIBLE


@pytest.mark.parametrize(
    ("expression", "lower", "upper"),
    [
        (lambda q, v: v[0], 0.5, np.inf),  # rest to rest needs braking
        (lambda q, v: v[5] - v[6], 0.0, 0.0),  # two joints with different ways to go
        (lambda q, v: q[0], 9.0, np.inf),  # violated at the boundary whatever happens
    ],
)
def test_rows_that_nothing_satisfies_are_infeasible(structured, iiwa, expression, lower, upper):
    problem = between_postures(iiwa, 3)
    problem = replace(problem, constraints=(*problem.constraints, row(expression, 40, lower, upper)))
    solution = structured.solve(problem)
    assert solution.status is Status.INFEASIBLE, solution.message


def test_contradicting_rows_are_infeasible(structured, iiwa):
    problem = between_postures(iiwa, 3)
    apart = replace(
        row(lambda q, v: ca.vertcat(v[0], v[0]), 40, -np.inf, 0.5), lower=[1.0, -np.inf], upper=[np.inf, 0.5]
    )
    solution = structured.solve(replace(problem, constraints=(apart,)))
    assert solution.status is Status.INFEASIBLE, solution.message


def test_an_equality_that_can_be_kept_is_kept(structured, iiwa):
    problem = between_postures(iiwa, 3)
    symmetric = {
        name: np.where(np.arange(7) == 6, getattr(problem, name)[5], getattr(problem, name))
        for name in ("start_position", "end_position")
    }
    problem = replace(problem, **symmetric, constraints=(row(lambda q, v: q[5] - q[6], 40, 0.0, 0.0),))
    solution = structured.solve(problem)
    require_valid(problem, solution)
    motion = solution.require()
    np.testing.assert_allclose(motion.position[:, 5], motion.position[:, 6], atol=2e-9)


def test_numbers_that_are_none_are_a_status(structured, iiwa):
    problem = between_postures(iiwa, 3)
    middle = float((problem.start_position + problem.end_position)[0] / 2)
    for expression in (lambda q, v: ca.sqrt(q[0] - middle), lambda q, v: ca.log(1e-3 - v[0] ** 2) + 0 * q[0]):
        solution = structured.solve(replace(problem, constraints=(row(expression, 40, -99.0, np.inf),)))
        assert solution.status is Status.NONFINITE, solution.message
        assert not solution.ok


def test_the_deadline_is_kept_and_the_best_iterate_returned(iiwa):
    problem = between_postures(iiwa, 3, N=400)
    optimal = StructuredSolver().solve(problem)
    feasible = 0
    for limit in (0.0, 0.3, 0.6, 0.9):
        solver = StructuredSolver(StructuredSettings(time_limit=limit * optimal.timings_ms["total"] / 1e3))
        began = time.perf_counter()
        solution = solver.solve(problem)
        elapsed = time.perf_counter() - began
        if solution.ok:  # the machine was faster this time
            continue
        assert solution.status is Status.DEADLINE_MISSED
        assert elapsed < 3 * optimal.timings_ms["total"] / 1e3 + 0.1
        motion = solution.trajectory
        assert motion is not None
        assert motion.dynamics_defect() < 1e-11
        assert solution.worst_violation == pytest.approx(worst_violation(problem, motion)[0], rel=1e-6, abs=1e-10)
        if solution.worst_violation <= FEASIBLE:
            feasible += 1
            assert solution.objective >= optimal.objective * (1 - 1e-8)
    limited = StructuredSolver(StructuredSettings(max_iterations=6)).solve(problem)
    assert limited.status is Status.ITERATION_LIMIT
    assert limited.iterations == 6
    assert limited.worst_violation <= FEASIBLE
    assert optimal.objective < limited.objective < 1.2 * optimal.objective
