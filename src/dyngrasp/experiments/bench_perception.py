"""From rendered pictures to poses: how long it takes, how good poses are from where, and what wrong ones do."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.experiments.filmed_approach import ASIDE, FilmSet, Motion, film_set, view
from dyngrasp.experiments.pose_noise_fit import fit_pose_noise, pose_errors, sightings
from dyngrasp.experiments.pose_outliers import outlier_row
from dyngrasp.models.catalogue import load_camera, load_gripper
from dyngrasp.perception.marker_detection import one_thread
from dyngrasp.perception.marker_pose import MarkerPoseSolver
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings
from dyngrasp.signals import Array

# From the camera to the middle of the part's upper markers (m), and of the view against their vertical (degrees).
DISTANCES = (0.25, 0.3, 0.4, 0.5, 0.6)
ANGLES = (0.0, 15.0, 30.0, 45.0, 60.0, 70.0)

# Pictures of each run; while they are taken the view moves by up to this much: turn and tilt (rad), aside (m).
FRAMES = 10
DRIFT = (np.deg2rad(5.0), np.deg2rad(2.0), 0.01)

STAGES = ("detect", "pose", "filter", "frame")


def bench_perception(
    runs: int,
    seed: int,
    resolution: tuple[int, int] | None = None,
    distances: Sequence[float] = DISTANCES,
    angles: Sequence[float] = ANGLES,
    progress: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Look at a part at rest from a moving camera and from a hand that approaches it, and compare with the truth.

    Args:
        runs: Of each distance and angle, of `FRAMES` pictures each. Twice as many approaches are filmed, of a part at
            rest and of one on a belt.
        seed: Draws views, motions and noise.
        resolution: Width and height; the camera's own if left out.
        distances: From the camera to the middle of the part's upper markers (m).
        angles: Of the view against the vertical of these markers (degrees).
        progress: Told what is going on.

    Returns:
        Rows of every `stage`: detect, pose, filter and frame (all three together) with wall and CPU times on one
        thread; accuracy with the share of recognised pictures and the errors of single pictures and of the filter after
        the last one (`nees` is the mean of eᵀP⁻¹e, of six numbers); noise, see `PoseNoiseFit.rows`; outliers, see
        `outlier_row`.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
    """
    camera = load_camera("ava1000")
    camera = camera if resolution is None else camera.scaled(*resolution)
    rng = np.random.default_rng(seed)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in STAGES}
    rows, extra = [], []
    with film_set(camera, seed=seed) as stage, one_thread():
        for distance in distances:
            for angle in angles:
                progress(f"{distance:g} m, {angle:g}°")
                rows.append(_accuracy(stage, rng, distance, angle, runs, times))
        solver = MarkerPoseSolver(camera, stage.part)
        settings: dict[Motion, PoseFilterSettings] = {
            "still": PoseFilterSettings.still(),
            "conveyor": PoseFilterSettings(),
        }
        for motion, of_filter in settings.items():
            progress(f"approaches, part {motion}")
            films = [stage.shoot(rng, motion) for _ in range(2 * runs)]
            if motion == "still":
                errors = pose_errors(films, camera, stage.part, load_gripper("sdh2"), seed)
                extra += fit_pose_noise(errors).rows()
            extra.append(outlier_row(motion, films, [sightings(film, solver) for film in films], seed, of_filter))
    resolution_text = f"{camera.width}x{camera.height}"
    return [{"resolution": resolution_text, **row} for row in [*_timing(times), *rows, *extra]]


def _accuracy(
    stage: FilmSet,
    rng: np.random.Generator,
    distance: float,
    angle: float,
    runs: int,
    times: dict[str, list[tuple[float, float]]],
) -> dict[str, Any]:
    solver, rate = MarkerPoseSolver(stage.camera, stage.part), stage.camera.rate
    single: list[Array] = []
    filtered: list[Array] = []
    normalised: list[float] = []
    for _ in range(runs):
        towards, turn = rng.uniform(-np.pi, np.pi, 2)
        aside = rng.uniform(-ASIDE, ASIDE, 2)
        drift = rng.uniform(-1.0, 1.0, 4) * np.array([DRIFT[0], DRIFT[1], DRIFT[2], DRIFT[2]])
        pose_filter = PoseFilter(PoseFilterSettings.still())
        for k in range(FRAMES):
            moved = drift * (k / (FRAMES - 1) - 0.5)
            T = view(distance, np.deg2rad(angle) + moved[1], towards, turn + moved[0], aside + moved[2:])
            pixels, t = stage.look(T), k / rate
            # The world is the part here: the camera moves about it.
            T_world_camera = T.inverse()
            clocks = [_clocks()]
            found = stage.detector.detect(pixels)
            clocks.append(_clocks())
            sighting = solver.solve(found)
            clocks.append(_clocks())
            candidates = [c.in_world(T_world_camera, t, t) for c in sighting.plausible]
            if candidates:
                pose_filter.update(candidates)
            clocks.append(_clocks())
            taken = np.diff(np.array(clocks), axis=0)
            for name, (wall, cpu) in zip(STAGES, [*taken, taken.sum(axis=0)], strict=True):
                times[name].append((float(wall), float(cpu)))
            if candidates:
                single.append(pin.log6(candidates[0].T_world_object.inverse()).vector)
        if pose_filter.acquired:
            estimate = pose_filter.estimate((FRAMES - 1) / rate)
            e = pin.log6(estimate.T_world_object.inverse()).vector
            filtered.append(e)
            normalised.append(float(e @ np.linalg.solve(estimate.covariance, e)))
    return {
        "stage": "accuracy",
        "distance_m": distance,
        "angle_deg": angle,
        "pictures": runs * FRAMES,
        "recognised": len(single) / (runs * FRAMES),
        "single_rms_mm": _rms(single, slice(0, 3), 1e3),
        "single_rms_deg": _rms(single, slice(3, 6), np.rad2deg(1.0)),
        "acquired": len(filtered) / runs,
        "rms_mm": _rms(filtered, slice(0, 3), 1e3),
        "rms_deg": _rms(filtered, slice(3, 6), np.rad2deg(1.0)),
        "nees": float(np.mean(normalised)) if normalised else None,
    }


def _clocks() -> tuple[float, float]:
    return time.perf_counter(), time.thread_time()


def _rms(errors: list[Array], axes: slice, unit: float) -> float | None:
    """Of lengths."""
    return float(unit * np.sqrt(np.mean(np.sum(np.square(errors)[:, axes], axis=1)))) if errors else None


def _timing(times: dict[str, list[tuple[float, float]]]) -> list[dict[str, Any]]:
    rows = []
    for name, values in times.items():
        row: dict[str, Any] = {"stage": name, "n": len(values)}
        for clock, taken in zip(("", "cpu_"), 1e3 * np.array(values).T, strict=True):
            row[f"{clock}median_ms"] = float(np.median(taken))
            row[f"{clock}p99_ms"] = float(np.percentile(taken, 99))
            row[f"{clock}max_ms"] = float(taken.max())
        rows.append(row)
    return rows
