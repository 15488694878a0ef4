"""Numerical inverse kinematics against the closed form, and joint rates for a twist."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.models.catalogue import load_robot
from dyngrasp.models.damped_least_squares import DampedLeastSquares, DampedLeastSquaresSettings
from dyngrasp.models.inverse_kinematics import (
    InverseKinematics,
    inverse_kinematics_for,
    joint_velocity,
)
from dyngrasp.models.limits import JointLimits
from dyngrasp.models.robot import RobotModel
from dyngrasp.models.srs_kinematics import SrsKinematics

ROBOT = load_robot("iiwa14")
CLOSED = SrsKinematics.from_robot(ROBOT)
NUMERICAL = DampedLeastSquares(ROBOT)
LOWER, UPPER = ROBOT.limits.position_lower, ROBOT.limits.position_upper
SIX = [0, 1, 3, 4, 5, 6]


@cache
def six_joint_arm() -> RobotModel:
    """The same arm with its third joint locked at zero: its solutions are those of the S-R-S arm with q3 = 0."""
    model = pin.buildReducedModel(ROBOT.pin_model, [ROBOT.pin_model.getJointId("A3")], np.zeros(7))
    kept = {name: getattr(ROBOT.limits, name)[SIX] for name in JointLimits.__dataclass_fields__}
    return replace(
        ROBOT, name="iiwa14 without A3", pin_model=model, kinematics="general", srs=None, limits=JointLimits(**kept)
    )


def random_postures(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(LOWER, UPPER, (count, 7))


def errors(robot: RobotModel, q: np.ndarray, T: pin.SE3) -> tuple[float, float]:
    reached = robot.forward_kinematics(q)
    turn = pin.log3(T.rotation @ reached.rotation.T)
    return float(np.linalg.norm(reached.translation - T.translation)), float(np.linalg.norm(turn))


def cost(q: np.ndarray, reference: np.ndarray) -> float:
    return float((((q - reference) / ROBOT.limits.velocity) ** 2).sum())


def test_factory_goes_by_the_model_file() -> None:
    assert isinstance(inverse_kinematics_for(ROBOT), SrsKinematics)
    assert isinstance(inverse_kinematics_for(replace(ROBOT, kinematics="general", srs=None)), DampedLeastSquares)


@pytest.mark.parametrize("solver", [CLOSED, NUMERICAL], ids=["closed", "numerical"])
def test_both_answer_alike(solver: InverseKinematics) -> None:
    for q in random_postures(5, seed=1):
        T = ROBOT.forward_kinematics(q)
        nearest, found = solver.nearest(T, q), solver.solutions(T, count=30)
        assert nearest.shape == (7,)
        assert found.ndim == 2
        assert found.shape[1] == 7
        for solution in (nearest, *found):
            # A frame turned back by the logarithm adds rounding of 1e-15 to the solver's own tolerance.
            assert max(errors(ROBOT, solution, T)) < 1.01e-10
            assert (solution >= LOWER).all()
            assert (solution <= UPPER).all()
        assert np.abs(nearest - q).max() < 1e-8


def test_warm_start_finds_the_nearest_configuration_of_the_closed_form() -> None:
    random = np.random.default_rng(2)
    agree = 0
    for q in random_postures(60, seed=3):
        T, reference = ROBOT.forward_kinematics(q), np.clip(q + random.uniform(-0.1, 0.1, 7), LOWER, UPPER)
        numerical, closed = NUMERICAL.nearest(T, reference), CLOSED.nearest(T, reference)
        assert max(errors(ROBOT, numerical, T)) < 1.01e-10
        # Local against global: never better than the closed form by more than its arm-angle step times the slope.
        assert cost(numerical, reference) > cost(closed, reference) - 1e-8
        agree += np.abs(numerical - closed).max() < 1e-6
    assert agree >= 57


def test_cold_start_reaches_poses_far_from_the_reference() -> None:
    for q in random_postures(30, seed=4):
        T, reference = ROBOT.forward_kinematics(q), np.zeros(7)
        found = NUMERICAL.nearest(T, reference)
        assert max(errors(ROBOT, found, T)) < 1.01e-10
        assert ((found >= LOWER) & (found <= UPPER)).all()


def test_a_redundant_solution_lies_on_the_closed_form_of_its_own_arm_angle() -> None:
    T = ROBOT.forward_kinematics(np.array([0.4, 0.7, 0.2, -1.4, 0.3, 0.9, 0.0]))
    found = NUMERICAL.solutions(T, count=40)
    assert len(found) > 10
    for q in found:
        assert np.abs(CLOSED.solve(T, CLOSED.arm_angle(q), CLOSED.branch(q)) - q).max() < 1e-7
    gaps = np.abs(found[:, None] - found[None]).max(axis=2) + 10.0 * np.eye(len(found))
    assert gaps.min() > NUMERICAL.settings.distinct
    np.testing.assert_array_equal(found, NUMERICAL.solutions(T, count=40))


def test_any_chain_is_solved(robot: RobotModel) -> None:
    solver, random = DampedLeastSquares(robot), np.random.default_rng(11)
    lower, upper = robot.limits.position_lower, robot.limits.position_upper
    for _ in range(10):
        q = random.uniform(lower, upper)
        T, reference = robot.forward_kinematics(q), np.clip(q + random.uniform(-0.2, 0.2, robot.n), lower, upper)
        found = solver.nearest(T, reference)
        assert max(errors(robot, found, T)) < 1.01e-10
        assert ((found >= lower) & (found <= upper)).all()
        # q itself is a solution, so the nearest one found by descent is no farther; six joints have no choice.
        if robot.n > 6:
            weight = 1.0 / robot.limits.velocity
            assert (((found - reference) * weight) ** 2).sum() <= (((q - reference) * weight) ** 2).sum() + 1e-12
        twist = random.normal(size=6)
        assert np.abs(robot.jacobian(q) @ joint_velocity(robot, q, twist) - twist).max() < 1e-8


def test_six_joints_have_the_solutions_of_the_closed_form_with_q3_zero() -> None:
    arm = six_joint_arm()
    for q in random_postures(4, seed=5):
        q[2] = 0.0
        T = ROBOT.forward_kinematics(q)
        # q3 = 0 puts the elbow into the vertical plane through shoulder and wrist, above or below their line.
        expected = CLOSED.scan(T, np.array([0.0, np.pi])).configurations
        expected = expected[np.abs(expected[:, 2]) < 1e-9][:, SIX]
        found = DampedLeastSquares(arm).solutions(T, count=120)
        assert len(found) == len(expected) >= 1
        for solution in expected:
            assert np.abs(found - solution).max(axis=1).min() < 1e-8
        nearest = DampedLeastSquares(arm).nearest(T, q[SIX] + 0.02)
        assert np.abs(nearest - q[SIX]).max() < 1e-8


def test_solutions_on_a_limit_are_found() -> None:
    arm = DampedLeastSquares(six_joint_arm())
    q = np.array([0.3, 0.8, 0.0, UPPER[3], -0.4, UPPER[5], 0.2])
    found = arm.nearest(ROBOT.forward_kinematics(q), q[SIX] - 0.1)
    assert np.abs(found - q[SIX]).max() < 1e-8


def test_stretched_arm_is_reached_although_convergence_is_slow_there() -> None:
    q = np.array([0.3, 0.8, 0.1, 0.0, -0.4, 0.9, 0.2])
    T = ROBOT.forward_kinematics(q)
    assert max(errors(ROBOT, NUMERICAL.nearest(T, q + 0.1), T)) < 1.01e-10


def test_unreachable_pose_says_how_far_it_stays_away() -> None:
    # Straight up and 0.3 m too high, in the orientation of the stretched arm: position alone is out of reach.
    T = pin.SE3(np.eye(3), np.array([0.0, 0.0, 1.306 + 0.3]))
    for ask in (lambda: NUMERICAL.solutions(T), lambda: NUMERICAL.nearest(T, np.full(7, 0.1))):
        with pytest.raises(OutOfReach, match="attempts") as refused:
            ask()
        assert refused.value.distance == pytest.approx(0.3, abs=1e-2)
    with pytest.raises(OutOfReach) as refused:
        CLOSED.solutions(T)
    assert refused.value.distance == pytest.approx(0.3, abs=1e-12)


def test_limits_can_forbid_what_the_arm_could_reach() -> None:
    narrow = replace(ROBOT.limits, position_lower=np.full(7, -0.2), position_upper=np.full(7, 0.2))
    T = ROBOT.forward_kinematics(np.full(7, 0.9))
    with pytest.raises(OutOfReach):
        DampedLeastSquares(replace(ROBOT, limits=narrow), DampedLeastSquaresSettings(restarts=10)).solutions(T)


def test_null_vector_holds_the_flange_and_turns_without_jumps() -> None:
    start, end = random_postures(2, seed=6)
    before = NUMERICAL.null_space_rate(start)
    for s in np.linspace(0.0, 1.0, 400):
        q = start + s * (end - start)
        rate = NUMERICAL.null_space_rate(q)
        assert np.linalg.norm(rate) == pytest.approx(1.0, abs=1e-12)
        assert np.abs(ROBOT.jacobian(q) @ rate).max() < 1e-12
        assert rate @ before > 0.5
        before = rate
        closed = CLOSED.null_space_rate(q)
        assert abs(rate @ closed) == pytest.approx(np.linalg.norm(closed), rel=1e-9)


def test_six_joints_have_no_null_space() -> None:
    np.testing.assert_array_equal(DampedLeastSquares(six_joint_arm()).null_space_rate(np.full(6, 0.4)), np.zeros(6))


def test_the_null_space_of_eight_joints_is_refused(robot: RobotModel) -> None:
    if robot.n <= 7:
        assert np.shape(DampedLeastSquares(robot).null_space_rate(np.zeros(robot.n))) == (robot.n,)
        return
    with pytest.raises(InvalidProblem, match="not a line"):
        DampedLeastSquares(robot).null_space_rate(np.zeros(robot.n))


finite = st.floats(-0.5, 0.5)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 199), st.lists(finite, min_size=6, max_size=6), finite)
def test_joint_velocity_moves_the_flange_with_the_twist(row: int, twist: list[float], swivel: float) -> None:
    q = random_postures(200, seed=7)[row]
    rate = joint_velocity(ROBOT, q, twist, swivel)
    assert np.abs(ROBOT.jacobian(q) @ rate - twist).max() < 1e-8
    least = joint_velocity(ROBOT, q, twist)
    assert np.linalg.norm(least) <= np.linalg.norm(rate) + 1e-12
    np.testing.assert_allclose(rate - least, swivel * CLOSED.null_space_rate(q), atol=1e-9)


def test_joint_velocity_against_a_small_displacement() -> None:
    q, h = np.array([0.4, 0.7, 0.2, -1.4, 0.3, 0.9, 0.0]), 1e-6
    twist = np.array([0.1, -0.2, 0.05, 0.3, 0.1, -0.4])
    rate = joint_velocity(ROBOT, q, twist, 0.3)
    before, after = ROBOT.forward_kinematics(q - h * rate), ROBOT.forward_kinematics(q + h * rate)
    moved = np.concatenate([after.translation - before.translation, pin.log3(after.rotation @ before.rotation.T)]) / (
        2.0 * h
    )
    np.testing.assert_allclose(moved, twist, atol=1e-8)


def test_swivel_has_no_effect_on_six_joints() -> None:
    arm, q = six_joint_arm(), np.array([0.4, 0.7, -1.4, 0.3, 0.9, 0.0])
    np.testing.assert_array_equal(joint_velocity(arm, q, np.ones(6), 0.5), joint_velocity(arm, q, np.ones(6)))


def test_singular_posture_refuses_a_twist_that_it_cannot_produce() -> None:
    q = np.zeros(7)
    with pytest.raises(InvalidProblem, match="singular"):
        joint_velocity(ROBOT, q, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    turning = joint_velocity(ROBOT, q, [0.0, 0.0, 0.0, 0.0, 0.0, 0.2])
    assert np.abs(turning).max() < 0.2


def test_bad_input_is_refused() -> None:
    T = ROBOT.forward_kinematics(np.full(7, 0.3))
    with pytest.raises(InvalidProblem, match="7 finite joint angles"):
        NUMERICAL.nearest(T, np.zeros(6))
    with pytest.raises(InvalidProblem, match="not finite"):
        NUMERICAL.solutions(pin.SE3(np.eye(3), np.array([0.0, np.inf, 0.0])))
    with pytest.raises(InvalidProblem, match="six finite numbers"):
        joint_velocity(ROBOT, np.zeros(7), np.zeros(3))
