"""Joint limits of an arm, and the procedure that bounds its Coriolis and centrifugal torques."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Array, read_only

if TYPE_CHECKING:
    from dyngrasp.models.robot import RobotModel

MARGIN = 1.05  # local ascent from finitely many samples may miss the highest peak by a little
ASCENTS = 64  # starts for each joint; with 24, one seed in three missed a highest peak of the iiwa 14 by 0.2 %


@dataclass(frozen=True)
class JointLimits:
    """Limits of n joints; every array has shape (n,).

    Attributes:
        position_lower: Smallest position (rad).
        position_upper: Largest position (rad).
        velocity: Largest |q̇| (rad/s).
        torque: Largest |τ| (Nm).
        acceleration: Largest |q̈| (rad/s²), +inf where only the torque limits it; one number stands for all joints.
        coriolis: Bounds c on |C(q, q̇) q̇| (Nm) by which torque rows that leave this term out are tightened.

    Raises:
        InvalidProblem: Shapes differ, limits are reversed, or a bound is not positive (`coriolis`: negative).
    """

    position_lower: Array
    position_upper: Array
    velocity: Array
    torque: Array
    acceleration: Array = field(default_factory=lambda: np.array(np.inf))
    coriolis: Array = field(default_factory=lambda: np.array(0.0))

    def __post_init__(self) -> None:
        n = np.size(self.position_lower)
        for name in ("acceleration", "coriolis"):
            if np.ndim(getattr(self, name)) == 0:
                object.__setattr__(self, name, np.full(n, getattr(self, name)))
        for name in ("position_lower", "position_upper", "velocity", "torque", "acceleration", "coriolis"):
            try:
                object.__setattr__(self, name, read_only(getattr(self, name), (n,)))
            except ValueError as error:
                raise InvalidProblem(f"limits: {name}: {error}") from error
        if not (self.position_lower < self.position_upper).all():
            raise InvalidProblem("limits: every lower position must be below its upper one")
        for name in ("velocity", "torque", "acceleration"):
            if not (getattr(self, name) > 0).all():
                raise InvalidProblem(f"limits: {name} must be > 0, got {getattr(self, name)}")
        if not (self.coriolis >= 0).all():
            raise InvalidProblem(f"limits: coriolis must be ≥ 0, got {self.coriolis}")

    def __len__(self) -> int:
        return self.velocity.size


def coriolis_bounds(robot: RobotModel, samples: int = 20_000, seed: int = 0, velocity_fraction: float = 1.0) -> Array:
    """Bounds c on |C(q, q̇) q̇| over all postures and speeds within limits, for the torque rows below eq. (3).

    Samples postures uniformly within the position limits. C(q, q̇) q̇ is quadratic in q̇, so its extremes over the box of
    speeds lie on the boundary, mostly at corners: half of the samples take a random corner, half a random interior
    speed. From the best samples of each joint and sign a projected quasi-Newton ascent (L-BFGS-B with analytical
    derivatives) climbs to a local maximum within the same box. The largest value found is widened by 5 % and rounded up
    to 0.01 Nm.

    It is a wide bound: the worst posture with every joint at full speed. For the iiwa 14 with hand and part it takes 9
    to 28 % of the torque limits (A7: 1 %). It is kept all the same: it holds for every motion within limits, and the
    joint it costs most, A6, needs 7 of the 29 Nm that remain to hold the load anywhere. It grows with the square of the
    speeds: a planner that keeps to a fraction f of the velocity limits may use f² times the bound, which
    `velocity_fraction` computes.

    Args:
        robot: The arm with everything that it carries as its payload.
        samples: Number of random states, ≥ 1.
        seed: Of the random generator; the same seed gives the same bounds.
        velocity_fraction: Part of the velocity limits that is used, in (0, 1].

    Returns:
        (n,) bounds in Nm.
    """
    if samples < 1 or not 0 < velocity_fraction <= 1:
        raise InvalidProblem(
            f"samples must be ≥ 1 and the velocity fraction in (0, 1], got {samples}, {velocity_fraction}"
        )
    random = np.random.default_rng(seed)
    n, limits = robot.n, robot.limits
    speed = velocity_fraction * limits.velocity
    lower = np.concatenate([limits.position_lower, -speed])
    upper = np.concatenate([limits.position_upper, speed])

    states = random.uniform(lower, upper, (samples, 2 * n))
    corners = slice(0, (samples + 1) // 2)
    states[corners, n:] = np.copysign(speed, states[corners, n:])
    torques = np.array([robot.bias_torque(x[:n], x[n:]) for x in states])

    model = pin.Model(robot.loaded_model)
    model.gravity.linear = np.zeros(3)
    data, rest = model.createData(), np.zeros(n)

    # Angles and speeds have like magnitudes here, but dividing by the half-widths makes the box a cube for every arm.
    half = (upper - lower) / 2
    middle = (upper + lower) / 2

    def climb(joint: int, sign: float, start: Array) -> float:
        def descend(y: Array) -> tuple[float, Array]:
            x = middle + half * y
            pin.computeRNEADerivatives(model, data, x[:n], x[n:], rest)
            slope = np.concatenate([data.dtau_dq[joint], data.dtau_dv[joint]])
            return -sign * data.tau[joint], -sign * slope * half

        found = minimize(descend, (start - middle) / half, jac=True, method="L-BFGS-B", bounds=[(-1.0, 1.0)] * (2 * n))
        return -float(found.fun)

    bounds = np.zeros(n)
    for joint in range(n):
        for sign in (1.0, -1.0):
            best = np.argsort(-sign * torques[:, joint])[: ASCENTS // 2]
            bounds[joint] = max(bounds[joint], *(climb(joint, sign, states[i]) for i in best))
    return read_only(np.ceil(MARGIN * bounds * 100) / 100)
