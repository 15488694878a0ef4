"""The reference backend against the closed form, against another optimiser, and in everything that can go wrong."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

from dyngrasp.errors import PlanningFailed
from dyngrasp.planning import constraints
from dyngrasp.planning.collocation import ipopt, transcription
from dyngrasp.planning.collocation.closed_form import best_duration, least_cost, least_effort
from dyngrasp.planning.collocation.ipopt import IpoptSettings, IpoptSolver
from dyngrasp.planning.collocation.residuals import objective, worst_violation
from dyngrasp.planning.problem import NodeConstraint, Status

# IPOPT relaxes bounds by 1e-8 of their size.
FEASIBLE = 1e-7


def bounds(lower: float, upper: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower and upper bound of a single row and its scale, 1."""
    return np.array([lower]), np.array([upper]), np.ones(1)


def speed_rows(n: int, N: int, bound: float) -> NodeConstraint:
    """A nonlinear row on (q, v): q·q + 0.1 v·v ≤ bound."""
    q, v, p = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("p", 1)
    row = ca.Function("row", [q, v, p], [ca.sumsqr(q) + p * ca.sumsqr(v)])
    return NodeConstraint("row", row, np.full((N + 1, 1), 0.1), *bounds(-np.inf, bound))


def check(problem, solution):
    assert solution.status is Status.CONVERGED, solution.message
    motion = solution.require()
    assert motion.dynamics_defect() < 1e-12
    np.testing.assert_array_equal(motion.position[[0, -1]], [problem.start_position, problem.end_position])
    np.testing.assert_array_equal(motion.velocity[[0, -1]], [problem.start_velocity, problem.end_velocity])
    assert np.abs(motion.velocity / problem.velocity_limit).max() <= 1 + FEASIBLE
    assert np.abs(motion.acceleration / problem.acceleration_limit).max() <= 1 + FEASIBLE
    assert (motion.position >= problem.position_lower - FEASIBLE).all()
    assert (motion.position <= problem.position_upper + FEASIBLE).all()
    assert problem.min_duration - FEASIBLE <= motion.duration <= problem.max_duration + FEASIBLE
    assert solution.objective == pytest.approx(objective(problem, motion), rel=1e-14)


@pytest.mark.parametrize("N", [4, 10, 50, 100])
def test_without_active_limits_it_finds_the_closed_form(make_problem, solver, N):
    for seed in range(3):
        problem = make_problem(seed, intervals=N, velocity_limit=np.full(7, 1e3), position_upper=np.full(7, 50.0))
        # Started well away from the answer, or the answer would be its own proof.
        solution = solver.solve(problem, least_effort(problem, 3 * best_duration(problem)))
        check(problem, solution)
        assert solution.objective == pytest.approx(least_cost(problem, best_duration(problem)), rel=1e-8)


@pytest.mark.parametrize("N", [4, 10, 50, 100])
@pytest.mark.parametrize("weight", [1.0, 1e-3])
def test_limits_of_the_arm_hold(make_problem, solver, iiwa, N, weight):
    for seed in range(2):
        problem = make_problem(
            seed,
            intervals=N,
            effort_weight=weight,
            velocity_limit=iiwa.limits.velocity,
            constraints=(constraints.torque_rows(iiwa, N, 0.5),),
        )
        solution = solver.solve(problem)
        check(problem, solution)
        assert solution.worst_violation < FEASIBLE
        for q, v in zip(solution.trajectory.position, solution.trajectory.acceleration, strict=True):
            torque = np.abs(iiwa.inverse_dynamics(q, np.zeros(7), v))
            assert (torque <= (0.5 * iiwa.limits.torque - iiwa.limits.coriolis) * (1 + 1e-6)).all()


def test_active_limits_agree_with_another_optimiser(make_problem, solver):
    """Sequential quadratic programming over the accelerations, derivatives by differences: nothing in common."""
    N, n = 8, 2
    problem = make_problem(
        3,
        joints=n,
        intervals=N,
        effort_weight=0.01,
        velocity_limit=np.array([0.6, 0.7]),
        acceleration_limit=np.array([3.0, 2.0]),
        constraints=(speed_rows(n, N, 1.5),),
    )
    solution = solver.solve(problem)
    check(problem, solution)

    def motion(x):
        v, dt = x[:-1].reshape(N + 1, n) / x[-1] ** 2, x[-1] / N
        w = np.cumsum(np.vstack([problem.start_velocity, dt / 2 * (v[1:] + v[:-1])]), axis=0)
        return np.cumsum(np.vstack([problem.start_position, dt / 2 * (w[1:] + w[:-1])]), axis=0), w, v

    def ends(x):
        q, w, _ = motion(x)
        return np.concatenate([q[-1] - problem.end_position, w[-1] - problem.end_velocity])

    def inside(x):
        q, w, v = motion(x)
        rows = 1.5 - np.sum(q**2, axis=1) - 0.1 * np.sum(v**2, axis=1)
        boxes = [problem.velocity_limit - np.abs(w), problem.acceleration_limit - np.abs(v)]
        return np.concatenate([rows, *(box.ravel() for box in boxes)])

    start = least_effort(problem, 2.5)
    found = minimize(
        lambda x: x[-1] * (1 + 0.01 / N * np.sum(motion(x)[2] ** 2)),
        np.append((start.acceleration * 2.5**2).ravel(), 2.5),
        method="SLSQP",
        constraints=[{"type": "eq", "fun": ends}, {"type": "ineq", "fun": inside}],
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert found.success, found.message
    assert inside(found.x).min() > -1e-8
    speed = np.abs(solution.trajectory.velocity[1:-1]) / problem.velocity_limit
    acceleration = np.abs(solution.trajectory.acceleration) / problem.acceleration_limit
    assert min(speed.max(), acceleration.max()) > 0.999, "limits that are not active would not be tested"
    # Difference quotients leave SLSQP with some six digits.
    assert solution.objective == pytest.approx(found.fun, rel=1e-6)


def test_the_start_does_not_decide_the_answer(make_problem, solver, iiwa):
    problem = make_problem(
        1, effort_weight=1e-3, velocity_limit=iiwa.limits.velocity, constraints=(constraints.torque_rows(iiwa, 100),)
    )
    first = solver.solve(problem)
    other = solver.solve(make_problem(1, intervals=40, effort_weight=1.0))
    for guess in (least_effort(problem, 3.0), other.require()):
        assert solver.solve(problem, guess).objective == pytest.approx(first.objective, rel=1e-6)


def test_derivatives_are_those_of_the_functions(make_problem, iiwa):
    """Assembled Jacobian and Hessian against CasADi's own differentiation of the whole program."""
    N = 4
    problem = make_problem(
        0, intervals=N, acceleration_limit=np.full(7, 9.0), constraints=(constraints.torque_rows(iiwa, N),)
    )
    program = transcription.build(problem)
    x, p, f, g = (program.problem[key] for key in "xpfg")
    multiplier, sigma = ca.MX.sym("lambda", g.numel()), ca.MX.sym("sigma")
    reference = ca.Function(
        "reference",
        [x, p, sigma, multiplier],
        [ca.gradient(f, x), ca.jacobian(g, x), ca.triu(ca.hessian(sigma * f + ca.dot(multiplier, g), x)[0])],
    )
    random = np.random.default_rng(0)
    at = transcription.pack(least_effort(problem, 1.3)) + 0.1 * random.normal(size=x.numel())
    numbers = transcription.numbers(problem)["p"]
    weights = random.normal(size=g.numel())
    gradient, jacobian, hessian = reference(at, numbers, 0.7, weights)
    for found, expected in (
        (program.grad_f(at, numbers)[1], gradient),
        (program.jac_g(at, numbers)[1], jacobian),
        (program.hess_lag(at, numbers, 0.7, weights), hessian),
    ):
        found, expected = found.full(), expected.full()
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_another_pose_and_other_limits_build_nothing(make_problem, iiwa, monkeypatch):
    built = []
    build = transcription.build
    monkeypatch.setattr(ipopt.transcription, "build", lambda problem: built.append(problem) or build(problem))
    own = IpoptSolver()
    for seed, fraction, weight in ((0, 0.8, 1.0), (1, 0.6, 1.0), (2, 0.8, 0.1)):
        rows = constraints.torque_rows(iiwa, 20, fraction)
        problem = make_problem(seed, intervals=20, effort_weight=weight, constraints=(rows,))
        assert own.solve(problem).ok
    assert len(built) == 1


class TestFailuresAreData:
    def test_too_little_time_for_the_speed_limits(self, make_problem, solver):
        problem = make_problem(0, max_duration=0.2)
        solution = solver.solve(problem)
        assert solution.status is Status.INFEASIBLE
        assert "top speed" in solution.message
        with pytest.raises(PlanningFailed, match="top speed"):
            solution.require()

    def test_too_little_time_for_the_acceleration_limits(self, make_problem, solver):
        rest = {"start_velocity": np.zeros(7), "end_velocity": np.zeros(7), "acceleration_limit": np.full(7, 1.0)}
        problem = make_problem(0, intervals=20, max_duration=1.3, **rest)
        travel = np.abs(problem.end_position - problem.start_position).max()
        assert 2 * np.sqrt(travel) > 1.5, "full acceleration, then full braking must not suffice"
        solution = solver.solve(problem)
        assert solution.status is Status.INFEASIBLE
        assert solution.worst_violation > 1e-3

    def test_a_row_that_a_boundary_position_violates(self, make_problem, solver):
        q, v, p = ca.SX.sym("q", 7), ca.SX.sym("v", 7), ca.SX.sym("p", 0)
        row = ca.Function("row", [q, v, p], [q[0]])
        problem = make_problem(0)
        bound = problem.end_position[0]
        for lower, status in ((bound + 1e-3, Status.INFEASIBLE), (min(bound, problem.start_position[0]) - 1e-3, None)):
            rows = NodeConstraint("wall", row, np.zeros((101, 0)), *bounds(lower, np.inf))
            solution = solver.solve(make_problem(0, constraints=(rows,)))
            assert solution.status is (status or Status.CONVERGED)
            assert ("wall" in solution.message) == (status is Status.INFEASIBLE)

    def test_iteration_limit(self, make_problem):
        problem = make_problem(0, effort_weight=1e-3)
        solution = IpoptSolver(IpoptSettings(max_iterations=2)).solve(problem)
        assert solution.status is Status.ITERATION_LIMIT
        assert solution.iterations == 2
        assert solution.trajectory is not None
        assert solution.trajectory.dynamics_defect() < 1e-12

    def test_deadline(self, make_problem):
        problem = make_problem(0, effort_weight=1e-3)
        solution = IpoptSolver(IpoptSettings(time_limit=1e-6)).solve(problem)
        assert solution.status is Status.DEADLINE_MISSED

    def test_a_row_that_is_not_finite(self, make_problem, solver):
        q, v, p = ca.SX.sym("q", 7), ca.SX.sym("v", 7), ca.SX.sym("p", 0)
        row = ca.Function("row", [q, v, p], [ca.sqrt(-1 - ca.sumsqr(v))])
        rows = NodeConstraint("row", row, np.zeros((101, 0)), *bounds(-1.0, 1.0))
        solution = solver.solve(make_problem(0, constraints=(rows,)))
        assert solution.status is Status.NONFINITE
        assert solution.worst_violation == np.inf

    def test_nothing_is_printed(self, make_problem, solver, capfd):
        solver.solve(make_problem(0))
        solver.solve(make_problem(0, max_duration=0.2))
        assert capfd.readouterr() == ("", "")


def test_violation_is_measured_and_named(make_problem):
    problem = make_problem(0)
    slow, fast = least_effort(problem, 20.0), least_effort(problem, 0.5)
    assert worst_violation(problem, slow) == (0.0, "")
    value, name = worst_violation(problem, fast)
    assert name == "velocity"
    assert value == pytest.approx(np.abs(fast.velocity / problem.velocity_limit).max() - 1)
    assert worst_violation(make_problem(0, max_duration=10.0), slow) == (1.0, "duration")
