"""The end of a phase as a problem of its own."""

import subprocess
import sys

import numpy as np
import pytest

from dyngrasp.planning import constraints
from dyngrasp.planning.collocation.closed_form import least_effort, nearest_trajectory
from dyngrasp.planning.collocation.limit_rows import LimitRows
from dyngrasp.planning.collocation.node_functions import node_functions
from dyngrasp.planning.collocation.phase_model import PhaseModel
from dyngrasp.planning.collocation.planner import CollocationPlanner
from dyngrasp.planning.collocation.residuals import objective
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.collocation.three_tap import CURVATURE, POSITION, ThreeTap
from dyngrasp.planning.collocation.window import STANDING_FOR, Window
from dyngrasp.planning.collocation.work_arrays import WorkArrays

N, FIRST = 30, 12


@pytest.fixture
def problem(make_problem, iiwa):
    start = np.full(7, 0.3)
    return make_problem(5, intervals=N, start_velocity=start, constraints=(constraints.torque_rows(iiwa, N),))


@pytest.fixture
def window(problem):
    return Window.of(problem, ThreeTap.of(problem), list(problem.constraints), FIRST)


def test_a_motion_of_least_effort_goes_through_a_window_unchanged(problem, window):
    """What is eliminated is of least effort anyway."""
    T = 1.7
    motion = least_effort(problem, T)
    x = window.unknowns(ThreeTap.of(problem).unknowns(motion))
    scale = np.abs(motion.acceleration).max() * T**2
    np.testing.assert_allclose(window.curvature(problem, x, T), motion.acceleration * T**2, atol=1e-9 * scale)


def test_a_window_costs_what_the_whole_motion_costs(problem, window):
    """The two grid points that stand for those before have their effort; the others are those of the whole grid."""
    random, T = np.random.default_rng(2), 1.4
    x = window.unknowns(ThreeTap.of(problem).unknowns(least_effort(problem, T)))
    x = x + 1e-3 * random.normal(size=x.shape)
    functions = [node_functions(constraint) for constraint in problem.constraints]
    limits = LimitRows.without_boxes(problem, problem.constraints, functions)
    work = WorkArrays.of(window.map.first.size, 7, limits.constraint_rows)
    model = PhaseModel(problem, functions, limits, work, window)
    cost = model.values(x, T, np.empty(model.rows))
    # The unknowns meet the boundary states whatever they are, so that the accelerations need no correction.
    curvature = window.curvature(problem, x, T)
    whole = nearest_trajectory(problem, curvature, T)
    np.testing.assert_allclose(whole.acceleration * T**2, curvature, atol=1e-9 * np.abs(curvature).max())
    assert cost == pytest.approx(objective(problem, whole), rel=1e-12)
    z = window.map.expand(x, T)[:, STANDING_FOR:]
    np.testing.assert_allclose(z[POSITION], whole.position[FIRST:], atol=1e-12)
    np.testing.assert_allclose(z[CURVATURE], curvature[FIRST:], atol=1e-9 * np.abs(curvature).max())
    # Nothing before the window costs less with the same r there.
    change = np.zeros_like(curvature)
    change[:FIRST] = random.normal(size=(FIRST, 7))
    other = ThreeTap.of(problem).unknowns(nearest_trajectory(problem, curvature + change, T))
    other[FIRST - 2 :] = x
    before = (np.sum(ThreeTap.of(problem).expand(other, T)[CURVATURE] ** 2), np.sum(curvature**2))
    assert before[0] > before[1]


def test_an_approach_solved_by_its_end_is_an_optimum_of_the_whole(task, targets, q_start, monkeypatch):
    planner = CollocationPlanner(task)
    approach, _, _ = planner.phase_problems(q_start, targets)
    solver = StructuredSolver()
    solution = solver.solve(approach, planner.guess(approach, targets))
    assert solution.ok
    assert "end" in solution.message
    # The method for the whole, from its motion, finds nothing better nearby.
    monkeypatch.setattr(StructuredSolver, "_solve_window", lambda *_: None)
    again = solver.solve(approach, solution.require())
    assert again.ok
    assert again.objective == pytest.approx(solution.objective, rel=1e-7)
    np.testing.assert_allclose(again.require().position, solution.require().position, atol=1e-5)


FRESH_PROCESS = """
import importlib, pkgutil
import numpy as np, pinocchio as pin
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning import collocation
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.structured import compile_kernels
from dyngrasp.planning.grasp_targets import grasp_targets
from dyngrasp.planning.grasp_task import GraspTask

names = [module.name for module in pkgutil.iter_modules(collocation.__path__)]
modules = [importlib.import_module(f"{collocation.__name__}.{name}") for name in names]
kernels = {f.py_func.__name__: f for module in modules for f in vars(module).values() if hasattr(f, "signatures")}

def compiled():
    return {name: len(f.signatures) for name, f in kernels.items()}

compile_kernels()
prepared = compiled()
assert len(prepared) > 20
place = np.deg2rad([-45.0, 34.0, 0.0, -53.0, 0.0, 93.0, 90.0])
task = GraspTask(load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting"), place)
q = np.deg2rad([55.0, 39.5, -6.6, -22.0, -36.3, 110.6, 134.0])
targets = grasp_targets(pin.SE3(np.eye(3), np.array([0.65, 0.0, task.grasp_object.rest_height])), task, q)
for weight in (1.0, 1e-3):
    result = CollocationPlanner(task, CollocationSettings(effort_weight=weight)).plan(q, targets)
    assert result.ok and result.phases[0].iterations > 0, result.message
assert compiled() == prepared, {name: (n, compiled()[name]) for name, n in prepared.items() if compiled()[name] != n}
"""


def test_solves_compile_nothing_but_what_was_prepared():
    """What is compiled within a solve would count towards its time limit."""
    done = subprocess.run([sys.executable, "-c", FRESH_PROCESS], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
