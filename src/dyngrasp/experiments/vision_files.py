"""Pictures of a run as files, and poses from pictures that are files: of a run, or of a camera in the real world."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin

from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import InputFileError
from dyngrasp.experiments.output import OutputFolder, atomic
from dyngrasp.experiments.vision import tracker_settings
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSolver
from dyngrasp.perception.part_tracker import Frame, FrameReport, PartTracker
from dyngrasp.perception.picture_files import png, read_picture
from dyngrasp.perception.picture_folder import TABLE, TakenPicture, read_table, table

COLUMNS = (
    "picture", "t_capture_s", "t_receipt_s", "markers", "verdict",
    "x_m", "y_m", "z_m", "quat_w", "quat_x", "quat_y", "quat_z", "deviation_mm", "deviation_deg",
)  # fmt: skip
"""Of the table of poses: the part in the world at the receipt, and the standard deviations of its position and turn in
the direction in which each is known least; empty before anything is known."""


def write_pictures(vision: VisionRecord, folder: OutputFolder) -> int:
    """Write the kept pictures as PNG files with their `frames.csv`; those of an earlier run in the folder go.

    Returns:
        Bytes written.
    """
    taken = []
    size = 0
    for number, picture in sorted(vision.pictures.items()):
        frame = vision.reports[number].frame
        taken.append(TakenPicture(folder / f"{number:04d}.png", frame.t_capture, frame.t_receipt, frame.arm_position))
        size += _write(taken[-1].path, png(picture))
    current = {picture.path for picture in taken}
    for path in folder.path.glob("*.png"):
        if re.fullmatch(r"\d{4,}", path.stem) and path not in current:
            path.unlink()
    return size + _write(folder / TABLE, table(taken, vision.arm_joints).encode())


def perceive(
    workcell: Workcell, folder: str | Path, progress: Callable[[int, int], None] = lambda done, total: None
) -> tuple[tuple[TakenPicture, FrameReport], ...]:
    """Where the part of a scenario is, from a folder of pictures, with nothing believed beforehand.

    Args:
        workcell: Its arm, hand, part, camera (lens and mount) and the part's motion count.
        folder: Pictures with their `frames.csv`, see `perception.picture_folder`.
        progress: Called with the number of pictures done and of all.

    Raises:
        InputFileError: A file is missing or cannot be used, or a picture is not of the camera's size.
        InvalidProblem: The part carries no markers.
    """
    task, camera = workcell.task, workcell.camera
    pictures = read_table(folder, task.robot.joint_names)
    detector = MarkerDetector(task.grasp_object)
    solver = MarkerPoseSolver(camera, task.grasp_object)
    tracker = PartTracker(solver, task.robot, task.gripper, settings=tracker_settings(workcell.scenario))
    for i, taken in enumerate(pictures):
        progress(i, len(pictures))
        pixels = read_picture(taken.path)
        height, width = pixels.shape
        if (width, height) != (camera.width, camera.height):
            raise InputFileError(
                taken.path,
                "size",
                f"{width} x {height}",
                f"the camera {camera.name} of the scenario takes pictures of {camera.width} x {camera.height}; "
                "camera.width and camera.height scale its lens",
            )
        tracker.look(Frame(taken.t_capture, taken.t_receipt, taken.arm_position, detector.detect(pixels)))
    return tuple(zip(pictures, tracker.reports, strict=True))


def pose_table(seen: Sequence[tuple[TakenPicture, FrameReport]]) -> str:
    """The poses as comma-separated values, one row a picture; see `COLUMNS`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for taken, report in seen:
        verdict = report.verdict.value if report.verdict else ""
        row = [taken.path.name, repr(taken.t_capture), repr(taken.t_receipt)]
        writer.writerow([*row, " ".join(map(str, report.frame.seen)), verdict, *_numbers(report)])
    return text.getvalue()


def deviations(report: FrameReport) -> tuple[float, float]:
    """Standard deviations of position (m) and turn (rad) in the direction in which each is known least."""
    assert report.estimate is not None
    blocks = report.estimate.covariance[:3, :3], report.estimate.covariance[3:, 3:]
    position, turn = (float(np.sqrt(np.linalg.eigvalsh(block)[-1])) for block in blocks)
    return position, turn


def _numbers(report: FrameReport) -> list[str]:
    if report.estimate is None:
        return [""] * 9
    T = report.estimate.T_world_object
    x, y, z, w = pin.Quaternion(T.rotation).coeffs()
    position, turn = deviations(report)
    return [f"{value:.9g}" for value in (*T.translation, w, x, y, z, 1e3 * position, np.rad2deg(turn))]


def _write(path: Path, content: bytes) -> int:
    with atomic(path) as temporary:
        return temporary.write_bytes(content)
