"""From what was detected in one picture after another to where the part is: pose, test, filter.

Nothing here knows where the pictures come from, so that a running camera, a recorded run and a folder of photographs
are worked out by the same lines and give the same numbers.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.robot import RobotModel
from dyngrasp.perception.marker_detection import MarkerCorners
from dyngrasp.perception.marker_pose import MarkerPoseSolver, PoseCandidate, Sighting
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings, Verdict
from dyngrasp.signals import Array, PoseEstimate, read_only


@dataclass(frozen=True)
class PartTrackerSettings:
    """Settings of `PartTracker`.

    Attributes:
        least_markers: Poses that so many markers agree with always reach the filter. Fewer do if they are not ambiguous
            and `largest_tilt` holds: one small square far away gives its tilt by a few pixels, wrong for many frames.
        largest_tilt: Standard deviation of the rotation that is small enough for that (rad).
        filter: Of the pose filter.
    """

    least_markers: int = 2
    largest_tilt: float = np.deg2rad(1.0)
    filter: PoseFilterSettings = field(default_factory=PoseFilterSettings.still)

    def __post_init__(self) -> None:
        if self.least_markers < 1:
            raise InvalidProblem(f"least_markers ≥ 1 expected, got {self.least_markers}")


@dataclass(frozen=True, eq=False)
class Frame:
    """One picture as perception knows it.

    Attributes:
        t_capture, t_receipt: Middle of the exposure, and when the markers had been found (s).
        arm_position: (n,) what the encoders read at the capture (rad), not at the receipt.
        markers: What was detected.
    """

    t_capture: float
    t_receipt: float
    arm_position: Array
    markers: tuple[MarkerCorners, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "arm_position", read_only(self.arm_position, (-1,)))

    @property
    def seen(self) -> tuple[int, ...]:
        """Numbers of the detected markers."""
        return tuple(marker.id for marker in self.markers)


@dataclass(frozen=True, eq=False)
class FrameReport:
    """What became of a frame.

    Attributes:
        frame: The frame.
        ratio: Second best reprojection error over the best, see `Sighting`.
        verdict: What the filter said; None if too few markers agreed on a pose and it was not asked.
        estimate: What the filter knew at the receipt, this frame included; None before anything was acquired.
    """

    frame: Frame
    ratio: float
    verdict: Verdict | None
    estimate: PoseEstimate | None


class PartTracker:
    """Follows one part through the frames of one camera on the hand."""

    def __init__(
        self,
        solver: MarkerPoseSolver,
        robot: RobotModel,
        gripper: GripperModel,
        prior: PoseEstimate | None = None,
        settings: PartTrackerSettings | None = None,
    ) -> None:
        """Begin.

        Args:
            solver: Turns markers into poses; its camera is the one that calibration believes in, the mount included.
            robot: Gives the hand's pose at the capture, from the encoders.
            gripper: How the hand is mounted.
            prior: What is believed of the part before it is seen; without it the first frames that agree begin.
            settings: What reaches the filter, and the filter's own.
        """
        self.settings = settings or PartTrackerSettings()
        self.filter = PoseFilter(self.settings.filter, prior)
        self.solver, self.prior = solver, prior
        self.reports: list[FrameReport] = []
        self.robot, self.gripper = robot, gripper
        self._underway: deque[Frame] = deque()

    def expect(self, frame: Frame) -> None:
        """A frame that is on its way: it counts from its receipt on. Frames come in the order of their receipt."""
        self._underway.append(frame)

    def receive(self, t: float) -> None:
        """Take in the frames that have arrived by time t (s)."""
        while self._underway and self._underway[0].t_receipt <= t:
            self.look(self._underway.popleft())

    def estimate(self, t: float) -> PoseEstimate:
        """What is known at time t (s) from the frames that have arrived by then.

        Raises:
            PoseUnknown: Nothing has been acquired yet.
        """
        self.receive(t)
        return self.filter.estimate(t)

    def look(self, frame: Frame) -> FrameReport:
        """Take in a frame that has just arrived."""
        sighting = self.solver.solve(frame.markers)
        T_world_hand: pin.SE3 = self.robot.forward_kinematics(frame.arm_position) * self.gripper.T_flange_hand
        T_world_camera = T_world_hand * self.solver.camera.T_hand_camera
        candidates = [
            c.in_world(T_world_camera, frame.t_capture, frame.t_receipt)
            for c in sighting.plausible
            if self._passes(c, sighting)
        ]
        verdict = self.filter.update(candidates, now=frame.t_receipt) if candidates else None
        estimate = self.filter.estimate(frame.t_receipt) if self.filter.acquired else None
        report = FrameReport(frame, sighting.ratio, verdict, estimate)
        self.reports.append(report)
        return report

    def _passes(self, candidate: PoseCandidate, sighting: Sighting) -> bool:
        if len(candidate.markers) >= self.settings.least_markers:
            return True
        tilt = float(np.sqrt(np.linalg.eigvalsh(candidate.covariance[3:, 3:])[-1]))
        return not sighting.ambiguous and tilt <= self.settings.largest_tilt
