"""From measured poses, some late, some wrong, some worthless, to one pose with a covariance at any time.

Each measurement acts at the time when its light was captured: the track is taken back there and forward again over the
measurements that came after. What differs from the track by more than its gate allows is refused, unless several
such frames in a row agree with one another: then the part has moved, and they are the new track.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from types import MappingProxyType

import numpy as np
from scipy.stats import chi2

from dyngrasp.errors import DyngraspError, InvalidProblem
from dyngrasp.perception.pose_track import CameraErrors, MotionSettings, TrackState, begin, correct, innovation, predict
from dyngrasp.signals import PoseEstimate

# Captures closer than this are one capture (s): the camera's fastest frames are 10 ms apart.
SAME_TIME = 1e-6


class PoseUnknown(DyngraspError):
    """A filter is asked for a pose that it has no measurement of."""


class Verdict(Enum):
    """What became of a measurement."""

    ACCEPTED = "accepted"
    """It corrected the track."""
    ACQUIRED = "acquired"
    """It completed a row of frames that agree: the track begins anew with them."""
    NAN = "nan"
    """Not numbers, not a rotation, or a covariance that is none."""
    FUTURE = "future"
    """Captured later than now, or received later than now: another clock."""
    OLD = "old"
    """Captured before what the history still knows."""
    REPEATED = "repeated"
    """Of this capture time there was one already."""
    CLOCK = "clock"
    """Time ran backwards from one call to the next, or the receipt precedes the capture."""
    GATED = "gated"
    """Too far from where the part must be."""


@dataclass(frozen=True)
class PoseFilterSettings:
    """Settings of `PoseFilter`.

    Attributes:
        motion: How the part may move.
        gate: Probability with which a good measurement passes; 0.999 of six dimensions is 4.74 standard deviations.
        acquire_frames: How many measurements in a row must agree for a track to begin.
        history: How far back late measurements are taken (s); 0 refuses whatever comes out of order.
        longest_gap: Without measurements for longer than this (s) the track is lost: it still predicts, but only a new
            row of frames that agree brings it back.
        clock_tolerance: How far a capture may lie ahead of now (s): rounding, not another clock.
        camera: What the poses of a camera have in common, which averaging frames does not reduce.
    """

    motion: MotionSettings = field(default_factory=MotionSettings)
    gate: float = 0.999
    acquire_frames: int = 4
    history: float = 0.5
    longest_gap: float = 2.0
    clock_tolerance: float = 1e-4
    camera: CameraErrors = field(default_factory=CameraErrors)

    def __post_init__(self) -> None:
        if not 0.5 <= self.gate < 1.0:
            raise InvalidProblem(f"gate: a probability in [0.5, 1) expected, got {self.gate}")
        if self.acquire_frames < 1:
            raise InvalidProblem(f"acquire_frames must be ≥ 1, got {self.acquire_frames}")
        for name in ("history", "longest_gap", "clock_tolerance"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InvalidProblem(f"{name} must be ≥ 0 s, got {getattr(self, name)}")

    @classmethod
    def still(cls) -> PoseFilterSettings:
        """For a part that nobody moves."""
        return cls(motion=MotionSettings.still())


Candidates = tuple[PoseEstimate, ...]


@dataclass(frozen=True)
class _Step:
    """A track after a measurement, and the candidates of that measurement."""

    state: TrackState
    candidates: Candidates


class _Track:
    """States in the order of capture, so that a late measurement finds its place."""

    def __init__(self, first: PoseEstimate, settings: PoseFilterSettings, limit: float) -> None:
        self._settings, self._limit = settings, limit
        self._steps = [_Step(begin(first, settings.motion, settings.camera), (first,))]
        self.frames, self.total_surprise = 1, 0.0

    @property
    def newest(self) -> float:
        return self._steps[-1].state.t

    @property
    def oldest(self) -> float:
        return self._steps[0].state.t

    def at(self, t: float) -> TrackState:
        """The state at a time, from the measurements until then."""
        place = bisect_right(self._steps, t, key=lambda step: step.state.t)
        return predict(self._steps[max(place - 1, 0)].state, t, self._settings.motion)

    def surprise(self, candidates: Candidates) -> float:
        """Twice the negative log likelihood of the candidate that fits best, less a constant; infinite off the gate."""
        predicted = self.at(candidates[0].t_capture)
        best, distance = nearest(predicted, candidates, self._settings.camera)
        if not distance <= self._limit:
            return np.inf
        return distance + _spread(predicted, best)

    def take(self, candidates: Candidates) -> bool:
        """Take in the candidate that fits best if it passes the gate."""
        t = candidates[0].t_capture
        predicted = self.at(t)
        best, distance = nearest(predicted, candidates, self._settings.camera)
        if not distance <= self._limit:
            return False
        place = bisect_right(self._steps, t, key=lambda step: step.state.t)
        self.total_surprise += distance + _spread(predicted, best)
        state = correct(predicted, best, self._settings.camera)
        later = self._steps[place:]
        self._steps[place:] = [_Step(state, candidates)]
        for step in later:
            state = predict(state, step.state.t, self._settings.motion)
            best, _ = nearest(state, step.candidates, self._settings.camera)
            state = correct(state, best, self._settings.camera)
            self._steps.append(_Step(state, step.candidates))
        self.frames += 1
        self._forget()
        return True

    def _forget(self) -> None:
        horizon = self.newest - self._settings.history
        while len(self._steps) > 1 and self._steps[1].state.t <= horizon:
            del self._steps[0]


class PoseFilter:
    """Holds the belief about one part. Times are seconds on the clock of whoever calls."""

    def __init__(self, settings: PoseFilterSettings | None = None, prior: PoseEstimate | None = None) -> None:
        """Begin.

        Args:
            settings: Motion, gate, times.
            prior: What is believed before anything is seen; without it the first row of frames that agree begins.
        """
        self.settings = settings or PoseFilterSettings()
        # The squared distance of good measurements follows χ² with the six degrees of freedom of a pose.
        self._limit = float(chi2.ppf(self.settings.gate, 6))
        self._track = None if prior is None else _Track(prior, self.settings, self._limit)
        self._challengers: list[_Track] = []
        self._captures: list[float] = []
        self._now = -np.inf
        self._counts = dict.fromkeys(Verdict, 0)

    @property
    def counts(self) -> Mapping[Verdict, int]:
        """How many measurements met with each verdict."""
        return MappingProxyType(self._counts)

    @property
    def acquired(self) -> bool:
        """Whether there is a track, or a prior."""
        return self._track is not None

    def update(self, measured: PoseEstimate | Sequence[PoseEstimate], now: float | None = None) -> Verdict:
        """Take in one frame.

        Args:
            measured: Its pose, or all poses that explain it, best first and of one capture time: the track decides.
            now: Time of the caller (s); the receipt of the measurement if left out. A clock of another domain is
                recognised only with it.

        Returns:
            What became of it; also counted.

        Raises:
            InvalidProblem: No candidate, or candidates of different capture times.
        """
        candidates = (measured,) if isinstance(measured, PoseEstimate) else tuple(measured)
        if not candidates:
            raise InvalidProblem("a frame without a pose is no measurement: do not call update for it")
        if (
            any(other.t_capture != candidates[0].t_capture for other in candidates[1:])
            and np.isfinite([candidate.t_capture for candidate in candidates]).all()
        ):
            raise InvalidProblem("candidates of one frame must have one capture time")
        verdict = self._judge(candidates, now)
        self._counts[verdict] += 1
        return verdict

    def estimate(self, t: float) -> PoseEstimate:
        """The part at time t (s): predicted past the last measurement, with the covariance growing as it must.

        Raises:
            PoseUnknown: Nothing has been acquired yet, or t lies before what the history knows.
        """
        state = self.state(t)
        return PoseEstimate(state.T_world_object, state.covariance[:6, :6], t, t, state.twist_world)

    def state(self, t: float) -> TrackState:
        """Pose, twist and their covariance at time t (s); raises as `estimate` does."""
        if self._track is None:
            raise PoseUnknown(f"no pose yet: {self.settings.acquire_frames} frames that agree are needed")
        if not np.isfinite(t) or t < self._track.oldest - SAME_TIME:
            raise PoseUnknown(f"the pose at {t} s is asked for; the history begins at {self._track.oldest:.4f} s")
        return self._track.at(t)

    def _judge(self, candidates: Candidates, now: float | None) -> Verdict:
        s = self.settings
        candidates = tuple(candidate for candidate in candidates if _is_sound(candidate))
        if not candidates or (now is not None and not np.isfinite(now)):
            return Verdict.NAN
        t, receipt = candidates[0].t_capture, candidates[0].t_receipt
        now = receipt if now is None else now
        if receipt < t - s.clock_tolerance or now < self._now - s.clock_tolerance:
            return Verdict.CLOCK
        if max(t, receipt) > now + s.clock_tolerance:
            return Verdict.FUTURE
        self._now = max(self._now, now)
        if any(abs(t - other) < SAME_TIME for other in self._captures):
            return Verdict.REPEATED
        newest = self._captures[-1] if self._captures else -np.inf
        if t < newest - s.history or (self._track is not None and t < self._track.oldest):
            return Verdict.OLD
        self._captures = sorted([other for other in self._captures if other >= max(newest, t) - s.history] + [t])
        # Both poses of a square may begin a row of their own; the frames that follow tell them apart.
        recent = [track for track in self._challengers if track.oldest <= t <= track.newest + s.longest_gap]
        if self._track is not None and t - self._track.newest <= s.longest_gap:
            # After refusals the gate of the track has opened wide. What a row of refused frames explains better must
            # not slip through it and be taken for a sudden speed.
            rival = min((track.surprise(candidates) for track in recent if track.frames > 1), default=np.inf)
            surprise = self._track.surprise(candidates)
            if surprise <= rival and self._track.take(candidates):
                self._challengers.clear()
                return Verdict.ACCEPTED
        return self._challenge(candidates, recent)

    def _challenge(self, candidates: Candidates, recent: list[_Track]) -> Verdict:
        """Frames that the track refuses may agree with one another."""
        agreeing = [track for track in recent if track.take(candidates)]
        self._challengers = agreeing or [_Track(c, self.settings, self._limit) for c in candidates]
        ripe = [track for track in self._challengers if track.frames >= self.settings.acquire_frames]
        if not ripe:
            return Verdict.GATED
        self._track = min(ripe, key=lambda track: track.total_surprise)
        self._challengers = []
        return Verdict.ACQUIRED


def _spread(state: TrackState, estimate: PoseEstimate) -> float:
    """Log determinant of the innovation's covariance: without it whatever knows little would always fit best."""
    return float(np.linalg.slogdet(state.covariance[:6, :6] + estimate.covariance)[1])


def nearest(state: TrackState, candidates: Candidates, camera: CameraErrors) -> tuple[PoseEstimate, float]:
    """The candidate that a track explains best, and its squared Mahalanobis distance."""
    distances = [innovation(state, candidate, camera)[2] for candidate in candidates]
    best = int(np.argmin(distances))
    return candidates[best], distances[best]


def _is_sound(estimate: PoseEstimate) -> bool:
    numbers = [estimate.t_capture, estimate.t_receipt, *estimate.T_world_object.homogeneous.ravel()]
    if not (np.isfinite(numbers).all() and np.isfinite(estimate.covariance).all()):
        return False
    if not np.isfinite(estimate.twist_world).all():
        return False
    R, P = estimate.T_world_object.rotation, estimate.covariance
    # Rotations arrive from files and networks in single precision, no worse.
    if np.abs(R.T @ R - np.eye(3)).max() > 1e-5 or np.linalg.det(R) < 0:
        return False
    scale = np.sqrt(np.maximum(np.diag(P), 0.0))
    if (scale <= 0.0).any() or np.abs(P - P.T).max() > 1e-9 * scale.max() ** 2:
        return False
    return bool(np.linalg.eigvalsh(P / np.outer(scale, scale))[0] > 0.0)
