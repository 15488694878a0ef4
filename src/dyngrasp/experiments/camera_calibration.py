"""A camera's lens and mount from a folder of pictures: looked through, worked out, and put into a camera's file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path

import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from dyngrasp.errors import InputFileError, InvalidProblem
from dyngrasp.experiments.output import OutputError, atomic, check_writable
from dyngrasp.models.camera import CameraModel, camera_toml, picture_border, read_camera
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.robot import RobotModel
from dyngrasp.perception.calibration import (
    LEAST_VIEWS,
    Board,
    BoardView,
    HandEyeCalibration,
    LensCalibration,
    calibrate_hand_eye,
    calibrate_lens,
    find_board,
)
from dyngrasp.perception.picture_files import read_picture
from dyngrasp.perception.picture_folder import TABLE, read_postures
from dyngrasp.signals import Array

SUFFIXES = (".png", ".jpg", ".jpeg")

# A view whose reprojection error is this many times the median is shown as an outlier.
STANDS_OUT = 3.0

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class LookedAt:
    """One picture.

    Attributes:
        path: The file.
        view: What was seen of the board in it.
        left_out: Why it was not used, or None.
        error: Root mean square reprojection error (pixels), of those that were used.
    """

    path: Path
    view: BoardView
    left_out: str | None
    error: float | None = None


@dataclass(frozen=True, eq=False)
class LensFound:
    """The lens from a folder of pictures.

    Attributes:
        pictures: All, those that were left out among them.
        result: From those that were used.
        covered: Share of the picture within the hull of all corners.
        tilt: Largest angle between the line of sight and the board's normal (rad).
    """

    pictures: tuple[LookedAt, ...]
    result: LensCalibration
    covered: float
    tilt: float


@dataclass(frozen=True, eq=False)
class MountFound:
    """The mount from a folder of pictures; attributes as of `LensFound`, `camera` is the given one with the mount."""

    pictures: tuple[LookedAt, ...]
    result: HandEyeCalibration
    camera: CameraModel


def lens_from_folder(
    folder: str | Path, board: Board, camera: CameraModel, progress: Progress = lambda done, total: None
) -> LensFound:
    """The lens, from all PNG and JPEG pictures of a folder.

    Args:
        folder: Holds them; subfolders are not looked into.
        board: What they show.
        camera: Gives the size of the pictures and the first guess.
        progress: Called with the number of pictures done and of all.

    Raises:
        InputFileError: No pictures, one that cannot be read or has another size, or too few views of the board.
    """
    folder = Path(folder)
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    except OSError as error:
        raise InputFileError(folder, None, None, f"a folder of pictures expected: {error.strerror}") from error
    pictures = _look(folder, paths, board, camera, progress)
    views = [picture.view for picture in pictures if picture.left_out is None]
    try:
        result = calibrate_lens(views, board, camera)
    except InvalidProblem as error:
        raise InputFileError(folder, "views", len(views), str(error)) from error
    found = result.camera
    if not (
        np.isfinite(found.undistort(picture_border(found))).all()
        and (found.centre >= 0).all()
        and (found.centre < [found.width, found.height]).all()
    ):
        raise InputFileError(
            folder, "views", len(views),
            f"the lens that fits best (centre {found.centre.round(1).tolist()}, distortion "
            f"{found.distortion.round(3).tolist()}) cannot be one: more tilted views, which reach the picture's "
            "corners, a camera file nearer to the truth, or the true measures of the board are needed",
        )  # fmt: skip
    corners = np.concatenate([view.pixels for view in views])
    return LensFound(
        pictures=_with_errors(pictures, result.view_errors),
        result=result,
        covered=float(ConvexHull(corners).volume) / (found.width * found.height),
        tilt=float(max(np.arccos(min(1.0, abs(T.rotation[2, 2]))) for T in result.T_camera_board)),
    )


def mount_from_folder(
    folder: str | Path,
    board: Board,
    camera: CameraModel,
    robot: RobotModel,
    gripper: GripperModel,
    progress: Progress = lambda done, total: None,
) -> MountFound:
    """Where the camera is on the hand, from pictures of a board that lay still and the postures of `frames.csv`.

    Args:
        folder: Holds table and pictures.
        board: What they show.
        camera: With its lens calibrated.
        robot: The arm.
        gripper: The hand that carried the camera.
        progress: Called with the number of pictures done and of all.

    Raises:
        InputFileError: Table or pictures cannot be used, angles beyond the arm's limits, too few views, or a hand
            that hardly turned.
    """
    folder = Path(folder)
    postures = read_postures(folder, robot.joint_names)
    for i, (_, q) in enumerate(postures):
        _require_within_limits(folder / TABLE, i, q, robot)
    pictures = _look(folder, [path for path, _ in postures], board, camera, progress)
    kept = [k for k, picture in enumerate(pictures) if picture.left_out is None]
    hands = [robot.forward_kinematics(postures[k][1]) * gripper.T_flange_hand for k in kept]
    try:
        result = calibrate_hand_eye([pictures[k].view for k in kept], hands, board, camera)
    except InvalidProblem as error:
        raise InputFileError(folder, "views", len(kept), str(error)) from error
    return MountFound(
        pictures=_with_errors(pictures, result.view_errors),
        result=result,
        camera=replace(camera, T_hand_camera=result.T_hand_camera),
    )


def outliers(pictures: Sequence[LookedAt]) -> tuple[LookedAt, ...]:
    """Used pictures whose error stands out from the others'."""
    errors = [picture.error for picture in pictures if picture.error is not None]
    bound = STANDS_OUT * float(np.median(errors))
    return tuple(picture for picture in pictures if picture.error is not None and picture.error > bound)


def lens_difference(one: CameraModel, other: CameraModel) -> float:
    """Largest distance (pixels) between where two lenses show the same point, anywhere in the picture.

    A shift of the whole picture is left out: it is a turn of the camera, and belongs to the mount.
    """
    u, v = np.meshgrid(np.linspace(0, one.width - 1, 17), np.linspace(0, one.height - 1, 17))
    pixels = np.column_stack([u.ravel(), v.ravel()])
    rays = np.column_stack([one.undistort(pixels), np.ones(len(pixels))])
    shift = other.project(rays)[0] - pixels
    return float(np.linalg.norm(shift - shift.mean(axis=0), axis=1).max())


def mount_difference(one: CameraModel, other: CameraModel) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two mounts."""
    T = one.T_hand_camera.actInv(other.T_hand_camera)
    return float(np.linalg.norm(T.translation)), float(np.linalg.norm(pin.log3(T.rotation)))


def require_new_file(path: str | Path) -> None:
    """Make sure that a file can be put at `path` and that none is there.

    Raises:
        OutputError: There is one, or none can be put there.
    """
    check_writable(path)
    if Path(path).exists():
        raise OutputError(path, "it exists already; take another name, or remove it first")


def write_camera(path: str | Path, camera: CameraModel, remarks: Sequence[str]) -> None:
    """Write a camera's file, and read it again before it counts.

    Args:
        path: There must be none yet.
        camera: What to write.
        remarks: Where the numbers come from; comments in the file.

    Raises:
        OutputError: There is a file, or none can be put there.
        ModelFileError: Numbers that no camera file may hold.
    """
    require_new_file(path)
    with atomic(path) as temporary:
        dated = [f"Written by `dyngrasp calibrate` on {date.today().isoformat()}.", *remarks]
        temporary.write_text(camera_toml(camera, dated), encoding="utf-8")
        read_camera(temporary)


def _look(folder: Path, paths: Sequence[Path], board: Board, camera: CameraModel, progress: Progress) -> list[LookedAt]:
    if len(paths) < LEAST_VIEWS:
        raise InputFileError(
            folder, "pictures", len(paths), f"at least {LEAST_VIEWS} expected ({', '.join(SUFFIXES)}), better 20"
        )
    pictures = []
    for i, path in enumerate(paths):
        progress(i, len(paths))
        pixels = read_picture(path)
        height, width = pixels.shape
        if (width, height) != (camera.width, camera.height):
            raise InputFileError(
                path,
                "size",
                f"{width} x {height}",
                f"the camera {camera.name} takes pictures of {camera.width} x {camera.height}; another camera file, or "
                f"--size {width} {height} if the file's lens is to be scaled",
            )
        view = find_board(pixels, board)
        pictures.append(LookedAt(path, view, view.shortcoming(board)))
    if not any(len(picture.view.ids) for picture in pictures):
        raise InputFileError(
            folder, "views", 0, f"at least {LEAST_VIEWS} expected, but no picture shows a board of {board.columns} x "
            f"{board.rows} squares with markers {board.dictionary}: is it another, or are columns and rows swapped?",
        )  # fmt: skip
    return pictures


def _with_errors(pictures: Sequence[LookedAt], errors: Array) -> tuple[LookedAt, ...]:
    of_used = iter(errors)
    return tuple(picture if picture.left_out else replace(picture, error=float(next(of_used))) for picture in pictures)


def _require_within_limits(path: Path, i: int, q: Array, robot: RobotModel) -> None:
    lower, upper = robot.limits.position_lower, robot.limits.position_upper
    for name, angle, low, high in zip(robot.joint_names, q, lower, upper, strict=True):
        # An encoder at the stop may read a little more.
        if not low - 0.01 <= angle <= high + 0.01:
            raise InputFileError(
                path,
                f"row {i + 1}: {name}",
                round(float(angle), 6),
                f"{low:.4g} to {high:.4g} rad, the limits of {robot.name}; a column of degrees is called {name}_deg",
            )
