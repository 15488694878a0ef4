"""Pictures of a calibration board in the simulated cell, with the postures they were taken at: to try a calibration on.

The camera that takes them is not quite the one of the file: lens and mount are off as those of a camera may be that
somebody has just screwed on. Calibration is to find them; the truth lies beside the pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.experiments.output import OutputError, OutputFolder, atomic
from dyngrasp.models.camera import CameraModel, camera_toml
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.models.inverse_kinematics import inverse_kinematics_for
from dyngrasp.perception.board_pictures import MARGIN, board_picture
from dyngrasp.perception.calibration import Board
from dyngrasp.perception.picture_files import png
from dyngrasp.perception.picture_folder import TABLE, TakenPicture, table
from dyngrasp.signals import Array
from dyngrasp.simulation.camera_sensor import CameraSensor, ImagingSettings, Picture
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.plant import ContactCategory
from dyngrasp.simulation.printed_sheet import PrintedSheet
from dyngrasp.simulation.scene import build_scene

TRUTH = "truth.toml"

# The board's middle on the ground (m), and a plate under the paper.
PLACE, THICKNESS = np.array([0.55, 0.0, 0.0]), 0.003

# Where the part is out of the way (m).
ASIDE = np.array([-0.9, 0.0])

# Near it the hand looks straight down, 0.65 m above the ground.
POSTURE = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])

# Of the views: distance of the camera from the board's middle (m), below which the fingers touch the ground; largest
# tilt of the board and turn about its normal (rad); how far its middle is from the line of sight (m).
DISTANCES, TILT, TURN, OFF_AXIS = (0.34, 0.52), np.deg2rad(52.0), np.deg2rad(70.0), 0.09

# Share of the board's corners that has to be in the picture, fingers not counted.
LEAST_SHARE = 0.5

ATTEMPTS = 200


@dataclass(frozen=True, eq=False)
class FilmedView:
    """One picture: grey values (h, w), and the (n,) joint angles of the arm that held the camera (rad)."""

    picture: Picture
    arm_position: Array


def mounted_by_hand(nominal: CameraModel, seed: int) -> CameraModel:
    """A camera as it may turn out: focal lengths off by up to 0.7 %, the centre by 8 of 1024 pixels, the mount by 5 mm.

    Args:
        nominal: As the file has it.
        seed: Draws the deviations.
    """
    rng = np.random.default_rng([seed, 1])
    common, each = rng.uniform(-7e-3, 7e-3), rng.uniform(-1e-3, 1e-3, 2)
    return replace(
        nominal,
        focal=nominal.focal * (1.0 + common + each),
        centre=nominal.centre + rng.uniform(-8.0, 8.0, 2) * nominal.width / 1024.0,
        distortion=nominal.distortion + rng.uniform(-1.0, 1.0, 5) * np.array([0.02, 0.02, 3e-4, 3e-4, 0.0]),
        T_hand_camera=nominal.T_hand_camera
        * pin.SE3(pin.exp3(rng.uniform(-0.02, 0.02, 3)), rng.uniform(-5e-3, 5e-3, 3)),
    )


def film_board(
    camera: CameraModel, board: Board, count: int, seed: int, settings: ImagingSettings | None = None
) -> Iterator[FilmedView]:
    """Move the arm around the board and take a picture of it wherever the arm comes to rest.

    Args:
        camera: The true one.
        board: Lies on the ground before the arm.
        count: Of the pictures.
        seed: Draws the views.
        settings: Light and noise.

    Yields:
        The views; postures are the inverse kinematics of views that the arm reaches without touching ground or itself.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
        InvalidProblem: No such views: the board is too large.
    """
    robot, gripper, part = load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting")
    edge = min(240, 4096 // max(board.columns, board.rows))
    width = board.columns * board.square + 2 * MARGIN
    T_world_sheet = pin.SE3(np.eye(3), PLACE)
    sheet = PrintedSheet("board", board_picture(board, edge), width, THICKNESS, T_world_sheet)
    scene = build_scene(robot, gripper, part, sheets=[sheet])
    T_world_part = pin.SE3(np.eye(3), np.array([*ASIDE, part.rest_height]))
    kinematics = inverse_kinematics_for(robot)
    T_flange_camera = gripper.T_flange_hand * camera.T_hand_camera
    corners = board.corners - board.corners.mean(axis=0)
    rng = np.random.default_rng(seed)
    T_world_middle = T_world_sheet * pin.SE3(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, THICKNESS]))
    with CameraSensor(scene, camera, settings or ImagingSettings(seed=seed)) as sensor:
        for number in range(count):
            for _ in range(ATTEMPTS):
                T = _view(rng)
                pixels, _ = camera.project(corners @ T.rotation.T + T.translation)
                inside = ((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1])).all(axis=1)
                if inside.mean() < LEAST_SHARE:
                    continue
                try:
                    q = kinematics.nearest(T_world_middle * T.inverse() * T_flange_camera.inverse(), POSTURE)
                except OutOfReach:
                    continue
                plant = MujocoPlant(scene, q, gripper.open_posture, T_world_part)
                touching = plant.truth().contacts
                if not (touching[ContactCategory.ROBOT_GROUND] or touching[ContactCategory.ROBOT_ROBOT]):
                    break
            else:
                raise InvalidProblem(
                    f"{ATTEMPTS} draws without a view that the arm reaches and that shows enough of a board of "
                    f"{board.columns} × {board.rows} squares of {1e3 * board.square:g} mm: take a smaller one"
                )
            yield FilmedView(sensor.capture([plant.state], [float(number)]).pixels, q)


def write_board_film(
    folder: str | Path,
    nominal: CameraModel,
    board: Board,
    count: int,
    seed: int,
    settings: ImagingSettings | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> CameraModel:
    """Pictures, `frames.csv` and the true camera, `truth.toml`, in a new folder.

    Args:
        folder: Does not exist, or is empty.
        nominal: The camera as its file has it.
        board: What lies in the cell.
        count: Of the pictures.
        seed: Draws the true camera and the views.
        settings: Light and noise.
        progress: Called with the number of pictures done.

    Returns:
        The true camera.

    Raises:
        OutputError: The folder holds something already, or cannot be written.
        RenderingUnavailable, InvalidProblem: As for `film_board`.
    """
    if Path(folder).is_dir() and any(Path(folder).iterdir()):
        raise OutputError(folder, "the folder is not empty; take another name")
    true = mounted_by_hand(nominal, seed)
    taken = []
    with OutputFolder(folder) as out:
        for number, view in enumerate(film_board(true, board, count, seed, settings)):
            path = out / f"{number:04d}.png"
            _write(path, png(view.picture))
            # Taken at rest, a second apart: the times say no more than the order.
            taken.append(TakenPicture(path, float(number), float(number), view.arm_position))
            progress(number + 1)
        _write(out / TABLE, table(taken, load_robot("iiwa14").joint_names).encode())
        remark = "The camera that took these pictures. A calibration is to find it without this file."
        _write(out / TRUTH, camera_toml(true, [remark]).encode())
    return true


def _view(rng: np.random.Generator) -> pin.SE3:
    """The board's middle before the camera; where the board faces it the rotation is one about the line of sight."""
    towards = rng.uniform(-np.pi, np.pi)
    tilt = rng.uniform(0.0, TILT) * np.array([np.cos(towards), np.sin(towards), 0.0])
    rotation = pin.exp3(tilt) @ pin.exp3(np.array([0.0, 0.0, rng.uniform(-TURN, TURN)]))
    return pin.SE3(rotation, np.array([*rng.uniform(-OFF_AXIS, OFF_AXIS, 2), rng.uniform(*DISTANCES)]))


def _write(path: Path, content: bytes) -> None:
    with atomic(path) as temporary:
        temporary.write_bytes(content)
