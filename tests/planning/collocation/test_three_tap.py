"""The change of variables against the trapezoidal rule it replaces."""

import numpy as np
import pytest

from dyngrasp.planning.collocation import three_tap
from dyngrasp.planning.collocation.closed_form import nearest_trajectory
from dyngrasp.planning.collocation.three_tap import ThreeTap

GRIDS = [4, 5, 6, 7, 8, 25, 100]


def tolerance(N: int) -> float:
    """Rounding of a second difference of numbers of order one on N intervals."""
    return 50 * N**2 * np.finfo(float).eps


@pytest.mark.parametrize("N", GRIDS)
def test_any_unknowns_give_a_motion_that_obeys_the_rule(make_problem, N):
    problem = make_problem(N, joints=3, intervals=N)
    tap, h = ThreeTap.of(problem), 1 / N
    x, T = np.random.default_rng(N).normal(size=(N - 1, 3)), 1.7
    q, w, a = tap.expand(x, T)
    np.testing.assert_allclose(np.diff(q, axis=0), h / 2 * (w[1:] + w[:-1]), atol=tolerance(N))
    np.testing.assert_allclose(np.diff(w, axis=0), h / 2 * (a[1:] + a[:-1]), atol=tolerance(N) * N)
    np.testing.assert_allclose(q[[0, -1]], [problem.start_position, problem.end_position], atol=tolerance(N))
    np.testing.assert_allclose(
        w[[0, -1]], T * np.array([problem.start_velocity, problem.end_velocity]), atol=tolerance(N)
    )


@pytest.mark.parametrize("N", GRIDS)
def test_every_motion_that_obeys_the_rule_has_its_unknowns(make_problem, N):
    problem = make_problem(N, joints=3, intervals=N)
    motion = nearest_trajectory(problem, np.random.default_rng(N).normal(size=(N + 1, 3)), 1.3)
    tap = ThreeTap.of(problem)
    q, w, a = tap.expand(tap.unknowns(motion), motion.duration)
    np.testing.assert_allclose(q, motion.position, atol=tolerance(N))
    np.testing.assert_allclose(w, 1.3 * motion.velocity, atol=tolerance(N) * N)
    np.testing.assert_allclose(a, 1.3**2 * motion.acceleration, atol=tolerance(N) * N**2)


@pytest.mark.parametrize("N", GRIDS)
def test_steps_and_pull_back_are_the_linear_map_and_its_transpose(make_problem, N):
    random = np.random.default_rng(N)
    tap = ThreeTap.of(make_problem(N, joints=2, intervals=N))
    x, dx, T, dT = random.normal(size=(N - 1, 2)), random.normal(size=(N - 1, 2)), 1.1, 0.4
    dz = np.empty((3, N + 1, 2))
    three_tap.expand_step(tap, dx, dT, dz)
    np.testing.assert_allclose(dz, tap.expand(x + dx, T + dT) - tap.expand(x, T), atol=tolerance(N) * N**2)
    dual, gradient = random.normal(size=dz.shape), np.empty_like(dx)
    by_T = three_tap.pull_back(tap, dual, gradient)
    assert np.vdot(dual, dz) == pytest.approx(np.vdot(gradient, dx) + by_T * dT, rel=1e-10)
