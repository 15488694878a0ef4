"""From the `[camera]` table of a scenario to poses out of pictures, and from the pictures to figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.closed_loop.camera_poses import CameraPoses, CameraPosesSettings
from dyngrasp.closed_loop.recorded_poses import RecordedPoses
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.experiments.draws import Trial
from dyngrasp.experiments.scenario import Scenario
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.models.camera import CameraModel
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSolver
from dyngrasp.perception.part_tracker import PartTracker, PartTrackerSettings
from dyngrasp.perception.pose_filter import PoseFilterSettings
from dyngrasp.perception.pose_track import CameraErrors
from dyngrasp.simulation.camera_sensor import CameraSensor, ImagingSettings
from dyngrasp.simulation.scene import Scene

# Of all random streams of a trial this one belongs to the pictures: the others stay what they are without them.
_IMAGE_STREAM = 8


@contextmanager
def camera_poses(workcell: Workcell, trial: Trial, scene: Scene) -> Iterator[CameraPoses]:
    """The camera of a scenario on the hand of a scene that shows the markers; nothing is believed beforehand.

    Args:
        workcell: Scenario and models.
        trial: Gives the seed.
        scene: Built with `markers=True`.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
        InvalidProblem: The part carries no markers.
    """
    section, task = workcell.scenario.camera, workcell.task
    true = workcell.camera
    streams = np.random.SeedSequence(trial.seed, spawn_key=(_IMAGE_STREAM,)).spawn(2)
    believed = _misplaced(true, 1e-3 * section.mount_mm, np.deg2rad(section.mount_deg), streams[0])
    imaging = ImagingSettings(
        brightness=section.brightness,
        noise=section.noise,
        vignetting=section.vignetting,
        seed=int(streams[1].generate_state(1)[0]),
    )
    settings = CameraPosesSettings(
        latency=1e-3 * section.latency_ms,
        exposures=section.exposures,
        keep_every=section.keep_every,
    )
    detector = MarkerDetector(task.grasp_object)
    solver = MarkerPoseSolver(believed, task.grasp_object)
    tracker = PartTracker(solver, task.robot, task.gripper, settings=tracker_settings(workcell.scenario))
    with CameraSensor(scene, true, imaging) as sensor:
        yield CameraPoses(sensor, detector, tracker, settings)


def tracker_settings(scenario: Scenario) -> PartTrackerSettings:
    """How the part is followed: what the scenario says of its motion and of the calibration."""
    section = scenario.camera
    pose_filter = PoseFilterSettings.still() if scenario.pose.motion == "still" else PoseFilterSettings()
    # The mount is wrong by so much in a random direction: a third of the square along each axis.
    mount = np.array([1e-3 * section.mount_mm, np.deg2rad(section.mount_deg)]) / np.sqrt(3)
    return PartTrackerSettings(filter=replace(pose_filter, camera=CameraErrors((float(mount[0]), float(mount[1])))))


def recorded_poses(
    workcell: Workcell, vision: VisionRecord, settings: PartTrackerSettings | None = None
) -> RecordedPoses:
    """A source that replays what a run saw.

    Args:
        workcell: Arm, hand and part of that run.
        vision: Its record; camera and prior are taken from there.
        settings: Of the tracker; the scenario's if left out, which give the run's own estimates.
    """
    task = workcell.task
    solver = MarkerPoseSolver(vision.camera, task.grasp_object)
    settings = settings or tracker_settings(workcell.scenario)
    tracker = PartTracker(solver, task.robot, task.gripper, vision.prior, settings)
    return RecordedPoses(tracker, vision.frames)


def vision_summary(vision: VisionRecord | None) -> dict[str, Any]:
    """Pictures of an episode: how many, what the filter said, how many showed the part."""
    if vision is None or not vision.reports:
        return {}
    reports = vision.reports
    return {
        "frames": len(reports),
        "pictures_kept": len(vision.pictures),
        "recognised": sum(report.verdict is not None for report in reports),
        "verdicts": dict(Counter(report.verdict.value for report in reports if report.verdict is not None)),
        "markers_mean": float(np.mean([len(report.frame.seen) for report in reports])),
    }


def _misplaced(camera: CameraModel, shift: float, turn: float, stream: np.random.SeedSequence) -> CameraModel:
    """The camera as a calibration believes it that is wrong by a shift (m) and a turn (rad) in random directions."""
    rng = np.random.default_rng(stream)
    directions = rng.normal(size=(2, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    error = pin.SE3(pin.exp3(turn * directions[1]), shift * directions[0])
    return replace(camera, T_hand_camera=camera.T_hand_camera * error)
