"""Simple volumes around the collision bodies of a cell, and distances between them."""

from __future__ import annotations

from typing import Any, NamedTuple

import coal  # pyright: ignore[reportMissingImports]  # comes with Pinocchio, reached through a path file
import numpy as np
import pinocchio as pin
from numba import njit
from numpy.typing import NDArray

from dyngrasp.signals import Array, read_only


class Bodies(NamedTuple):
    """Volumes around B bodies on F links, each in the frame of its link (m); make it with `bounding_bodies`.

    Attributes:
        links: (B,) index of the link that each is fixed to.
        ends: (B, 2, 3) ends of the segment of a capsule around the body.
        radii: (B,) radius of that capsule.
        halves: (B, 3, 3) half the edges, one a row, of a box about the middle of the segment that, rounded off with
            `rounding`, contains the body too. For a box it is the box itself, for all others the segment.
        rounding: (B,)
        reaches: (B,) no point of the body is farther from the middle of its link's capsule.
        members: (B,) all bodies, link after link.
        firsts: (F + 1,) where in `members` those of a link begin.
        link_ends: (F, 2, 3) a capsule around all bodies of a link; of one that has none, nothing.
        link_radii: (F,)
        link_reaches: (F,) half its length.
    """

    links: NDArray[np.int64]
    ends: Array
    radii: Array
    halves: Array
    rounding: Array
    reaches: Array
    members: NDArray[np.int64]
    firsts: NDArray[np.int64]
    link_ends: Array
    link_radii: Array
    link_reaches: Array


class Pieces(NamedTuple):
    """Boxes around the P convex pieces of a part, in the frame of the part (m).

    Attributes:
        low, high: (P, 3) opposite corners.
        around: (2, 3) corners of the box around all of them.
        reaches: (P,) no point of a piece is farther from the middle of that.
        first: Number of the first piece among all bodies.
    """

    low: Array
    high: Array
    around: Array
    reaches: Array
    first: int


def bounding_bodies(shapes: list[Any], placements: list[pin.SE3], links: NDArray[np.int64], count: int) -> Bodies:
    """Volumes around bodies that are fixed to links.

    Args:
        shapes: Primitives or meshes of Coal.
        placements: Of each in the frame of its link.
        links: (B,) which of the `count` links.
        count: F, the number of links.
    """
    ends, radii, halves, rounding = [], [], [], []
    for shape, placement in zip(shapes, placements, strict=True):
        segment, radius = bounding_capsule(shape)
        placed = np.array([placement.act(end) for end in segment])
        ends.append(placed)
        radii.append(radius)
        if isinstance(shape, coal.Box):
            halves.append(np.ravel(shape.halfSide)[:, None] * placement.rotation.T)
            rounding.append(0.0)
        else:
            halves.append(np.vstack([(placed[1] - placed[0]) / 2, np.zeros((2, 3))]))
            rounding.append(radius)
    link_ends, link_radii, reaches = np.zeros((count, 2, 3)), np.zeros(count), np.zeros(len(shapes))
    for link in np.unique(links):
        on_it = np.flatnonzero(links == link)
        link_ends[link], link_radii[link] = _around(np.array(ends)[on_it], np.array(radii)[on_it])
        middle = link_ends[link].mean(axis=0)
        for b in on_it:
            reaches[b] = np.linalg.norm(ends[b] - middle, axis=1).max() + radii[b]
    members = np.argsort(links, kind="stable")
    firsts = np.searchsorted(links[members], np.arange(count + 1))
    link_reaches = np.linalg.norm(link_ends[:, 1] - link_ends[:, 0], axis=1) / 2 + link_radii
    for indices in (members, firsts):
        indices.setflags(write=False)
    return Bodies(
        links, read_only(ends), read_only(radii), read_only(halves), read_only(rounding), read_only(reaches),
        members, firsts, read_only(link_ends), read_only(link_radii), read_only(link_reaches),
    )  # fmt: skip


def boxes_around(points: list[Array], first: int) -> Pieces:
    """Boxes along the axes around the vertices (V, 3) of each piece; `first` is the number of the first one."""
    low, high = np.array([p.min(axis=0) for p in points]), np.array([p.max(axis=0) for p in points])
    around = read_only([low.min(axis=0), high.max(axis=0)])
    farthest = np.maximum(abs(low - around.mean(axis=0)), abs(high - around.mean(axis=0)))
    return Pieces(read_only(low), read_only(high), around, read_only(np.linalg.norm(farthest, axis=1)), first)


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
    return _around(points[:, None], np.zeros(len(points)))


def _along(axis: int, half: float) -> Array:
    ends = np.zeros((2, 3))
    ends[:, axis] = -half, half
    return ends


def _around(points: Array, radii: Array) -> tuple[Array, float]:
    """A capsule along the longest extent of balls: K groups of points (K, E, 3), each with one radius."""
    flat, rounded = points.reshape(-1, 3), np.repeat(radii, points.shape[1])
    centre = flat.mean(axis=0)
    axis = np.linalg.svd(flat - centre, full_matrices=False)[2][0]
    along = (flat - centre) @ axis
    radius = (np.linalg.norm(flat - centre - along[:, None] * axis, axis=1) + rounded).max()
    return centre + np.array([[along.min()], [along.max()]]) * axis, float(radius)


@njit(cache=True, error_model="numpy", inline="always")
def point_at(R, p, point, s):
    """A point (3,) that a link (3, 3, S), (3, S) carries, at sample s (m)."""
    x, y, z = point[0], point[1], point[2]
    return (
        p[0, s] + R[0, 0, s] * x + R[0, 1, s] * y + R[0, 2, s] * z,
        p[1, s] + R[1, 0, s] * x + R[1, 1, s] * y + R[1, 2, s] * z,
        p[2, s] + R[2, 0, s] * x + R[2, 1, s] * y + R[2, 2, s] * z,
    )


@njit(cache=True, error_model="numpy", inline="always")
def lower_end(R, p, ends, s):
    """Height (m) of the lower end of a segment (2, 3) that a link carries, at sample s."""
    x, y, z = R[2, 0, s], R[2, 1, s], R[2, 2, s]
    one = x * ends[0, 0] + y * ends[0, 1] + z * ends[0, 2]
    other = x * ends[1, 0] + y * ends[1, 1] + z * ends[1, 2]
    return p[2, s] + min(one, other)


@njit(cache=True, error_model="numpy", inline="always")
def lowest_corner(R, p, low, high, s):
    """Height (m) of the lowest corner of a box that a link carries, at sample s; corners in the frame of the link."""
    z = p[2, s]
    for a in range(3):
        z += min(R[2, a, s] * low[a], R[2, a, s] * high[a])
    return z


@njit(cache=True, error_model="numpy", inline="always")
def segment_gap(R, p, ends, s, corners):
    """Distance (m) of a box (2, 3) from the one along its axes around a segment on a link; −inf if they overlap."""
    gap, one, other = 0.0, point_at(R, p, ends[0], s), point_at(R, p, ends[1], s)
    for a in range(3):
        d = max(corners[0, a] - max(one[a], other[a]), min(one[a], other[a]) - corners[1, a], 0.0)
        gap += d * d
    return np.sqrt(gap) if gap > 0.0 else -np.inf


@njit(cache=True, error_model="numpy", inline="always")
def gap(low, high, s, other_low, other_high):
    """Distance of two boxes along the axes, the first at sample s; −inf if they overlap."""
    gap = 0.0
    for a in range(3):
        d = max(other_low[a] - high[a, s], low[a, s] - other_high[a], 0.0)
        gap += d * d
    # How deep two bodies are in each other, overlapping boxes do not say.
    return np.sqrt(gap) if gap > 0.0 else -np.inf


@njit(cache=True, error_model="numpy", inline="always")
def segment_distance(R, p, ends, other_R, other_p, other_ends, s):
    """Distance of two segments (2, 3) on two links at sample s: where the lines come nearest, clamped in turn."""
    px, py, pz = point_at(R, p, ends[0], s)
    ux, uy, uz = point_at(R, p, ends[1], s)
    ux, uy, uz = ux - px, uy - py, uz - pz
    qx, qy, qz = point_at(other_R, other_p, other_ends[0], s)
    vx, vy, vz = point_at(other_R, other_p, other_ends[1], s)
    vx, vy, vz = vx - qx, vy - qy, vz - qz
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
