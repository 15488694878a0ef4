"""Geometry of an S-R-S arm (spherical shoulder, revolute elbow, spherical wrist), joint limits aside.

Chain: seven joints about z, y, z, −y, z, y, z, all frames parallel to the base at q = 0, where the arm stands straight
up. The fourth axis points along −y: a positive elbow angle turns the forearm towards −x, the manufacturer's sign of the
KUKA LBR iiwa.

With shoulder S, elbow E and wrist W fixed at their distances, a flange pose leaves one freedom: E moves on a circle
about the line S–W.

**Arm angle ψ** (rad, in (−π, π]): the angle, right-handed about u = (W − S)/|W − S|, from the *reference direction* to
the direction from that line to E. The reference direction is the part of the base's z axis that is perpendicular to u:
at ψ = 0 the elbow lies in the vertical plane through S and W, above the line. Two fallbacks complete the definition:

- S–W parallel to the base's z axis (closer than `VERTICAL` rad): the reference direction is the base's x axis.
- Elbow straight (q4 = 0): E lies on the line, and the axis of joint 4 says where it would move for q4 → 0⁺.

ψ depends on q continuously except at the first case and where q4 changes sign: there E changes side and ψ jumps by π.

**Branches**: the same ψ is reached with each sign of q2, q4 and q6. Branch b = 1·[q2 < 0] + 2·[q4 < 0] + 4·[q6 < 0].

Where q2 (or q6) is 0 or π only the sum or the difference of its two neighbours matters; they then share it equally.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numba import njit

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.signals import Array, read_only

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

BRANCHES = 8
VERTICAL = 1e-9
"""Angle (rad) between S–W and the base's z axis below which the reference direction is x: rounding alone makes the
direction of the perpendicular part of z uncertain by 1e-16 / 1e-9 rad, still far below any use of ψ."""
ROUNDING = 1e-10
"""How far (m, rad) a pose or a joint may pass the edge of what is possible and still be put down to rounding. It is
then set on the edge, which moves the flange by about as much."""
STRAIGHT = 1e-7
"""Elbow angle (rad) below which it is taken as zero. The reach depends on it in second order only: this moves the
flange by 1e-15 m, whereas an angle that is rounding alone would give the joints beside it an arbitrary turn."""
ALIGNED = 1e-12
"""Length (m) and sine below which a direction is lost."""
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


@dataclass(frozen=True, eq=False)
class ElbowCircle:
    """The circle of the elbow that one flange pose leaves.

    Attributes:
        elbow: |q4| (rad).
        rotations: (3, 18), R03 and R47 row by row for q4 ≥ 0, as coefficients of (cos ψ, sin ψ, 1).
    """

    elbow: float
    rotations: Array


@dataclass(frozen=True, eq=False)
class SrsChain:
    """An S-R-S arm without joint limits.

    Attributes:
        lengths: (4,) base to shoulder, shoulder to elbow, elbow to wrist, wrist to flange (m).

    Raises:
        InvalidProblem: Not four finite lengths with the middle two positive.
    """

    lengths: Array

    def __post_init__(self) -> None:
        try:
            object.__setattr__(self, "lengths", read_only(self.lengths, (4,)))
        except ValueError as error:
            raise InvalidProblem(f"lengths of an S-R-S arm: {error}") from error
        if not (np.isfinite(self.lengths).all() and (self.lengths[1:3] > 0.0).all()):
            raise InvalidProblem(
                f"lengths of an S-R-S arm: finite, upper arm and forearm positive; got {self.lengths.tolist()}"
            )

    def forward_kinematics(self, q: ArrayLike) -> pin.SE3:
        """T_world_flange at a configuration q (7,) (rad)."""
        base, a, b, tool = self.lengths
        rotation, position = np.eye(3), np.array([0.0, 0.0, base])
        for angle, axis, length in zip(joint_vector(q), _AXES, (0.0, 0.0, a, 0.0, b, 0.0, tool), strict=True):
            rotation = rotation @ pin.AngleAxis(float(angle), axis).matrix()
            position = position + length * rotation[:, 2]
        return pin.SE3(rotation, position)

    def reach(self, elbow: float) -> float:
        """Distance S–W (m) at an elbow angle (rad)."""
        _, a, b, _ = self.lengths
        return math.sqrt(max(a * a + b * b + 2.0 * a * b * math.cos(elbow), 0.0))

    def branch(self, q: ArrayLike) -> int:
        """Branch of a configuration q (7,), 0 to 7; a joint at exactly zero counts as positive."""
        q = joint_vector(q)
        return int(q[1] < 0.0) + 2 * int(q[3] < 0.0) + 4 * int(q[5] < 0.0)

    def arm_angle(self, q: ArrayLike) -> float:
        """Arm angle ψ (rad, in (−π, π]) of a configuration q (7,) (rad); the module states the convention."""
        _, a, b, _ = self.lengths
        return arm_angle_of(joint_vector(q), a, b)

    def null_space_rate(self, q: ArrayLike) -> Array:
        """Joint rates dq/dψ (7,) that turn the elbow about S–W at 1 rad/s and keep the flange where it is.

        The rates grow without bound as q2 or q6 approaches 0 or π, where in general no finite rates turn the elbow.
        Closer than 1e-6 the rates are therefore scaled to length one: J · rate = 0 holds everywhere, unit arm-angle
        rate does not hold there. Where the elbow turns all the same (the straight arm), the unit rate is kept.
        """
        q, rate = joint_vector(q), np.empty(7)
        if not write_null_space_rate(q, self.lengths, rate):
            raise InvalidProblem("the wrist centre lies on the shoulder centre: there is no arm angle")
        return rate

    def circle(self, T_world_flange: pin.SE3, nearest: float, farthest: float) -> ElbowCircle:
        """The circle of the elbow for a flange pose.

        Args:
            T_world_flange: Pose of the flange.
            nearest: Smallest distance S–W (m) that the elbow allows.
            farthest: Largest distance S–W (m) that the elbow allows.

        Raises:
            OutOfReach: The distance is outside these by more than rounding; `distance` says how far.
            InvalidProblem: A pose that is not finite.
        """
        R, p = T_world_flange.rotation, T_world_flange.translation
        elbow, rotations, L = circle_at(R, p, self.lengths, nearest, farthest)
        excess = max(L - farthest, nearest - L)
        if not math.isfinite(L):
            raise InvalidProblem("the flange pose holds a number that is not finite")
        if excess > ROUNDING or L < ALIGNED:
            how = "farther than the arm reaches" if farthest < L else "nearer than the elbow can fold"
            where = f"the wrist centre would be {L:.6g} m from the shoulder, {max(excess, 0.0):.3g} m {how}"
            raise OutOfReach("the flange pose", max(excess, 0.0), where)
        return ElbowCircle(elbow, rotations)


def joint_vector(q: ArrayLike) -> Array:
    """A configuration (7,) as floats; InvalidProblem if the shape is another."""
    q = np.asarray(q, dtype=float)
    if q.shape != (7,):
        raise InvalidProblem(f"a configuration of an S-R-S arm has shape (7,), got {q.shape}")
    return q


# From here on three numbers are a tuple and no array, and nothing is assigned to slices: both become much machine code,
# which a replanning cycle, where it runs but once or twice, has to wait for.


@njit(cache=True, error_model="numpy")
def _shoulder_to_wrist(q, a, b):
    """Unit vector u from S to W and the y axis of the upper arm (opposite to joint 4's axis), both in the base."""
    c1, c2, c3, s1, s2, s3 = np.cos(q[0]), np.cos(q[1]), np.cos(q[2]), np.sin(q[0]), np.sin(q[1]), np.sin(q[2])
    along_x, along_z = -b * np.sin(q[3]), a + b * np.cos(q[3])
    u = (
        along_x * (c1 * c2 * c3 - s1 * s3) + along_z * (c1 * s2),
        along_x * (s1 * c2 * c3 + c1 * s3) + along_z * (s1 * s2),
        along_x * (-s2 * c3) + along_z * c2,
    )
    L = max(np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]), ALIGNED)
    return (u[0] / L, u[1] / L, u[2] / L), (-c1 * c2 * s3 - s1 * c3, -s1 * c2 * s3 + c1 * c3, s2 * s3)


@njit(cache=True, error_model="numpy")
def arm_angle_of(q, a, b):
    """`SrsChain.arm_angle` for the lengths a and b of upper arm and forearm (m)."""
    u, y = _shoulder_to_wrist(q, a, b)
    # Joint 4's axis instead of the elbow's offset from S–W: it keeps its direction where the offset vanishes.
    h = (y[1] * u[2] - y[2] * u[1], y[2] * u[0] - y[0] * u[2], y[0] * u[1] - y[1] * u[0])
    side = -1.0 if q[3] < 0.0 else 1.0
    e, g = _reference_directions(u)
    along_e, along_g = h[0] * e[0] + h[1] * e[1] + h[2] * e[2], h[0] * g[0] + h[1] * g[1] + h[2] * g[2]
    return np.arctan2(side * along_g, side * along_e)


@njit(cache=True, error_model="numpy")
def _reference_directions(u):
    """Reference direction e of the arm angle for S–W along u, and g = u × e."""
    level = np.hypot(u[0], u[1])
    if level < VERTICAL:
        # To first order in the tilt of u: exact in double precision below VERTICAL.
        return (1.0, 0.0, -u[0] * u[2]), (0.0, u[2], -u[1])
    cx, cy = u[0] / level, u[1] / level
    return (-u[2] * cx, -u[2] * cy, level), (cy, -cx, 0.0)


@njit(cache=True, error_model="numpy")
def circle_at(R, p, lengths, nearest, farthest):
    """`ElbowCircle.elbow` and `.rotations` for a flange pose with S–W brought into its bounds, and S–W as it is."""
    base, a, b, tool = lengths[0], lengths[1], lengths[2], lengths[3]
    wx, wy, wz = p[0] - tool * R[0, 2], p[1] - tool * R[1, 2], p[2] - tool * R[2, 2] - base
    true_L = np.sqrt(wx * wx + wy * wy + wz * wz)
    u = (wx / true_L, wy / true_L, wz / true_L)
    L = min(max(true_L, nearest), farthest)
    # The half-angle form keeps its precision near the straight and the folded elbow; acos loses half the digits.
    elbow = 2.0 * np.arctan2(
        np.sqrt(max((a + b - L) * (a + b + L), 0.0)), np.sqrt(max((L - abs(a - b)) * (L + abs(a - b)), 0.0))
    )
    if elbow < STRAIGHT:
        elbow = 0.0
    s4, c4 = np.sin(elbow), np.cos(elbow)
    sin_alpha, cos_alpha = b * s4 / L, (a + b * c4) / L
    e, g = _reference_directions(u)
    # Elbow direction h = cos ψ e + sin ψ g; columns of R03 for q4 ≥ 0: x = cos α h − sin α u, y = u × h,
    # z = cos α u + sin α h, with α the angle at the shoulder between S–W and the upper arm.
    rotations = np.zeros((3, 18))
    for i in range(3):
        rotations[0, 3 * i], rotations[0, 3 * i + 1], rotations[0, 3 * i + 2] = cos_alpha * e[i], g[i], sin_alpha * e[i]
        rotations[1, 3 * i], rotations[1, 3 * i + 1], rotations[1, 3 * i + 2] = (
            cos_alpha * g[i],
            -e[i],
            sin_alpha * g[i],
        )
        rotations[2, 3 * i], rotations[2, 3 * i + 2] = -sin_alpha * u[i], cos_alpha * u[i]
    # R47 = (R03 R34)ᵀ R, where R34 turns by the elbow angle about −y.
    for k in range(3):
        for i in range(3):
            x, y, z = rotations[k, 3 * i], rotations[k, 3 * i + 1], rotations[k, 3 * i + 2]
            for j in range(3):
                rotations[k, 9 + j] += (c4 * x + s4 * z) * R[i, j]
                rotations[k, 12 + j] += y * R[i, j]
                rotations[k, 15 + j] += (c4 * z - s4 * x) * R[i, j]
    return elbow, rotations, true_L


@njit(cache=True, error_model="numpy")
def angles_at(elbow, rotations, psi, angles):
    """Write the joint angles (7,) at an arm angle on branch 0; returns whether shoulder and wrist are aligned.

    `elbow` and `rotations` are those of the `ElbowCircle`.
    """
    c, s = np.cos(psi), np.sin(psi)
    angles[3] = elbow
    return _zyz_angles(rotations, 0, c, s, angles, 0), _zyz_angles(rotations, 9, c, s, angles, 4)


@njit(cache=True, error_model="numpy", inline="always")
def put_on_branch(angles, aligned, branch, q):
    """Write the joint angles (7,) (rad, whole turns arbitrary) of one branch, given the outcome of `angles_at`."""
    shoulder, wrist = aligned
    for i in range(7):
        q[i] = angles[i] * _SIGNS[branch, i] + _TURNS[branch, i]
    if shoulder:
        _share_turn(q, 0, angles[1])
    if wrist:
        _share_turn(q, 4, angles[5])


@njit(cache=True, error_model="numpy")
def _zyz_angles(rotations, j, c, s, angles, first):
    """Write the three angles of R = Rz Ry Rz from `first` on, the middle one in [0, π]; whether that is 0 or π.

    R is c and s times two rows of `rotations` and once the third, row by row from column j on. Where the middle angle
    is 0 or π, the first one is zero and the third takes all of the turn.
    """
    xx = c * rotations[0, j] + s * rotations[1, j] + rotations[2, j]
    xy = c * rotations[0, j + 1] + s * rotations[1, j + 1] + rotations[2, j + 1]
    xz = c * rotations[0, j + 2] + s * rotations[1, j + 2] + rotations[2, j + 2]
    yx = c * rotations[0, j + 3] + s * rotations[1, j + 3] + rotations[2, j + 3]
    yy = c * rotations[0, j + 4] + s * rotations[1, j + 4] + rotations[2, j + 4]
    yz = c * rotations[0, j + 5] + s * rotations[1, j + 5] + rotations[2, j + 5]
    zz = c * rotations[0, j + 8] + s * rotations[1, j + 8] + rotations[2, j + 8]
    tilt = np.hypot(xz, yz)
    aligned = tilt < ALIGNED
    # cos and sin of the first angle. From the upper two rows instead of the last one, which vanishes with the tilt.
    cosine, sine = (1.0, 0.0) if aligned else (xz / tilt, yz / tilt)
    angles[first] = 0.0 if aligned else np.arctan2(yz, xz)
    angles[first + 1] = np.arctan2(tilt, zz)
    angles[first + 2] = np.arctan2(cosine * yx - sine * xx, cosine * yy - sine * xy)
    return aligned


@njit(cache=True, error_model="numpy")
def _share_turn(q, first, middle):
    """Let the neighbours of an aligned joint share their turn equally, in place; at 0 they add up, at π subtract."""
    sign = -1.0 if middle > 0.5 * np.pi else 1.0
    turn = q[first + 2] + sign * q[first]
    turn -= 2.0 * np.pi * np.rint(turn / (2.0 * np.pi))
    q[first], q[first + 2] = 0.5 * sign * turn, 0.5 * turn


@njit(cache=True, error_model="numpy")
def write_null_space_rate(q, lengths, rate):
    """Write `SrsChain.null_space_rate`; whether there is an arm angle at all."""
    a, b = lengths[1], lengths[2]
    L = np.sqrt(max(a * a + b * b + 2.0 * a * b * np.cos(q[3]), 0.0))
    if L < ALIGNED:
        return False
    u, _ = _shoulder_to_wrist(q, a, b)
    shoulder = _write_euler_rates(q[0], q[1], u, rate, 0)
    seen_from_wrist = (-a * np.sin(q[3]) / L, 0.0, -(b + a * np.cos(q[3])) / L)
    wrist = _write_euler_rates(q[4], q[5], seen_from_wrist, rate, 4)
    rate[3] = 0.0
    if shoulder == 1.0 and wrist == 1.0:
        return True
    by_wrist, size = wrist if shoulder != 0.0 or wrist != 0.0 else 1.0, 0.0
    for i in range(7):
        rate[i] *= by_wrist if i < 3 else shoulder
        size += rate[i] * rate[i]
    for i in range(7):
        rate[i] /= np.sqrt(size)
    return True


@njit(cache=True, error_model="numpy")
def _write_euler_rates(first, middle, omega, rate, at):
    """Write k · rates (3,) of Rz(first) Ry(middle) Rz(third) for angular velocity omega from `at` on; returns k.

    k ≤ 1 keeps them finite.
    """
    c, s = np.cos(first), np.sin(first)
    along, across = c * omega[0] + s * omega[1], -s * omega[0] + c * omega[1]
    sine, cosine = np.sin(middle), np.cos(middle)
    if abs(sine) > _NEARLY_ALIGNED:
        third, k = along / sine, 1.0
    elif abs(along) <= ROUNDING:
        third, k = 0.0, 1.0
    else:
        third, k = along, sine
    rate[at], rate[at + 1], rate[at + 2] = k * omega[2] - cosine * third, k * across, third
    return k
