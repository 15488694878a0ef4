"""The camera: pinhole with OpenCV's five distortion coefficients, and where it sits on the hand.

Written in numpy and not with OpenCV: planner, perception and the simulated sensor all read it, and only the
last two may need OpenCV. Equations: x' = x/z, r² = x'² + y'²,
x'' = x'(1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x'y' + p2(r² + 2x'²), likewise y''; u = fx x'' + cx.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from dyngrasp.errors import ModelFileError
from dyngrasp.models.model_file import Finite, NonNegative, PoseTable, Positive, StrictSchema, decode, read_toml
from dyngrasp.signals import Array, read_only

# Newton's method from the distorted point; real lenses need four or five steps to rounding.
UNDISTORT_STEPS = 20
UNDISTORT_TOLERANCE = 1e-11


class SensorTable(StrictSchema):
    """`[sensor]`."""

    width: int
    height: int
    rate_hz: Positive
    exposure_s: NonNegative


class IntrinsicsTable(StrictSchema):
    """`[intrinsics]` in pixels; distortion k1, k2, p1, p2, k3."""

    fx: Positive
    fy: Positive
    cx: Finite
    cy: Finite
    distortion: tuple[Finite, Finite, Finite, Finite, Finite]


class CameraFile(StrictSchema):
    """A camera's model.toml. `mount` is the camera frame in the hand frame."""

    kind: Literal["camera"]
    name: str
    description: str = ""
    sensor: SensorTable
    intrinsics: IntrinsicsTable
    mount: PoseTable


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A camera on the hand. Its frame: z along the view, x to the right and y downwards in the picture.

    Attributes:
        name, description: As in the model file.
        width, height: Of the picture (pixels).
        focal: (2,) fx, fy (pixels).
        centre: (2,) cx, cy (pixels), counted from the centre of the upper left pixel.
        distortion: (5,) k1, k2, p1, p2, k3 as OpenCV orders them.
        T_hand_camera: The mount.
        rate: Pictures per second (Hz).
        exposure: How long the shutter is open (s).
    """

    name: str
    description: str
    width: int
    height: int
    focal: Array
    centre: Array
    distortion: Array
    T_hand_camera: pin.SE3
    rate: float
    exposure: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "focal", read_only(self.focal, (2,)))
        object.__setattr__(self, "centre", read_only(self.centre, (2,)))
        object.__setattr__(self, "distortion", read_only(self.distortion, (5,)))

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix as OpenCV takes it."""
        (fx, fy), (cx, cy) = self.focal, self.centre
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Where points are seen.

        Args:
            points: (k, 3) in the camera frame (m).

        Returns:
            (k, 2) pixels, and their (k, 2, 3) derivatives by the points (pixels/m). NaN for points that are not before
            the camera. Pixels may lie outside the picture.
        """
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        z = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        normalised = points[:, :2] / z[:, None]
        distorted, slope = self.distort(normalised)
        perspective = np.zeros((len(points), 2, 3))
        perspective[:, 0, 0] = perspective[:, 1, 1] = 1.0 / z
        perspective[:, :, 2] = -normalised / z[:, None]
        pixels = self.focal * distorted + self.centre
        return pixels, self.focal[None, :, None] * (slope @ perspective)

    def distort(self, normalised: ArrayLike) -> tuple[Array, Array]:
        """What the lens does to directions.

        Args:
            normalised: (k, 2) x/z and y/z of an ideal pinhole.

        Returns:
            (k, 2) distorted, and the (k, 2, 2) derivatives.
        """
        k1, k2, p1, p2, k3 = self.distortion
        x, y = np.asarray(normalised, dtype=float).reshape(-1, 2).T
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        radial_slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2))  # by r², times two: d r² / dx = 2x
        distorted = np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ]
        )
        slope = np.empty((x.size, 2, 2))
        slope[:, 0, 0] = radial + x * x * radial_slope + 2.0 * p1 * y + 6.0 * p2 * x
        slope[:, 1, 1] = radial + y * y * radial_slope + 6.0 * p1 * y + 2.0 * p2 * x
        slope[:, 0, 1] = slope[:, 1, 0] = x * y * radial_slope + 2.0 * p1 * x + 2.0 * p2 * y
        return distorted, slope

    def undistort(self, pixels: ArrayLike) -> Array:
        """Directions in which pixels look.

        Args:
            pixels: (k, 2).

        Returns:
            (k, 2) x/z and y/z of an ideal pinhole; NaN where the lens model has no inverse (far outside the picture).
        """
        target = (np.asarray(pixels, dtype=float).reshape(-1, 2) - self.centre) / self.focal
        found = target.copy()
        error = np.full(len(target), np.inf)
        with np.errstate(all="ignore"):  # points without an inverse may run away; they become NaN below
            for _ in range(UNDISTORT_STEPS):
                distorted, slope = self.distort(found)
                residual = target - distorted
                error = np.abs(residual).max(axis=1)
                if not (error > UNDISTORT_TOLERANCE).any():
                    break
                (a, b), (c, d) = np.moveaxis(slope, 0, -1)
                determinant = a * d - b * c
                found[:, 0] += (d * residual[:, 0] - b * residual[:, 1]) / determinant
                found[:, 1] += (a * residual[:, 1] - c * residual[:, 0]) / determinant
            # Beyond the fold of the polynomial the inverse is another branch, which no ray of light takes.
            _, slope = self.distort(found)
            folded = (np.linalg.det(np.nan_to_num(slope)) <= 0.0) | (slope[:, 0, 0] <= 0.0)
        found[~(error < 1e-8) | folded] = np.nan
        return found

    def scaled(self, width: int, height: int) -> CameraModel:
        """The same camera with smaller or larger pictures: pixels stay square, the middle of the picture is kept.

        Where the shape differs, the longer side relative to the old one decides, and the other is cut: 640 × 480 of
        1024 × 1024 sees as much from left to right and less from top to bottom.

        Raises:
            ValueError: A size below one pixel.
        """
        if min(width, height) < 1:
            raise ValueError(f"pictures of at least 1 × 1 pixel, got {width} × {height}")
        factor = max(width / self.width, height / self.height)
        # Edges of the picture, not centres of pixels, are what scales: hence the halves.
        old, new = np.array([self.width, self.height]), np.array([width, height])
        centre = (self.centre + 0.5 - old / 2) * factor + new / 2 - 0.5
        return replace(self, width=width, height=height, focal=self.focal * factor, centre=centre)


def read_camera(path: str | Path) -> CameraModel:
    """Read a camera from its model.toml.

    Raises:
        ModelFileError: A key is unknown, missing or out of range, or the distortion folds the picture over itself.
    """
    path = Path(path)
    table = decode(CameraFile, read_toml(path), path)
    sensor, intrinsics = table.sensor, table.intrinsics
    for key, size in (("width", sensor.width), ("height", sensor.height)):
        if not 16 <= size <= 16384:
            raise ModelFileError(path, f"sensor.{key}", size, "16 to 16384 pixels")
    if sensor.exposure_s > 1.0 / sensor.rate_hz:
        limit = 1.0 / sensor.rate_hz
        raise ModelFileError(
            path, "sensor.exposure_s", sensor.exposure_s, f"at most {limit:g} s, the time of one frame"
        )
    for key, centre, size in (("cx", intrinsics.cx, sensor.width), ("cy", intrinsics.cy, sensor.height)):
        if not 0.0 <= centre < size:
            raise ModelFileError(path, f"intrinsics.{key}", centre, f"a pixel of the picture, 0 to {size}")
    camera = CameraModel(
        name=table.name,
        description=table.description,
        width=sensor.width,
        height=sensor.height,
        focal=np.array([intrinsics.fx, intrinsics.fy]),
        centre=np.array([intrinsics.cx, intrinsics.cy]),
        distortion=np.array(intrinsics.distortion),
        T_hand_camera=table.mount.pose,
        rate=sensor.rate_hz,
        exposure=sensor.exposure_s,
    )
    if not np.isfinite(camera.undistort(picture_border(camera))).all():
        raise ModelFileError(
            path, "intrinsics.distortion", list(intrinsics.distortion), "coefficients that do not fold the picture over"
        )
    return camera


def camera_toml(camera: CameraModel, remarks: Sequence[str] = ()) -> str:
    """The contents of a model.toml that `read_camera` reads again: numbers to the last bit, the mount to rounding.

    Args:
        camera: What to write.
        remarks: Lines for people, written as comments.
    """
    x, y, z, w = pin.Quaternion(camera.T_hand_camera.rotation).coeffs()
    lines = [
        *(f"# {' '.join(remark.split())}" for remark in remarks),
        'kind = "camera"',
        f"name = {_quoted(camera.name)}",
        f"description = {_quoted(camera.description)}",
        "",
        "[sensor]",
        f"width = {camera.width}",
        f"height = {camera.height}",
        f"rate_hz = {float(camera.rate)!r}",
        f"exposure_s = {float(camera.exposure)!r}",
        "",
        "# Pixels, counted from the centre of the upper left one.",
        "[intrinsics]",
        *(f"{key} = {float(value)!r}" for key, value in zip(("fx", "fy"), camera.focal, strict=True)),
        *(f"{key} = {float(value)!r}" for key, value in zip(("cx", "cy"), camera.centre, strict=True)),
        "# k1, k2, p1, p2, k3 of OpenCV's model.",
        f"distortion = {camera.distortion.tolist()}",
        "",
        "# Camera frame (z along the view, x to the right and y downwards in the picture) in the hand frame.",
        "[mount]",
        f"position = {camera.T_hand_camera.translation.tolist()}",
        f"quat_wxyz = {[float(value) for value in (w, x, y, z)]}",
    ]
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    # JSON's strings are TOML's, but for DEL, which TOML wants escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def picture_border(camera: CameraModel, step: int = 16) -> Array:
    """(k, 2) pixels along the outer edge of the picture, every `step` pixels or closer."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    u = np.linspace(-0.5, right, 2 + camera.width // step)
    v = np.linspace(-0.5, bottom, 2 + camera.height // step)
    sides = [
        np.column_stack([u, np.full_like(u, -0.5)]),
        np.column_stack([u, np.full_like(u, bottom)]),
        np.column_stack([np.full_like(v, -0.5), v]),
        np.column_stack([np.full_like(v, right), v]),
    ]
    return np.vstack(sides)
