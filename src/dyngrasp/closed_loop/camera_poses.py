"""Poses from pictures that the camera on the hand takes while the episode runs.

The plant is wrapped: as it steps, the shutter opens and closes at the camera's rate. Markers are detected at once,
but what they say reaches the filter only when exposure, transfer and detection would have taken their time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import InvalidProblem
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.part_tracker import Frame, PartTracker
from dyngrasp.signals import Array, Command, Observation, PoseEstimate
from dyngrasp.simulation.camera_sensor import CameraSensor, Picture
from dyngrasp.simulation.plant import Truth, TruthfulPlant


@dataclass(frozen=True)
class CameraPosesSettings:
    """Settings of `CameraPoses`.

    Attributes:
        latency: From the end of the exposure to the pose in the filter (s): transfer and detection.
        exposures: Moments of one exposure that are drawn and averaged; 1 takes its middle alone, without motion blur.
        start: When the shutter first opens (s).
        keep_every: Of so many pictures the first is kept; 0 keeps none.
    """

    latency: float = 0.012
    exposures: int = 1
    start: float = 0.0
    keep_every: int = 0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.latency) and self.latency >= 0) or self.exposures < 1:
            raise InvalidProblem(f"latency ≥ 0 s and exposures ≥ 1 expected, got {self.latency}, {self.exposures}")
        if self.keep_every < 0:
            raise InvalidProblem(f"keep_every ≥ 0 expected, got {self.keep_every}")


class CameraPoses:
    """A `PoseSource` that looks at the truth only through the camera."""

    def __init__(
        self,
        sensor: CameraSensor,
        detector: MarkerDetector,
        tracker: PartTracker,
        settings: CameraPosesSettings | None = None,
    ) -> None:
        """Begin.

        Args:
            sensor: Takes the pictures, with the true camera.
            detector: Finds the part's markers.
            tracker: Makes poses of them, with the camera as calibration believes it.
            settings: Times, and which pictures are kept.
        """
        self.settings = settings or CameraPosesSettings()
        self.tracker = tracker
        self.until = np.inf
        """Last time at which the shutter opens (s): after the grasp nobody asks for pictures."""
        self.pictures: dict[int, Picture] = {}
        """Pictures that were kept, by their number in the order of capture."""
        self._sensor, self._detector = sensor, detector
        self._opens = self.settings.start
        self._taken = 0
        self._exposure: list[tuple[float, Array, Array]] = []

    def filmed(self, plant: TruthfulPlant) -> FilmedPlant:
        """The plant with this camera watching it; to be used in its place."""
        return FilmedPlant(plant, self)

    def watch(self, t: float, state: Array, arm_position: Array) -> None:
        """Called at every step.

        Args:
            t: Now (s).
            state: (nq,) generalised positions, for the renderer.
            arm_position: (n,) what the encoders read (rad).
        """
        self.tracker.receive(t)
        if t < self._opens - 1e-9 or (not self._exposure and t > self.until):
            return
        self._exposure.append((t, state, arm_position))
        # Sums of rounded periods: half a microsecond is none.
        if t >= self._opens + self._sensor.camera.exposure - 5e-7:
            self._take()
            self._opens += 1.0 / self._sensor.camera.rate

    def estimate(self, truth: Truth, t: float) -> PoseEstimate:
        """What the filter knows at time t (s) from the pictures that have arrived by then.

        Raises:
            PoseUnknown: Too few of them showed the part.
        """
        return self.tracker.estimate(t)

    def finish(self, meta: dict[str, Any] | None = None) -> VisionRecord:
        """The record of every frame that has arrived."""
        tracker = self.tracker
        reports = tuple(tracker.reports)
        pictures = {k: picture for k, picture in self.pictures.items() if k < len(reports)}
        names = tracker.robot.joint_names
        return VisionRecord(names, tracker.solver.camera, tracker.prior, reports, pictures, dict(meta or {}))

    def _take(self) -> None:
        s = self.settings
        moments = self._exposure
        self._exposure = []
        picks = [len(moments) // 2] if s.exposures == 1 else np.linspace(0, len(moments) - 1, s.exposures).round()
        chosen = [moments[k] for k in sorted({int(pick) for pick in picks})]
        image = self._sensor.capture([state for _, state, _ in chosen], [t for t, _, _ in chosen])
        # The encoders at the middle of the exposure: those of now would shift the part by the hand's motion.
        times = np.array([t for t, _, _ in moments])
        angles = np.array([q for _, _, q in moments])
        q = np.array([np.interp(image.t_capture, times, column) for column in angles.T])
        receipt = moments[-1][0] + s.latency
        self.tracker.expect(Frame(image.t_capture, receipt, q, self._detector.detect(image.pixels)))
        if s.keep_every and self._taken % s.keep_every == 0:
            self.pictures[self._taken] = image.pixels
        self._taken += 1


class FilmedPlant:
    """A plant that is looked at as it steps; implements `TruthfulPlant`."""

    def __init__(self, plant: TruthfulPlant, poses: CameraPoses) -> None:
        """Wrap `plant`, with `poses` watching."""
        self._plant, self._poses = plant, poses

    @property
    def t(self) -> float:
        """Time of the plant (s)."""
        return self._plant.t

    @property
    def applied(self) -> Command:
        """The torques of the last step."""
        return self._plant.applied

    @property
    def state(self) -> Array:
        """Generalised positions of everything in the scene."""
        return self._plant.state

    def observe(self) -> Observation:
        """What the sensors read now."""
        return self._plant.observe()

    def truth(self) -> Truth:
        """The state that the sensors only hint at."""
        return self._plant.truth()

    def step(self, command: Command) -> None:
        """Apply the torques for one control period, with the camera's shutter open or closed."""
        self._poses.watch(self._plant.t, self._plant.state, self._plant.observe().arm_position)
        self._plant.step(command)
