"""What corners of markers are off by in rendered pictures, and how far that repeats while the view changes little."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.experiments.filmed_approach import Film, FilmSet, film_set
from dyngrasp.perception.marker_pose import corners_in_object
from dyngrasp.perception.pose_track import view_change
from dyngrasp.signals import Array

# Edges of the classes of view change, see `pose_track.view_change`.
CHANGES = (0.0, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6)

# Beyond this a corner is none of the marker's: it lies behind something, or outside the picture (pixels).
ASTRAY = 1.0


@dataclass(frozen=True, eq=False)
class SeenSquare:
    """One marker in one picture.

    Attributes:
        T_camera_object: The true view.
        errors: (4, 2) detected less true corners (pixels).
        outwards: (4, 2) unit vectors from its middle to the corners.
    """

    T_camera_object: pin.SE3
    errors: Array
    outwards: Array


def bench_corners(runs: int, seed: int, progress: Callable[[str], None] = lambda text: None) -> list[dict[str, Any]]:
    """Film approaches to a part at rest, and describe the errors of the corners.

    Args:
        runs: How many.
        seed: Draws them.
        progress: Told what is going on.

    Returns:
        First a row for all squares, then one for each class of view change, see `describe`.

    Raises:
        RenderingUnavailable: The machine cannot draw off screen.
    """
    squares: list[list[SeenSquare]] = []
    with film_set(seed=seed) as films:
        for run in range(runs):
            progress(f"corners: {run} of {runs}")
            film = films.shoot(np.random.default_rng([seed, run]))
            squares += seen_squares(films, film)
    return describe(squares)


def seen_squares(films: FilmSet, film: Film) -> list[list[SeenSquare]]:
    """Each marker of a film through its pictures."""
    corners = {marker.id: corners_in_object(marker) for marker in films.part.markers}
    by_marker: dict[int, list[SeenSquare]] = {}
    for T, found in zip(film.T_camera_object, film.corners, strict=True):
        for marker in found:
            true, _ = films.camera.project(corners[marker.id] @ T.rotation.T + T.translation)
            spokes = true - true.mean(axis=0)
            outwards = spokes / np.linalg.norm(spokes, axis=1)[:, None]
            by_marker.setdefault(marker.id, []).append(SeenSquare(T, marker.corners - true, outwards))
    return list(by_marker.values())


def describe(squares: Sequence[Sequence[SeenSquare]]) -> list[dict[str, Any]]:
    """Size of the errors, and their correlation against the change of the view.

    Args:
        squares: Of each marker and film, all pictures.

    Returns:
        `rms_px` an axis, `outwards_px` the mean of what all four corners of a square have in common along its diagonals
        and `outwards_deviation_px` its spread, `astray_percent` of squares that are left out; then rows with
        `view_change` (the class's middle) and `correlation` of the errors of one corner in two pictures.
    """
    every = [square for film in squares for square in film]
    kept = [[square for square in film if np.abs(square.errors).max() < ASTRAY] for film in squares]
    errors = np.array([square.errors for film in kept for square in film])
    radial = np.array([np.sum(square.errors * square.outwards, axis=1).mean() for film in kept for square in film])
    variance = float(np.mean(errors**2))
    rows: list[dict[str, Any]] = [
        {
            "squares": len(every),
            "rms_px": float(np.sqrt(variance)),
            "outwards_px": float(radial.mean()),
            "outwards_deviation_px": float(radial.std()),
            "astray_percent": 100.0 * (1.0 - len(errors) / len(every)),
        }
    ]
    pairs = np.array([pair for film in kept for pair in _pairs(film)]).reshape(-1, 2)
    for low, high in pairwise(CHANGES):
        products = pairs[(low <= pairs[:, 0]) & (pairs[:, 0] < high), 1]
        if products.size:
            correlation = float(products.mean()) / variance
            rows.append({"view_change": 0.5 * (low + high), "pairs": products.size, "correlation": correlation})
    return rows


def _pairs(film: Sequence[SeenSquare]) -> Iterator[tuple[float, float]]:
    """Change of the view and mean product of the errors, of all pairs of pictures of one marker."""
    for a, b in combinations(film, 2):
        yield view_change(a.T_camera_object, b.T_camera_object), float(np.mean(a.errors * b.errors))
