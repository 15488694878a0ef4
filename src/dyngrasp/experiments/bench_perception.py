"""How long a picture takes to become a pose, and how good poses are against distance, on rendered pictures."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.models.camera import CameraModel
from dyngrasp.models.catalogue import load_camera, load_gripper, load_object, load_robot
from dyngrasp.perception.marker_detection import MarkerDetector
from dyngrasp.perception.marker_pose import MarkerPoseSolver
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings
from dyngrasp.signals import Array
from dyngrasp.simulation.camera_sensor import CameraSensor, ImagingSettings
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import build_scene

DISTANCES = (0.25, 0.35, 0.45, 0.6)

# The hand some 0.6 m above the ground, looking straight down; it drifts by up to this much (rad) in every run.
POSTURE = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])
DRIFT = np.deg2rad(4.0)

# The part's upper markers about the middle of the picture (m), tilted by up to this much (rad).
ASIDE, TILT = 0.02, 0.5

FRAMES = 12


def bench_perception(
    runs: int,
    seed: int,
    resolution: tuple[int, int] | None = None,
    distances: Sequence[float] = DISTANCES,
    progress: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Look at a part at rest from a moving hand, and compare with the truth.

    Args:
        runs: Of each distance, of `FRAMES` pictures each.
        seed: Draws views, motions and noise.
        resolution: Width and height; the camera's own if left out.
        distances: From the camera to the middle of the part's upper markers (m).
        progress: Told what is going on.

    Returns:
        Rows: `stage` detect, pose, filter and frame (all three together) with times, and `stage` accuracy with the
        errors of single pictures and of the filter after the last one; `nees` is the mean of eᵀP⁻¹e, of six numbers.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
    """
    camera = load_camera("ava1000")
    camera = camera if resolution is None else camera.scaled(*resolution)
    robot, gripper, part = load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting")
    scene = build_scene(robot, gripper, part, markers=True)
    detector, solver = MarkerDetector(part), MarkerPoseSolver(camera, part)
    resting = MujocoPlant(scene, POSTURE, gripper.open_posture, pin.SE3.Identity()).state
    settings = replace(PoseFilterSettings.still(), acquire_frames=3)
    rng = np.random.default_rng(seed)
    times: dict[str, list[float]] = {"detect": [], "pose": [], "filter": [], "frame": []}
    rows = []
    with CameraSensor(scene, camera, ImagingSettings(seed=seed)) as sensor:
        for distance in distances:
            single: list[Array] = []
            filtered: list[Array] = []
            normalised: list[float] = []
            for run in range(runs):
                progress(f"{distance:g} m: {run} of {runs}")
                T_world_part = sensor.pose(resting) * _view(rng, distance)
                drift = rng.uniform(-DRIFT, DRIFT, POSTURE.size) / FRAMES
                pose_filter = PoseFilter(settings)
                for k in range(FRAMES):
                    state = resting.copy()
                    state[scene.arm_qpos] = POSTURE + k * drift
                    x, y, z, w = pin.Quaternion(T_world_part.rotation).coeffs()
                    state[scene.part_qpos : scene.part_qpos + 7] = [*T_world_part.translation, w, x, y, z]
                    t = k / camera.rate
                    image = sensor.capture([state], [t])
                    T_world_camera = sensor.pose(state)
                    began = time.perf_counter()
                    found = detector.detect(image.pixels)
                    detected = time.perf_counter()
                    sighting = solver.solve(found)
                    solved = time.perf_counter()
                    candidates = [c.in_world(T_world_camera, t, t) for c in sighting.plausible]
                    if candidates:
                        pose_filter.update(candidates)
                    done = time.perf_counter()
                    steps = (detected - began, solved - detected, done - solved, done - began)
                    for name, taken in zip(times, steps, strict=True):
                        times[name].append(1e3 * taken)
                    if candidates:
                        single.append(_error(candidates[0].T_world_object, T_world_part))
                if pose_filter.acquired:
                    estimate = pose_filter.estimate((FRAMES - 1) / camera.rate)
                    e = _error(estimate.T_world_object, T_world_part)
                    filtered.append(e)
                    normalised.append(float(e @ np.linalg.solve(estimate.covariance, e)))
            rows.append(_accuracy(distance, camera, runs, single, filtered, normalised))
    return [_timing(name, values, camera) for name, values in times.items()] + rows


def _view(rng: np.random.Generator, distance: float) -> pin.SE3:
    """T_camera_object: the upper side towards the camera, turned and tilted at random."""
    axis = rng.uniform(-np.pi, np.pi)
    tilt = pin.exp3(rng.uniform(0, TILT) * np.array([np.cos(axis), np.sin(axis), 0.0]))
    facing = tilt @ np.diag([1.0, -1.0, -1.0]) @ pin.exp3(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    T = pin.SE3(facing, np.array([*rng.uniform(-ASIDE, ASIDE, 2), distance]))
    return T * pin.SE3(np.eye(3), np.array([-0.02, 0.0, 0.055]))


def _error(found: pin.SE3, true: pin.SE3) -> Array:
    return pin.log6(found.actInv(true)).vector


def _timing(stage: str, values: list[float], camera: CameraModel) -> dict[str, Any]:
    return {
        "stage": stage,
        "resolution": f"{camera.width}x{camera.height}",
        "n": len(values),
        "median_ms": float(np.median(values)),
        "p99_ms": float(np.percentile(values, 99)),
        "max_ms": float(np.max(values)),
    }


def _accuracy(
    distance: float,
    camera: CameraModel,
    runs: int,
    single: list[Array],
    filtered: list[Array],
    normalised: list[float],
) -> dict[str, Any]:
    def rms(errors: list[Array], part: slice) -> float | None:
        return float(np.sqrt(np.mean(np.sum(np.square(errors)[:, part], axis=1)))) if errors else None

    def times(value: float | None, factor: float) -> float | None:
        return None if value is None else value * factor

    shift, turn = slice(0, 3), slice(3, 6)
    return {
        "stage": "accuracy",
        "resolution": f"{camera.width}x{camera.height}",
        "distance_m": distance,
        "runs": runs,
        "acquired": len(filtered),
        "single_rms_mm": times(rms(single, shift), 1e3),
        "single_rms_deg": times(rms(single, turn), np.rad2deg(1.0)),
        "rms_mm": times(rms(filtered, shift), 1e3),
        "rms_deg": times(rms(filtered, turn), np.rad2deg(1.0)),
        "nees": float(np.mean(normalised)) if normalised else None,
    }
