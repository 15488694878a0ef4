"""Where the loop gets the part's pose from: the truth, or the truth as a camera would blur it."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from dyngrasp.perception.pose_noise import PoseNoise
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.plant import Truth


class PoseSource(Protocol):
    """Gives the newest estimate of the part's pose."""

    def estimate(self, truth: Truth, t: float) -> PoseEstimate:
        """The estimate at time t (s). Sources that simulate a sensor may look at the truth; nothing else may."""
        ...


class TruePoses:
    """No error at all."""

    def __init__(self, track_motion: bool = False) -> None:
        """Velocities are part of the estimates only if `track_motion`: a part at rest trembles in any simulation."""
        self._track_motion = track_motion

    def estimate(self, truth: Truth, t: float) -> PoseEstimate:
        """The truth."""
        twist = truth.part_twist if self._track_motion else np.zeros(6)
        return PoseEstimate(truth.T_world_part, 1e-12 * np.eye(6), t, t, twist)


class NoisyPoses:
    """The truth through a noise model: what a camera on the hand would know at this distance."""

    def __init__(self, noise: PoseNoise, track_motion: bool = False) -> None:
        """Estimates of `noise`; velocities as in `TruePoses`."""
        self._noise, self._track_motion = noise, track_motion

    def estimate(self, truth: Truth, t: float) -> PoseEstimate:
        """The truth with the error of this distance."""
        twist = truth.part_twist if self._track_motion else None
        return self._noise.estimate(truth.T_world_part, truth.p_world_grasp_point, t, twist)
