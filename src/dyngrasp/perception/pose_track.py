"""One moving body as an error-state Kalman filter on SE(3) sees it: constant velocity, driven by white acceleration.

The mean is a pose T and a twist in world axes, the error a right perturbation of the pose, T·exp([ρ, θ]), and a
difference of the twist, in the order [ρ (m), θ (rad), δv (m/s), δω (rad/s)]. Over a time h with R' = exp(ωh)R:
ρ' = R'ᵀRρ + R'ᵀδv h, θ' = θ + R'ᵀJ(ωh)δω h, J the left Jacobian of SO(3).

Poses from one camera share errors, which averaging does not reduce: that of the mount, and what the corners of the
markers are off by as long as the view changes little. Both are states of the filter, of variance one and of no interest
in themselves: a pose that the camera measures is T·exp(x + G n + v), with n the twelve of them and v white.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

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
    acceleration: tuple[float, float] = (0.05, 0.1)
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


@dataclass(frozen=True)
class CameraErrors:
    """What the poses of one camera have in common.

    The defaults hold for rendered pictures, where `benchmarks/filter_consistency.py` measures what a corner's error has
    in common with that of another picture: 0.6 to 0.7 of its variance up to a change of 0.3, 0.46 after 0.6, 0.09 after
    1.2. Share and scale were chosen for the normalised errors of filtered poses, on films of other seeds than those
    that are reported.

    Attributes:
        mount: Standard deviation per axis of the camera's pose on the hand as calibration knows it (m, rad); by default
            as well as stickers are placed on a part.
        repeating: Share of a single frame's variance that stays while the view does.
        view_change: Change of the view after which the correlation of that share has fallen to 1/e: angle (rad) and
            path over distance of the camera, added up.
    """

    mount: tuple[float, float] = (1.5e-4, 6e-4)
    repeating: float = 0.7
    view_change: float = 0.5

    def __post_init__(self) -> None:
        if len(self.mount) != 2 or not (np.isfinite(self.mount).all() and min(self.mount) >= 0):
            raise InvalidProblem(f"mount: two numbers ≥ 0 expected, got {self.mount}")
        if not (0.0 <= self.repeating < 1.0 and np.isfinite(self.view_change) and self.view_change > 0):
            raise InvalidProblem(
                f"0 ≤ repeating < 1 and view_change > 0 expected, got {self.repeating}, {self.view_change}"
            )


@dataclass(frozen=True)
class CameraPose(PoseEstimate):
    """A pose that a camera measured; its covariance is that of a single frame, without the mount's error.

    Attributes:
        T_camera_object: The view.
    """

    T_camera_object: pin.SE3 = field(default_factory=pin.SE3.Identity)


@dataclass(frozen=True, eq=False)
class TrackState:
    """What is known at time `t` (s).

    Attributes:
        t: Time.
        T_world_object: Mean pose.
        twist_world: (6,) mean linear velocity of the object's origin (m/s) and angular velocity (rad/s), world axes.
        covariance: (12, 12) of [ρ, θ, δv, δω]; once a camera's pose was taken in, (24, 24) with its errors n behind.
        errors: Mean of n, (12,), or (0,) before.
        seen: The camera's last pose, None before.
    """

    t: float
    T_world_object: pin.SE3
    twist_world: Array
    covariance: Array
    errors: Array = field(default_factory=lambda: np.zeros(0))
    seen: CameraPose | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "twist_world", read_only(self.twist_world, (6,)))
        object.__setattr__(self, "errors", read_only(self.errors, (-1,)))
        size = 12 + self.errors.size
        object.__setattr__(self, "covariance", read_only(self.covariance, (size, size)))


def view_change(before: pin.SE3, now: pin.SE3) -> float:
    """How much the view T_camera_object has changed: angle (rad), and path of the camera over its distance."""
    moved = before * now.inverse()
    path = float(np.linalg.norm(moved.translation) / np.linalg.norm(now.translation))
    return path + float(np.linalg.norm(pin.log3(moved.rotation)))


def begin(estimate: PoseEstimate, motion: MotionSettings, camera: CameraErrors | None = None) -> TrackState:
    """A track that knows one measurement and nothing of the velocity but that measurement's own claim."""
    P = np.zeros((12, 12))
    P[6:, 6:] = np.diag(np.repeat(motion.first_velocity, 3) ** 2)
    state = TrackState(estimate.t_capture, estimate.T_world_object, estimate.twist_world, P)
    if not isinstance(estimate, CameraPose):
        P[:6, :6] = estimate.covariance
        return replace(state, covariance=P)
    white, G = _split(estimate, camera or CameraErrors())
    joint = np.eye(24)
    joint[:12, :12] = P
    joint[:6, :6] = white + G @ G.T
    # The pose is off by the opposite of what the measurement is.
    joint[:6, 12:], joint[12:, :6] = -G, -G.T
    return replace(state, covariance=joint, errors=np.zeros(12), seen=estimate)


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
    F = np.eye(12 + state.errors.size)
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
    return replace(state, t=t, T_world_object=T, covariance=0.5 * (P + P.T))


def innovation(
    state: TrackState, estimate: PoseEstimate, camera: CameraErrors | None = None
) -> tuple[Array, Array, float]:
    """How a measurement differs from a track at the same time.

    Returns:
        The difference r (6,) with T_measured = T·exp(r), less the camera's errors as far as they are known; its
        covariance (6, 6), and the squared Mahalanobis distance. Here all of a frame's error counts as new: pictures
        that repeat less than `camera` says are good pictures, too.
    """
    state, r, H, white = _observed(state, estimate, camera or CameraErrors())
    if isinstance(estimate, CameraPose):
        white = white / (1.0 - (camera or CameraErrors()).repeating)
    S = H @ state.covariance @ H.T + white
    return r, S, float(r @ np.linalg.solve(S, r))


def correct(state: TrackState, estimate: PoseEstimate, camera: CameraErrors | None = None) -> TrackState:
    """The track with a measurement of the same time taken in."""
    state, r, H, white = _observed(state, estimate, camera or CameraErrors())
    P = state.covariance
    gain = np.linalg.solve(H @ P @ H.T + white, H @ P).T
    shift = gain @ r
    keep = np.eye(len(P)) - gain @ H
    P = keep @ P @ keep.T + gain @ white @ gain.T
    # The mean has moved: errors are counted from the new one.
    reset = pin.Jexp6(shift[:6])
    P[:6] = reset @ P[:6]
    P[:, :6] = P[:, :6] @ reset.T
    T = state.T_world_object * pin.exp6(shift[:6])
    twist, errors = state.twist_world + shift[6:12], state.errors + shift[12:]
    return TrackState(state.t, T, twist, 0.5 * (P + P.T), errors, state.seen)


def _observed(
    state: TrackState, estimate: PoseEstimate, camera: CameraErrors
) -> tuple[TrackState, Array, Array, Array]:
    """The track with the camera's errors as they are in this view; difference r, its matrix H and its white part."""
    white, G = estimate.covariance, np.zeros((6, state.errors.size))
    if isinstance(estimate, CameraPose):
        if not state.errors.size:
            P = np.eye(24)
            P[:12, :12] = state.covariance
            state = replace(state, covariance=P, errors=np.zeros(12), seen=estimate)
        state = _in_view_of(state, estimate, camera)
        white, G = _split(estimate, camera)
    difference = state.T_world_object.actInv(estimate.T_world_object)
    # log(exp(x)·exp(e)) = x + J e with x near r. A first look may differ by centimetres from what was believed: were J
    # left out, what is well known of a pose would be mixed with what is not.
    J = pin.Jlog6(difference)
    r = pin.log6(difference).vector - J @ G @ state.errors
    return state, r, np.hstack([np.eye(6, 12), J @ G]), J @ white @ J.T


def _in_view_of(state: TrackState, estimate: CameraPose, camera: CameraErrors) -> TrackState:
    """The track with what repeats forgotten as far as the view has changed.

    Where the error enters in another way than before, with other markers say, it is another error that far: else the
    filter would tell it from the pose by that difference.
    """
    assert state.seen is not None
    change = view_change(state.seen.T_camera_object, estimate.T_camera_object)
    before, now = np.linalg.cholesky(state.seen.covariance), np.linalg.cholesky(estimate.covariance)
    difference = np.linalg.norm(np.linalg.solve(before, now) - np.eye(6))
    kept = float(np.exp(-change / camera.view_change) / np.sqrt(1.0 + difference**2))
    errors, P = state.errors.copy(), state.covariance.copy()
    errors[:6] *= kept
    P[12:18] *= kept
    P[:, 12:18] *= kept
    P[12:18, 12:18] += (1.0 - kept**2) * np.eye(6)
    return replace(state, errors=errors, covariance=P, seen=estimate)


def _split(estimate: CameraPose, camera: CameraErrors) -> tuple[Array, Array]:
    """White part (6, 6) of the covariance, and G (6, 12): how the repeating error and the mount's enter the pose."""
    C = estimate.covariance
    # T_world_camera·exp(ξ)·T_camera_object is T_world_object·exp(Ad ξ).
    by_mount = estimate.T_camera_object.toActionMatrixInverse() * np.repeat(camera.mount, 3)
    return (1.0 - camera.repeating) * C, np.hstack([np.sqrt(camera.repeating) * np.linalg.cholesky(C), by_mount])
