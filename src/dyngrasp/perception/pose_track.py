"""One moving body as an error-state Kalman filter on SE(3) sees it: constant velocity, driven by white acceleration.

The mean is a pose T and a twist in world axes, the error a right perturbation of the pose, T·exp([ρ, θ]), and a
difference of the twist, in the order [ρ (m), θ (rad), δv (m/s), δω (rad/s)]. Over a time h with R' = exp(ωh)R:
ρ' = R'ᵀRρ + R'ᵀδv h, θ' = θ + R'ᵀJ(ωh)δω h, J the left Jacobian of SO(3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.signals import Array, PoseEstimate, read_only


@dataclass(frozen=True)
class MotionSettings:
    """How the part may move. Each pair is for translation and rotation.

    Attributes:
        first_velocity: Standard deviation of the velocity when a track begins (m/s, rad/s), per axis; 0 for a part that
            is known to lie still: its velocity is then never estimated.
        acceleration: Root of the spectral density of the acceleration (m/s²/√Hz, rad/s²/√Hz).
        drift: Root of the density of a random walk of the pose itself (m/√s, rad/√s): it keeps the filter of a part at
            rest awake.
    """

    first_velocity: tuple[float, float] = (0.3, 0.5)
    acceleration: tuple[float, float] = (0.2, 0.5)
    drift: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("first_velocity", "acceleration", "drift"):
            pair = getattr(self, name)
            if len(pair) != 2 or not np.isfinite(pair).all() or min(pair) < 0:
                raise InvalidProblem(f"{name}: two numbers ≥ 0 expected, got {pair}")

    @classmethod
    def still(cls) -> MotionSettings:
        """For a part that nobody moves: no velocity, and a walk of 10 µm and 0.006° in a second."""
        return cls(first_velocity=(0.0, 0.0), acceleration=(0.0, 0.0), drift=(1e-5, 1e-4))


@dataclass(frozen=True, eq=False)
class TrackState:
    """What is known at time `t` (s).

    Attributes:
        t: Time.
        T_world_object: Mean pose.
        twist_world: (6,) mean linear velocity of the object's origin (m/s) and angular velocity (rad/s), world axes.
        covariance: (12, 12) of [ρ, θ, δv, δω].
    """

    t: float
    T_world_object: pin.SE3
    twist_world: Array
    covariance: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "twist_world", read_only(self.twist_world, (6,)))
        object.__setattr__(self, "covariance", read_only(self.covariance, (12, 12)))


def begin(estimate: PoseEstimate, motion: MotionSettings) -> TrackState:
    """A track that knows one measurement and nothing of the velocity but that measurement's own claim."""
    P = np.zeros((12, 12))
    P[:6, :6] = estimate.covariance
    P[6:, 6:] = np.diag(np.repeat(motion.first_velocity, 3) ** 2)
    return TrackState(estimate.t_capture, estimate.T_world_object, estimate.twist_world, P)


def predict(state: TrackState, t: float, motion: MotionSettings) -> TrackState:
    """The same track at a later time.

    Args:
        state: Of the track.
        t: Not before `state.t` (s).
        motion: How the part may move.
    """
    h = t - state.t
    if h == 0.0:
        return state
    R = state.T_world_object.rotation
    v, turn = state.twist_world[:3], state.twist_world[3:] * h
    turned = pin.exp3(turn)
    R_new = turned @ R
    F = np.eye(12)
    F[:3, :3] = R.T @ turned.T @ R
    F[:3, 6:9] = h * R_new.T
    F[3:6, 9:12] = h * R_new.T @ pin.Jexp3(-turn)
    P = F @ state.covariance @ F.T
    for block, (walk, acceleration) in enumerate(zip(motion.drift, motion.acceleration, strict=True)):
        pose, twist = slice(3 * block, 3 * block + 3), slice(6 + 3 * block, 9 + 3 * block)
        density = acceleration**2
        P[pose, pose] += (walk**2 * h + density * h**3 / 3.0) * np.eye(3)
        P[twist, twist] += density * h * np.eye(3)
        # The pose's error is in the object's axes, the twist's in the world's.
        cross = 0.5 * density * h**2 * R_new.T
        P[pose, twist] += cross
        P[twist, pose] += cross.T
    T = pin.SE3(R_new, state.T_world_object.translation + v * h)
    return TrackState(t, T, state.twist_world, 0.5 * (P + P.T))


def innovation(state: TrackState, estimate: PoseEstimate) -> tuple[Array, Array, float]:
    """How a measurement differs from a track at the same time.

    Returns:
        The difference r (6,) with T_measured = T·exp(r), its covariance (6, 6), and the squared Mahalanobis distance.
    """
    r = pin.log6(state.T_world_object.actInv(estimate.T_world_object)).vector
    # To first order in r; a far larger r lies outside any gate, and its exact covariance would be that of no Gaussian.
    S = state.covariance[:6, :6] + estimate.covariance
    return r, S, float(r @ np.linalg.solve(S, r))


def correct(state: TrackState, estimate: PoseEstimate) -> TrackState:
    """The track with a measurement of the same time taken in."""
    r, S, _ = innovation(state, estimate)
    P = state.covariance
    gain = np.linalg.solve(S, P[:6]).T
    shift = gain @ r
    keep = np.eye(12)
    keep[:, :6] -= gain
    P = keep @ P @ keep.T + gain @ estimate.covariance @ gain.T
    # The mean has moved: errors are counted from the new one.
    reset = pin.Jexp6(shift[:6])
    P[:6] = reset @ P[:6]
    P[:, :6] = P[:, :6] @ reset.T
    T = state.T_world_object * pin.exp6(shift[:6])
    return TrackState(state.t, T, state.twist_world + shift[6:], 0.5 * (P + P.T))
