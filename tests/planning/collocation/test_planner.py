"""Whole plans of the iiwa with the SDH2 and the casting: three phases, one clock, and the audit's last word."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem, PlanningFailed
from dyngrasp.models.catalogue import load_object
from dyngrasp.planning.collocation.closed_form import best_duration, least_cost
from dyngrasp.planning.collocation.gripper_path import gripper_path
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.residuals import infeasible_at_once, worst_violation
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import grasp_targets
from dyngrasp.planning.grasp_task import GraspTask, TaskSettings
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.target_update import updated_targets
from dyngrasp.signals import JointState
from dyngrasp.trajectory import PHASE_NAMES

Q_START = np.deg2rad([0.0, 0.0, 0.0, -40.0, 0.0, 100.0, 90.0])
Q_PLACE = np.deg2rad([-50.0, 30.0, 0.0, -85.0, 0.0, 65.0, 0.0])


@pytest.fixture(scope="module")
def task(iiwa, sdh2):
    return GraspTask(iiwa, sdh2, load_object("casting"), Q_PLACE)


@pytest.fixture(scope="module")
def targets(task):
    pose = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, 0.4), np.array([0.64, 0.05, task.grasp_object.rest_height]))
    return grasp_targets(pose, task, Q_START)


@pytest.fixture(scope="module", params=[1.0, 1e-3], ids=["papers weight", "nearly time-optimal"])
def planner(task, request):
    return CollocationPlanner(task, CollocationSettings(effort_weight=request.param))


@pytest.fixture(scope="module")
def result(planner, targets):
    return planner.plan(Q_START, targets, start_time=2.0)


def test_plan_converges_and_passes_the_audit(result):
    assert result.ok, result.message
    assert [solution.status for solution in result.phases] == [Status.CONVERGED] * 3
    assert all(solution.worst_violation < 1e-6 for solution in result.phases)
    assert result.audit is not None
    assert result.audit.ok
    assert set(result.timings_ms) >= {*PHASE_NAMES, "audit", "total"}


def test_boundary_states_and_gripper_are_the_targets(result, targets):
    plan = result.require()
    for phase, state in zip(plan.arm, (targets.pregrasp, targets.grasped, targets.place), strict=True):
        np.testing.assert_array_equal(phase.position[-1], state.position)
        np.testing.assert_array_equal(phase.velocity[-1], state.velocity)
    np.testing.assert_array_equal(plan.arm[0].position[0], Q_START)
    np.testing.assert_array_equal(plan.gripper[1].position[[0, -1]], [targets.gripper_open, targets.gripper_closed])
    assert plan.start_time == 2.0


def test_grasp_takes_as_long_as_the_hand_needs(result, targets, task):
    path = gripper_path(targets.gripper_open, targets.gripper_closed, 100)
    needed = path.shortest_duration(task.gripper.velocity, task.gripper.acceleration)
    duration = result.require().durations[1]
    assert needed - 1e-7 <= duration <= task.settings.grasp_duration_max + 1e-7
    assert duration >= task.settings.grasp_duration_min - 1e-7


def test_approach_starts_from_a_guess_down_the_funnel(planner, targets):
    approach, grasp, deliver = planner.phase_problems(Q_START, targets)
    guess = planner.guess(approach, targets)
    assert guess is not None
    assert guess.dynamics_defect() < 1e-12
    only_funnel = replace(
        approach,
        constraints=approach.constraints[1:],
        velocity_limit=np.full(7, 1e3),
        position_lower=np.full(7, -9.0),
        position_upper=np.full(7, 9.0),
    )
    violation, _ = worst_violation(only_funnel, guess)
    # In units of z_th: a descent of least effort bows by a few millimetres where a wall of the funnel is steep.
    assert violation < 0.7
    assert planner.guess(grasp, targets) is None
    assert planner.guess(deliver, targets) is None


def test_approaches_down_the_funnel_take_few_iterations(task):
    planner = CollocationPlanner(task)
    start = np.deg2rad([55, 39.5, -6.6, -22, -36.3, 110.6, 134])
    random = np.random.default_rng(3)
    iterations = []
    for _ in range(15):
        pose = pin.SE3(
            pin.utils.rotate("z", random.uniform(-np.pi, np.pi)),
            np.array([random.uniform(0.6, 0.7), random.uniform(-0.1, 0.1), task.grasp_object.rest_height]),
        )
        targets = grasp_targets(pose, task, start)
        approach, _, _ = planner.phase_problems(start, targets)
        solution = planner.solver.solve(approach, planner.guess(approach, targets))
        assert solution.ok, solution.message
        assert solution.objective >= least_cost(approach, best_duration(approach)) * (1 - 1e-9)
        iterations.append(solution.iterations)
    # With free steps at the start, which leave the funnel, the median is 18.
    assert np.median(iterations) <= 14, iterations


def test_a_moving_start_is_taken_as_it_is(planner, targets, result):
    state = result.require().arm[0].sample(0.4 * result.require().durations[0])
    replanned = planner.plan(JointState(0.0, state.position, state.velocity, state.acceleration), targets)
    assert replanned.ok, replanned.message
    np.testing.assert_array_equal(replanned.require().arm[0].velocity[0], state.velocity)


def test_boundary_states_satisfy_the_rows_that_no_acceleration_enters(planner, targets):
    for problem in planner.phase_problems(Q_START, targets):
        assert infeasible_at_once(problem, 1e-6) == ""


class CountingSolver:
    """The default solver; notes which phases it was asked for."""

    def __init__(self):
        self.solver, self.asked = StructuredSolver(), []

    def solve(self, problem, guess=None, stop=None):
        self.asked.append(problem)
        return self.solver.solve(problem, guess, stop)


@pytest.mark.parametrize(
    ("phase", "row", "bare"),
    [("approach", "funnel", {"funnel_margin": 0.0}), ("deliver", "hold", {"hold_safety": 1.0})],
)
def test_a_row_that_keeps_too_little_in_hand_is_tightened_until_the_audit_passes(task, targets, phase, row, bare):
    solver = CountingSolver()
    planner = CollocationPlanner(task, CollocationSettings(effort_weight=1e-3, **bare), solver)
    result = planner.plan(Q_START, targets)
    assert result.ok, result.message
    asked = [problem for problem in solver.asked if problem.name == phase]
    assert 2 <= len(asked) <= 4
    # The last solution is the one in the plan, and it satisfies the tighter row that was missing before.
    first, last = asked[0], asked[-1]
    used = result.require().arm[PHASE_NAMES.index(phase)]
    assert worst_violation(last, used)[0] < 1e-6
    assert worst_violation(last, solver.solver.solve(first, used).require())[1] == row
    assert result.phases[PHASE_NAMES.index(phase)].objective > solver.solver.solve(first, used).objective


def test_a_phase_without_time_stops_the_plan_there(task, targets):
    hurried = CollocationPlanner(task, CollocationSettings(max_duration=0.05)).plan(Q_START, targets)
    assert hurried.status is Status.INFEASIBLE
    assert hurried.plan is None
    assert len(hurried.phases) == 1
    with pytest.raises(PlanningFailed, match="approach"):
        hurried.require()


def test_a_hand_too_slow_for_the_grasp_is_refused_in_numbers(iiwa, sdh2, task, targets):
    settings = TaskSettings(grasp_duration_min=0.1, grasp_duration_max=0.2)
    quick = GraspTask(iiwa, sdh2, task.grasp_object, Q_PLACE, settings)
    with pytest.raises(InvalidProblem, match=r"needs 0\.5"):
        CollocationPlanner(quick).phase_problems(Q_START, targets)


@pytest.mark.parametrize(
    "bad",
    [
        {"torque_fraction": 0.0},
        {"velocity_fraction": 1.1},
        {"backend": "none"},
        {"intervals": 3},
        {"effort_weight": -1.0},
        {"hold_safety": 0.9},
        {"funnel_margin": np.nan},
        {"max_duration": np.inf},
    ],
)
def test_senseless_settings_are_refused(bad):
    with pytest.raises(InvalidProblem, match=next(iter(bad))):
        CollocationSettings(**bad)


def test_after_a_small_move_the_old_plan_is_a_good_start(task):
    planner = CollocationPlanner(task, CollocationSettings(effort_weight=1e-3))
    random = np.random.default_rng(8)
    iterations = {"cold": [], "warm": []}
    for _ in range(6):
        turn = pin.utils.rotate("z", random.uniform(-np.pi, np.pi))
        position = np.array([random.uniform(0.6, 0.7), random.uniform(-0.1, 0.1), task.grasp_object.rest_height])
        before = grasp_targets(pin.SE3(turn, position), task, Q_START)
        after = updated_targets(before, pin.SE3(turn, position + [0.01, 0.0, 0.0]), task)
        _, _, old = planner.phase_problems(Q_START, before)
        _, _, new = planner.phase_problems(Q_START, after)
        known = planner.solver.solve(old).require()
        cold, warm = planner.solver.solve(new), planner.solver.solve(new, known)
        assert cold.ok, cold.message
        assert warm.ok, warm.message
        # Both stop within 1e-7 of the same optimum.
        assert warm.objective == pytest.approx(cold.objective, rel=1e-6)
        iterations["cold"].append(cold.iterations)
        iterations["warm"].append(warm.iterations)
    # The ground is a wall that hardly bends: full steps from the start. Cautious ones take as many as from nothing.
    assert np.mean(iterations["warm"]) < 0.8 * np.mean(iterations["cold"]), iterations
