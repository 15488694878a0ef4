"""One posture at a time, compiled: where the flange of a serial chain is, and the joint rates that move it.

`batch_dynamics` is for many postures at once. Here is what a replanning cycle asks for a dozen times, each time of one
posture: its kernels can be called from other compiled code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from numba import njit

from dyngrasp.models.batch_dynamics import BatchModel
from dyngrasp.signals import Array, read_only

# Pivots of the Jacobian's rows below this share of the largest: too near to a singular posture for normal arithmetic.
_SINGULAR = 1e-6


@dataclass(frozen=True, eq=False)
class FlangeChain:
    """A chain of n revolute joints and a flange.

    Attributes:
        rotations, offsets: (n+1, 3, 3), (n+1, 3) frame of each joint in that of the joint before it, where all stand at
            zero; every frame is turned so that its joint turns about z. The last one is the flange's.
    """

    rotations: Array
    offsets: Array

    @classmethod
    def from_pinocchio(cls, model: pin.Model, T_last_flange: pin.SE3) -> FlangeChain:
        """Read a chain whose joints are all revolute.

        Args:
            model: The chain.
            T_last_flange: The flange in the frame of the last joint.
        """
        tree = BatchModel.from_pinocchio(model)
        flange = tree.attach([(model.njoints - 1, T_last_flange)])
        return cls(
            read_only(np.concatenate([tree.rotations, flange.rotations])),
            read_only(np.concatenate([tree.offsets, flange.positions])),
        )

    def pose(self, q: Array) -> pin.SE3:
        """T_world_flange at q (n,) (rad)."""
        frames = np.empty((len(self.offsets), 3, 4))
        place_frames(self.rotations, self.offsets, q, frames)
        return pin.SE3(frames[-1, :, :3], frames[-1, :, 3])

    def least_rates(self, q: Array, twist_world: Array) -> tuple[Array, float] | None:
        """Joint rates (n,) of least norm for a twist (6,) of the flange, and the norm of what they miss of it.

        None with fewer than six joints, or near a singular posture: least squares are for another method then.
        """
        rates = np.empty(q.size)
        missing = least_rates(self.rotations, self.offsets, q, twist_world, rates) if q.size >= 6 else -1.0
        return (rates, missing) if missing >= 0.0 else None

    def is_dexterous(self, q: Array, least: float) -> bool:
        """Whether all min(6, n) singular values of the Jacobian at q (n,) are at least so large (translation in m)."""
        return is_dexterous(self.rotations, self.offsets, q, least)

    def moved_to(self, T_world_flange: pin.SE3, q: Array, steps: int, damping: float) -> Array:
        """The configuration (n,) that Newton steps of least length lead to from q (n,), towards a pose of the flange.

        Args:
            T_world_flange: The pose.
            q: Where to begin (rad).
            steps: How many.
            damping: Added to the squares of the Jacobian, so that a singular posture gives a finite step.
        """
        reached = np.array(q)
        R, p = T_world_flange.rotation, T_world_flange.translation
        _move_to(self.rotations, self.offsets, R, p, steps, damping, reached)
        return reached


@njit(cache=True, error_model="numpy")
def place_frames(rotations, offsets, q, frames):
    """Write the frames [R | p] (n+1, 3, 4) of all joints and of the flange in the world, at q (n,) (rad)."""
    for i in range(offsets.shape[0]):
        # Element by element: a slice that is assigned to becomes ten times the machine code.
        for a in range(3):
            if i == 0:
                frames[0, a, 3] = offsets[0, a]
                for b in range(3):
                    frames[0, a, b] = rotations[0, a, b]
            else:
                x, y, z = frames[i - 1, a, 0], frames[i - 1, a, 1], frames[i - 1, a, 2]
                frames[i, a, 3] = frames[i - 1, a, 3] + x * offsets[i, 0] + y * offsets[i, 1] + z * offsets[i, 2]
                for b in range(3):
                    frames[i, a, b] = x * rotations[i, 0, b] + y * rotations[i, 1, b] + z * rotations[i, 2, b]
        if i < q.size:
            c, s = np.cos(q[i]), np.sin(q[i])
            for a in range(3):
                x, y = frames[i, a, 0], frames[i, a, 1]
                frames[i, a, 0], frames[i, a, 1] = c * x + s * y, c * y - s * x


@njit(cache=True, error_model="numpy")
def _jacobian(frames, J):
    """Write the Jacobian (6, n) of the flange, linear rows before angular ones in world axes, from the frames."""
    n = J.shape[1]
    for i in range(n):
        ax, ay, az = frames[i, 0, 2], frames[i, 1, 2], frames[i, 2, 2]
        rx, ry, rz = (
            frames[n, 0, 3] - frames[i, 0, 3],
            frames[n, 1, 3] - frames[i, 1, 3],
            frames[n, 2, 3] - frames[i, 2, 3],
        )
        J[0, i], J[1, i], J[2, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx
        J[3, i], J[4, i], J[5, i] = ax, ay, az


@njit(cache=True, error_model="numpy")
def _factor(J, shift, L):
    """Write the Cholesky factor L (m, m) of J Jᵀ + shift; whether that is positive definite."""
    for i in range(len(J)):
        for j in range(i + 1):
            rest = shift if i == j else 0.0
            for k in range(J.shape[1]):
                rest += J[i, k] * J[j, k]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = rest / L[j, j]
            elif rest > 0.0:
                L[i, i] = np.sqrt(rest)
            else:
                return False
    return True


@njit(cache=True, error_model="numpy")
def is_dexterous(rotations, offsets, q, least):
    """`FlangeChain.is_dexterous`: no square of a singular value is less than that of the least."""
    frames, J = np.empty((q.size + 1, 3, 4)), np.empty((6, q.size))
    place_frames(rotations, offsets, q, frames)
    _jacobian(frames, J)
    rows = J if q.size >= 6 else J.T.copy()
    return _factor(rows, -(least**2), np.empty((len(rows), len(rows))))


@njit(cache=True, error_model="numpy")
def _move_to(rotations, offsets, R, p, steps, damping, q):
    """`FlangeChain.moved_to` in place."""
    frames, J, L, y = np.empty((q.size + 1, 3, 4)), np.empty((6, q.size)), np.empty((6, 6)), np.empty(6)
    for _ in range(steps):
        place_frames(rotations, offsets, q, frames)
        _jacobian(frames, J)
        now = frames[-1]
        for i in range(3):
            y[i] = p[i] - now[i, 3]
            # The axis of the turn R nowᵀ that is left, times the sine of its angle.
            before, after = (i + 2) % 3, (i + 1) % 3
            y[3 + i] = 0.0
            for k in range(3):
                y[3 + i] += (R[before, k] * now[after, k] - R[after, k] * now[before, k]) / 2
        sine, trace = np.sqrt((y[3:] ** 2).sum()), (R * now[:, :3]).sum()
        if sine > 0.0:
            y[3:] *= np.arctan2(sine, (trace - 1.0) / 2) / sine
        if not _factor(J, damping, L):
            break
        for i in range(6):
            for k in range(i):
                y[i] -= L[i, k] * y[k]
            y[i] /= L[i, i]
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                y[i] -= L[k, i] * y[k]
            y[i] /= L[i, i]
        for i in range(6):
            q += y[i] * J[i]


@njit(cache=True, error_model="numpy")
def least_rates(rotations, offsets, q, twist, rates):
    """`FlangeChain.least_rates`; −1 instead of what is missing where it does not answer.

    With J = L Q, Q's six rows orthonormal, the rates are Qᵀ L⁻¹ twist.
    """
    n = q.size
    frames, J = np.empty((n + 1, 3, 4)), np.empty((6, n))
    place_frames(rotations, offsets, q, frames)
    _jacobian(frames, J)
    Q, L, y = J.copy(), np.zeros((6, 6)), np.empty(6)
    largest = 0.0
    for row in range(6):
        # Twice is enough: the second time takes away what rounding left in the first.
        for _ in range(2):
            for other in range(row):
                along = 0.0
                for i in range(n):
                    along += Q[row, i] * Q[other, i]
                L[row, other] += along
                for i in range(n):
                    Q[row, i] -= along * Q[other, i]
        size = 0.0
        for i in range(n):
            size += Q[row, i] ** 2
        L[row, row] = np.sqrt(size)
        largest = max(largest, L[row, row])
        if not L[row, row] > _SINGULAR * largest:
            return -1.0
        y[row] = twist[row]
        for i in range(n):
            Q[row, i] /= L[row, row]
        for other in range(row):
            y[row] -= L[row, other] * y[other]
        y[row] /= L[row, row]
    for i in range(n):
        rates[i] = 0.0
        for row in range(6):
            rates[i] += Q[row, i] * y[row]
    missing = 0.0
    for row in range(6):
        rest = -twist[row]
        for i in range(n):
            rest += J[row, i] * rates[i]
        missing += rest * rest
    return np.sqrt(missing)
