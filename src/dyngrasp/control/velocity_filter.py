"""Velocities from encoder positions: the differential filter of the paper's controllers."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from dyngrasp.signals import Array

PAPER_TIME_CONSTANT = 0.012  # s, section V of the paper


class VelocityFilter:
    """Differentiates and smooths: the transfer function s / (1 + T₁ s), one per joint.

    Discretised exactly for positions that run linearly between two samples, so that it means the same at 1 kHz and at
    8 kHz. Fed with a ramp it settles at the slope, without bias.

    Args:
        time_constant: T₁ > 0 (s).
        dt: Sampling period > 0 (s).

    Raises:
        ValueError: A time that is not positive.
    """

    def __init__(self, time_constant: float, dt: float) -> None:
        if not (time_constant > 0 and dt > 0):
            raise ValueError(f"time constant and sampling period must be > 0, got {time_constant} s and {dt} s")
        self.time_constant, self.dt = time_constant, dt
        self._decay = math.exp(-dt / time_constant)
        self._position: Array | None = None
        self._velocity: Array | None = None

    def update(self, position: ArrayLike) -> Array:
        """Take the next sample.

        Args:
            position: (n,) encoder positions (rad).

        Returns:
            (n,) filtered velocities (rad/s); zeros at the first sample, when a machine is taken to be at rest.
        """
        position = np.array(position, dtype=float)
        if self._position is None or self._velocity is None:
            velocity = np.zeros_like(position)
        else:
            slope = (position - self._position) / self.dt
            velocity = slope + self._decay * (self._velocity - slope)
        self._position, self._velocity = position, velocity
        return velocity.copy()
