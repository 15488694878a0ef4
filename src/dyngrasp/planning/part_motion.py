"""Where the part is until it is taken, for compiled code."""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.signals import Array

PartMotion = tuple[Array, Array, Array, float]


def part_motion(targets: GraspTargets) -> PartMotion:
    """First argument of `part_poses`, for the part that is to be grasped; `GraspTargets` says the same of one time.

    Returns:
        Rotation (3, 3) and position (3,) (m) at and after the time of arrival, in the world; velocity of the origin
        (m/s) and angular velocity (rad/s) before, (6,) in world axes; the time of arrival (s), which a part at rest has
        none of.
    """
    T = targets.T_world_object
    return np.ascontiguousarray(T.rotation), np.array(T.translation), targets.twist_world, float(targets.grasp_time)


@njit(cache=True, error_model="numpy")
def part_poses(motion, times, R, p):
    """Poses at some times of a part that keeps its velocities until it is taken.

    Args:
        motion: Of `part_motion`.
        times: (M,) s.
        R: (3, 3, ≥ M) in which the rotations are written,
        p: (3, ≥ M) and the positions (m).
    """
    rotation, position, twist, arrival = motion
    x, y, z = twist[3], twist[4], twist[5]
    rate = np.sqrt(x * x + y * y + z * z)
    if rate > 0.0:
        x, y, z = x / rate, y / rate, z / rate
    if rate == 0.0 and twist[0] == 0.0 and twist[1] == 0.0 and twist[2] == 0.0:
        for a in range(3):
            for s in range(times.size):
                p[a, s] = position[a]
            for b in range(3):
                for s in range(times.size):
                    R[a, b, s] = rotation[a, b]
        return
    for s in range(times.size):
        before = min(times[s] - arrival, 0.0)
        c, d = np.sin(rate * before), 2.0 * np.sin(rate * before / 2.0) ** 2
        for a in range(3):
            p[a, s] = position[a] + before * twist[a]
            u, v, w = rotation[0, a], rotation[1, a], rotation[2, a]
            # Rodrigues: u + sin φ axis × u + (1 − cos φ) axis × (axis × u).
            e, f, g = y * w - z * v, z * u - x * w, x * v - y * u
            R[0, a, s] = u + c * e + d * (y * g - z * f)
            R[1, a, s] = v + c * f + d * (z * e - x * g)
            R[2, a, s] = w + c * g + d * (x * f - y * e)
