"""From a flange pose to joint angles, and from a flange twist to joint rates, for any arm.

Arms of the S-R-S kind have a closed form (`srs_kinematics`), every other chain is solved numerically
(`damped_least_squares`). Both answer through the same `InverseKinematics`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin
from numba import njit

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.damped_least_squares import RATE_CUTOFF, DampedLeastSquares, finite_joint_angles
from dyngrasp.models.srs_kinematics import SrsKinematics
from dyngrasp.signals import Array

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from dyngrasp.models.robot import RobotModel

TWIST_TOLERANCE = 1e-8
"""Largest part of a twist (relative to its size) that joint rates may fail to produce: far above rounding, far below
what a motion could show."""


class InverseKinematics(Protocol):
    """What inverse kinematics of an n-joint arm answers."""

    def solutions(self, T_world_flange: pin.SE3, *, count: int = ...) -> Array:
        """Admissible configurations, (k, n) with k ≥ 1.

        Args:
            T_world_flange: Pose of the flange.
            count: How many arm angles (closed form) or starts (numerical) to try.

        Raises:
            OutOfReach: There is none.
        """
        ...

    def nearest(self, T_world_flange: pin.SE3, q_reference: ArrayLike) -> Array:
        """The admissible configuration (n,) near a reference (n,), in Σ ((q − q_reference) / velocity limit)².

        Raises:
            OutOfReach: There is none.
        """
        ...

    def null_space_rate(self, q: ArrayLike) -> Array:
        """Joint rates (n,) that keep the flange where it is; zeros if the arm has no joint to spare."""
        ...


def inverse_kinematics_for(robot: RobotModel) -> InverseKinematics:
    """The closed form if the robot's model file says "srs", damped least squares otherwise.

    Raises:
        ModelFileError: The file says "srs" but the chain is another.
    """
    return SrsKinematics.from_robot(robot) if robot.kinematics == "srs" else DampedLeastSquares(robot)


def joint_velocity(robot: RobotModel, q: ArrayLike, twist_world: ArrayLike, swivel_rate: float = 0.0) -> Array:
    """Joint rates that move the flange with a twist: those of least norm, plus a motion of the elbow.

    Args:
        robot: The arm.
        q: (n,) joint angles (rad).
        twist_world: (6,) velocity of the flange origin (m/s), then angular velocity (rad/s), world axes.
        swivel_rate: Multiple of `InverseKinematics.null_space_rate` to add: for an S-R-S arm the rate of the arm angle
            (rad/s) in excess of what the twist itself asks for. Without effect on an arm that has no joint to spare.

    Returns:
        (n,) rad/s; velocity limits are not looked at.

    Raises:
        InvalidProblem: Shapes differ, or the arm is in a singular posture that cannot produce the twist.
    """
    q, twist = finite_joint_angles(robot, q), np.asarray(twist_world, dtype=float)
    if twist.shape != (6,) or not np.isfinite(twist).all() or not math.isfinite(swivel_rate):
        raise InvalidProblem(f"six finite numbers of a twist and a finite swivel rate expected: {twist}, {swivel_rate}")
    rate, missing = robot.flange_chain.least_rates(q, twist) or _least_squares_rates(robot.jacobian(q), twist)
    if missing > TWIST_TOLERANCE * max(1.0, math.hypot(*twist)):
        raise InvalidProblem(
            f"{robot.name} is singular at q = {q.round(4).tolist()}: it cannot move with the twist "
            f"{twist.round(4).tolist()}, {missing:.3g} of it would be missing"
        )
    if swivel_rate == 0.0:
        return rate
    return rate + swivel_rate * inverse_kinematics_for(robot).null_space_rate(q)


def _least_squares_rates(J: Array, twist: Array) -> tuple[Array, float]:
    """Rates of least norm among those that miss least of a twist, and by how much they miss it."""
    rate: Array = np.linalg.lstsq(J, twist, rcond=RATE_CUTOFF)[0].astype(float)
    return rate, float(np.linalg.norm(J @ rate - twist))


def null_space_velocity(rate: Array, towards: Array, limit: Array, least_rate: float, least_ratio: float) -> Array:
    """A multiple (n,) of a null-space rate (n,) (rad/s): turned towards a direction (n,) and fast enough to show.

    Args:
        rate: See `InverseKinematics.null_space_rate`; the answer is zero if it is.
        towards: Direction whose product with the answer is not negative.
        limit: Speed limits (rad/s).
        least_rate: Least multiple.
        least_ratio: Least max-norm of the answer over the limits.
    """
    velocity = np.empty(rate.size)
    write_null_space_velocity(rate, towards, limit, least_rate, least_ratio, velocity)
    return velocity


@njit(cache=True, error_model="numpy")
def write_null_space_velocity(rate, towards, limit, least_rate, least_ratio, velocity):
    """Write `null_space_velocity` (n,), which may take the place of the rate."""
    ratio, along = 0.0, 0.0
    for i in range(rate.size):
        ratio = max(ratio, abs(rate[i]) / limit[i])
        along += rate[i] * towards[i]
    factor = 0.0 if ratio == 0.0 else max(least_rate, least_ratio / ratio)
    for i in range(rate.size):
        velocity[i] = (factor if along >= 0.0 else -factor) * rate[i]
