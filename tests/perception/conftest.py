"""Pictures drawn from known poses: markers as homographies of their patterns, three by three samples a pixel."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.models.camera import CameraModel
from dyngrasp.models.catalogue import load_camera, load_object
from dyngrasp.models.grasp_object import MARKER_DICTIONARIES, GraspObject

FINE = 3
MODULES, QUIET = 6, 1
PIXELS_A_MODULE = 40


@pytest.fixture(scope="session")
def casting() -> GraspObject:
    return load_object("casting")


@pytest.fixture(scope="session")
def camera() -> CameraModel:
    """The catalogue's camera with the smaller pictures, which are quicker to draw."""
    return load_camera("ava1000").scaled(640, 480)


@pytest.fixture(scope="session")
def draw(camera, casting) -> Callable[..., np.ndarray]:
    """Draw the casting's markers: `draw(T_camera_object, noise, seed, only)` gives a (480, 640) picture."""

    def draw(T: pin.SE3, noise: float = 2.0, seed: int = 0, only: tuple[int, ...] | None = None) -> np.ndarray:
        width, height = camera.width, camera.height
        # 10 % more on each side: the lens bends what lies outside the ideal picture into it.
        margin = np.array([width // 10, height // 10])
        size = FINE * (np.array([width, height]) + 2 * margin)
        canvas = np.full((size[1], size[0]), 120, np.uint8)
        for marker in casting.markers:
            T_camera_marker = T * marker.T_object_marker
            towards = -T_camera_marker.translation @ T_camera_marker.rotation[:, 2]
            if towards <= 0 or (only is not None and marker.id not in only):
                continue
            picture = _pattern(casting.marker_dictionary, marker.id)
            side = len(picture)
            edge = 0.5 * marker.size * (MODULES + 2 * QUIET) / MODULES
            square = np.array([[-edge, edge, 0], [edge, edge, 0], [edge, -edge, 0], [-edge, -edge, 0]])
            points = square @ T_camera_marker.rotation.T + T_camera_marker.translation
            ideal = points[:, :2] / points[:, 2:] * camera.focal + camera.centre
            target = FINE * (ideal + margin + 0.5) - 0.5
            source = np.array([[0, 0], [side, 0], [side, side], [0, side]]) - 0.5
            low = np.maximum(np.floor(target.min(axis=0)).astype(int) - 2, 0)
            high = np.minimum(np.ceil(target.max(axis=0)).astype(int) + 3, size)
            if (high - low).min() <= 0:
                continue
            transform = cv2.getPerspectiveTransform(source.astype(np.float32), (target - low).astype(np.float32))
            extent = tuple(int(n) for n in high - low)
            patch = cv2.warpPerspective(picture, transform, extent, flags=cv2.INTER_AREA)
            mask = cv2.warpPerspective(np.full_like(picture, 255), transform, extent, flags=cv2.INTER_LINEAR)
            view = canvas[low[1] : high[1], low[0] : high[0]]
            view[mask > 127] = patch[mask > 127]
        seen = cv2.remap(canvas, *_lens(camera, tuple(margin)), cv2.INTER_LINEAR)
        picture = cv2.resize(seen, (width, height), interpolation=cv2.INTER_AREA).astype(float)
        picture += np.random.default_rng(seed).normal(0.0, noise, picture.shape)
        return np.clip(np.round(picture), 0, 255).astype(np.uint8)

    return draw


def looking_down(distance: float, tilt: float = 0.0, yaw: float = 0.0, turn: float = 0.0) -> pin.SE3:
    """The part `distance` (m) before the camera, which looks at its upper side; angles in rad."""
    facing = np.diag([1.0, -1.0, -1.0])
    rotation = pin.exp3(np.array([np.cos(turn), np.sin(turn), 0.0]) * tilt) @ facing
    T = pin.SE3(rotation, np.array([0.0, 0.0, distance])) * pin.SE3(pin.exp3(np.array([0, 0, yaw])), np.zeros(3))
    # The middle of the upper markers stands on the optical axis.
    return T * pin.SE3(np.eye(3), np.array([-0.02, 0.0, 0.055]))


@cache
def _pattern(dictionary: str, number: int) -> np.ndarray:
    inner = cv2.aruco.generateImageMarker(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, MARKER_DICTIONARIES[dictionary])),
        number,
        MODULES * PIXELS_A_MODULE,
    )
    return np.pad(inner, QUIET * PIXELS_A_MODULE, constant_values=255)


@cache
def _lens(camera: CameraModel, margin: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(FINE * camera.width), np.arange(FINE * camera.height))
    pixels = (np.column_stack([u.ravel(), v.ravel()]) + 0.5) / FINE - 0.5
    ideal = camera.undistort(pixels) * camera.focal + camera.centre
    source = (FINE * (ideal + np.array(margin) + 0.5) - 0.5).astype(np.float32).reshape(*u.shape, 2)
    return source[..., 0], source[..., 1]
