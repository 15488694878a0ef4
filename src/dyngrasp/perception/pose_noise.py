"""Pose estimates without a camera: the truth with the error that a camera on the hand would leave, smaller as it nears.

At first the part is believed to be where somebody said; what was wrong with that is revealed linearly with the
distance between hand and part, down to an error that stays, as calibration leaves it, and noise from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Array, PoseEstimate


@dataclass(frozen=True)
class PoseNoiseSettings:
    """Settings of `PoseNoise`.

    Attributes:
        reveal_from: Distance of G from the grasp frame above which nothing of the first error is known (m).
        reveal_to: Distance below which all of it is (m).
        residual_position, residual_angle: Radius (m) and largest angle (rad) of the error that stays, drawn once.
        frame_position, frame_angle: Standard deviation of each axis from frame to frame (m, rad).
        frame_velocity, frame_spin: The same of the velocities of a moving part (m/s, rad/s).
    """

    reveal_from: float = 0.40
    reveal_to: float = 0.15
    residual_position: float = 0.001
    residual_angle: float = np.deg2rad(0.5)
    frame_position: float = 0.0002
    frame_angle: float = np.deg2rad(0.05)
    frame_velocity: float = 0.001
    frame_spin: float = np.deg2rad(0.1)

    def __post_init__(self) -> None:
        if not 0 <= self.reveal_to < self.reveal_from:
            raise InvalidProblem(f"0 ≤ reveal_to < reveal_from expected, got {self.reveal_to}, {self.reveal_from} m")
        numbers = (
            *(self.residual_position, self.residual_angle, self.frame_position, self.frame_angle),
            *(self.frame_velocity, self.frame_spin),
        )
        if not (np.isfinite(numbers).all() and min(numbers) >= 0):
            raise InvalidProblem(f"errors of a pose must be ≥ 0, got {numbers}")


class PoseNoise:
    """Estimates of one trial; equal seeds give equal errors.

    Errors act in the grasp frame: there a turn does not move the place where the fingers go.
    """

    def __init__(
        self,
        first_error: pin.SE3,
        T_object_grasp: pin.SE3,
        settings: PoseNoiseSettings,
        seed: int,
        first_twist_error: Array | None = None,
    ) -> None:
        """Draw the error that stays.

        Args:
            first_error: The grasp frame as it is believed at first, in the true one.
            T_object_grasp: The grasp frame in the object.
            settings: Distances and sizes.
            seed: Of all draws.
            first_twist_error: (6,) what is believed of a moving part's velocities at first, less the truth.
        """
        self._first_twist = np.zeros(6) if first_twist_error is None else first_twist_error
        self._first = pin.log6(first_error).vector
        self._T_object_grasp = T_object_grasp
        self.settings = settings
        self._rng = np.random.default_rng(seed)
        # The cube root makes the ball's volume uniform.
        offset = _direction(self._rng) * settings.residual_position * self._rng.uniform() ** (1 / 3)
        turn = _direction(self._rng) * settings.residual_angle * self._rng.uniform()
        self._residual = np.concatenate([offset, turn])

    def hidden_share(self, distance: float) -> float:
        """What part of the first error is not known yet at a distance (m): 1 far away, 0 near."""
        s = self.settings
        return float(np.clip((distance - s.reveal_to) / (s.reveal_from - s.reveal_to), 0.0, 1.0))

    def estimate(
        self, T_world_object: pin.SE3, p_world_hand: Array, t: float, twist_world: Array | None = None
    ) -> PoseEstimate:
        """One frame.

        Args:
            T_world_object: The truth.
            p_world_hand: (3,) G of the hand (m).
            t: When the picture is taken (s).
            twist_world: (6,) true velocities of the part; at rest, and known to be, if left out.
        """
        s = self.settings
        T_world_grasp = T_world_object * self._T_object_grasp
        share = self.hidden_share(float(np.linalg.norm(p_world_hand - T_world_grasp.translation)))
        scale = np.repeat([s.frame_position, s.frame_angle], 3)
        error = share * self._first + (1.0 - share) * self._residual + scale * self._rng.normal(size=6)
        variance = (
            scale**2 + np.repeat([s.residual_position, s.residual_angle], 3) ** 2 / 5 + (share * self._first) ** 2
        )
        # A covariance without uncertainty would be none that a filter could use.
        covariance = np.diag(np.maximum(variance, 1e-12))
        T = T_world_grasp * pin.exp6(error) * self._T_object_grasp.inverse()
        twist = np.zeros(6)
        if twist_world is not None:
            noise = np.repeat([s.frame_velocity, s.frame_spin], 3) * self._rng.normal(size=6)
            twist = twist_world + share * self._first_twist + noise
        return PoseEstimate(T, covariance, t, t, twist)


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
