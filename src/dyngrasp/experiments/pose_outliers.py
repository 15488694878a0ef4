"""What wrong poses and true jumps do to the filter: poses from films of approaches, some spoilt on purpose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.experiments.filmed_approach import Film
from dyngrasp.perception.marker_pose import Sighting
from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings, Verdict
from dyngrasp.perception.pose_track import CameraPose, innovation

# Each kind of wrong pose takes the place of so many frames.
SHARE = 0.05
KINDS = ("aside", "turned", "nan")

# How far aside (m), drawn with all magnitudes alike.
ASIDE = (0.02, 1.0)

# Before so many frames a filter of moving parts knows no velocity yet, and 2 cm from frame to frame are what a part may
# do: nothing is spoilt until then.
FIRST_FRAMES = 10

# A part that is taken elsewhere: by so much (m), turned by five times that (rad), in this frame.
JUMPS, JUMP_FRAME = (0.01, 0.05, 0.4), 25

# It is found again where the estimate is as near as this (m, rad), far below the smallest jump.
FOUND = (3e-3, np.deg2rad(1.5))

# An outlier whose distance from what was known is larger than so many standard deviations must not be accepted.
LARGEST_SIGMAS = 5.0

# Each film is spoilt in so many ways.
REPEATS = 10


def outlier_row(
    motion: str, films: Sequence[Film], seen: Sequence[Sequence[Sighting]], seed: int, settings: PoseFilterSettings
) -> dict[str, Any]:
    """Spoil films.

    Args:
        motion: Of the part, for the row.
        films: Approaches, of more than `JUMP_FRAME` frames.
        seen: What each frame of each film says.
        seed: Draws which frames are spoilt and how, and where the part jumps.
        settings: Of the filter.

    Returns:
        How many poses were spoilt, and of these accepted; accepted ones of any kind beyond 5 σ; the share of good
        frames that was refused; and how many frames the filter needed to find the part again after a jump: median and
        largest of all jumps that were followed, and how many were not by the end of the film.
    """
    rng = np.random.default_rng(seed)
    counts: dict[str, int] = dict.fromkeys((*KINDS, "accepted", "beyond", "good", "refused"), 0)
    recoveries = []
    for film, sightings in zip(films, seen, strict=True):
        for _ in range(REPEATS):
            _spoil_film(film, sightings, settings, rng, counts)
        recoveries += [_recovery(film, sightings, settings, jump, rng) for jump in JUMPS for _ in range(REPEATS)]
    found = [frames for frames in recoveries if frames is not None]
    return {
        "stage": "outliers",
        "motion": motion,
        **{kind: counts[kind] for kind in KINDS},
        "accepted": counts["accepted"],
        "accepted_beyond_5_sigma": counts["beyond"],
        "good_refused": counts["refused"] / max(counts["good"], 1),
        "jumps": len(recoveries),
        "recovery_frames_median": float(np.median(found)) if found else None,
        "recovery_frames_max": max(found, default=None),
        "lost": len(recoveries) - len(found),
    }


def _spoil_film(
    film: Film,
    sightings: Sequence[Sighting],
    settings: PoseFilterSettings,
    rng: np.random.Generator,
    counts: dict[str, int],
) -> None:
    pose_filter = PoseFilter(settings)
    for k, (t, sighting) in enumerate(zip(film.times, sightings, strict=True)):
        poses = [c.in_world(film.T_world_camera[k], t, t) for c in sighting.plausible]
        if not poses:
            continue
        draw = rng.uniform()
        kind = KINDS[int(draw / SHARE)] if k >= FIRST_FRAMES and draw < SHARE * len(KINDS) else None
        if kind is not None:
            poses = [_spoilt(poses[0], kind, rng)]
            counts[kind] += 1
        sigmas = min(_sigmas(pose_filter, pose, t, settings) for pose in poses)
        verdict = pose_filter.update(poses)
        counts["beyond"] += verdict is Verdict.ACCEPTED and not sigmas <= LARGEST_SIGMAS
        if kind is not None:
            counts["accepted"] += verdict in (Verdict.ACCEPTED, Verdict.ACQUIRED)
        elif k >= FIRST_FRAMES:
            counts["good"] += 1
            counts["refused"] += verdict is Verdict.GATED


def _recovery(
    film: Film, sightings: Sequence[Sighting], settings: PoseFilterSettings, jump: float, rng: np.random.Generator
) -> int | None:
    """Frames with the part from the jump on until the estimate is right; None if it never is."""
    direction, axis = rng.normal(size=(2, 3))
    turn = pin.exp3(5.0 * jump * axis / np.linalg.norm(axis))
    offset = jump * direction / np.linalg.norm(direction)
    pose_filter, since = PoseFilter(settings), 0
    for k, (t, sighting) in enumerate(zip(film.times, sightings, strict=True)):
        poses = [c.in_world(film.T_world_camera[k], t, t) for c in sighting.plausible]
        true = film.T_world_object[k]
        if k >= JUMP_FRAME:
            # Set down elsewhere, turned about its origin; what the camera is wrong by, it is wrong by there too.
            there = pin.SE3(turn @ true.rotation, true.translation + offset)
            poses = [replace(pose, T_world_object=there * true.actInv(pose.T_world_object)) for pose in poses]
            true = there
        if poses:
            pose_filter.update(poses)
            since += k >= JUMP_FRAME
        if since and pose_filter.acquired:
            error = pin.log6(pose_filter.estimate(t).T_world_object.actInv(true)).vector
            if np.linalg.norm(error[:3]) < FOUND[0] and np.linalg.norm(error[3:]) < FOUND[1]:
                return since
    return None


def _spoilt(pose: CameraPose, kind: str, rng: np.random.Generator) -> CameraPose:
    T, direction = pose.T_world_object, rng.normal(size=3)
    direction /= np.linalg.norm(direction)
    if kind == "aside":
        distance = np.exp(rng.uniform(*np.log(ASIDE)))
        return replace(pose, T_world_object=pin.SE3(T.rotation, T.translation + distance * direction))
    if kind == "turned":
        return replace(pose, T_world_object=pin.SE3(T.rotation @ pin.exp3(np.pi * direction), T.translation))
    return replace(pose, T_world_object=pin.SE3(T.rotation, np.full(3, np.nan)))


def _sigmas(pose_filter: PoseFilter, pose: CameraPose, t: float, settings: PoseFilterSettings) -> float:
    """How many standard deviations a pose is off what is known; 0 where nothing is."""
    if not pose_filter.acquired:
        return 0.0
    if not np.isfinite(pose.T_world_object.translation).all():
        return np.inf
    return float(np.sqrt(innovation(pose_filter.state(t), pose, settings.camera)[2]))
