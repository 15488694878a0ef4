"""The benchmark's rows say what the interface promises, and general solvers find the structured solver's minimiser."""

import numpy as np
import pytest

from dyngrasp.errors import UnknownName
from dyngrasp.experiments.bench_replan import bench_replan, make_cell
from dyngrasp.experiments.end_point_errors import end_point_rows
from dyngrasp.experiments.online_programs import active_rows, qp_problems
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.general_solvers import solver_of
from dyngrasp.planning.replanning.lcqp import sparse_program
from dyngrasp.planning.replanning.tracking_qp import paper_step, solve_tracking


@pytest.fixture(scope="module")
def cell():
    return make_cell(1.0)


@pytest.mark.parametrize("name", ["ipopt", "osqp", "piqp", "piqp_multistage", "clarabel"])
def test_general_solvers_agree_on_the_program(cell, name):
    solve = solver_of(name)
    if solve is None:
        pytest.skip(f"{name} is not installed")
    for problem in qp_problems(cell.plan, cell.targets, cell.task, "qp_free", 2, 0):
        ours = solve_tracking(problem)
        assert ours.status is Status.CONVERGED
        x, elapsed = solve(sparse_program(problem))
        # their tolerance is 1e-9 in residuals, which the conditioning of the program turns into up to 1e-8 in the
        # variables
        assert np.abs(paper_step(problem, ours).ravel() - x).max() < 1e-7
        assert elapsed > 0


@pytest.mark.parametrize(
    ("case", "least", "most"), [("qp_free", 0, 0), ("qp_active", 15, 25), ("qp_many_active", 40, 400)]
)
def test_cases_have_as_many_active_rows_as_they_say(cell, case, least, most):
    solutions = [solve_tracking(problem) for problem in qp_problems(cell.plan, cell.targets, cell.task, case, 10, 0)]
    assert sum(solution.status is Status.CONVERGED for solution in solutions) >= 9
    assert least <= np.median([active_rows(solution) for solution in solutions]) <= most


def test_unknown_solvers_are_named():
    with pytest.raises(UnknownName):
        solver_of("simplex")


def test_the_exact_step_does_not_miss_and_the_papers_does(cell):
    rows = end_point_rows(cell.plan, cell.targets, cell.task, 0)
    exact = [row["error_mm"] for row in rows if row["solver"] == "exact"]
    paper = {row["move"]: row["error_mm"] for row in rows if row["solver"] == "lcqp" and row["duration_weight"] == 1.0}
    assert max(exact) < 1e-9
    assert paper["1 cm"] < paper["3 cm"] < paper["5 cm"] < paper["10 cm"]


@pytest.mark.slow
def test_rows_have_the_keys_of_the_interface():
    rows = bench_replan(20, 0, 1.0)
    cases = {row["case"] for row in rows}
    assert {"qp_free", "qp_active", "qp_many_active", "cycle_free", "cycle_constrained", "end_point_error"} <= cases
    for row in rows:
        assert "solver" in row
        if row["case"] not in ("end_point_error", "late_moves"):
            assert {"median_ms", "p99_ms", "max_ms", "n"} <= row.keys()
        if row["case"] == "late_moves":
            assert row["5_mm"] > 0.9
        elif row["solver"] == "replanner":
            assert row["published_invalid"] == 0
            assert row["jumps"] == 0
