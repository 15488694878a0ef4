"""Least effort in closed form against a dense solver of the same equations, and against brute force in the duration."""

import numpy as np
import pytest
from scipy.optimize import fminbound

from dyngrasp.planning.collocation.closed_form import (
    best_duration,
    least_cost,
    least_effort,
    nearest_trajectory,
    optimum_through,
    rest_to_rest,
    unconstrained_optimum,
)
from dyngrasp.planning.collocation.residuals import objective

GRIDS = (4, 5, 10, 50, 100)

# A hundred sums of numbers of order one; a few ulp each.
ROUNDING = 1e-13


def dense_least_effort(problem, duration, fixed=()):
    """Accelerations of least norm by the trapezoidal rule written out and a singular value decomposition."""
    N, dt = problem.intervals, duration / problem.intervals
    rate = np.zeros((N + 1, N + 1))
    for k in range(N):
        rate[k + 1] = rate[k]
        rate[k + 1, [k, k + 1]] += dt / 2
    place = np.zeros((N + 1, N + 1))
    for k in range(N):
        place[k + 1] = place[k] + dt / 2 * (rate[k] + rate[k + 1])
    nodes = [node for node, _ in fixed]
    A = np.vstack([rate[N], place[N], place[nodes]])
    b = [
        problem.end_velocity - problem.start_velocity,
        problem.end_position - problem.start_position - duration * problem.start_velocity,
        *(q - problem.start_position - node * dt * problem.start_velocity for node, q in fixed),
    ]
    return np.linalg.lstsq(A, np.array(b), rcond=None)[0]


@pytest.mark.parametrize("N", GRIDS)
@pytest.mark.parametrize("duration", [0.3, 2.7])
def test_least_effort_is_the_least_norm_solution(make_problem, N, duration):
    problem = make_problem(N, intervals=N)
    expected = dense_least_effort(problem, duration)
    found = least_effort(problem, duration).acceleration
    # The dense solver works in seconds, with a condition of some 10³.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("N", GRIDS)
def test_boundary_states_and_dynamics_hold_to_rounding(make_problem, N):
    for seed in range(20):
        problem = make_problem(seed, intervals=N)
        motion = unconstrained_optimum(problem)
        assert motion.dynamics_defect() < ROUNDING
        np.testing.assert_array_equal(motion.position[[0, -1]], [problem.start_position, problem.end_position])
        np.testing.assert_array_equal(motion.velocity[[0, -1]], [problem.start_velocity, problem.end_velocity])


@pytest.mark.parametrize("weight", [0.0, 1e-3, 1.0, 100.0])
def test_duration_is_the_best_of_a_scan(make_problem, weight):
    for seed in range(20):
        problem = make_problem(seed, effort_weight=weight, min_duration=0.05, max_duration=20.0)
        duration = best_duration(problem)
        scan = np.geomspace(0.05, 20.0, 400)
        costs = [least_cost(problem, T) for T in scan]
        k = int(np.clip(np.argmin(costs), 1, scan.size - 2))
        refined = fminbound(lambda T, p=problem: least_cost(p, T), scan[k - 1], scan[k + 1])
        # A minimum is flat: a search that stops at 1e-5 in T is off by 1e-10 in the cost.
        assert least_cost(problem, duration) <= min(least_cost(problem, np.asarray(refined).item()), *costs) + 1e-9
        assert 0.05 <= duration <= 20.0


def test_cost_formula_is_the_objective_of_the_motion(make_problem):
    problem = make_problem(3)
    for duration in (0.2, 1.0, 9.0):
        expected = objective(problem, least_effort(problem, duration))
        assert least_cost(problem, duration) == pytest.approx(expected, rel=1e-12)


def test_a_motion_that_stays_where_it_is_takes_no_time(make_problem):
    rest = {"start_position": np.ones(3), "end_position": np.ones(3), "start_velocity": 0 * np.ones(3)}
    problem = make_problem(joints=3, end_velocity=np.zeros(3), **rest)
    motion = unconstrained_optimum(problem)
    assert motion.duration == pytest.approx(1e-3)
    np.testing.assert_array_equal(motion.acceleration, 0.0)


def test_way_points_are_met_at_least_effort(make_problem):
    problem = make_problem(5, intervals=40, effort_weight=0.1)
    nodes, waypoints = [11, 25], np.random.default_rng(0).uniform(-1, 1, (2, 7))
    motion, cost = optimum_through(problem, [nodes], waypoints)
    np.testing.assert_allclose(motion.position[nodes], waypoints, rtol=0, atol=ROUNDING)
    assert motion.dynamics_defect() < ROUNDING
    assert cost == pytest.approx(objective(problem, motion), rel=1e-12)
    expected = dense_least_effort(problem, motion.duration, list(zip(nodes, waypoints, strict=True)))
    np.testing.assert_allclose(motion.acceleration, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    for duration in (0.98 * motion.duration, 1.02 * motion.duration):
        slower = dense_least_effort(problem, duration, list(zip(nodes, waypoints, strict=True)))
        assert duration * (1 + 0.1 / 40 * np.sum(slower**2)) > cost


def test_cheapest_of_several_timetables_is_taken(make_problem):
    problem = make_problem(6, intervals=40, effort_weight=0.1)
    timetables, waypoints = [[5, 9], [12, 27], [20, 36]], np.random.default_rng(1).uniform(-1, 1, (2, 7))
    alone = [optimum_through(problem, [nodes], waypoints) for nodes in timetables]
    best = min(range(3), key=lambda i: alone[i][1])
    motion, cost = optimum_through(problem, timetables, waypoints)
    assert cost == pytest.approx(alone[best][1], rel=1e-12)
    np.testing.assert_allclose(motion.position, alone[best][0].position, rtol=0, atol=ROUNDING)


def test_correction_is_the_smallest_that_meets_the_ends(make_problem):
    problem = make_problem(1, intervals=20)
    wanted = np.random.default_rng(2).normal(size=(21, 7))
    motion = nearest_trajectory(problem, wanted, 1.0)
    assert motion.dynamics_defect() < ROUNDING
    change = motion.acceleration - wanted
    # Any other correction differs from this one by a motion from rest to rest in place, to which it is orthogonal.
    idle = np.zeros(21)
    idle[5:8] = 1.0, -2.0, 1.0
    idle[11:14] = -1.0, 2.0, -1.0
    rows = np.ones(21), np.arange(20.0, -1.0, -1.0)
    assert abs(rows[0] @ idle) < ROUNDING
    assert abs(rows[1] @ idle) < ROUNDING
    assert np.abs(idle @ change).max() < 1e-11


@pytest.mark.parametrize("N", GRIDS)
def test_rest_to_rest_is_exact_and_odd(N):
    position, rate, curvature = rest_to_rest(N)
    h = 1 / N
    assert np.abs(np.diff(position) - h / 2 * (rate[1:] + rate[:-1])).max() < 1e-14
    assert np.abs(np.diff(rate) - h / 2 * (curvature[1:] + curvature[:-1])).max() < 1e-14
    assert (position[0], position[-1], rate[0], rate[-1]) == (0.0, 1.0, 0.0, 0.0)
    np.testing.assert_array_equal(curvature, -curvature[::-1])


def test_rest_to_rest_tends_to_the_cubic():
    s = np.linspace(0, 1, 1001)
    position, rate, curvature = rest_to_rest(1000)
    # The discrete minimiser differs from the cubic by terms of order h, from the halved weights at its ends.
    np.testing.assert_allclose(position, 3 * s**2 - 2 * s**3, atol=2e-3)
    np.testing.assert_allclose(rate, 6 * s - 6 * s**2, atol=6e-3)
    np.testing.assert_allclose(curvature[1:-1], (6 - 12 * s)[1:-1], atol=2e-2)
