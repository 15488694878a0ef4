"""Pictures of a calibration board as a camera on the simulated hand takes them, with the arm's angles at each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.experiments.output import OutputFolder, atomic
from dyngrasp.models.camera import CameraModel, camera_toml
from dyngrasp.models.catalogue import load_object
from dyngrasp.models.gripper import GripperModel
from dyngrasp.models.inverse_kinematics import inverse_kinematics_for
from dyngrasp.models.robot import RobotModel
from dyngrasp.perception.board_pictures import MARGIN, board_picture
from dyngrasp.perception.calibration import Board
from dyngrasp.perception.picture_files import png
from dyngrasp.perception.picture_folder import TABLE, TakenPicture, table
from dyngrasp.signals import Array
from dyngrasp.simulation.camera_sensor import CameraSensor, ImagingSettings
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.plant import ContactCategory
from dyngrasp.simulation.printed_sheet import PrintedSheet
from dyngrasp.simulation.scene import Scene, build_scene

TRUE_CAMERA = "true_camera.toml"

# Middle of the board on the ground before the arm, and a turn that no axis of the cell shares.
T_WORLD_SHEET = pin.SE3(pin.utils.rotate("z", 1.2), np.array([0.58, 0.05, 0.0]))
PLATE = 0.003  # m: what the board is glued to

# From camera to board (m), between the line of sight and the board's normal (rad), and about the line of sight (rad).
DISTANCE, TILT, ROLL = (0.32, 0.5), 0.6, 0.8

# The line of sight meets the board within this share of its half edges, so that corners come near the picture's edges.
ASIDE = 0.5

# Of all corners, in a picture that counts.
LEAST_SHARE = 0.6

# The part's place: behind the arm, where no picture shows it.
AWAY = (-0.8, 0.4)

_CLEAR_OF = (ContactCategory.ROBOT_GROUND, ContactCategory.ROBOT_ROBOT, ContactCategory.OTHER_ROBOT_PART)
_ATTEMPTS = 40  # a picture


@dataclass(frozen=True, eq=False)
class BoardCell:
    """Arm and hand over a board on the ground.

    Attributes:
        robot, gripper: The arm, and the hand that carries the camera.
        board: What lies there.
        camera: The true one.
    """

    robot: RobotModel
    gripper: GripperModel
    board: Board
    camera: CameraModel

    @property
    def T_world_board(self) -> pin.SE3:
        """Where the board is; its frame is OpenCV's, in the corner and with z into the plate."""
        half = 0.5 * self.board.square * np.array([self.board.columns, self.board.rows])
        corner = np.array([-half[0], half[1], PLATE])
        return T_WORLD_SHEET * pin.SE3(np.diag([1.0, -1.0, -1.0]), corner)

    def scene(self) -> Scene:
        """The world with the board in it."""
        board = self.board
        width = board.columns * board.square + 2 * MARGIN
        sheet = PrintedSheet("board", board_picture(board), width, PLATE, T_WORLD_SHEET)
        return build_scene(self.robot, self.gripper, load_object("casting"), sheets=[sheet])


def another_copy(camera: CameraModel, rng: np.random.Generator) -> CameraModel:
    """A camera of the same make, as it may have been built and screwed on: what a calibration is for.

    Focal lengths differ by 1 %, the centre by 8 pixels of 1024, the first two coefficients by a fifth, the mount by
    3 mm and 1° (standard deviations of each number).
    """
    k1, k2, p1, p2, k3 = camera.distortion
    turn = np.concatenate([rng.normal(0.0, 3e-3, 3), rng.normal(0.0, np.deg2rad(1.0), 3)])
    return replace(
        camera,
        focal=camera.focal * (1.0 + rng.normal(0.0, 0.01)) * (1.0 + rng.normal(0.0, 1e-3, 2)),
        centre=camera.centre + rng.normal(0.0, 8.0 / 1024.0, 2) * camera.width,
        distortion=np.array([*(np.array([k1, k2]) * (1.0 + rng.normal(0.0, 0.2, 2))), p1, p2, k3]),
        T_hand_camera=camera.T_hand_camera * pin.exp6(turn),
    )


def render_board_views(
    cell: BoardCell,
    folder: OutputFolder,
    count: int,
    seed: int,
    progress: Callable[[int], None] = lambda done: None,
) -> None:
    """Write pictures, `frames.csv` and the true camera into a folder.

    Args:
        cell: What there is to see and who looks.
        folder: Where the files go.
        count: Of the pictures.
        seed: Draws postures and noise.
        progress: Called with the number of pictures done.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
        InvalidProblem: The arm cannot bring the camera over the board.
    """
    rng = np.random.default_rng(seed)
    scene = cell.scene()
    taken = []
    with CameraSensor(scene, cell.camera, ImagingSettings(seed=seed)) as sensor:
        for k in range(count):
            progress(k)
            q, state = _posture(cell, scene, rng)
            # The arm stops for every picture; a second is what that takes.
            picture = sensor.capture([state], [float(k)])
            taken.append(TakenPicture(folder / f"{k:04d}.png", float(k), float(k), q))
            with atomic(taken[-1].path) as temporary:
                temporary.write_bytes(png(picture.pixels))
    remark = "The camera that took the pictures of this folder: what a calibration should find."
    for name, text in (
        (TABLE, table(taken, cell.robot.joint_names)),
        (TRUE_CAMERA, camera_toml(cell.camera, (remark,))),
    ):
        with atomic(folder / name) as temporary:
            temporary.write_text(text, encoding="utf-8")


def _posture(cell: BoardCell, scene: Scene, rng: np.random.Generator) -> tuple[Array, Array]:
    """Angles of the arm from which enough of the board is seen and nothing is touched, and the state of the scene."""
    robot, gripper, camera = cell.robot, cell.gripper, cell.camera
    kinematics = inverse_kinematics_for(robot)
    middle = 0.5 * (robot.limits.position_lower + robot.limits.position_upper)
    T_flange_camera = gripper.T_flange_hand * camera.T_hand_camera
    part = load_object("casting")
    T_part = pin.SE3(np.eye(3), np.array([*AWAY, part.rest_height]))
    for _ in range(_ATTEMPTS):
        T_world_camera = _view(cell.board, cell.T_world_board, rng)
        if _share_seen(cell, T_world_camera) < LEAST_SHARE:
            continue
        try:
            q = kinematics.nearest(T_world_camera * T_flange_camera.inverse(), middle)
        except OutOfReach:
            continue
        plant = MujocoPlant(scene, q, gripper.open_posture, T_part)
        touching = plant.truth().contacts
        if not any(touching[category] for category in _CLEAR_OF):
            return q, plant.state
    raise InvalidProblem(
        f"{robot.name} with {gripper.name} found no posture in {_ATTEMPTS} attempts from which {camera.name} sees a board "
        f"of {cell.board.columns} × {cell.board.rows} squares of {1e3 * cell.board.square:g} mm: take a smaller board"
    )


def _view(board: Board, T_world_board: pin.SE3, rng: np.random.Generator) -> pin.SE3:
    """T_world_camera: on a point of the board, from above, tilted and turned about the line of sight."""
    half = 0.5 * board.square * np.array([board.columns, board.rows])
    aim = np.array([*(half * (1.0 + rng.uniform(-ASIDE, ASIDE, 2))), 0.0])
    azimuth = rng.uniform(-np.pi, np.pi)
    tilt = pin.exp3(rng.uniform(0.0, TILT) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    # The board's z points into it, and so does the camera's.
    R = tilt @ pin.utils.rotate("z", rng.uniform(-ROLL, ROLL))
    return T_world_board * pin.SE3(R, aim) * pin.SE3(np.eye(3), np.array([0.0, 0.0, -rng.uniform(*DISTANCE)]))


def _share_seen(cell: BoardCell, T_world_camera: pin.SE3) -> float:
    T = T_world_camera.actInv(cell.T_world_board)
    corners = cell.board.corners
    pixels = cell.camera.project(corners @ T.rotation.T + T.translation)[0]
    inside = ((pixels > 0.0) & (pixels < np.array([cell.camera.width, cell.camera.height]) - 1.0)).all(axis=1)
    return float(np.mean(inside))
