"""Poses from pictures that the camera on the hand takes while the episode runs.

The plant is wrapped: as it steps, the shutter opens and closes at the camera's rate. A picture is worked out at once,
but what it says reaches the filter only when exposure, transfer and detection would have taken their time.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.robot import RobotModel
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSolver, PoseCandidate, Sighting
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings, Verdict
from dyngrasp.signals import Array, Command, Observation, PoseEstimate
from dyngrasp.simulation.camera_sensor import CameraSensor
from dyngrasp.simulation.plant import Truth, TruthfulPlant


@dataclass(frozen=True)
class CameraPosesSettings:
    """Settings of `CameraPoses`.

    Attributes:
        latency: From the end of the exposure to the pose in the filter (s): transfer and detection.
        exposures: Moments of one exposure that are drawn and averaged; 1 takes its middle alone, without motion blur.
        least_markers: Poses that so many markers agree with always reach the filter. Fewer do if they are not ambiguous
            and `largest_tilt` holds: one small square far away gives its tilt by a few pixels, wrong for many frames.
        largest_tilt: Standard deviation of the rotation that is small enough for that (rad).
        correlation: By how much covariances of single frames are enlarged: so many count as one. The error of a corner
            depends on where it lies on the grid of pixels and repeats while the view changes little.
        largest_deviation: Standard deviation of the position (m) above which estimates are not passed on: the last good
            one stays.
        until: No pictures from then on (s): after the grasp nobody asks for them.
        filter: Of the pose filter.
    """

    latency: float = 0.012
    exposures: int = 1
    least_markers: int = 2
    largest_tilt: float = np.deg2rad(1.0)
    correlation: float = 8.0
    largest_deviation: float = 0.005
    until: float = np.inf
    filter: PoseFilterSettings = field(default_factory=PoseFilterSettings.still)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.latency) and self.latency >= 0) or self.exposures < 1:
            raise InvalidProblem(f"latency ≥ 0 s and exposures ≥ 1 expected, got {self.latency}, {self.exposures}")
        if self.least_markers < 1 or not (np.isfinite(self.correlation) and self.correlation >= 1):
            raise InvalidProblem(
                f"least_markers ≥ 1 and correlation ≥ 1 expected, got {self.least_markers}, {self.correlation}"
            )
        if not self.largest_deviation > 0:
            raise InvalidProblem(f"largest_deviation must be > 0 m, got {self.largest_deviation}")


@dataclass(frozen=True)
class FrameReport:
    """One picture of an episode.

    Attributes:
        t_capture, t_receipt: Middle of the exposure, and when the filter had it (s).
        seen: Numbers of the detected markers.
        ratio: Second best reprojection error over the best, see `Sighting`.
        verdict: What the filter said; None if too few markers agreed on a pose and it was not asked.
    """

    t_capture: float
    t_receipt: float
    seen: tuple[int, ...]
    ratio: float
    verdict: Verdict | None


@dataclass(frozen=True)
class _Pending:
    report: FrameReport
    candidates: tuple[PoseEstimate, ...]


class CameraPoses:
    """A `PoseSource` that looks at the truth only through the camera."""

    def __init__(
        self,
        sensor: CameraSensor,
        camera: CameraModel,
        robot: RobotModel,
        gripper: GripperModel,
        detector: MarkerDetector,
        solver: MarkerPoseSolver,
        prior: PoseEstimate,
        settings: CameraPosesSettings | None = None,
    ) -> None:
        """Begin.

        Args:
            sensor: Takes the pictures, with the true camera.
            camera: The camera as calibration believes it: its mount counts here, its lens is the solver's.
            robot: Gives the hand's pose at the capture, from the encoders.
            gripper: How the hand is mounted.
            detector: Finds the part's markers.
            solver: Turns them into poses.
            prior: What is believed of the part before it is seen.
            settings: Times and bounds.
        """
        self.settings = settings or CameraPosesSettings()
        self.frames: list[FrameReport] = []
        self.filter = PoseFilter(self.settings.filter, prior)
        self._sensor, self._camera, self._robot, self._gripper = sensor, camera, robot, gripper
        self._detector, self._solver = detector, solver
        self._passed_on = prior
        self._opens = prior.t_capture
        self._exposure: list[tuple[float, Array, Array]] = []
        self._pending: list[_Pending] = []

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
        if t < self._opens - 1e-9 or t > self.settings.until:
            return
        self._exposure.append((t, state, arm_position))
        # Sums of rounded periods: half a microsecond is none.
        if t >= self._opens + self._camera.exposure - 5e-7:
            self._take()
            self._opens += 1.0 / self._camera.rate

    def estimate(self, truth: Truth, t: float) -> PoseEstimate:
        """What the filter knows at time t (s) from the pictures that have arrived by then.

        While it knows too little, the last estimate that was good enough stays, at first the prior.
        """
        while self._pending and self._pending[0].report.t_receipt <= t:
            self._receive(self._pending.pop(0))
        current = self.filter.estimate(t)
        deviation = float(np.sqrt(np.linalg.eigvalsh(current.covariance[:3, :3])[-1]))
        if deviation <= self.settings.largest_deviation:
            self._passed_on = current
        return self._passed_on

    def _take(self) -> None:
        s = self.settings
        moments = self._exposure
        self._exposure = []
        picks = [len(moments) // 2] if s.exposures == 1 else np.linspace(0, len(moments) - 1, s.exposures).round()
        chosen = [moments[k] for k in sorted({int(pick) for pick in picks})]
        image = self._sensor.capture([state for _, state, _ in chosen], [t for t, _, _ in chosen])
        sighting = self._solver.solve(self._detector.detect(image.pixels))
        # The encoders at the middle of the exposure: those of now would shift the part by the hand's motion.
        times = np.array([t for t, _, _ in moments])
        angles = np.array([q for _, _, q in moments])
        q = np.array([np.interp(image.t_capture, times, column) for column in angles.T])
        T_world_hand: pin.SE3 = self._robot.forward_kinematics(q) * self._gripper.T_flange_hand
        T_world_camera = T_world_hand * self._camera.T_hand_camera
        receipt = moments[-1][0] + s.latency
        candidates = tuple(
            replace(c, covariance=s.correlation * c.covariance).in_world(T_world_camera, image.t_capture, receipt)
            for c in sighting.plausible
            if self._passes(c, sighting)
        )
        report = FrameReport(image.t_capture, receipt, sighting.seen, sighting.ratio, None)
        self._pending.append(_Pending(report, candidates))

    def _passes(self, candidate: PoseCandidate, sighting: Sighting) -> bool:
        if len(candidate.markers) >= self.settings.least_markers:
            return True
        tilt = float(np.sqrt(np.linalg.eigvalsh(candidate.covariance[3:, 3:])[-1]))
        return not sighting.ambiguous and tilt <= self.settings.largest_tilt

    def _receive(self, pending: _Pending) -> None:
        report = pending.report
        verdict = self.filter.update(pending.candidates, now=report.t_receipt) if pending.candidates else None
        self.frames.append(FrameReport(report.t_capture, report.t_receipt, report.seen, report.ratio, verdict))


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
