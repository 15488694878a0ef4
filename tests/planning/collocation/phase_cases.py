"""Motions between random postures of an arm, rows of any kind, and what must hold of every solution."""

import casadi as ca
import numpy as np
import pytest

from dyngrasp.planning import constraints
from dyngrasp.planning.collocation.residuals import objective, worst_violation
from dyngrasp.planning.problem import NodeConstraint, PhaseProblem, Status

FEASIBLE = 1e-9  # in units of each limit, as the solver's own tolerance


def between_postures(robot, seed, N=40, weight=1e-3, fraction=1.0, moving=False, **changes) -> PhaseProblem:
    """A motion between random postures that the arm can hold, at rest or in motion, under torque rows."""
    random = np.random.default_rng(seed)
    limits = robot.limits
    strength = fraction * limits.torque - limits.coriolis

    def posture():
        while True:
            q = random.uniform(0.8 * limits.position_lower, 0.8 * limits.position_upper)
            if (np.abs(robot.gravity_torque(q)) < 0.9 * strength).all():
                return q

    speed = 0.4 if moving else 0.0
    phase = {
        "name": f"postures {seed}",
        "start_position": posture(),
        "end_position": posture(),
        "start_velocity": speed * random.uniform(-1, 1, robot.n) * limits.velocity,
        "end_velocity": speed * random.uniform(-1, 1, robot.n) * limits.velocity,
        "position_lower": limits.position_lower,
        "position_upper": limits.position_upper,
        "velocity_limit": limits.velocity,
        "acceleration_limit": limits.acceleration,
        "constraints": (constraints.torque_rows(robot, N, fraction),),
        "intervals": N,
        "effort_weight": weight,
    }
    return PhaseProblem(**(phase | changes))


def row(expression, N, lower, upper, n=7, name="row") -> NodeConstraint:
    """A row made of `expression(q, v)`."""
    q, v, p = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("p", 0)
    function = ca.Function("row", [q, v, p], [expression(q, v)])
    size = function.size1_out(0)
    return NodeConstraint(
        name, function, np.zeros((N + 1, 0)), np.full(size, lower), np.full(size, upper), np.ones(size)
    )


def require_valid(problem, solution):
    assert solution.status is Status.CONVERGED, solution.message
    motion = solution.require()
    assert motion.dynamics_defect() < 1e-12
    np.testing.assert_array_equal(motion.position[[0, -1]], [problem.start_position, problem.end_position])
    np.testing.assert_array_equal(motion.velocity[[0, -1]], [problem.start_velocity, problem.end_velocity])
    violation, name = worst_violation(problem, motion)
    assert violation <= FEASIBLE, name
    assert solution.worst_violation == pytest.approx(violation, abs=1e-10)
    assert solution.objective == pytest.approx(objective(problem, motion), rel=1e-12)
