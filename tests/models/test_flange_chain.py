"""The compiled chain against Pinocchio, its least rates against numpy's least squares."""

import itertools

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models.catalogue import load_robot
from dyngrasp.models.flange_chain import FlangeChain
from dyngrasp.models.robot import RobotModel

RNG = np.random.default_rng(3)


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return load_robot("iiwa14")


def postures(robot: RobotModel, count: int) -> np.ndarray:
    return RNG.uniform(robot.limits.position_lower, robot.limits.position_upper, (count, robot.n))


def test_the_flange_is_where_pinocchio_puts_it(robot):
    for q in postures(robot, 50):
        difference = robot.flange_chain.pose(q).homogeneous - robot.forward_kinematics(q).homogeneous
        assert np.abs(difference).max() < 1e-14  # seven products of rotations


def test_rates_are_those_of_least_squares(robot):
    for q in postures(robot, 200):
        J, twist = robot.jacobian(q), RNG.normal(size=6)
        answer = robot.flange_chain.least_rates(q, twist)
        expected = np.linalg.lstsq(J, twist, rcond=None)[0]
        assert answer is not None
        # Rounding grows with the condition of the Jacobian, in both.
        tolerance = 1e-14 * np.linalg.cond(J) * np.abs(expected).max()
        assert np.abs(answer[0] - expected).max() < tolerance
        assert answer[1] == pytest.approx(np.linalg.norm(J @ answer[0] - twist), abs=1e-14 * np.linalg.cond(J))


def test_no_answer_where_a_direction_is_lost(robot):
    straight = np.zeros(robot.n)
    assert robot.flange_chain.least_rates(straight, np.ones(6)) is None
    assert robot.flange_chain.least_rates(np.full(robot.n, np.nan), np.ones(6)) is None


def test_newton_steps_lead_to_a_pose_nearby(robot):
    for q in postures(robot, 50):
        if np.linalg.svd(robot.jacobian(q), compute_uv=False)[-1] < 0.1:
            continue
        target = robot.forward_kinematics(q + RNG.normal(scale=0.05, size=robot.n))
        errors = [
            np.linalg.norm(pin.log6(target.actInv(robot.flange_chain.pose(reached))).vector)
            for reached in (robot.flange_chain.moved_to(target, q, steps, 1e-9) for steps in range(4))
        ]
        # The error of a Newton step is of second order in the error before it, here with a factor of ten at most.
        assert all(after < 10 * before**2 + 1e-9 for before, after in itertools.pairwise(errors)), errors


def test_one_step_is_the_damped_least_squares_of_a_pose_error(robot):
    for q in postures(robot, 20):
        here, target = robot.forward_kinematics(q), pin.SE3.Random()
        J = robot.jacobian(q)
        twist = np.concatenate([target.translation - here.translation, pin.log3(target.rotation @ here.rotation.T)])
        step = J.T @ np.linalg.solve(J @ J.T + 0.01 * np.eye(6), twist)
        # The logarithm loses digits towards half a turn; the condition of the matrix is a few hundred.
        np.testing.assert_allclose(robot.flange_chain.moved_to(target, q, 1, 0.01), q + step, atol=1e-9)


def test_newton_steps_from_a_singular_posture_are_finite(robot):
    straight = np.zeros(robot.n)
    assert np.isfinite(robot.flange_chain.moved_to(pin.SE3.Identity(), straight, 3, 1e-6)).all()
    np.testing.assert_array_equal(straight, 0.0)


def test_dexterity_is_the_least_singular_value(robot):
    for q in postures(robot, 100):
        least = np.linalg.svd(robot.jacobian(q), compute_uv=False)[-1]
        assert robot.flange_chain.is_dexterous(q, least * (1 - 1e-6))
        assert not robot.flange_chain.is_dexterous(q, least * (1 + 1e-6))
    assert not robot.flange_chain.is_dexterous(np.full(robot.n, np.nan), 0.0)


def test_dexterity_of_fewer_joints_than_six_is_that_of_the_directions_they_have(robot):
    chain = FlangeChain(robot.flange_chain.rotations[-5:], robot.flange_chain.offsets[-5:])
    q, J = np.array([0.3, 0.8, -0.5, 0.4]), np.empty((6, 4))
    for i in range(4):
        step = np.zeros(4)
        step[i] = 1e-6
        after, before = chain.pose(q + step), chain.pose(q - step)
        J[:3, i] = (after.translation - before.translation) / 2e-6
        J[3:, i] = pin.log3(after.rotation @ before.rotation.T) / 2e-6
    least = np.linalg.svd(J, compute_uv=False)[-1]
    # Central differences of this step are good to nine digits or so.
    assert chain.is_dexterous(q, least * (1 - 1e-6))
    assert not chain.is_dexterous(q, least * (1 + 1e-6))
