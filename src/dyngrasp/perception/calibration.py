"""The camera's lens from pictures of a ChArUco board, and its place on the hand from the arm's poses at each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.grasp_object import MARKER_DICTIONARIES, MarkerDictionary
from dyngrasp.signals import Array, read_only

# Corners of a view that a homography with some redundancy needs.
LEAST_CORNERS = 8

LEAST_VIEWS = 5

# Standard deviation of the focal length as a share of it. Ten views with tilts of 30° have 0.15 %, of 6° 1.7 %, of 3°
# 6 %, of none any number: then the board may be as well nearer and the lens shorter.
MOST_FOCAL_DEVIATION = 0.03

# Root mean square turn of the hand about a second axis (rad): below it the mount along the first one is not determined.
LEAST_TURN = np.deg2rad(5.0)


@dataclass(frozen=True)
class Board:
    """A ChArUco board: a chessboard with markers in its white squares. Its frame as OpenCV's: z into the board.

    Attributes:
        columns, rows: Number of squares.
        square, marker: Edges (m).
        dictionary: Family of the markers.
    """

    columns: int = 8
    rows: int = 6
    square: float = 0.03
    marker: float = 0.022
    dictionary: MarkerDictionary = "5x5_50"

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3:
            raise InvalidProblem(f"a board of at least 3 × 3 squares expected, got {self.columns} × {self.rows}")
        inner = (self.columns - 1) * (self.rows - 1)
        if inner < LEAST_CORNERS:
            raise InvalidProblem(
                f"{self.columns} × {self.rows} squares have {inner} corners between them, {LEAST_CORNERS} are needed"
            )
        if not 0.0 < self.marker < self.square:
            raise InvalidProblem(f"0 < marker < square expected, got {self.marker} and {self.square} m")
        markers = self.columns * self.rows // 2
        if markers > 50:
            raise InvalidProblem(f"{markers} markers on the board; its dictionary has at least 50: take fewer squares")

    @property
    def corners(self) -> Array:
        """((columns − 1)(rows − 1), 3) inner corners in the board frame (m), by number."""
        return np.asarray(self.opencv().getChessboardCorners(), dtype=float)

    def opencv(self) -> cv2.aruco.CharucoBoard:
        """The same as OpenCV has it."""
        family = getattr(cv2.aruco, MARKER_DICTIONARIES[self.dictionary])
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square, self.marker, cv2.aruco.getPredefinedDictionary(family))


@dataclass(frozen=True, eq=False)
class BoardView:
    """The board in one picture: numbers of its corners (k,) and where they are (k, 2), in pixels."""

    ids: NDArray[np.int_]
    pixels: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "pixels", read_only(self.pixels, (len(self.ids), 2)))

    def shortcoming(self, board: Board) -> str | None:
        """Why the view determines no pose with something to spare, in words; None where it does."""
        if len(self.ids) == 0:
            return "no board seen"
        if len(self.ids) < LEAST_CORNERS:
            return f"{len(self.ids)} corners seen, {LEAST_CORNERS} needed"
        places = board.corners[self.ids, :2]
        spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)
        return None if spread[1] > 0.1 * board.square else "all corners seen are in one line"


@dataclass(frozen=True, eq=False)
class LensCalibration:
    """What the pictures say about the lens.

    Attributes:
        camera: The camera with the numbers found.
        error: Root mean square of the reprojection errors' lengths (pixels).
        view_errors: The same for each view; one that stands out is blurred or of another board.
        focal_deviation: (2,) standard deviations of the focal lengths (pixels).
        T_camera_board: Where the board was in each view.
    """

    camera: CameraModel
    error: float
    view_errors: Array
    focal_deviation: Array
    T_camera_board: tuple[pin.SE3, ...]


@dataclass(frozen=True, eq=False)
class HandEyeCalibration:
    """What pictures and arm poses together say about the mount.

    Attributes:
        T_hand_camera: The mount.
        T_world_board: Where the board is.
        error: Root mean square of the reprojection errors' lengths (pixels).
        view_errors: The same for each view; one that stands out has another posture than was noted.
        deviation: (6,) standard deviations of the mount, [translation (m), rotation (rad)], if the lens is
            exact; the arm's errors are counted as far as they differ from view to view.
        lens_deviation: (6,) what comes on top (in squares) if the lens was calibrated from views as many and as good
            as these, or from these: a shift of its centre looks much like a turn of the camera.
    """

    T_hand_camera: pin.SE3
    T_world_board: pin.SE3
    error: float
    view_errors: Array
    deviation: Array
    lens_deviation: Array


def find_board(image: NDArray[np.uint8], board: Board) -> BoardView:
    """The board's corners in a picture, refined; none where it is not seen.

    Args:
        image: (height, width) grey values.
        board: What to look for.

    Raises:
        InvalidProblem: Not such an array.
    """
    if image.dtype != np.uint8 or image.ndim != 2:
        raise InvalidProblem(f"a grey picture of uint8, (h, w), expected; got {image.dtype} {image.shape}")
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv()).detectBoard(image)
    if corners is None or ids is None:
        return BoardView(np.zeros(0, dtype=int), np.zeros((0, 2)))
    return BoardView(np.ravel(ids).astype(int), np.asarray(corners, dtype=float).reshape(-1, 2))


def calibrate_lens(views: Sequence[BoardView], board: Board, camera: CameraModel) -> LensCalibration:
    """Focal lengths, centre and k1, k2, p1, p2; k3 stays zero, as a view of 40° does not determine it.

    Args:
        views: Of the board at different tilts and places of the picture, at least five.
        board: What was seen.
        camera: Gives the picture's size, and the first guess.

    Raises:
        InvalidProblem: Too few views, views with too few corners, or views so alike that the focal length stays open.
    """
    if len(views) < LEAST_VIEWS:
        raise InvalidProblem(f"a lens needs at least {LEAST_VIEWS} views of the board, got {len(views)}")
    _require_corners(views, board)
    objects = [board.corners[view.ids].astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32)[:, None] for view in views]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    _, matrix, distortion, turns, shifts = cv2.calibrateCamera(
        objects, pixels, (camera.width, camera.height), camera.matrix, np.zeros(5), flags=flags
    )
    found = replace(
        camera,
        focal=np.array([matrix[0, 0], matrix[1, 1]]),
        centre=np.array([matrix[0, 2], matrix[1, 2]]),
        distortion=np.ravel(distortion)[:5],
    )
    poses = tuple(
        pin.SE3(pin.exp3(np.ravel(turn)), np.ravel(shift).astype(float))
        for turn, shift in zip(turns, shifts, strict=True)
    )
    errors = [_lengths(found, T, board, view) for T, view in zip(poses, views, strict=True)]
    deviation = np.sqrt(np.diag(_lens_covariance(found, poses, board, views))[:2])
    share = np.max(deviation / found.focal)
    if not share < MOST_FOCAL_DEVIATION:
        raise InvalidProblem(
            f"the views leave the focal length open by {100 * share:.1f} % (one standard deviation; "
            f"{100 * MOST_FOCAL_DEVIATION:g} % at most): tilt the board by some 30° in different directions"
        )
    return LensCalibration(
        camera=found,
        error=float(np.sqrt(np.mean(np.concatenate(errors) ** 2))),
        view_errors=np.array([np.sqrt(np.mean(lengths**2)) for lengths in errors]),
        focal_deviation=deviation,
        T_camera_board=poses,
    )


def calibrate_hand_eye(
    views: Sequence[BoardView], T_world_hand: Sequence[pin.SE3], board: Board, camera: CameraModel
) -> HandEyeCalibration:
    """The mount of a camera whose lens is known, from a board that stays where it is.

    Park and Martin's closed form begins; then mount and board are moved together until the corners of all views fit
    best: that weighs each view by what it says, which the closed form does not.

    Args:
        views: Of the board, at least five.
        T_world_hand: The hand at each of them, from the joint positions.
        board: What was seen.
        camera: Its lens; its own mount is not used.

    Raises:
        InvalidProblem: Too few views or corners, poses that are not one for each view, or a hand that never turned
            about two axes.
    """
    if len(views) != len(T_world_hand):
        raise InvalidProblem(f"one pose of the hand for each view expected, got {len(T_world_hand)} for {len(views)}")
    if len(views) < LEAST_VIEWS:
        raise InvalidProblem(f"the mount needs at least {LEAST_VIEWS} views of the board, got {len(views)}")
    _require_corners(views, board)
    _require_turns(T_world_hand)
    T_camera_board = [_board_pose(camera, board, view) for view in views]
    rotation, translation = cv2.calibrateHandEye(
        [T.rotation for T in T_world_hand],
        [T.translation for T in T_world_hand],
        [T.rotation for T in T_camera_board],
        [T.translation for T in T_camera_board],
        method=cv2.CALIB_HAND_EYE_PARK,
    )
    mount = pin.SE3(np.asarray(rotation, dtype=float), np.ravel(translation).astype(float))
    place = T_world_hand[0] * mount * T_camera_board[0]

    def residual(step: Array) -> Array:
        X, B = mount * pin.exp6(step[:6]), place * pin.exp6(step[6:])
        return np.concatenate(
            [
                _residual(camera, (T * X).actInv(B), board, view).ravel()
                for T, view in zip(T_world_hand, views, strict=True)
            ]
        )

    # Lengths in metres and turns in radians matter about equally at arm's length: no scaling is needed.
    found = least_squares(residual, np.zeros(12), method="lm")
    ends = np.cumsum([2 * len(view.ids) for view in views])[:-1]
    # The corners of a view share the arm's error: views are independent of one another, corners need not be (White's
    # covariance, by view). Twelve unknowns fit what six numbers of each view leave.
    scores = [J.T @ r for J, r in zip(np.split(found.jac, ends), np.split(found.fun, ends), strict=True)]
    bread = np.linalg.inv(found.jac.T @ found.jac)
    covariance = len(views) / (len(views) - 2) * bread @ (np.transpose(scores) @ scores) @ bread
    deviation = np.sqrt(np.diag(covariance)[:6])
    mount, place = mount * pin.exp6(found.x[:6]), place * pin.exp6(found.x[6:])
    T_camera_board = [(T * mount).actInv(place) for T in T_world_hand]
    of_lens = _lens_covariance(camera, T_camera_board, board, views)
    by_lens = [
        _by_lens(camera, board.corners[view.ids] @ T.rotation.T + T.translation).reshape(-1, 8)
        for T, view in zip(T_camera_board, views, strict=True)
    ]
    # How the mount that fits best moves with the lens that is believed.
    slope = np.linalg.lstsq(found.jac, np.vstack(by_lens))[0][:6]
    return HandEyeCalibration(
        T_hand_camera=mount,
        T_world_board=place,
        error=float(np.sqrt(2.0 * np.mean(found.fun**2))),
        view_errors=np.array([np.sqrt(2.0 * np.mean(part**2)) for part in np.split(found.fun, ends)]),
        deviation=deviation,
        lens_deviation=np.sqrt(np.diag(slope @ of_lens @ slope.T)),
    )


def _require_corners(views: Sequence[BoardView], board: Board) -> None:
    poor = [k for k, view in enumerate(views) if view.shortcoming(board)]
    if poor:
        raise InvalidProblem(
            f"views {poor} show fewer than {LEAST_CORNERS} corners of the board, or one line of them: leave them out"
        )


def _require_turns(T_world_hand: Sequence[pin.SE3]) -> None:
    turns = [pin.log3(T_world_hand[0].rotation.T @ T.rotation) for T in T_world_hand[1:]]
    # Two axes: the second largest singular value says how far the hand turned out of its main plane of turning.
    spread = np.linalg.svd(np.array(turns), compute_uv=False)[1] / np.sqrt(len(turns))
    if spread < LEAST_TURN:
        raise InvalidProblem(
            f"the hand turned by {np.rad2deg(spread):.2g}° (root mean square) about a second axis; the mount needs at "
            f"least {np.rad2deg(LEAST_TURN):.2g}° about each of two axes"
        )


def _board_pose(camera: CameraModel, board: Board, view: BoardView) -> pin.SE3:
    rays = camera.undistort(view.pixels)
    _, turn, shift = cv2.solvePnP(board.corners[view.ids], rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    _, turn, shift = cv2.solvePnP(
        board.corners[view.ids], rays, np.eye(3), None, turn, shift, useExtrinsicGuess=True
    )  # fmt: skip
    return pin.SE3(pin.exp3(np.ravel(turn)), np.ravel(shift).astype(float))


def _residual(camera: CameraModel, T_camera_board: pin.SE3, board: Board, view: BoardView) -> Array:
    points = board.corners[view.ids] @ T_camera_board.rotation.T + T_camera_board.translation
    return camera.project(points)[0] - view.pixels


def _lens_covariance(
    camera: CameraModel, T_camera_board: Sequence[pin.SE3], board: Board, views: Sequence[BoardView]
) -> Array:
    """(8, 8) of fx, fy, cx, cy, k1, k2, p1, p2. OpenCV's own is of no use without tilts: it drops what is open.

    What a view's pose explains, errors of the arm among it, says nothing about the lens and is taken out.
    """
    information, squares, count = np.zeros((8, 8)), 0.0, -8
    for T, view in zip(T_camera_board, views, strict=True):
        points = board.corners[view.ids] @ T.rotation.T + T.translation
        by_point = camera.project(points)[1]
        by_pose = np.concatenate([by_point, -by_point @ np.array([pin.skew(p) for p in points])], axis=2)
        by_lens, by_pose = _by_lens(camera, points).reshape(-1, 8), by_pose.reshape(-1, 6)
        residual = _residual(camera, T, board, view).ravel()
        # What is left of the lens's columns once the pose has taken its part: the Schur complement, without squaring.
        basis = np.linalg.qr(by_pose)[0]
        left, unexplained = by_lens - basis @ (basis.T @ by_lens), residual - basis @ (basis.T @ residual)
        information += left.T @ left
        squares += float(unexplained @ unexplained)
        count += residual.size - 6
    # Focal lengths (hundreds of pixels) and coefficients (hundredths) share a matrix: scaled, for its inverse.
    scale = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    inverse = (vectors / np.maximum(values, np.finfo(float).eps)) @ vectors.T / np.outer(scale, scale)
    return squares / max(count, 1) * inverse


def _by_lens(camera: CameraModel, points: Array) -> Array:
    """(k, 2, 8) derivatives of pixels by fx, fy, cx, cy, k1, k2, p1, p2."""
    x, y = normalised = points[:, :2].T / points[:, 2]
    r2 = x * x + y * y
    slope = np.zeros((len(points), 2, 8))
    slope[:, [0, 1], [0, 1]] = camera.distort(normalised.T)[0]
    slope[:, [0, 1], [2, 3]] = 1.0
    slope[:, :, 4] = camera.focal * (normalised * r2).T
    slope[:, :, 5] = camera.focal * (normalised * r2**2).T
    slope[:, :, 6] = camera.focal * np.column_stack([2.0 * x * y, r2 + 2.0 * y * y])
    slope[:, :, 7] = camera.focal * np.column_stack([r2 + 2.0 * x * x, 2.0 * x * y])
    return slope


def _lengths(camera: CameraModel, T_camera_board: pin.SE3, board: Board, view: BoardView) -> Array:
    return np.linalg.norm(_residual(camera, T_camera_board, board, view), axis=1)
