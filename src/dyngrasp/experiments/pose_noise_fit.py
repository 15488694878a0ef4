"""The noise model's parameters from films of rendered approaches: how large errors are from where, how long they last.

What is fitted is what the replanner is told: the estimates of the filter, with the grasp frame as their frame. Errors
of one axis are taken as normal with a standard deviation of a + b·distance² (most likely a, b ≥ 0, all axes alike;
distance and tilt of a small square are known the worse by its square) and a correlation of exp(−Δt/τ) (least squares
over lags up to half a second). The error that stays is what an error of the hand-eye transform leaves of the grasp
frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize, minimize_scalar

from dyngrasp.errors import InvalidProblem
from dyngrasp.experiments.filmed_approach import Film
from dyngrasp.models.camera import CameraModel
from dyngrasp.models.grasp_object import GraspObject
from dyngrasp.models.gripper import GripperModel
from dyngrasp.perception.marker_pose import MarkerPoseSolver, Sighting
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings
from dyngrasp.perception.pose_noise import PoseNoiseSettings
from dyngrasp.signals import Array, read_only

# Of the hand-eye transform, in a random direction: as in scenarios/camera_sdh2.toml (m, rad).
MOUNT_ERROR = (5e-4, np.deg2rad(0.1))

# For each film so many of these errors are drawn.
MOUNT_DRAWS = 8

# Longer ones are seen too seldom in an approach to say anything (s).
LONGEST_LAG = 0.5

# Of the distances that a table or a figure shows one by one (m).
BIN = 0.05


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of k frames of several films, δ of true = estimated · exp(δ) of the grasp frame, in m and rad.

    Attributes:
        film: (k,) number of the film.
        times: (k,) in its film (s).
        distance: (k,) of the hand's G from the grasp frame (m).
        single: (k, 6) of the frame alone; NaN where the part was not recognised.
        filtered: (k, 6) of the filter; NaN before it knew the part.
        mount: (m, 6) what errors of the hand-eye transform leave, of each film's last frame.
    """

    film: Array
    times: Array
    distance: Array
    single: Array
    filtered: Array
    mount: Array

    def __post_init__(self) -> None:
        for name in ("film", "times", "distance"):
            object.__setattr__(self, name, read_only(getattr(self, name), (-1,)))
        for name in ("single", "filtered"):
            object.__setattr__(self, name, read_only(getattr(self, name), (self.film.size, 6)))
        object.__setattr__(self, "mount", read_only(self.mount, (-1, 6)))


@dataclass(frozen=True, eq=False)
class PoseNoiseFit:
    """What the films say.

    Attributes:
        errors: Of all frames.
        settings: The noise model's with the parameters that fit.
        lags: (l,) in s.
        correlation: (l, 2) of position and rotation over that time.
    """

    errors: PoseErrors
    settings: PoseNoiseSettings
    lags: Array
    correlation: Array

    def rows(self) -> list[dict[str, Any]]:
        """Deviation per axis at each distance, of single frames, after the filter, and of the model; mm and degrees."""
        rows = []
        edges = np.arange(np.floor(self.errors.distance.min() / BIN), self.errors.distance.max() / BIN + 1.0) * BIN
        for low, high in pairwise(edges):
            inside = (self.errors.distance >= low) & (self.errors.distance < high)
            known = inside & np.isfinite(self.errors.filtered[:, 0])
            # Ten films that pass here give a standard deviation to a fifth or so, errors being alike within each.
            films = np.unique(self.errors.film[known]).size
            if films < 3:
                continue
            model = self.settings.deviation(float(self.errors.distance[known].mean()))
            row: dict[str, Any] = {"stage": "noise", "from_m": float(low), "to_m": float(high), "films": films}
            seen = inside & np.isfinite(self.errors.single[:, 0])
            for name, errors in (("single", self.errors.single[seen]), ("filter", self.errors.filtered[known])):
                row[f"{name}_mm"] = 1e3 * _rms(errors[:, :3])
                row[f"{name}_deg"] = float(np.rad2deg(_rms(errors[:, 3:])))
            rows.append(row | {"model_mm": 1e3 * float(model[0]), "model_deg": float(np.rad2deg(model[3]))})
        return rows

    def parameters(self) -> dict[str, float]:
        """The fitted keys of `[pose]`."""
        s = self.settings
        return {
            "residual_mm": 1e3 * s.residual_position,
            "residual_deg": float(np.rad2deg(s.residual_angle)),
            "frame_mm": 1e3 * s.frame_position,
            "frame_mm_per_m2": 1e3 * s.frame_position_growth,
            "frame_deg": float(np.rad2deg(s.frame_angle)),
            "frame_deg_per_m2": float(np.rad2deg(s.frame_angle_growth)),
            "correlation_s": s.correlation_time,
        }


def sightings(film: Film, solver: MarkerPoseSolver) -> list[Sighting]:
    """What each frame of a film says of the part."""
    return [solver.solve(corners) for corners in film.corners]


def pose_errors(
    films: Sequence[Film], camera: CameraModel, part: GraspObject, gripper: GripperModel, seed: int = 0
) -> PoseErrors:
    """Work out films of a part at rest, and compare with the truth.

    Args:
        films: Of a part that lies still.
        camera: With which they were made.
        part: The part.
        gripper: Hand that carries the camera, open.
        seed: Draws errors of the hand-eye transform.
    """
    solver, rng = MarkerPoseSolver(camera, part), np.random.default_rng(seed)
    T_object_grasp = part.grasps[0].T_object_grasp
    T_camera_pinch = camera.T_hand_camera.inverse() * gripper.T_hand_grasp(gripper.open_posture)
    distances, singles, filtered, mounts = [], [], [], []

    def error(found: pin.SE3, k: int, film: Film) -> Array:
        return pin.log6((found * T_object_grasp).actInv(film.T_world_object[k] * T_object_grasp)).vector

    for film in films:
        seen = sightings(film, solver)
        for k, sighting in enumerate(seen):
            pinch = film.T_world_camera[k] * T_camera_pinch
            grasp = film.T_world_object[k] * T_object_grasp
            distances.append(np.linalg.norm(pinch.translation - grasp.translation))
            best = sighting.plausible[0].T_camera_object if sighting.plausible else None
            singles.append(np.full(6, np.nan) if best is None else error(film.T_world_camera[k] * best, k, film))
        known = _filtered(film, seen, pin.SE3.Identity())
        errors = [np.full(6, np.nan) if T is None else error(T, k, film) for k, T in enumerate(known)]
        filtered += errors
        for _ in range(MOUNT_DRAWS):
            directions = rng.normal(size=(2, 3))
            directions /= np.linalg.norm(directions, axis=1)[:, None]
            wrong = pin.SE3(pin.exp3(MOUNT_ERROR[1] * directions[1]), MOUNT_ERROR[0] * directions[0])
            last = _filtered(film, seen, wrong)[-1]
            if last is not None:
                mounts.append(error(last, -1, film) - errors[-1])
    if not mounts:
        raise InvalidProblem(f"the part was not recognised at the end of any of {len(films)} films")
    return PoseErrors(
        np.repeat(np.arange(float(len(films))), [len(film.times) for film in films]),
        np.concatenate([film.times for film in films]),
        np.array(distances),
        np.array(singles),
        np.array(filtered),
        np.array(mounts),
    )


def fit_pose_noise(errors: PoseErrors) -> PoseNoiseFit:
    """The noise model that makes such errors most likely; what it reveals from where is not fitted."""
    known = np.isfinite(errors.filtered[:, 0])
    distance, filtered = errors.distance[known], errors.filtered[known]
    position, angle = (_parabola(distance, filtered[:, axes]) for axes in (slice(0, 3), slice(3, 6)))
    unit = np.full_like(errors.filtered, np.nan)
    unit[known, :3] = filtered[:, :3] / (position[0] + position[1] * distance**2)[:, None]
    unit[known, 3:] = filtered[:, 3:] / (angle[0] + angle[1] * distance**2)[:, None]
    lags, correlation = _correlation(errors, unit)
    near = lags <= LONGEST_LAG
    found: Any = minimize_scalar(
        lambda log: float(np.sum((correlation[near] - np.exp(-lags[near] / np.exp(log))[:, None]) ** 2)),
        bounds=(np.log(1e-3), np.log(100.0)),
        method="bounded",
    )
    # Of a ball the mean square is 3/5 of the radius squared; of angles between none and the largest, a third.
    offset, turn = (float(np.sqrt(3.0) * _rms(errors.mount[:, axes])) for axes in (slice(0, 3), slice(3, 6)))
    settings = PoseNoiseSettings(
        residual_position=float(offset * np.sqrt(5.0 / 3.0)),
        residual_angle=float(turn * np.sqrt(3.0)),
        frame_position=position[0],
        frame_position_growth=position[1],
        frame_angle=angle[0],
        frame_angle_growth=angle[1],
        correlation_time=float(np.exp(found.x)),
    )
    return PoseNoiseFit(errors, settings, lags, correlation)


def _filtered(film: Film, seen: Sequence[Sighting], mount_error: pin.SE3) -> list[pin.SE3 | None]:
    """The part after each frame, by a camera that is believed a little beside where it sits."""
    pose_filter = PoseFilter(PoseFilterSettings.still())
    poses: list[pin.SE3 | None] = []
    for t, T_world_camera, sighting in zip(film.times, film.T_world_camera, seen, strict=True):
        if sighting.plausible:
            pose_filter.update([c.in_world(T_world_camera * mount_error, t, t) for c in sighting.plausible])
        poses.append(pose_filter.estimate(t).T_world_object if pose_filter.acquired else None)
    return poses


def _parabola(distance: Array, errors: Array) -> tuple[float, float]:
    """a, b ≥ 0 of the standard deviation a + b·distance² that makes errors (k, 3) most likely."""
    size = _rms(errors)
    square = np.mean((errors / size) ** 2, axis=1)

    def surprise(terms: Array) -> float:
        deviation = terms[0] + terms[1] * distance**2
        return float(np.sum(2.0 * np.log(deviation) + square / deviation**2))

    # Not zero at no distance either: a camera that is perfect there would be no camera.
    found: Any = minimize(
        surprise, [0.5, 0.5 / np.mean(distance**2)], bounds=[(0.01, None), (0.0, None)], method="L-BFGS-B"
    )
    return float(size * found.x[0]), float(size * found.x[1])


def _correlation(errors: PoseErrors, unit: Array) -> tuple[Array, Array]:
    """Lags (l,) and the correlation (l, 2) of errors of unit size over them, within films."""
    numbers = np.unique(errors.film)
    step = float(np.median(np.diff(errors.times[errors.film == numbers[0]])))
    shortest = min(int(np.sum(errors.film == number)) for number in numbers)
    lags = np.arange(shortest // 2 + 1)
    sums, counts = np.zeros((lags.size, 2)), np.zeros((lags.size, 2))
    for number in numbers:
        of_film = unit[errors.film == number].reshape(-1, 2, 3)
        for lag in lags:
            product = of_film[lag:] * of_film[: len(of_film) - lag]
            good = np.isfinite(product)
            sums[lag] += np.where(good, product, 0.0).sum(axis=(0, 2))
            counts[lag] += good.sum(axis=(0, 2))
    covariance = sums / np.maximum(counts, 1)
    return np.asarray(lags * step, dtype=float), np.asarray(covariance / covariance[0], dtype=float)


def _rms(errors: Array) -> float:
    """Of single numbers, not of rows."""
    return float(np.sqrt(np.mean(errors**2)))
