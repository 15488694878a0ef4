"""Every derivative that the Newton system is made of, against finite differences."""

import casadi as ca
import numpy as np
import pytest

from dyngrasp.planning import constraints
from dyngrasp.planning.collocation.closed_form import least_effort
from dyngrasp.planning.collocation.limit_rows import LimitRows
from dyngrasp.planning.collocation.node_functions import node_functions
from dyngrasp.planning.collocation.phase_model import PhaseModel
from dyngrasp.planning.collocation.residuals import worst_violation
from dyngrasp.planning.collocation.three_tap import ThreeTap
from dyngrasp.planning.collocation.work_arrays import WorkArrays
from dyngrasp.planning.problem import NodeConstraint

STEP = 1e-6
# Central differences: error of order STEP² and rounding of order 1e-16 / STEP times numbers of up to 1e3.
DIFFERENCE = 1e-6


def model_of(problem) -> PhaseModel:
    functions = [node_functions(constraint) for constraint in problem.constraints]
    limits = LimitRows.of(problem, functions)
    work = WorkArrays.of(problem.intervals + 1, problem.joints, limits.constraint_rows)
    return PhaseModel(problem, functions, limits, work)


def position_row(n: int, N: int) -> NodeConstraint:
    """A row without accelerations, bounded above: constant at both ends."""
    q, v, p = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("p", 1)
    row = ca.Function("row", [q, v, p], [ca.sin(p * q[0]) * ca.sumsqr(q)])
    return NodeConstraint("bent", row, np.full((N + 1, 1), 1.3), *(np.array([x]) for x in (-np.inf, 9.0, 2.0)))


@pytest.fixture(params=[4, 7])
def case(request, make_problem, iiwa):
    N = request.param
    limits = np.array([6.0, 7.0, 8.0, 9.0, np.inf, 6.0, 7.0])
    rows = (constraints.torque_rows(iiwa, N), position_row(7, N))
    problem = make_problem(3, intervals=N, acceleration_limit=limits, constraints=rows, effort_weight=0.02)
    model = model_of(problem)
    random = np.random.default_rng(N)
    x, T = random.normal(scale=0.5, size=(N - 1, 7)), 1.3
    return model, x, T, random.uniform(0, 1, model.rows)


def rows_at(model, x, T):
    g = np.empty(model.rows)
    model.values(x, T, g)
    return g


def differences(function, x, T):
    """Derivatives of a function of (x, T) by every unknown, as columns."""
    columns = []
    for i in range(x.size + 1):
        up, down = np.append(x.ravel(), T), np.append(x.ravel(), T)
        up[i] += STEP
        down[i] -= STEP
        ends = [function(y[:-1].reshape(x.shape), y[-1]) for y in (up, down)]
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    return np.array(columns).T


def gradient_of_lagrangian(model, x, T, multiplier):
    g, out = np.empty(model.rows), np.empty_like(x)
    model.derivatives(x, T, multiplier, g)
    by_T = model.descent(multiplier, out)
    return -np.append(out.ravel(), by_T)


def test_gradient(case):
    model, x, T, multiplier = case

    def lagrangian(x, T):
        g = np.empty(model.rows)
        return np.array(model.values(x, T, g) - multiplier @ g)

    found = gradient_of_lagrangian(model, x, T, multiplier)
    np.testing.assert_allclose(found, differences(lagrangian, x, T), atol=DIFFERENCE * np.abs(found).max())


def test_steps_of_rows(case):
    model, x, T, multiplier = case
    g, dg = np.empty(model.rows), np.empty(model.rows)
    model.derivatives(x, T, multiplier, g)
    jacobian = differences(lambda x, T: rows_at(model, x, T), x, T)
    model.derivatives(x, T, multiplier, g)
    assert model.factorise(np.ones(model.rows), multiplier, 0.0, 50.0)
    random, rhs, dx = np.random.default_rng(6), np.empty_like(x), np.empty_like(x)
    for y in random.normal(size=(5, model.rows)):
        by_T = model.descent(y, rhs)
        dT, product = model.newton_step(y, dx, dg, np.inf)
        step = np.append(dx.ravel(), dT)
        np.testing.assert_allclose(dg, jacobian @ step, atol=DIFFERENCE * np.abs(jacobian).max() * np.abs(step).max())
        assert product == pytest.approx(rhs.ravel() @ dx.ravel() + by_T * dT)


def test_newton_matrix(case):
    """Hessian of the Lagrangian + Jᵀ Ω J, by solving with it: K K⁻¹ r = r for the matrix from differences."""
    model, x, T, multiplier = case
    random = np.random.default_rng(5)
    omega = random.uniform(0.5, 1.5, model.rows)
    hessian = differences(lambda x, T: gradient_of_lagrangian(model, x, T, multiplier), x, T)
    jacobian = differences(lambda x, T: rows_at(model, x, T), x, T)
    K = hessian + jacobian.T @ (omega[:, None] * jacobian)
    # The identity in the space of accelerations makes the banded part definite; it is known exactly.
    shift = 50.0
    tap = ThreeTap.of(model.problem)
    by_x = differences(lambda x, T: tap.expand(x, T)[2].ravel(), x, T)
    K += shift * by_x.T @ by_x
    model.derivatives(x, T, multiplier, np.empty(model.rows))
    assert model.factorise(omega, multiplier, 1.0, shift)
    rhs = random.normal(size=(2, x.size + 1))
    for r in rhs:
        step = r[:-1].reshape(x.shape).copy()
        step_T = model.solve(step, r[-1])
        residual = K @ np.append(step.ravel(), step_T) - r
        assert np.abs(residual).max() < 1e-4 * np.abs(r).max()
    assert np.linalg.eigvalsh((K + K.T) / 2)[0] > 0
    assert model.complement > 0


def test_without_curvature_the_matrix_is_gauss_and_newtons(case):
    model, x, T, multiplier = case
    omega = np.full(model.rows, 0.3)
    model.derivatives(x, T, multiplier, np.empty(model.rows))
    assert model.factorise(omega, multiplier, 0.0, 0.0)
    with_multipliers = model.corner
    model.derivatives(x, T, np.zeros(model.rows), np.empty(model.rows))
    assert model.factorise(omega, np.zeros(model.rows), 1.0, 0.0)
    assert model.corner == pytest.approx(with_multipliers, rel=1e-12)


def test_violation_is_that_of_the_residuals(case):
    model, _, _, _ = case
    for T in (0.3, 0.5, 0.8):
        motion = least_effort(model.problem, T)
        g = rows_at(model, model.map.unknowns(motion), T)
        expected, name = worst_violation(model.problem, motion)
        found, found_name = model.limits.violation(g, T)
        assert expected > 0
        assert found == pytest.approx(expected, rel=1e-9)
        assert found_name == name


def test_fixed_duration_takes_no_step(make_problem):
    problem = make_problem(0, min_duration=1.5, max_duration=1.5)
    model = model_of(problem)
    x = model.map.unknowns(least_effort(problem, 1.5))
    multiplier = np.full(model.rows, 0.1)
    model.derivatives(x, 1.5, multiplier, np.empty(model.rows))
    assert model.factorise(multiplier, multiplier, 1.0, 0.0)
    assert model.solve(x.copy(), 7.0) == 0.0


def test_slope_of_the_objective_along_a_step(case):
    model, x, T, multiplier = case
    g, omega = np.empty(model.rows), np.full(model.rows, 0.7)
    objective = model.derivatives(x, T, multiplier, g)
    assert model.factorise(omega, multiplier, 0.0, 0.0)
    model.complement = max(model.complement, 1.0)
    dx, dg = np.empty_like(x), np.empty(model.rows)
    dT, _ = model.newton_step(multiplier, dx, dg, 0.5 * T)
    slope = model.objective_slope(dT)
    ahead, behind = (model.values(x + step * dx, T + step * dT, g) for step in (STEP, -STEP))
    np.testing.assert_allclose((ahead - behind) / (2 * STEP), slope, atol=DIFFERENCE * max(abs(objective), 1.0))


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_walls_bend_by_second_derivative_over_squared_slope(make_problem, iiwa, scale):
    N = 6
    q, v, p = ca.SX.sym("q", 7), ca.SX.sym("v", 7), ca.SX.sym("p", 0)
    row = ca.Function("circle", [q, v, p], [q[0] ** 2 + q[1] ** 2])
    bounds = (np.array([x]) for x in (-np.inf, 9.0, scale))
    circle = NodeConstraint("circle", row, np.empty((N + 1, 0)), *bounds)
    problem = make_problem(5, intervals=N, constraints=(constraints.torque_rows(iiwa, N), circle))
    model = model_of(problem)
    motion = least_effort(problem, 1.0)
    radius = np.linalg.norm(motion.position[1:-1, :2], axis=1)
    # Second derivatives 2/scale of two joints, slope 2 r/scale.
    expected = np.sqrt(8.0) / scale / (2 * radius.min() / scale) ** 2
    np.testing.assert_allclose(model.bend(model.map.unknowns(motion), 1.0), expected, rtol=1e-9)
    without = model_of(make_problem(5, intervals=N, constraints=(constraints.torque_rows(iiwa, N),)))
    assert without.bend(model.map.unknowns(motion), 1.0) == 0.0
