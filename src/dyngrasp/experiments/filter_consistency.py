"""Whether the pose filter's errors are as large as it says, on rendered approaches with a mount that is a little wrong.

The measure is the normalised error squared eᵀP⁻¹e of the pose: over many runs its mean is six if the covariance P is
right, larger if the filter claims too much, smaller if it knows more than it says. What frames share (the mount, what
repeats in the corners) is in P, or else it would be averaged away frame by frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, get_args

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.stats import chi2

from dyngrasp.experiments.filmed_approach import Film, FilmSet, Motion, film_set
from dyngrasp.perception.marker_pose import MarkerPoseSolver
from dyngrasp.perception.part_tracker import PartTrackerSettings
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings, Verdict
from dyngrasp.perception.pose_track import CameraErrors
from dyngrasp.signals import Array

MOTIONS: tuple[Motion, ...] = get_args(Motion)

# Of the camera on the hand: so far (m) and by so much (rad) in random directions, as in the scenarios with a camera.
MOUNT_SHIFT, MOUNT_TURN = 0.5e-3, np.deg2rad(0.1)

# Frames after which the filter is asked; the last is the end of the approach.
ASKED = (10, 20, 30, 40)


@dataclass(frozen=True, eq=False)
class Outcome:
    """One run.

    Attributes:
        errors: (asked, 6) of the pose, [translation (m), rotation (rad)] in the object's axes; NaN if it was unknown.
        normalised: (asked,) eᵀP⁻¹e of each.
        refused: Share of the frames after the first estimate that the gate refused.
    """

    errors: Array
    normalised: Array
    refused: float


def filter_consistency(
    runs: int,
    seed: int,
    motions: Sequence[Motion] = MOTIONS,
    progress: Callable[[str], None] = lambda text: None,
) -> list[dict[str, Any]]:
    """Film approaches, draw a mount for each, and compare the filter with the truth.

    Args:
        runs: Of each motion of the part.
        seed: Draws approaches, noise of the pictures and mounts.
        motions: Of the part.
        progress: Told what is going on.

    Returns:
        A row for each motion and number of frames, see `summary`.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
    """
    rows: list[dict[str, Any]] = []
    with film_set(seed=seed) as films:
        for motion in motions:
            outcomes = []
            for run in range(runs):
                progress(f"{motion}: {run} of {runs}")
                rng = np.random.default_rng([seed, MOTIONS.index(motion), run])
                film = films.shoot(rng, motion, frames=ASKED[-1])
                outcomes.append(follow(films, film, motion, draw_mount(rng)))
            rows += summary(motion, outcomes)
    return rows


def draw_mount(rng: np.random.Generator) -> pin.SE3:
    """The camera's frame as calibration believes it, in the true one."""
    directions = rng.normal(size=(2, 3))
    shift, turn = directions / np.linalg.norm(directions, axis=1)[:, None] * [[MOUNT_SHIFT], [MOUNT_TURN]]
    return pin.SE3(pin.exp3(turn), shift)


def follow(films: FilmSet, film: Film, motion: Motion, mount: pin.SE3, scale: float = 1.0) -> Outcome:
    """Run the filter over a film, with nothing believed beforehand.

    Args:
        films: The camera and the part of it.
        film: What was detected, and the truth.
        motion: Whether the filter is the one for parts at rest.
        mount: See `draw_mount`.
        scale: On every standard deviation that the filter is told; any but 1 is a filter that is wrong.
    """
    # A random direction has a third of the square along each axis.
    deviations = scale / np.sqrt(3.0) * np.array([MOUNT_SHIFT, MOUNT_TURN])
    errors = CameraErrors(mount=(float(deviations[0]), float(deviations[1])))
    settings = PoseFilterSettings.still() if motion == "still" else PoseFilterSettings()
    pose_filter = PoseFilter(replace(settings, camera=errors))
    solver = MarkerPoseSolver(films.camera, films.part)
    least = PartTrackerSettings().least_markers
    found, normalised, refused = [], [], []
    for k, (t, T_world_camera, T_world_object, markers) in enumerate(
        zip(film.times, film.T_world_camera, film.T_world_object, film.corners, strict=True), start=1
    ):
        candidates = [
            replace(c, covariance=scale**2 * c.covariance).in_world(T_world_camera * mount, t, t)
            for c in solver.solve(markers).plausible
            if len(c.markers) >= least
        ]
        known = pose_filter.acquired
        verdict = pose_filter.update(candidates) if candidates else None
        if known and verdict is not None:
            refused.append(verdict is Verdict.GATED)
        if k in ASKED:
            error, surprise = np.full(6, np.nan), np.nan
            if pose_filter.acquired:
                estimate = pose_filter.estimate(t)
                error = pin.log6(estimate.T_world_object.actInv(T_world_object)).vector
                surprise = float(error @ np.linalg.solve(estimate.covariance, error))
            found.append(error)
            normalised.append(surprise)
    return Outcome(np.array(found), np.array(normalised), float(np.mean(refused)) if refused else 0.0)


def summary(motion: Motion, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Rows of the runs with one motion: errors and mean normalised error, and the bounds that hold 95 % of such means.

    Of unknown poses there is no error; `known` says how many were known. Films may be shorter than the last of `ASKED`.
    """
    rows = []
    for place, frames in enumerate(ASKED[: outcomes[0].normalised.size]):
        errors = np.array([outcome.errors[place] for outcome in outcomes])
        known: NDArray[np.bool_] = np.isfinite(errors[:, 0])
        count = int(known.sum())
        low, high = chi2.ppf([0.025, 0.975], 6 * count) / count if count else (np.nan, np.nan)
        lengths = (
            np.sqrt(np.mean(np.sum(errors[known].reshape(-1, 2, 3) ** 2, axis=2), axis=0)) if count else [np.nan] * 2
        )
        normalised = np.array([outcome.normalised[place] for outcome in outcomes])[known]
        nees = float(normalised.mean()) if count else np.nan
        rows.append(
            {
                "stage": "consistency",
                "motion": motion,
                "frames": frames,
                "runs": len(outcomes),
                "known": count,
                "rms_mm": 1e3 * float(lengths[0]),
                "rms_deg": float(np.rad2deg(lengths[1])),
                "nees": nees,
                "low": float(low),
                "high": float(high),
                "within": bool(low < nees < high),
                "refused_percent": 100.0 * float(np.mean([outcome.refused for outcome in outcomes])),
            }
        )
    return rows
