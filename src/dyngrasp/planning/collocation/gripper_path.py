"""The hand's motion between two postures at rest: least effort, on the clock of the arm.

Σ|v|² has one minimiser between two states at rest, the same for every joint but for its travel and the same for every
duration but for the scale of time. So the path in normalised time is known before the phase is solved, which is what
lets the arm's constraints follow G(q_h(s)), and the hand's limits become one lower bound on the duration.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dyngrasp.planning.collocation.closed_form import rest_to_rest
from dyngrasp.signals import Array, frozen, read_only
from dyngrasp.trajectory import Trajectory


@dataclass(frozen=True)
class GripperPath:
    """A motion in normalised time s = t/T on N+1 grid points; every array has shape (N+1, m).

    Attributes:
        position: q_h (rad).
        rate: dq_h/ds (rad), zero at both ends.
        curvature: d²q_h/ds² (rad).
    """

    position: Array
    rate: Array
    curvature: Array

    def __post_init__(self) -> None:
        for name in ("position", "rate", "curvature"):
            object.__setattr__(self, name, read_only(getattr(self, name), (-1, -1)))

    def shortest_duration(self, velocity: ArrayLike, acceleration: ArrayLike) -> float:
        """The least duration within the limits on |q̇_h| (rad/s) and |q̈_h| (rad/s²), each (m,) (s)."""
        by_velocity = np.abs(self.rate) / np.asarray(velocity, dtype=float)
        by_acceleration = np.abs(self.curvature) / np.asarray(acceleration, dtype=float)
        return float(max(by_velocity.max(), np.sqrt(by_acceleration.max())))

    def over(self, duration: float) -> Trajectory:
        """The motion in real time; satisfies the trapezoidal rule."""
        return Trajectory(duration, self.position, frozen(self.rate / duration), frozen(self.curvature / duration**2))


def gripper_path(start: ArrayLike, end: ArrayLike, intervals: int) -> GripperPath:
    """The motion of least Σ|q̈_h|² between two postures at rest.

    Args:
        start: (m,) posture at s = 0 (rad).
        end: (m,) posture at s = 1 (rad).
        intervals: N ≥ 2.
    """
    start, end = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    travel = (end - start)[None, :]
    position, rate, curvature = (column[:, None] for column in rest_to_rest(intervals))
    path = start + position * travel
    path[-1] = end
    return GripperPath(path, rate * travel, curvature * travel)
