"""The part's pose from the corners of its markers.

A square seen nearly head-on has two poses that explain it about as well. Both of each marker are kept, each is refined
by Gauss-Newton on the corners of all markers that agree with it, and what remains is ranked by how many markers agree
and by the reprojection error. The covariance is that of least squares, σ²(JᵀJ)⁻¹.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.grasp_object import GraspObject, Marker
from dyngrasp.perception.marker_detection import MarkerCorners
from dyngrasp.perception.pose_track import CameraPose
from dyngrasp.signals import Array, read_only

# Corners of a marker of size 1 in its frame (x right, y up, z towards the viewer), in the order of `MarkerCorners`.
UNIT_CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


@dataclass(frozen=True)
class MarkerPoseSettings:
    """Settings of `MarkerPoseSolver`.

    Attributes:
        corner_noise: Standard deviation of a refined corner of a marker seen from the front (pixels), that of rendered
            pictures (`benchmarks/filter_consistency.py`). It is taken to
            grow as the longest side of the seen square over the shortest, and residuals count less by as much. Larger
            residuals enlarge the covariance; smaller ones do not shrink it: eight numbers say little about a variance.
        coarse_agreement: A marker belongs to a first guess, made from another marker, if its corners are within this
            (pixels): the guess of one small square extrapolates badly.
        agreement: It belongs to the refined pose if its corners are within this (pixels, root mean square).
        largest_error: Root mean square reprojection error above which a pose is none (pixels).
        clear_ratio: Reprojection error of the second best pose over that of the best above which the best is certain.
        steps: Of Gauss-Newton at most.
    """

    corner_noise: float = 0.11
    coarse_agreement: float = 15.0
    agreement: float = 2.0
    largest_error: float = 1.5
    clear_ratio: float = 2.0
    steps: int = 20

    def __post_init__(self) -> None:
        for name in ("corner_noise", "coarse_agreement", "agreement", "largest_error"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise InvalidProblem(f"{name} must be > 0, got {getattr(self, name)}")
        if not self.clear_ratio >= 1.0 or self.steps < 1:
            raise InvalidProblem(f"clear_ratio ≥ 1 and steps ≥ 1 expected, got {self.clear_ratio}, {self.steps}")


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """One pose that explains what is seen.

    Attributes:
        T_camera_object: The part in the camera frame.
        covariance: (6, 6) of a right perturbation T·exp(δ), δ = [translation (m), rotation (rad)].
        markers: Numbers of the markers that agree with it.
        error: Root mean square of their weighted reprojection residuals (pixels, per axis).
    """

    T_camera_object: pin.SE3
    covariance: Array
    markers: tuple[int, ...]
    error: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "covariance", read_only(self.covariance, (6, 6)))

    def in_world(self, T_world_camera: pin.SE3, t_capture: float, t_receipt: float) -> CameraPose:
        """The same as a measurement in the world.

        Args:
            T_world_camera: Where the camera was at the capture, not now.
            t_capture: Middle of the exposure (s).
            t_receipt: When the picture had been worked out (s).
        """
        # A right perturbation acts in the object's frame: the camera's pose does not turn it.
        T = T_world_camera * self.T_camera_object
        return CameraPose(T, self.covariance, t_capture, t_receipt, T_camera_object=self.T_camera_object)


@dataclass(frozen=True)
class Sighting:
    """What one picture says.

    Attributes:
        candidates: Best first; empty if the part was not recognised.
        seen: Numbers of the markers that were detected.
        ratio: Reprojection error of the second candidate with as many markers over that of the first; infinite if
            there is none.
        ambiguous: Whether that ratio is too small to decide by.
        plausible: The first candidates, those that the reprojection error cannot tell apart: a filter may choose.
    """

    candidates: tuple[PoseCandidate, ...]
    seen: tuple[int, ...]
    ratio: float
    ambiguous: bool
    plausible: tuple[PoseCandidate, ...] = ()


class MarkerPoseSolver:
    """Poses of one part before one camera."""

    def __init__(self, camera: CameraModel, part: GraspObject, settings: MarkerPoseSettings | None = None) -> None:
        """Prepare for a camera and a part, whose markers are known."""
        self.camera, self.settings = camera, settings or MarkerPoseSettings()
        self._markers = {marker.id: marker for marker in part.markers}
        self._corners = {marker.id: corners_in_object(marker) for marker in part.markers}

    def solve(self, detected: Sequence[MarkerCorners]) -> Sighting:
        """All poses that explain the corners.

        Args:
            detected: Markers of the part in one picture; numbers that the part does not carry are ignored.
        """
        detected = [found for found in detected if found.id in self._markers and np.isfinite(found.corners).all()]
        seen = tuple(found.id for found in detected)
        if not detected:
            return Sighting((), seen, np.inf, False)
        corners = self._gather(detected)
        candidates: list[PoseCandidate] = []
        # Large squares give the best first guesses.
        for found in sorted(detected, key=lambda found: -_area(found.corners)):
            for guess in self._square_poses(found):
                # A guess beside a pose that several markers agree with, and all, would only end there again.
                if any(1 < len(c.markers) == len(seen) and _close(c.T_camera_object, guess) for c in candidates):
                    continue
                candidate = self._refine(guess, corners)
                if candidate is not None and not any(_same(candidate, other) for other in candidates):
                    candidates.append(candidate)
            # Both guesses of one square have been followed; with all markers in one pose the others only repeat it.
            if len(seen) > 1 and any(
                len(c.markers) == len(seen) and c.error < 2.0 * self.settings.corner_noise for c in candidates
            ):
                break
        candidates.sort(key=lambda candidate: (-len(candidate.markers), candidate.error))
        rivals = [c for c in candidates if len(c.markers) == len(candidates[0].markers)]
        # Eight residuals of six parameters are expected at half the noise of a corner; below, a ratio says nothing.
        floor = 0.5 * self.settings.corner_noise
        ratio = max(rivals[1].error, floor) / max(rivals[0].error, floor) if len(rivals) > 1 else np.inf
        clear = self.settings.clear_ratio
        plausible = tuple(c for c in rivals if max(c.error, floor) < clear * max(rivals[0].error, floor))
        return Sighting(tuple(candidates), seen, float(ratio), bool(ratio < clear), plausible)

    def _gather(self, detected: Sequence[MarkerCorners]) -> _Corners:
        measured = np.stack([found.corners for found in detected])
        sides = np.linalg.norm(measured - np.roll(measured, 1, axis=1), axis=2)
        stretch = sides.max(axis=1) / sides.min(axis=1)
        points = np.vstack([self._corners[found.id] for found in detected])
        motion = np.zeros((len(points), 3, 6))
        motion[:, 0, 0] = motion[:, 1, 1] = motion[:, 2, 2] = 1.0
        x, y, z = points.T
        # −[p]×: where a small turn of the object moves its point p, in the object's axes.
        motion[:, 0, 4], motion[:, 0, 5] = z, -y
        motion[:, 1, 3], motion[:, 1, 5] = -z, x
        motion[:, 2, 3], motion[:, 2, 4] = y, -x
        ids = np.array([found.id for found in detected])
        return _Corners(ids, points, motion, measured.reshape(-1, 2), np.repeat(1.0 / stretch, 8))

    def _square_poses(self, found: MarkerCorners) -> list[pin.SE3]:
        """Both poses of the object by one marker alone."""
        marker = self._markers[found.id]
        rays = self.camera.undistort(found.corners)
        if not np.isfinite(rays).all():
            return []
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            marker.size * UNIT_CORNERS, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        T_marker_object = marker.T_object_marker.inverse()
        poses = []
        for rotation, translation in zip(rotations, translations, strict=True):
            if np.isfinite(rotation).all() and np.isfinite(translation).all() and translation[2, 0] > 0:
                T_camera_marker = pin.SE3(pin.exp3(rotation.ravel()), translation.ravel())
                poses.append(T_camera_marker * T_marker_object)
        return poses

    def _refine(self, guess: pin.SE3, corners: _Corners) -> PoseCandidate | None:
        s = self.settings
        T, agrees = guess, self._errors(guess, corners) < s.coarse_agreement
        chosen = corners
        for _ in range(3):
            if not agrees.any():
                return None
            chosen = corners.only(agrees)
            T = self._gauss_newton(T, chosen)
            agrees_now = self._errors(T, corners) < s.agreement
            if (agrees_now == agrees).all():
                break
            agrees = agrees_now
        else:
            return None
        residual, jacobian = self._residual(T, chosen)
        error = float(np.sqrt(np.mean(residual**2)))
        if not error < s.largest_error:
            return None
        variance = max(s.corner_noise**2, float(residual @ residual) / (residual.size - 6))
        covariance = variance * np.linalg.inv(jacobian.T @ jacobian)
        markers = tuple(int(number) for number in chosen.ids)
        return PoseCandidate(T, 0.5 * (covariance + covariance.T), markers, error)

    def _gauss_newton(self, T: pin.SE3, corners: _Corners) -> pin.SE3:
        residual, jacobian = self._residual(T, corners)
        cost = residual @ residual
        damping = 0.0
        for _ in range(self.settings.steps):
            information = jacobian.T @ jacobian
            # Damped only where a plain step made it worse: the tilt of a small square is weakly determined.
            damped = information + damping * np.diag(np.diag(information))
            moved = T * pin.exp6(-np.linalg.solve(damped, jacobian.T @ residual))
            residual_moved, jacobian_moved = self._residual(moved, corners)
            cost_moved = residual_moved @ residual_moved
            if not cost_moved <= cost:
                damping = max(4.0 * damping, 1e-3)
                if damping > 1e6:
                    break
                continue
            # Pixels squared: what is left to gain is far below the noise of one corner.
            done = cost - cost_moved < 1e-7 * (1.0 + cost)
            T, residual, jacobian, cost, damping = moved, residual_moved, jacobian_moved, cost_moved, 0.25 * damping
            if done:
                break
        return T

    def _errors(self, T: pin.SE3, corners: _Corners) -> Array:
        """(markers,) root mean square of each marker's weighted residuals (pixels)."""
        residual, _ = self._residual(T, corners)
        return np.nan_to_num(np.sqrt(np.mean(residual.reshape(-1, 8) ** 2, axis=1)), nan=np.inf)

    def _residual(self, T: pin.SE3, corners: _Corners) -> tuple[Array, Array]:
        """Weighted residuals (8k,) in pixels, and their (8k, 6) derivatives by δ of T·exp(δ)."""
        pixels, by_point = self.camera.project(corners.points @ T.rotation.T + T.translation)
        jacobian = (by_point @ T.rotation @ corners.motion).reshape(-1, 6)
        return corners.weight * (pixels - corners.measured).ravel(), corners.weight[:, None] * jacobian


@dataclass(frozen=True, eq=False)
class _Corners:
    """k markers: `points` (4k, 3) in the object, how they move with δ (4k, 3, 6), seen at (4k, 2), weights (8k,)."""

    ids: NDArray[np.int_]
    points: Array
    motion: Array
    measured: Array
    weight: Array

    def only(self, markers: NDArray[np.bool_]) -> _Corners:
        if markers.all():
            return self
        of_corners = np.repeat(markers, 4)
        return _Corners(
            self.ids[markers],
            self.points[of_corners],
            self.motion[of_corners],
            self.measured[of_corners],
            self.weight[np.repeat(markers, 8)],
        )


def corners_in_object(marker: Marker) -> Array:
    """(4, 3) corners of a marker in the object frame (m), in the order of `MarkerCorners`."""
    T = marker.T_object_marker
    return marker.size * UNIT_CORNERS @ T.rotation.T + T.translation


def _area(corners: Array) -> float:
    """Of a quadrilateral (pixels squared), half the cross product of its diagonals."""
    (a, b), (c, d) = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(a * d - b * c))


def _same(a: PoseCandidate, b: PoseCandidate) -> bool:
    """Whether two searches ended in one minimum: they then differ by what the last step left."""
    difference = pin.log6(a.T_camera_object.actInv(b.T_camera_object)).vector
    return bool(np.linalg.norm(difference[:3]) < 1e-4 and np.linalg.norm(difference[3:]) < 1e-3)


def _close(a: pin.SE3, b: pin.SE3) -> bool:
    """Whether Gauss-Newton from one finds the other: the mirrored pose of a square is farther off or is no minimum."""
    return bool(
        np.linalg.norm(a.translation - b.translation) < 0.02
        and np.trace(a.rotation.T @ b.rotation) > 1.0 + 2.0 * np.cos(0.1)
    )
