"""Pose estimates without a camera: the truth with the error that a camera on the hand would leave, smaller as it nears.

At first the part is believed to be where somebody said; what was wrong with that is revealed linearly with the
distance between hand and part, down to an error that stays, as calibration leaves it, and noise that grows with the
distance and changes slowly, as that of a filter does.
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

    The defaults of residual and frame are those of the rendered camera with the hand-eye error of
    `scenarios/camera_sdh2.toml`, rounded, from `python benchmarks/pose_noise.py --films 24 --seed 3`.

    Attributes:
        reveal_from: Distance of G from the grasp frame above which nothing of the first error is known (m).
        reveal_to: Distance below which all of it is (m).
        residual_position, residual_angle: Radius (m) and largest angle (rad) of the error that stays, drawn once.
        frame_position, frame_angle: Standard deviation of each axis at no distance (m, rad).
        frame_position_growth, frame_angle_growth: By how much that grows with the square of the distance (m/m²,
            rad/m²).
        correlation_time: After which the correlation of that noise has fallen to 1/e (s); 0 makes frames independent.
        frame_velocity, frame_spin: Standard deviation of the velocities of a moving part, independent from frame to
            frame (m/s, rad/s).
    """

    reveal_from: float = 0.40
    reveal_to: float = 0.15
    residual_position: float = 0.0009
    residual_angle: float = np.deg2rad(0.3)
    frame_position: float = 0.00003
    frame_angle: float = np.deg2rad(0.04)
    frame_position_growth: float = 0.0017
    frame_angle_growth: float = np.deg2rad(1.8)
    correlation_time: float = 1.4
    frame_velocity: float = 0.001
    frame_spin: float = np.deg2rad(0.1)

    def __post_init__(self) -> None:
        if not 0 <= self.reveal_to < self.reveal_from:
            raise InvalidProblem(f"0 ≤ reveal_to < reveal_from expected, got {self.reveal_to}, {self.reveal_from} m")
        numbers = (
            *(self.residual_position, self.residual_angle, self.frame_position, self.frame_angle),
            *(self.frame_position_growth, self.frame_angle_growth, self.correlation_time),
            *(self.frame_velocity, self.frame_spin),
        )
        if not (np.isfinite(numbers).all() and min(numbers) >= 0):
            raise InvalidProblem(f"errors of a pose and their correlation time must be ≥ 0, got {numbers}")

    def deviation(self, distance: float) -> Array:
        """(6,) standard deviation of the frames' noise at a distance of G from the grasp frame (m): m, then rad."""
        return np.repeat(
            [
                self.frame_position + self.frame_position_growth * distance**2,
                self.frame_angle + self.frame_angle_growth * distance**2,
            ],
            3,
        )


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
        self._noise, self._t = self._rng.normal(size=6), -np.inf

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
        distance = float(np.linalg.norm(p_world_hand - T_world_grasp.translation))
        share, scale = self.hidden_share(distance), s.deviation(distance)
        error = share * self._first + (1.0 - share) * self._residual + scale * self._noise_at(t)
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

    def _noise_at(self, t: float) -> Array:
        """(6,) of variance one: a first-order Gauss-Markov process, asked at whatever times."""
        tau = self.settings.correlation_time
        kept = float(np.exp(-abs(t - self._t) / tau)) if tau > 0 else 0.0
        self._noise = kept * self._noise + np.sqrt(1.0 - kept**2) * self._rng.normal(size=6)
        self._t = t
        return self._noise


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)
