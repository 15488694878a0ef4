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
    """Volumes around B bodies on F links (m); make it with `bounding_bodies`.

    All are given in the frame of their link, moved to the middle of the capsule around all its bodies.

    Attributes:
        ends: (B, 2, 3) ends of the segment of a capsule around the body.
        radii: (B,) radius of that capsule.
        halves: (B, 3, 3) half the edges, one a row, of a box about the middle of the segment that, rounded off with
            `rounding`, contains the body too. For a box it is the box itself, for all others the segment.
        rounding: (B,)
        firsts: (F + 1,) the first body of each link, and one after the last.
        link_ends: (F, 2, 3) a capsule around all bodies of a link; of one that has none, nothing.
        link_radii: (F,)
        reaches: (F,) no point of a body is farther from the middle of its link.
    """

    ends: Array
    radii: Array
    halves: Array
    rounding: Array
    firsts: NDArray[np.int64]
    link_ends: Array
    link_radii: Array
    reaches: Array


class Pieces(NamedTuple):
    """Boxes around the P convex pieces of a part, in its frame, moved to the middle of all of them (m).

    Attributes:
        low, high: (3, P) opposite corners.
        around: (2, 3) corners of the box around all of them.
        first: Number of the first piece among all bodies.
    """

    low: Array
    high: Array
    around: Array
    first: int


def bounding_bodies(
    shapes: list[Any], placements: list[pin.SE3], links: NDArray[np.int64], count: int
) -> tuple[Bodies, Array]:
    """Volumes around bodies that are fixed to links, and the middle of each link (F, 3) in its frame (m).

    Args:
        shapes: Primitives or meshes of Coal.
        placements: Of each in the frame of its link.
        links: (B,) which of the `count` links, in this order.
        count: F, the number of links.
    """
    ends, radii, halves, rounding = np.zeros((len(shapes), 2, 3)), np.zeros(len(shapes)), [], []
    for b, (shape, placement) in enumerate(zip(shapes, placements, strict=True)):
        segment, radii[b] = bounding_capsule(shape)
        ends[b] = [placement.act(end) for end in segment]
        if isinstance(shape, coal.Box):
            halves.append(np.ravel(shape.halfSide)[:, None] * placement.rotation.T)
            rounding.append(0.0)
        else:
            halves.append(np.vstack([(ends[b, 1] - ends[b, 0]) / 2, np.zeros((2, 3))]))
            rounding.append(radii[b])
    firsts = np.searchsorted(links, np.arange(count + 1))
    link_ends, link_radii, reaches = np.zeros((count, 2, 3)), np.zeros(count), np.zeros(count)
    for link in np.unique(links):
        own = slice(firsts[link], firsts[link + 1])
        link_ends[link], link_radii[link] = _around(ends[own], radii[own])
        middle = link_ends[link].mean(axis=0)
        reaches[link] = (np.linalg.norm(ends[own] - middle, axis=2).max(axis=1) + radii[own]).max()
    middles = link_ends.mean(axis=1)
    firsts.setflags(write=False)
    return Bodies(
        read_only(ends - middles[links][:, None]), read_only(radii), read_only(halves), read_only(rounding), firsts,
        read_only(link_ends - middles[:, None]), read_only(link_radii), read_only(reaches),
    ), read_only(middles)  # fmt: skip


def boxes_around(points: list[Array], first: int) -> tuple[Pieces, Array]:
    """Boxes along the axes around the vertices (V, 3) of each piece, and the middle (3,) of all in their frame (m).

    Args:
        points: Of each piece.
        first: Number of the first one.
    """
    low, high = np.array([p.min(axis=0) for p in points]), np.array([p.max(axis=0) for p in points])
    middle = (low.min(axis=0) + high.max(axis=0)) / 2
    low, high = low - middle, high - middle
    around = read_only([low.min(axis=0), high.max(axis=0)])
    return Pieces(read_only(low.T), read_only(high.T), around, first), read_only(middle)


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


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def segment_gap(pose, ends, corners):
    """Distance (m) of a box (2, 3) from the one along its axes around a segment (2, 3); −inf if they overlap.

    The pose (3, 4) is that of the segment's link as seen from the box.
    """
    gap = 0.0
    for a in range(3):
        one, other = pose[a, 3], pose[a, 3]
        for b in range(3):
            one += pose[a, b] * ends[0, b]
            other += pose[a, b] * ends[1, b]
        d = max(corners[0, a] - max(one, other), min(one, other) - corners[1, a], 0.0)
        gap += d * d
    return np.sqrt(gap) if gap > 0.0 else -np.inf


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def write_box(pose, ends, halves, box):
    """Write corners (2, 3) of the box along the axes around one given by half its edges (3, 3), seen from elsewhere.

    Its centre is in the middle of `ends` (2, 3); the pose (3, 4) is that of its link.
    """
    for a in range(3):
        middle, extent = pose[a, 3], 0.0
        for b in range(3):
            middle += pose[a, b] * (ends[0, b] + ends[1, b]) / 2
            extent += abs(pose[a, 0] * halves[b, 0] + pose[a, 1] * halves[b, 1] + pose[a, 2] * halves[b, 2])
        box[0, a], box[1, a] = middle - extent, middle + extent


@njit(cache=True, error_model="numpy", fastmath={"contract", "nnan", "nsz"})
def squared_gaps(box, low, high, squared):
    """Write the squared distances (P,) of a box (2, 3) from others along its axes, (3, P) each; returns the least (m²).

    How deep two bodies are in each other, overlapping boxes do not say: their distance is 0.
    """
    for i in range(squared.size):
        x = max(low[0, i] - box[1, 0], box[0, 0] - high[0, i], 0.0)
        y = max(low[1, i] - box[1, 1], box[0, 1] - high[1, i], 0.0)
        z = max(low[2, i] - box[1, 2], box[0, 2] - high[2, i], 0.0)
        squared[i] = x * x + y * y + z * z
    least = np.inf
    for i in range(squared.size):
        least = min(least, squared[i])
    return least


@njit(cache=True, error_model="numpy", inline="always")
def gap_of(squared):
    """Lower bound of a distance (m) whose boxes are apart by the root of this (m²)."""
    return np.sqrt(squared) if squared > 0.0 else -np.inf


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
