"""Inverse kinematics of any serial arm, numerically: a descent from some posture with the limits kept at every step."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.signals import Array

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from dyngrasp.models.robot import RobotModel

RATE_CUTOFF = 1e-9  # singular values of the Jacobian below this share of the largest count as directions it has lost


@dataclass(frozen=True)
class DampedLeastSquaresSettings:
    """Settings of `DampedLeastSquares`.

    Attributes:
        tolerance: Largest error of the position (m) and of the orientation (rad) of a solution.
        iterations: Steps of one attempt.
        restarts: Attempts from random postures when no other start leads to the pose.
        seed: Of the random postures; equal seeds give equal answers.
        distinct: Largest joint difference (rad) up to which two solutions are the same one.
        reference_steps: Steps along the null space towards a reference posture.
    """

    tolerance: float = 1e-10
    iterations: int = 100
    restarts: int = 40
    seed: int = 0
    distinct: float = 1e-3
    reference_steps: int = 60


@dataclass(frozen=True, eq=False)
class DampedLeastSquares:
    """Inverse kinematics of any serial arm by the Levenberg–Marquardt method.

    The damping follows the squared error (Sugihara 2011, doi:10.1109/TRO.2011.2148230), so that convergence is
    quadratic near a solution and steps stay bounded near a singularity. Joints that a step would push through a limit
    stay on it, and the step is solved again for the others.

    Attributes:
        robot: The arm.
        settings: Tolerances and effort.
    """

    robot: RobotModel
    settings: DampedLeastSquaresSettings = field(default_factory=DampedLeastSquaresSettings)

    def solutions(self, T_world_flange: pin.SE3, *, count: int | None = None) -> Array:
        """The distinct configurations (k, n) that attempts from `count` seeded random postures lead to.

        For six joints these are isolated points and soon all of them; for more joints a sample of a continuum.

        Raises:
            OutOfReach: No attempt reached the pose; `distance` is the position error of the best.
            InvalidProblem: A pose that is not finite.
        """
        found: list[Array] = []
        for q in self._attempts(T_world_flange, count or self.settings.restarts):
            if all(np.abs(q - other).max() > self.settings.distinct for other in found):
                found.append(q)
        return np.array(found)

    def nearest(self, T_world_flange: pin.SE3, q_reference: ArrayLike) -> Array:
        """The configuration (n,) that the arm reaches from a reference posture with the least detour.

        Starts at q_reference; with joints to spare it then moves along the null space to a local minimum of
        Σ ((q − q_reference) / velocity limit)². Only if that start fails are random postures tried, and the nearest of
        what they lead to is returned.

        Raises:
            OutOfReach: No attempt reached the pose; `distance` is the position error of the best.
            InvalidProblem: A pose or a reference that is not finite, or a wrong number of joints.
        """
        q_reference = finite_joint_angles(self.robot, q_reference)
        _require_finite(T_world_flange)
        q, reached, _ = self._converge(T_world_flange, self._within(q_reference))
        if reached:
            return self._approach(T_world_flange, q, q_reference)
        starts = self._attempts(T_world_flange, self.settings.restarts)
        candidates = [self._approach(T_world_flange, start, q_reference) for start in starts]
        return min(candidates, key=lambda candidate: self._cost(candidate, q_reference))

    def null_space_rate(self, q: ArrayLike) -> Array:
        """Unit vector (7,) of the null space of J, for seven joints; zeros (n,) for fewer.

        Its sign makes det [J; rateᵀ] > 0, which a motion can change only at a singular posture.

        Raises:
            InvalidProblem: More than seven joints: their null space is not a line.
        """
        q = finite_joint_angles(self.robot, q)
        if self.robot.n < 7:
            return np.zeros(self.robot.n)
        if self.robot.n > 7:
            raise InvalidProblem(
                f"{self.robot.name} has {self.robot.n} joints: its null space is not a line; use a swivel rate of 0"
            )
        J = self.robot.jacobian(q)
        rate = np.linalg.svd(J)[2][-1]
        return rate if np.linalg.det(np.vstack([J, rate])) >= 0.0 else -rate

    def _attempts(self, T: pin.SE3, count: int) -> list[Array]:
        _require_finite(T)
        random = np.random.default_rng(self.settings.seed)
        limits = self.robot.limits
        found: list[Array] = []
        best = np.full(6, np.inf)
        for _ in range(count):
            q, reached, error = self._converge(T, random.uniform(limits.position_lower, limits.position_upper))
            if reached:
                found.append(q)
            elif error @ error < best @ best:
                best = error
        if not found:
            distance, angle = float(np.linalg.norm(best[:3])), float(np.linalg.norm(best[3:]))
            raise OutOfReach(
                "the flange pose",
                distance,
                f"the best of {count} attempts within the joint limits ended {distance:.3g} m and {angle:.3g} rad away",
            )
        return found

    def _within(self, q: Array) -> Array:
        return np.clip(q, self.robot.limits.position_lower, self.robot.limits.position_upper)

    def _cost(self, q: Array, q_reference: Array) -> float:
        return float((((q - q_reference) / self.robot.limits.velocity) ** 2).sum())

    def _error(self, T: pin.SE3, q: Array) -> Array:
        """What twist (m, rad; world axes) within unit time would bring the flange to T."""
        now = self.robot.forward_kinematics(q)
        return np.concatenate([T.translation - now.translation, pin.log3(T.rotation @ now.rotation.T)])

    def _converge(self, T: pin.SE3, q: Array) -> tuple[Array, bool, Array]:
        """Descend from q; the configuration at the end, whether it reaches T, and the error that is left."""
        error = self._error(T, q)
        squared = float(error @ error)
        gain, stalled = 0.1, 0
        for _ in range(self.settings.iterations):
            if np.abs(error).max() <= 0.5 * self.settings.tolerance:
                break
            J = self.robot.jacobian(q)
            damping = gain * squared + 1e-15
            trial = self._within(q + self._limited(q, lambda free, J=J, d=damping, e=error: _damped(J[:, free], e, d)))
            new_error = self._error(T, trial)
            new_squared = float(new_error @ new_error)
            if new_squared < squared:
                # A minimum away from the pose is approached ever more slowly, a solution at least by halving.
                stalled = stalled + 1 if new_squared > 0.995 * squared else 0
                q, error, squared, gain = trial, new_error, new_squared, max(0.2 * gain, 1e-6)
            else:
                gain *= 8.0
            if stalled >= 4 or gain > 1e8:
                break
        reached = max(np.linalg.norm(error[:3]), np.linalg.norm(error[3:])) <= self.settings.tolerance
        return q, bool(reached), error

    def _limited(self, q: Array, step_of: StepOfFreeJoints) -> Array:
        """A step in which no joint on a limit moves outward: such joints are held and the others solved anew."""
        limits = self.robot.limits
        free = np.ones(q.size, dtype=bool)
        while True:
            step = np.zeros(q.size)
            step[free] = step_of(free)
            outward = ((q >= limits.position_upper) & (step > 0.0)) | ((q <= limits.position_lower) & (step < 0.0))
            if not outward.any():
                return step
            free &= ~outward

    def _approach(self, T: pin.SE3, q: Array, q_reference: Array) -> Array:
        """Move along the null space to a local minimum of the distance from the reference."""
        if self.robot.n <= 6:
            return q
        cost, length = self._cost(q, q_reference), 1.0
        for _ in range(self.settings.reference_steps):
            J, here = self.robot.jacobian(q), q
            step = self._limited(q, lambda free, J=J, q=here: self._towards(J, q, q_reference, free))
            size = float(np.abs(step).max())
            if size < 1e-9:
                break
            # Half a radian keeps the flange near enough to the pose for the correction to come back to it.
            scale = min(length, 0.5 / size)
            trial, reached, _ = self._converge(T, self._within(q + scale * step))
            trial_cost = self._cost(trial, q_reference)
            if reached and trial_cost < cost:
                gained = cost - trial_cost
                q, cost, length = trial, trial_cost, min(1.0, 2.0 * length)
                if gained < 1e-14 * max(cost, 1e-6):
                    break
            else:
                length *= 0.5
                if length < 1e-6:
                    break
        return q

    def _towards(self, J: Array, q: Array, q_reference: Array, free: NDArray[np.bool_]) -> Array:
        speed = self.robot.limits.velocity[free]
        J_scaled = J[:, free] * speed
        wish = (q_reference - q)[free] / speed
        along_task = np.linalg.lstsq(J_scaled, J_scaled @ wish, rcond=RATE_CUTOFF)[0]
        return speed * (wish - along_task)


class StepOfFreeJoints(Protocol):
    """A step of those joints that are free."""

    def __call__(self, free: NDArray[np.bool_]) -> Array:
        """Step (count of free,) for a mask (n,)."""
        ...


def _damped(J: Array, error: Array, damping: float) -> Array:
    if J.shape[1] == 0:
        return np.zeros(0)
    return J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)


def _require_finite(T: pin.SE3) -> None:
    if not np.isfinite(T.homogeneous).all():
        raise InvalidProblem("the flange pose holds a number that is not finite")


def finite_joint_angles(robot: RobotModel, q: ArrayLike) -> Array:
    """A configuration (n,) as floats.

    Raises:
        InvalidProblem: Another shape, or a number that is not finite.
    """
    q = np.asarray(q, dtype=float)
    if q.shape != (robot.n,) or not np.isfinite(q).all():
        raise InvalidProblem(f"{robot.n} finite joint angles of {robot.name} expected, got {q}")
    return q
