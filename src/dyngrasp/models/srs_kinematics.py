"""Inverse kinematics in closed form of an S-R-S arm within its joint limits.

`srs_chain` holds the geometry and states the conventions: what the arm angle ψ counts from, how the eight branches are
numbered, and what happens where joints line up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, ModelFileError, OutOfReach
from dyngrasp.models.srs_chain import BRANCHES, ElbowCircle, SrsChain, joint_vector
from dyngrasp.models.srs_search import (
    admissible_configurations,
    configurations_on,
    follow_configurations,
    nearest_configuration,
)
from dyngrasp.signals import Array, frozen, read_only

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from dyngrasp.models.limits import JointLimits
    from dyngrasp.models.robot import RobotModel

ARM_ANGLES = 72  # of a grid over the full turn
CHAIN_ROUNDING = 1e-9
"""Largest difference (m, rad) between the chain of a model file and the closed form: they must be the same arm."""


@dataclass(frozen=True, eq=False)
class SrsSolutions:
    """Configurations that reach one flange pose, all within the limits.

    Attributes:
        configurations: (k, 7) joint angles (rad).
        arm_angles: (k,) arm angle ψ of each (rad).
        branches: (k,) branch of each, 0 to 7.
    """

    configurations: Array
    arm_angles: Array
    branches: NDArray[np.int64]

    def __post_init__(self) -> None:
        for array in (self.configurations, self.arm_angles, self.branches):
            array.setflags(write=False)


@dataclass(frozen=True, eq=False)
class SrsKinematics:
    """Closed-form inverse kinematics of one S-R-S arm.

    Attributes:
        lengths: (4,) base to shoulder, shoulder to elbow, elbow to wrist, wrist to flange (m).
        limits: Limits of the seven joints. Of the angles that differ by full turns, the one nearest to the middle of
            the range is used, which loses nothing while ranges are at most one turn.

    Raises:
        InvalidProblem: Not four lengths with the middle two positive, or not seven joints.
    """

    lengths: Array
    limits: JointLimits

    def __post_init__(self) -> None:
        object.__setattr__(self, "lengths", self._chain.lengths)
        if len(self.limits) != 7:
            raise InvalidProblem(f"an S-R-S arm has 7 joints, got limits of {len(self.limits)}")

    @classmethod
    def from_robot(cls, robot: RobotModel) -> SrsKinematics:
        """The closed form of a robot whose model file says that it is an S-R-S arm.

        Raises:
            ModelFileError: The chain of the robot is not the one that the closed form is about.
        """
        expected = f'"general", or the four lengths of a chain about z, y, z, −y, z, y, z for {robot.name!r}'
        file = robot.mjcf_path or robot.urdf_path or robot.name
        if robot.srs is None or robot.n != 7:
            raise ModelFileError(file, "kinematics", robot.kinematics, expected)
        s = robot.srs
        lengths = (s.base_to_shoulder, s.shoulder_to_elbow, s.elbow_to_wrist, s.wrist_to_flange)
        arm = cls(read_only(lengths), robot.limits)
        # One generic posture tells the signs and the order of all axes apart, and every length from the others.
        q = np.array([0.3, 0.5, -0.7, 0.9, 1.1, -0.6, 0.4])
        difference = arm.forward_kinematics(q).actInv(robot.forward_kinematics(q))
        if np.abs(difference.homogeneous - np.eye(4)).max() > CHAIN_ROUNDING:
            raise ModelFileError(file, "kinematics", "srs", expected)
        return arm

    @cached_property
    def _chain(self) -> SrsChain:
        return SrsChain(self.lengths)

    @cached_property
    def _reach(self) -> tuple[float, float]:
        """Smallest and largest distance S–W (m) that the limits of joint 4 leave."""
        lower, upper = float(self.limits.position_lower[3]), float(self.limits.position_upper[3])
        least = 0.0 if lower <= 0.0 <= upper else min(abs(lower), abs(upper))
        most = min(max(abs(lower), abs(upper)), math.pi)
        return self._chain.reach(most), self._chain.reach(least)

    @cached_property
    def _middle(self) -> Array:
        # Bounded, so that a joint without limits has a middle too.
        full = 2.0 * math.pi
        lower, upper = self.limits.position_lower, self.limits.position_upper
        return 0.5 * (np.clip(lower, -full, full) + np.clip(upper, -full, full))

    @cached_property
    def arrays(self) -> tuple[Array, float, float, Array, Array, Array]:
        """What compiled code takes for the arm: lengths, least and largest distance S–W (m); middles and limits."""
        return self.lengths, *self._reach, self._middle, self.limits.position_lower, self.limits.position_upper

    def forward_kinematics(self, q: ArrayLike) -> pin.SE3:
        """T_world_flange at a configuration q (7,) (rad)."""
        return self._chain.forward_kinematics(q)

    def branch(self, q: ArrayLike) -> int:
        """Branch of a configuration q (7,), 0 to 7; a joint at exactly zero counts as positive."""
        return self._chain.branch(q)

    def arm_angle(self, q: ArrayLike) -> float:
        """Arm angle ψ (rad, in (−π, π]) of a configuration q (7,) (rad)."""
        return self._chain.arm_angle(q)

    def null_space_rate(self, q: ArrayLike) -> Array:
        """Joint rates dq/dψ (7,) that turn the elbow at 1 rad/s and hold the flange; see `SrsChain.null_space_rate`."""
        return self._chain.null_space_rate(q)

    def solve(self, T_world_flange: pin.SE3, arm_angle: float, branch: int) -> Array:
        """The configuration of one arm angle and one branch.

        Args:
            T_world_flange: Pose of the flange.
            arm_angle: ψ (rad).
            branch: 0 to 7.

        Returns:
            (7,) joint angles (rad), within the limits.

        Raises:
            OutOfReach: The wrist centre is too far or too near (`distance` says by how much), or a limit forbids this
                arm angle on this branch (`distance` 0).
            InvalidProblem: A pose or an arm angle that is not finite, or no such branch.
        """
        if branch not in range(BRANCHES):
            raise InvalidProblem(f"branch {branch}: an S-R-S arm has branches 0 to {BRANCHES - 1}")
        if not math.isfinite(arm_angle):
            raise InvalidProblem(f"arm angle {arm_angle}: a finite number expected")
        (q,), (within,) = self._configurations(self._circle(T_world_flange), np.array([arm_angle]), branch)
        if not within:
            lower, upper = self.limits.position_lower, self.limits.position_upper
            worst = int(np.argmax(np.maximum(lower - q, q - upper)))
            raise OutOfReach(
                "the flange pose",
                0.0,
                f"at arm angle {arm_angle:.6g} rad on branch {branch} joint {worst + 1} would stand at {q[worst]:.6g} "
                f"rad, outside [{lower[worst]:.6g}, {upper[worst]:.6g}]",
            )
        return q

    def follow(self, poses: Array, q_references: Array) -> tuple[Array, float]:
        """The configurations with the arm angles and the branches of other ones.

        Args:
            poses: (K, 3, 4) poses [R | p] of the flange.
            q_references: (K, 7) configurations (rad), one for each of them.

        Returns:
            Configurations (K, 7) within the limits (rad), NaN where there is none, and the largest turn of a joint from
            the references to them, NaN if one of them is.

        Raises:
            InvalidProblem: Other shapes.
        """
        if poses.shape[1:] != (3, 4) or q_references.shape != (len(poses), 7):
            raise InvalidProblem(
                f"poses (K, 3, 4) and configurations (K, 7) expected, got {poses.shape} and {q_references.shape}"
            )
        q = np.empty((len(poses), 7))
        return q, follow_configurations(poses, q_references, self.arrays, q)

    def scan(self, T_world_flange: pin.SE3, arm_angles: int | ArrayLike = ARM_ANGLES) -> SrsSolutions:
        """All configurations within the limits, over a grid of arm angles and all branches.

        Args:
            T_world_flange: Pose of the flange.
            arm_angles: How many arm angles, evenly spaced over the full turn with ψ = 0 among them, or the angles
                themselves (rad).

        Raises:
            OutOfReach: None exists on the grid.
            InvalidProblem: A pose that is not finite.
        """
        grid = _grid(arm_angles) if isinstance(arm_angles, int) else read_only(np.atleast_1d(arm_angles))
        circle, limits = self._circle(T_world_flange), self.limits
        found = admissible_configurations(
            circle.elbow, circle.rotations, grid, self._middle, limits.position_lower, limits.position_upper
        )  # fmt: skip
        if len(found[0]) == 0:
            raise self._forbidden(grid.size)
        return SrsSolutions(*found)

    def solutions(self, T_world_flange: pin.SE3, *, count: int = ARM_ANGLES) -> Array:
        """`scan(T_world_flange, count).configurations`: (k, 7), k ≥ 1; raises as `scan` does."""
        return self.scan(T_world_flange, count).configurations

    def admissible_arm_angles(
        self, T_world_flange: pin.SE3, branch: int, samples: int = 5 * ARM_ANGLES
    ) -> list[tuple[float, float]]:
        """Intervals of arm angles within the limits on one branch.

        Args:
            T_world_flange: Pose of the flange.
            branch: 0 to 7.
            samples: Grid on which the intervals are found; one narrower than 2π/samples can be missed.

        Returns:
            Intervals (from, to) in rad with −π ≤ from ≤ π and from < to; one that spans −π ends above π. Their ends are
            bisected to 1e-12 rad. Empty if there is none; [(−π, π)] if every arm angle is admissible.

        Raises:
            OutOfReach: The wrist centre is too far or too near.
            InvalidProblem: A pose that is not finite, or no such branch.
        """
        if branch not in range(BRANCHES):
            raise InvalidProblem(f"branch {branch}: an S-R-S arm has branches 0 to {BRANCHES - 1}")
        circle, grid = self._circle(T_world_flange), _grid(samples)

        def admissible(psi: Array) -> NDArray[np.bool_]:
            return self._configurations(circle, psi, branch)[1]

        inside = admissible(grid)
        if inside.all():
            return [(-math.pi, math.pi)]
        step = 2.0 * math.pi / samples
        edges = np.nonzero(inside != np.roll(inside, -1))[0]
        good, bad = grid[edges] + step * ~inside[edges], grid[edges] + step * inside[edges]
        while edges.size and np.abs(good - bad).max() > 1e-12:
            middle = 0.5 * (good + bad)
            keeps = admissible(middle)
            good, bad = np.where(keeps, middle, good), np.where(keeps, bad, middle)
        starts, ends = good[~inside[edges]], good[inside[edges]]
        if starts.size and ends[0] < starts[0]:
            ends = np.append(ends[1:], ends[0] + 2.0 * math.pi)
        return [(float(s), float(e)) for s, e in zip(starts, ends, strict=True)]

    def nearest(self, T_world_flange: pin.SE3, q_reference: ArrayLike) -> Array:
        """The admissible configuration nearest to a reference over all arm angles and branches.

        Nearest in Σ ((q − q_reference) / velocity limit)², the time scale of each joint; the minimum over a grid of arm
        angles is refined to 1e-9 rad in every local minimum of the grid that could still win.

        Args:
            T_world_flange: Pose of the flange.
            q_reference: (7,) rad.

        Returns:
            (7,) rad. It is q_reference itself, to rounding, if that reaches the pose.

        Raises:
            OutOfReach: No admissible configuration exists.
            InvalidProblem: A pose or a reference that is not finite.
        """
        q_reference = joint_vector(q_reference)
        if not np.isfinite(q_reference).all():
            raise InvalidProblem(f"q_reference: finite numbers expected, got {q_reference.tolist()}")
        circle, own = self._circle(T_world_flange), self.arm_angle(q_reference)
        weight, limits = 1.0 / np.asarray(self.limits.velocity), self.limits
        # Intervals narrower than the grid are rare; only where nothing else is left is the finer grid worth its time.
        for size in (ARM_ANGLES, 20 * ARM_ANGLES):
            q, cost = nearest_configuration(
                circle.elbow, circle.rotations, own + _grid(size), 2.0 * math.pi / size, q_reference, weight,
                self._middle, limits.position_lower, limits.position_upper,
            )  # fmt: skip
            if math.isfinite(cost):
                return q
        raise self._forbidden(20 * ARM_ANGLES)

    def _forbidden(self, count: int) -> OutOfReach:
        reason = f"the joint limits forbid every branch at all {count} arm angles tried"
        return OutOfReach("the flange pose", 0.0, reason)

    def _circle(self, T_world_flange: pin.SE3) -> ElbowCircle:
        return self._chain.circle(T_world_flange, *self._reach)

    def _configurations(self, circle: ElbowCircle, psi: Array, branch: int) -> tuple[Array, NDArray[np.bool_]]:
        """Configurations (m, 7) at arm angles (m,) on one branch, and whether each keeps the limits, (m,)."""
        limits = self.limits
        return configurations_on(
            branch, circle.elbow, circle.rotations, psi, self._middle, limits.position_lower, limits.position_upper
        )


@lru_cache(maxsize=8)
def _grid(count: int) -> Array:
    # Symmetric about zero with zero on it, so that a grid laid about an angle contains that angle exactly.
    return frozen(2.0 * math.pi * (np.arange(count) - count // 2) / count)
