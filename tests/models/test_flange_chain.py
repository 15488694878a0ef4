"""The compiled chain against Pinocchio, its least rates against numpy's least squares."""

import numpy as np
import pytest

from dyngrasp.models.catalogue import load_robot
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
