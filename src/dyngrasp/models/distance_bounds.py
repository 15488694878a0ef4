"""Cheap lower bounds of the distance between bodies that move, for many samples at once, compiled.

A body is bounded by a capsule (a segment with a radius), a convex piece by the box along its own axes. What a body can
have moved from one sample to another bounds how much any of its distances can have changed: after a sample that is far
the next ones are skipped, and one exact distance says something about its neighbours.

Bounds hold for signed distances: a penetration counts negative with the depth by which the bodies would have to part.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.signals import Array

# A path this short (m) is none: far below what any of the distances is known to.
STILL = 1e-9


@dataclass(frozen=True, eq=False)
class Capsules:
    """Bounding capsules of B bodies.

    Attributes:
        links: (B,) index of the frame that each is fixed to.
        ends: (B, 2, 3) ends of the segments in that frame (m).
        radii: (B,) m.
    """

    links: NDArray[np.int64]
    ends: Array
    radii: Array


@dataclass(frozen=True, eq=False)
class Tracks:
    """How B bodies move through S samples, seen from one frame.

    Attributes:
        ends: (B, 2, 3, S) ends of the segments (m).
        travel: (B, S) path that the fastest point of each body has covered since the first sample, at most (m).
    """

    ends: Array
    travel: Array


def bounding_capsule(shape: Any) -> tuple[Array, float]:
    """Segment ends (2, 3) and radius (m), in the frame of the shape, of a capsule that contains it.

    Args:
        shape: A primitive or a mesh of Coal.
    """
    if isinstance(shape, coal.Capsule | coal.Cylinder):
        return _along(2, shape.halfLength), float(shape.radius)
    if isinstance(shape, coal.Sphere):
        return np.zeros((2, 3)), float(shape.radius)
    if isinstance(shape, coal.Box):
        half = np.asarray(shape.halfSide, dtype=float).ravel()
        longest = int(np.argmax(half))
        return _along(longest, half[longest]), float(np.linalg.norm(np.delete(half, longest)))
    if isinstance(shape, coal.Ellipsoid):
        radii = np.asarray(shape.radii, dtype=float).ravel()
        longest, second = int(np.argmax(radii)), float(np.sort(radii)[1])
        return _along(longest, radii[longest] - second), second
    points = np.asarray(shape.points() if isinstance(shape, coal.ConvexBase) else shape.vertices(), dtype=float)
    centre = points.mean(axis=0)
    axis = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    along = (points - centre) @ axis
    radius = np.linalg.norm(points - centre - along[:, None] * axis, axis=1).max()
    return centre + np.array([[along.min()], [along.max()]]) * axis, float(radius)


def _along(axis: int, half: float) -> Array:
    ends = np.zeros((2, 3))
    ends[:, axis] = -half, half
    return ends


def tracks(R: Array, p: Array, capsules: Capsules) -> Tracks:
    """How bodies move in the frame in which the poses of their links are given.

    Args:
        R: (L, 3, 3, S) rotations of the links.
        p: (L, 3, S) their positions (m).
        capsules: The bodies.
    """
    return Tracks(*_tracks(R, p, capsules.links, capsules.ends, capsules.radii))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def seen_from(R_view, p_view, R, p):
    """Poses of links (L, 3, 3, S), (L, 3, S) as seen from a frame that moves too, (3, 3, S), (3, S)."""
    turned, shifted = np.empty(R.shape), np.empty(p.shape)
    samples = p.shape[2]
    for k in range(R.shape[0]):
        for a in range(3):
            x, y, z = R_view[0, a], R_view[1, a], R_view[2, a]
            for s in range(samples):
                shifted[k, a, s] = (
                    x[s] * (p[k, 0, s] - p_view[0, s])
                    + y[s] * (p[k, 1, s] - p_view[1, s])
                    + z[s] * (p[k, 2, s] - p_view[2, s])
                )
            for b in range(3):
                for s in range(samples):
                    turned[k, a, b, s] = x[s] * R[k, 0, b, s] + y[s] * R[k, 1, b, s] + z[s] * R[k, 2, b, s]
    return turned, shifted


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def _tracks(R, p, links, body_ends, radii):
    count, samples = R.shape[0], R.shape[3]
    # 2 sin(θ/2) of the turn of a link since the sample before: its Frobenius norm over √2.
    turn = np.zeros((count, samples))
    for k in range(count):
        for a in range(3):
            for b in range(3):
                _add_squared_steps(R[k, a, b], turn[k])
        for s in range(samples):
            turn[k, s] = np.sqrt(turn[k, s] / 2)
    ends, travel, step = np.empty((links.size, 2, 3, samples)), np.zeros((links.size, samples)), np.empty((2, samples))
    for i in range(links.size):
        k = links[i]
        step[:] = 0.0
        for e in range(2):
            t = body_ends[i, e]
            for a in range(3):
                x, y, z, origin = R[k, a, 0], R[k, a, 1], R[k, a, 2], p[k, a]
                row = ends[i, e, a]
                for s in range(samples):
                    row[s] = origin[s] + x[s] * t[0] + y[s] * t[1] + z[s] * t[2]
                _add_squared_steps(row, step[e])
        # Displacement is affine in the point, so within the segment it is largest at an end.
        path = 0.0
        for s in range(samples):
            path += np.sqrt(max(step[0, s], step[1, s])) + radii[i] * turn[k, s]
            travel[i, s] = path
    return ends, travel


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _add_squared_steps(row, total):
    """total[s] += (row[s] − row[s − 1])², from the second sample on."""
    for s in range(1, row.size):
        total[s] += (row[s] - row[s - 1]) ** 2


@njit(cache=True, error_model="numpy", inline="always")
def _box_gap(ends, s, low, high):
    """Distance between the box around the segment at sample s and a box; −inf if they overlap."""
    gap = 0.0
    for a in range(3):
        u, v = ends[0, a, s], ends[1, a, s]
        d = max(low[a] - max(u, v), min(u, v) - high[a], 0.0)
        gap += d * d
    # How deep two bodies are in each other, overlapping boxes do not say.
    return np.sqrt(gap) if gap > 0.0 else -np.inf


@njit(cache=True, error_model="numpy", inline="always")
def _first_beyond(travel, start, stop, reach):
    """First sample from `start` on, or `stop`, at which a path (S,), which never shrinks, exceeds `reach`."""
    low, high = start, stop
    while low < high:
        middle = (low + high) // 2
        if travel[middle] <= reach:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def near_boxes(ends, travel, radii, bodies, starts, stops, low, high, horizon):
    """Pairs of a body and a box that may come nearer than `horizon`, and lower bounds for them.

    Args:
        ends: Of the `Tracks` in the frame of the boxes.
        travel: Of the same.
        radii: (B,) m.
        bodies: (K,) which bodies.
        starts: (K,) first sample that counts for each of them.
        stops: (K,) one after the last.
        low: (P, 3) lower corners of the boxes (m).
        high: (P, 3) upper corners (m).
        horizon: m.

    Returns:
        Bodies, boxes, bounds (rows, S), inf where a sample does not count or is known to be farther than the horizon.
    """
    samples, count = travel.shape[1], low.shape[0]
    rows = np.empty((bodies.size * count, samples))
    first, second = np.empty(bodies.size * count, np.int64), np.empty(bodies.size * count, np.int64)
    around_low, around_high = np.empty(3), np.empty(3)
    for a in range(3):
        around_low[a], around_high[a] = low[:, a].min(), high[:, a].max()
    used = 0
    for n in range(bodies.size):
        b = bodies[n]
        comes_near = False
        s = begin = starts[n]
        while s < stops[n] and not comes_near:
            room = _box_gap(ends[b], s, around_low, around_high) - radii[b] - horizon
            comes_near = not room >= 0.0
            begin = s
            s = _first_beyond(travel[b], s + 1, stops[n], travel[b, s] + room)
        if not comes_near:
            continue
        for i in range(count):
            row = rows[used]
            keep = False
            s = begin
            while s < stops[n]:
                bound = _box_gap(ends[b], s, low[i], high[i]) - radii[b]
                if bound < horizon:
                    if not keep:
                        row[:] = np.inf
                    row[s] = bound
                    keep = True
                # While the body stays where it is, so does its distance.
                room = max(bound - horizon, STILL)
                s = _first_beyond(travel[b], s + 1, stops[n], travel[b, s] + room)
            if keep:
                first[used], second[used] = b, i
                used += 1
    return first[:used], second[:used], rows[:used]


@njit(cache=True, error_model="numpy")
def near_capsules(ends, travel, radii, first, second, horizon):
    """Pairs of bodies (K,), (K,) that may come nearer to each other than `horizon`; as `near_boxes`."""
    samples = travel.shape[1]
    rows, path = np.empty((first.size, samples)), np.empty(samples)
    kept = np.empty(first.size, np.int64)
    used = 0
    for n in range(first.size):
        i, k = first[n], second[n]
        row = rows[used]
        keep = False
        for s in range(samples):
            path[s] = travel[i, s] + travel[k, s]
        s = 0
        while s < samples:
            bound = _segment_distance(ends[i], ends[k], s) - radii[i] - radii[k]
            if bound < horizon:
                if not keep:
                    row[:] = np.inf
                row[s] = bound
                keep = True
            s = _first_beyond(path, s + 1, samples, path[s] + max(bound - horizon, STILL))
        if keep:
            kept[used] = n
            used += 1
    return kept[:used], rows[:used]


@njit(cache=True, error_model="numpy")
def _segment_distance(one, other, s):
    """Distance of two segments at sample s: where the lines come nearest, each parameter clamped in turn."""
    px, py, pz = one[0, 0, s], one[0, 1, s], one[0, 2, s]
    ux, uy, uz = one[1, 0, s] - px, one[1, 1, s] - py, one[1, 2, s] - pz
    qx, qy, qz = other[0, 0, s], other[0, 1, s], other[0, 2, s]
    vx, vy, vz = other[1, 0, s] - qx, other[1, 1, s] - qy, other[1, 2, s] - qz
    wx, wy, wz = px - qx, py - qy, pz - qz
    a, e = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    b, c, f = ux * vx + uy * vy + uz * vz, ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    denominator = a * e - b * b
    x = 0.0
    if a > 0.0:
        # Parallel segments: any start serves, the clamping below finds the nearest pair.
        x = min(max((b * f - c * e) / denominator, 0.0), 1.0) if denominator > 1e-14 * a * e else 0.0
    y = (b * x + f) / e if e > 0.0 else 0.0
    if y < 0.0 or y > 1.0 or e == 0.0:
        y = min(max(y, 0.0), 1.0)
        x = min(max((b * y - c) / a, 0.0), 1.0) if a > 0.0 else 0.0
    dx, dy, dz = wx + x * ux - y * vx, wy + x * uy - y * vy, wz + x * uz - y * vz
    return np.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True, error_model="numpy")
def heights(ends, radii, bodies):
    """(K, S) height of the lowest point of the capsules of some bodies, seen from the world."""
    rows = np.empty((bodies.size, ends.shape[3]))
    for n in range(bodies.size):
        b = bodies[n]
        for s in range(ends.shape[3]):
            rows[n, s] = min(ends[b, 0, 2, s], ends[b, 1, 2, s]) - radii[b]
    return rows


@njit(cache=True, error_model="numpy")
def box_heights(up, origin, low, high, start):
    """(P, S) height of the lowest corner of boxes (P, 3), (P, 3) in a frame; inf before sample `start`.

    Args:
        up: (3, S) the world's z axis in that frame.
        origin: (S,) height of its origin (m).
        low: (P, 3) lower corners in that frame (m).
        high: (P, 3) upper corners (m).
        start: First sample that counts.
    """
    rows = np.full((low.shape[0], origin.size), np.inf)
    for i in range(low.shape[0]):
        for s in range(start, origin.size):
            z = origin[s]
            for a in range(3):
                z += min(up[a, s] * low[i, a], up[a, s] * high[i, a])
            rows[i, s] = z
    return rows


@njit(cache=True, error_model="numpy")
def tighten(row, travel, at, distance):
    """Enter an exact distance into a row of bounds, as its neighbours see it; `at` itself is done (inf).

    Args:
        row: (S,) bounds, changed in place.
        travel: (S,) combined path of both bodies (m).
        at: The sample that was measured.
        distance: What was measured (m).

    Returns:
        Least bound that is left, and where.
    """
    row[at] = np.inf
    least, where = np.inf, 0
    for s in range(row.size):
        bound = distance - abs(travel[s] - travel[at])
        if bound > row[s]:
            row[s] = bound
        if row[s] < least:
            least, where = row[s], s
    return least, where
