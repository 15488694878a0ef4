"""Inverse kinematics in closed form of an S-R-S arm: spherical shoulder, revolute elbow, spherical wrist.

Chain: seven joints about z, y, z, −y, z, y, z, all frames parallel to the base at q = 0, where the arm stands straight
up. The fourth axis points along −y: a positive elbow angle turns the forearm towards −x, the manufacturer's sign of the
KUKA LBR iiwa.

With shoulder S, elbow E and wrist W fixed at their distances, a flange pose leaves one freedom: E moves on a circle
about the line S–W.

**Arm angle ψ** (rad, in (−π, π]): the angle, right-handed about u = (W − S)/|W − S|, from the *reference direction* to the
direction from that line to E. The reference direction is the part of the base's z axis that is perpendicular to u: at
ψ = 0 the elbow lies in the vertical plane through S and W, above the line. Two fallbacks complete the definition:

- S–W parallel to the base's z axis (closer than `VERTICAL` rad): the reference direction is the base's x axis.
- Elbow straight (q4 = 0): E lies on the line, and the axis of joint 4 says where it would move for q4 → 0⁺.

ψ depends on q continuously except at the first case and where q4 changes sign: there E changes side and ψ jumps by π.

**Branches**: the same ψ is reached with each sign of q2, q4 and q6. Branch b = 1·[q2 < 0] + 2·[q4 < 0] + 4·[q6 < 0].

Where q2 (or q6) is 0 or π only the sum or the difference of its two neighbours matters; they then share it equally.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, ModelFileError, OutOfReach
from dyngrasp.signals import Array, read_only

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from dyngrasp.models.limits import JointLimits
    from dyngrasp.models.robot import RobotModel

__all__ = ["BRANCHES", "SrsKinematics", "SrsSolutions"]

BRANCHES = 8
ARM_ANGLES = 72
VERTICAL = 1e-9
"""Angle (rad) between S–W and the base's z axis below which the reference direction is x: rounding alone makes the
direction of the perpendicular part of z uncertain by 1e-16 / 1e-9 rad, still far below any use of ψ."""
LIMIT_ROUNDING = 1e-10
"""How far (rad, m) a result may pass a limit by rounding; it is then set on the limit, which moves the flange less than
1e-10 m per metre of arm."""
STRAIGHT = 1e-7
"""Elbow angle (rad) below which it is taken as zero. The reach depends on it in second order only: this moves the flange
by 1e-15 m, whereas an angle that is rounding alone would give the joints beside it an arbitrary turn."""
CHAIN_ROUNDING = 1e-9
"""Largest difference (m, rad) between the chain of a model file and the closed form: they must be the same arm."""
_ALIGNED = 1e-12
_NEARLY_ALIGNED = 1e-6

_, _Y, _Z = np.eye(3)
_AXES = (_Z, _Y, _Z, -_Y, _Z, _Y, _Z)
_BITS = (np.arange(BRANCHES)[:, None] >> np.arange(3)) & 1
_SIGNS = np.ones((BRANCHES, 7))
_SIGNS[:, [1, 3, 5]] = 1.0 - 2.0 * _BITS
# Rz(α) Ry(β) Rz(γ) = Rz(α+π) Ry(−β) Rz(γ+π): a changed sign of q2, q4 or q6 costs a half turn of both neighbours.
_TURNS = np.zeros((BRANCHES, 7))
_TURNS[:, 0], _TURNS[:, 2] = _BITS[:, 0], _BITS[:, 0] + _BITS[:, 1]
_TURNS[:, 4], _TURNS[:, 6] = _BITS[:, 1] + _BITS[:, 2], _BITS[:, 2]
_TURNS *= math.pi


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class _Pose:
    """What one flange pose fixes: the elbow angle, and rotations R03 and R47 that are linear in (cos ψ, sin ψ, 1)."""

    elbow: float
    rotations: Array  # (3, 18): R03 and R47, each row-major


@dataclass(frozen=True)
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
        try:
            object.__setattr__(self, "lengths", read_only(self.lengths, (4,)))
        except ValueError as error:
            raise InvalidProblem(f"lengths of an S-R-S arm: {error}") from error
        if not (np.isfinite(self.lengths).all() and (self.lengths[1:3] > 0.0).all()):
            raise InvalidProblem(
                f"lengths of an S-R-S arm: finite, upper arm and forearm positive; got {self.lengths.tolist()}"
            )
        if np.size(self.limits.position_lower) != 7:
            raise InvalidProblem(f"an S-R-S arm has 7 joints, got limits of {np.size(self.limits.position_lower)}")

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

    def forward_kinematics(self, q: ArrayLike) -> pin.SE3:
        """T_world_flange at a configuration q (7,) (rad)."""
        base, a, b, tool = self.lengths
        rotation, position = np.eye(3), np.array([0.0, 0.0, base])
        for angle, axis, length in zip(_joint_vector(q), _AXES, (0.0, 0.0, a, 0.0, b, 0.0, tool), strict=True):
            rotation = rotation @ pin.AngleAxis(float(angle), axis).matrix()
            position = position + length * rotation[:, 2]
        return pin.SE3(rotation, position)

    @cached_property
    def _reach(self) -> tuple[float, float]:
        """Smallest and largest distance S–W (m) that the limits of joint 4 leave."""
        _, a, b, _ = self.lengths
        lower, upper = float(self.limits.position_lower[3]), float(self.limits.position_upper[3])
        least = 0.0 if lower <= 0.0 <= upper else min(abs(lower), abs(upper))
        most = min(max(abs(lower), abs(upper)), math.pi)
        return tuple(math.sqrt(max(a * a + b * b + 2.0 * a * b * math.cos(q), 0.0)) for q in (most, least))  # type: ignore[return-value]

    def branch(self, q: ArrayLike) -> int:
        """Branch of a configuration q (7,), 0 to 7; a joint at exactly zero counts as positive."""
        q = _joint_vector(q)
        return int(q[1] < 0.0) + 2 * int(q[3] < 0.0) + 4 * int(q[5] < 0.0)

    def arm_angle(self, q: ArrayLike) -> float:
        """Arm angle ψ (rad, in (−π, π]) of a configuration q (7,) (rad); the module states the convention."""
        q = _joint_vector(q)
        u, elbow_axis = self._shoulder_to_wrist(q)
        # Joint 4's axis instead of the elbow's offset from S–W: it keeps its direction where the offset vanishes.
        h = np.cross(u, elbow_axis) if q[3] < 0.0 else np.cross(elbow_axis, u)
        e, g = _reference_directions(*u)
        return math.atan2(h @ g, h @ e)

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
        q, within = self._configurations(self._pose(T_world_flange), np.array([arm_angle]), branch)
        q = q[0]
        if not within[0]:
            lower, upper = self.limits.position_lower, self.limits.position_upper
            worst = int(np.argmax(np.maximum(lower - q, q - upper)))
            raise OutOfReach(
                "the flange pose",
                0.0,
                f"at arm angle {arm_angle:.6g} rad on branch {branch} joint {worst + 1} would stand at {q[worst]:.6g} rad,"
                f" outside [{lower[worst]:.6g}, {upper[worst]:.6g}]",
            )
        return q

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
        grid = _grid(arm_angles) if isinstance(arm_angles, int) else np.atleast_1d(np.asarray(arm_angles, dtype=float))
        q, within = self._configurations(self._pose(T_world_flange), grid)
        at, branches = np.nonzero(within)
        if at.size == 0:
            raise self._forbidden(grid.size)
        return SrsSolutions(q[at, branches], grid[at], branches)

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
        pose, grid = self._pose(T_world_flange), _grid(samples)
        inside = self._configurations(pose, grid, branch)[1]
        if inside.all():
            return [(-math.pi, math.pi)]
        step = 2.0 * math.pi / samples
        edges = np.nonzero(inside != np.roll(inside, -1))[0]
        good, bad = grid[edges] + step * ~inside[edges], grid[edges] + step * inside[edges]
        while edges.size and np.abs(good - bad).max() > 1e-12:
            middle = 0.5 * (good + bad)
            keeps = self._configurations(pose, middle, branch)[1]
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
        q_reference = _joint_vector(q_reference)
        if not np.isfinite(q_reference).all():
            raise InvalidProblem(f"q_reference: finite numbers expected, got {q_reference.tolist()}")
        pose = self._pose(T_world_flange)
        weight = 1.0 / np.asarray(self.limits.velocity)

        def evaluate(psi: Array, branches: NDArray[np.int64] | None = None) -> tuple[Array, Array]:
            q, within = self._configurations(pose, psi, branches)
            return q, np.where(within, (((q - q_reference) * weight) ** 2).sum(axis=-1), np.inf)

        own = self.arm_angle(q_reference)
        # Intervals narrower than the grid are rare; only where nothing else is left is the finer grid worth its time.
        for size in (ARM_ANGLES, 20 * ARM_ANGLES):
            grid, step = own + _grid(size), 2.0 * math.pi / size
            q, cost = evaluate(grid)
            if np.isfinite(cost).any():
                break
        else:
            raise self._forbidden(20 * ARM_ANGLES)
        minima = (cost <= np.roll(cost, 1, axis=0)) & (cost <= np.roll(cost, -1, axis=0)) & np.isfinite(cost)
        at, branch = np.nonzero(minima)
        first = np.argsort(cost[at, branch], kind="stable")[:4]
        at, branch = at[first], branch[first]
        rows = np.arange(at.size)
        psi, best_q, best = grid[at], q[at, branch], cost[at, branch]
        offsets = np.linspace(-1.0, 1.0, 17)
        while step > 1e-9:
            trial = psi[:, None] + step * offsets
            q, cost = evaluate(trial.ravel(), np.repeat(branch, offsets.size))
            q, cost = q.reshape(*trial.shape, 7), cost.reshape(trial.shape)
            pick = cost.argmin(axis=1)
            better = cost[rows, pick] < best
            psi = np.where(better, trial[rows, pick], psi)
            best_q = np.where(better[:, None], q[rows, pick], best_q)
            best = np.where(better, cost[rows, pick], best)
            step /= 6.0  # wider than the spacing of 1/8: noise near the minimum cannot push it out of the next window
        return best_q[best.argmin()]

    def null_space_rate(self, q: ArrayLike) -> Array:
        """Joint rates dq/dψ (7,) that turn the elbow about S–W at 1 rad/s and keep the flange where it is.

        The rates grow without bound as q2 or q6 approaches 0 or π, where in general no finite rates turn the elbow.
        Closer than 1e-6 the rates are therefore scaled to length one: J · rate = 0 holds everywhere, unit arm-angle rate
        does not hold there. Where the elbow turns all the same (the straight arm), the unit rate is kept.
        """
        q = _joint_vector(q)
        _, a, b, _ = self.lengths
        u, _ = self._shoulder_to_wrist(q)
        shoulder, k_s = _euler_rates(q[0], q[1], u)
        L = math.sqrt(a * a + b * b + 2.0 * a * b * math.cos(q[3]))
        if L < _ALIGNED:
            raise InvalidProblem("the wrist centre lies on the shoulder centre: there is no arm angle")
        wrist, k_w = _euler_rates(q[4], q[5], np.array([-a * math.sin(q[3]), 0.0, -(b + a * math.cos(q[3]))]) / L)
        rate = np.concatenate([k_w * shoulder, [0.0], k_s * wrist])
        if k_s == 1.0 and k_w == 1.0:
            return rate
        if k_s == 0.0 and k_w == 0.0:
            rate[:3] = shoulder
        return rate / np.linalg.norm(rate)

    def _forbidden(self, count: int) -> OutOfReach:
        reason = f"the joint limits forbid every branch at all {count} arm angles tried"
        return OutOfReach("the flange pose", 0.0, reason)

    def _shoulder_to_wrist(self, q: Array) -> tuple[Array, Array]:
        """Unit vector u from S to W and the y axis of the upper arm (opposite to joint 4's axis), both in the base."""
        _, a, b, _ = self.lengths
        (c1, c2, c3), (s1, s2, s3) = np.cos(q[:3]), np.sin(q[:3])
        x3 = np.array([c1 * c2 * c3 - s1 * s3, s1 * c2 * c3 + c1 * s3, -s2 * c3])
        y3 = np.array([-c1 * c2 * s3 - s1 * c3, -s1 * c2 * s3 + c1 * c3, s2 * s3])
        z3 = np.array([c1 * s2, s1 * s2, c2])
        w = -b * math.sin(q[3]) * x3 + (a + b * math.cos(q[3])) * z3
        return w / max(float(np.linalg.norm(w)), _ALIGNED), y3

    def _pose(self, T_world_flange: pin.SE3) -> _Pose:
        R, p = T_world_flange.rotation, T_world_flange.translation
        if not (np.isfinite(R).all() and np.isfinite(p).all()):
            raise InvalidProblem("the flange pose holds a number that is not finite")
        base, a, b, tool = self.lengths
        wx, wy, wz = (float(v) for v in p - tool * R[:, 2])
        wz -= base
        L = math.sqrt(wx * wx + wy * wy + wz * wz)
        nearest, farthest = self._reach
        if farthest + LIMIT_ROUNDING < L:
            raise OutOfReach(
                "the flange pose",
                L - farthest,
                f"the wrist centre would be {L:.6g} m from the shoulder, {L - farthest:.3g} m farther than the arm reaches",
            )
        if nearest - LIMIT_ROUNDING > L or L < _ALIGNED:
            raise OutOfReach(
                "the flange pose",
                max(nearest - L, 0.0),
                f"the wrist centre would be {L:.6g} m from the shoulder, {max(nearest - L, 0.0):.3g} m nearer than the"
                " elbow can fold",
            )
        u = np.array([wx / L, wy / L, wz / L])
        L = min(max(L, nearest), farthest)
        # The half-angle form keeps its precision near the straight and the folded elbow, where acos loses half the digits.
        elbow = 2.0 * math.atan2(
            math.sqrt(max((a + b - L) * (a + b + L), 0.0)), math.sqrt(max((L - abs(a - b)) * (L + abs(a - b)), 0.0))
        )
        if elbow < STRAIGHT:
            elbow = 0.0
        s4, c4 = math.sin(elbow), math.cos(elbow)
        sin_alpha, cos_alpha = b * s4 / L, (a + b * c4) / L
        e, g = _reference_directions(*u)
        # Elbow direction h = cos ψ e + sin ψ g; columns of R03 for q4 ≥ 0: x = cos α h − sin α u, y = u × h,
        # z = cos α u + sin α h, with α the angle at the shoulder between S–W and the upper arm.
        R03 = np.zeros((3, 3, 3))
        for k, (h, u_cross_h) in enumerate(((e, g), (g, -e))):
            R03[k, :, 0], R03[k, :, 1], R03[k, :, 2] = cos_alpha * h, u_cross_h, sin_alpha * h
        R03[2, :, 0], R03[2, :, 2] = -sin_alpha * u, cos_alpha * u
        R34 = np.array([[c4, 0.0, -s4], [0.0, 1.0, 0.0], [s4, 0.0, c4]])
        R47 = np.swapaxes(R03 @ R34, 1, 2) @ R
        return _Pose(elbow, np.concatenate([R03.reshape(3, 9), R47.reshape(3, 9)], axis=1))

    def _configurations(
        self, pose: _Pose, psi: Array, branches: int | NDArray[np.int64] | None = None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Configurations at arm angles psi (m,) and whether each keeps the limits.

        (m, 7) and (m,) on the given branch of each arm angle, or (m, 8, 7) and (m, 8) on all branches.
        """
        m = psi.size
        weights = np.empty((m, 3))
        weights[:, 0], weights[:, 1], weights[:, 2] = np.cos(psi), np.sin(psi), 1.0
        rotations = (weights @ pose.rotations).reshape(m, 2, 9)
        angles, aligned = _zyz_angles(rotations)  # shoulder and wrist at once
        first = np.empty((m, 7))
        first[:, :3], first[:, 3], first[:, 4:] = angles[:, 0], pose.elbow, angles[:, 1]
        lower, upper = np.asarray(self.limits.position_lower), np.asarray(self.limits.position_upper)
        middle = np.clip(0.5 * (lower + upper), -math.pi, math.pi)
        if branches is None:
            q = first[:, None] * _SIGNS + _TURNS
        else:
            q = first * _SIGNS[branches] + _TURNS[branches]
        if aligned.any():
            _share_turns(q, angles, aligned)
        q -= 2.0 * math.pi * np.rint((q - middle) / (2.0 * math.pi))
        clipped = np.clip(q, lower, upper)
        within = (np.abs(q - clipped) <= LIMIT_ROUNDING).all(axis=-1)
        return np.where(within[..., None], clipped, q), within


def _joint_vector(q: ArrayLike) -> Array:
    q = np.asarray(q, dtype=float)
    if q.shape != (7,):
        raise InvalidProblem(f"a configuration of an S-R-S arm has shape (7,), got {q.shape}")
    return q


def _grid(count: int) -> Array:
    # Symmetric about zero with zero on it, so that a grid laid about an angle contains that angle exactly.
    return 2.0 * math.pi * (np.arange(count) - count // 2) / count


def _reference_directions(ux: float, uy: float, uz: float) -> tuple[Array, Array]:
    """Reference direction e of the arm angle for S–W along u, and g = u × e."""
    level = math.hypot(ux, uy)
    if level < VERTICAL:
        # To first order in the tilt of u: exact in double precision below VERTICAL.
        return np.array([1.0, 0.0, -ux * uz]), np.array([0.0, uz, -uy])
    cx, cy = ux / level, uy / level
    return np.array([-uz * cx, -uz * cy, level]), np.array([cy, -cx, 0.0])


def _zyz_angles(R: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Angles (..., 3) of R = Rz Ry Rz, the middle one in [0, π], and where it is 0 or π; R (..., 9) row-major.

    There the first angle is zero and the third takes all of the turn.
    """
    tilt = np.hypot(R[..., 2], R[..., 5])
    aligned = tilt < _ALIGNED
    first = np.where(aligned, 0.0, np.arctan2(R[..., 5], R[..., 2]))
    c, s = np.cos(first), np.sin(first)
    # From the upper two rows instead of the last one, which vanishes with the tilt.
    third = np.arctan2(c * R[..., 3] - s * R[..., 0], c * R[..., 4] - s * R[..., 1])
    return np.stack([first, np.arctan2(tilt, R[..., 8]), third], axis=-1), aligned


def _share_turns(q: Array, angles: Array, aligned: NDArray[np.bool_]) -> None:
    """Let the neighbours of an aligned joint share their turn equally, in place; q (m, 7) or (m, 8, 7)."""
    for part, (first, third) in enumerate(((0, 2), (4, 6))):
        rows = np.nonzero(aligned[:, part])[0]
        # At 0 the two neighbours add up, at π they subtract.
        sign = np.where(angles[rows, part, 1] > 0.5 * math.pi, -1.0, 1.0).reshape(-1, *[1] * (q.ndim - 2))
        turn = q[rows, ..., third] + sign * q[rows, ..., first]
        turn -= 2.0 * math.pi * np.rint(turn / (2.0 * math.pi))
        q[rows, ..., first], q[rows, ..., third] = 0.5 * sign * turn, 0.5 * turn


def _euler_rates(first: float, middle: float, omega: Array) -> tuple[Array, float]:
    """Rates (3,) of Rz(first) Ry(middle) Rz(third) for angular velocity omega, times a factor k ≤ 1 that keeps them finite."""
    c, s = math.cos(first), math.sin(first)
    along, across = c * omega[0] + s * omega[1], -s * omega[0] + c * omega[1]
    sine, cosine = math.sin(middle), math.cos(middle)
    if abs(sine) > _NEARLY_ALIGNED:
        third, k = along / sine, 1.0
    elif abs(along) <= LIMIT_ROUNDING:
        third, k = 0.0, 1.0
    else:
        third, k = along, sine
    return np.array([k * omega[2] - cosine * third, k * across, third]), k
