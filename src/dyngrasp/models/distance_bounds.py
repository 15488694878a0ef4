"""Which bodies may come near each other as they move, and how near at least: for many samples at once, compiled.

How far a body can have moved from one sample to another bounds how much any of its distances can have changed: after a
sample that is far the next ones are skipped, and one exact distance says something about its neighbours. All bodies of
a link are first looked at as one.

Bounds hold for signed distances: a penetration counts negative with the depth by which the bodies would have to part.
Links, samples and volumes are those of `bounding_volumes`; the link with index 0 is the world, the last one the part.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.bounding_volumes import (
    gap_of,
    lower_end,
    lowest_corner,
    segment_distance,
    segment_gap,
    squared_gaps,
    write_box,
)
from dyngrasp.models.link_motion import look_from, next_beyond
from dyngrasp.signals import Array

GROUND = -1  # its number among the bodies, as they are counted here


class Candidates(NamedTuple):
    """Pairs of bodies at samples where they may come near, K in all, and lower bounds of their distance there.

    At all other samples they are farther apart than asked for, or do not count.

    Attributes:
        which: (K, 3) one body by number, another, the sample.
        bounds: (K,) m.
    """

    which: NDArray[np.int64]
    bounds: Array


@njit(cache=True)
def space_for(count):
    """`Candidates` with room for so many."""
    return Candidates(np.empty((count, 3), np.int64), np.empty(count))


@njit(cache=True, inline="always")
def _note(found, n, one, other, sample, bound):
    """Enter one candidate after n; number of them now."""
    found.which[n, 0], found.which[n, 1], found.which[n, 2], found.bounds[n] = one, other, sample, bound
    return n + 1


@njit(cache=True, error_model="numpy")
def add_near_ground(motion, bodies, horizon, found, n):
    """Add bodies on moving links that may be lower than `horizon` (m), each paired with the ground: number −1.

    Bounds are the lower ends of capsules above z = 0, first of the one around all bodies of a link.

    Args:
        motion: `Motion` of the links.
        bodies: `Bodies`.
        horizon: m.
        found: `Candidates` with room for more.
        n: How many they are so far; −1 if they were full before.

    Returns:
        How many they are now; −1 if there is not room for all.
    """
    if n < 0:
        return -1
    R, p, paths, samples = motion.R, motion.p, motion.paths[0], motion.p.shape[2]
    for k in range(1, bodies.reaches.size):
        begin = 0
        while begin < samples:
            bound = p[k, 2, begin] - bodies.reaches[k]
            if bound < horizon:
                bound = lower_end(R[k], p[k], bodies.link_ends[k], begin) - bodies.link_radii[k]
                if bound < horizon:
                    break
            begin = next_beyond(paths[k], paths[0], begin, samples, bound - horizon)
        if begin == samples:
            continue
        for b in range(bodies.firsts[k], bodies.firsts[k + 1]):
            s = begin
            while s < samples:
                bound = lower_end(R[k], p[k], bodies.ends[b], s) - bodies.radii[b]
                if bound < horizon:
                    if n == found.bounds.size:
                        return -1
                    n = _note(found, n, b, GROUND, s, bound)
                s = next_beyond(paths[k], paths[0], s, samples, bound - horizon)
    return n


@njit(cache=True, error_model="numpy")
def add_pieces_near_ground(motion, pieces, window, horizon, found, n):
    """Add pieces that may be lower than `horizon` (m); the ground is number −1.

    Bounds are the lowest corners of boxes, first of the one around all pieces. Other arguments and the answer are those
    of `add_near_ground`.

    Args:
        motion: As there.
        pieces: `Pieces`.
        window: First sample that counts, and one after the last.
        horizon: As there.
        found: As there.
        n: As there.
    """
    if n < 0:
        return -1
    R, p, path, still = motion.R[-1], motion.p[-1], motion.paths[0, -1], motion.paths[0, 0]
    s, stop = window
    while s < stop:
        least = lowest_corner(R, p, pieces.around[0], pieces.around[1], s)
        if least < horizon:
            if n + pieces.low.shape[1] > found.bounds.size:
                return -1
            least = np.inf
            for i in range(pieces.low.shape[1]):
                bound = lowest_corner(R, p, pieces.low[:, i], pieces.high[:, i], s)
                if bound < horizon:
                    n = _note(found, n, pieces.first + i, GROUND, s, bound)
                least = min(least, bound)
        s = next_beyond(path, still, s, stop, least - horizon)
    return n


@njit(cache=True, error_model="numpy")
def add_near_pieces(motion, bodies, pieces, windows, horizon, found, n):
    """Add bodies that may come nearer than `horizon` (m) to pieces.

    Bounds are gaps between boxes along the axes of the part: first a link as a whole against all pieces, then a capsule
    around a body against all, then the body against each; what is far at one of these steps until some sample is not
    looked at before it. Other arguments and the answer are those of `add_near_ground`.

    Args:
        motion: As there.
        bodies: As there.
        pieces: `Pieces`.
        windows: (B, 2) first sample that counts for each body, and one after the last.
        horizon: As there.
        found: As there.
        n: As there.
    """
    if n < 0:
        return -1
    R, p, paths = motion.R, motion.p, motion.paths[1]
    still, squared, box, pose = paths[-1], np.empty(pieces.low.shape[1]), np.empty((2, 3)), np.empty((3, 4))
    for k in range(bodies.reaches.size):
        begin, end = p.shape[2], 0
        for b in range(bodies.firsts[k], bodies.firsts[k + 1]):
            if windows[b, 0] < windows[b, 1]:
                begin, end = min(begin, windows[b, 0]), max(end, windows[b, 1])
        while begin < end:
            look_from(R[-1], p[-1], R[k], p[k], begin, pose)
            bound = segment_gap(pose, bodies.link_ends[k], pieces.around) - bodies.link_radii[k]
            if bound < horizon:
                break
            begin = next_beyond(paths[k], still, begin, end, bound - horizon)
        if begin >= end:
            continue
        for b in range(bodies.firsts[k], bodies.firsts[k + 1]):
            s, stop = max(begin, windows[b, 0]), windows[b, 1]
            while s < stop:
                look_from(R[-1], p[-1], R[k], p[k], s, pose)
                bound = segment_gap(pose, bodies.ends[b], pieces.around) - bodies.radii[b]
                if bound < horizon:
                    write_box(pose, bodies.ends[b], bodies.halves[b], box)
                    bound = gap_of(squared_gaps(box, pieces.low, pieces.high, squared)) - bodies.rounding[b]
                if bound < horizon:
                    if n + squared.size > found.bounds.size:
                        return -1
                    for i in range(squared.size):
                        of_piece = gap_of(squared[i]) - bodies.rounding[b]
                        if of_piece < horizon:
                            n = _note(found, n, b, pieces.first + i, s, of_piece)
                s = next_beyond(paths[k], still, s, stop, bound - horizon)
    return n


@njit(cache=True, error_model="numpy")
def add_near_each_other(motion, bodies, link_pairs, horizon, found, n):
    """Add bodies, one on each of a pair of links (Q, 2), that may come nearer than `horizon` (m).

    Bounds are distances of capsules: of two links, then of a body and a link, then of bodies. Other arguments and the
    answer are those of `add_near_ground`.
    """
    if n < 0:
        return -1
    R, p, paths, samples = motion.R, motion.p, motion.paths[0], motion.p.shape[2]
    ends, radii, firsts = bodies.ends, bodies.radii, bodies.firsts
    link_ends, link_radii = bodies.link_ends, bodies.link_radii
    for q in range(link_pairs.shape[0]):
        j, k = link_pairs[q]
        begin = 0
        while begin < samples:
            bound = _between_balls(p[j], p[k], begin) - bodies.reaches[j] - bodies.reaches[k]
            if bound < horizon:
                apart = segment_distance(R[j], p[j], link_ends[j], R[k], p[k], link_ends[k], begin)
                bound = apart - link_radii[j] - link_radii[k]
                if bound < horizon:
                    break
            begin = next_beyond(paths[j], paths[k], begin, samples, bound - horizon)
        if begin == samples:
            continue
        for b in range(firsts[j], firsts[j + 1]):
            first = begin
            while first < samples:
                apart = segment_distance(R[j], p[j], ends[b], R[k], p[k], link_ends[k], first)
                bound = apart - radii[b] - link_radii[k]
                if bound < horizon:
                    break
                first = next_beyond(paths[j], paths[k], first, samples, bound - horizon)
            if first == samples:
                continue
            for c in range(firsts[k], firsts[k + 1]):
                s = first
                while s < samples:
                    apart = segment_distance(R[j], p[j], ends[b], R[k], p[k], ends[c], s)
                    bound = apart - radii[b] - radii[c]
                    if bound < horizon:
                        if n == found.bounds.size:
                            return -1
                        n = _note(found, n, b, c, s, bound)
                    s = next_beyond(paths[j], paths[k], s, samples, bound - horizon)
    return n


@njit(cache=True, error_model="numpy", inline="always")
def _between_balls(p, other_p, s):
    """Distance (m) of the origins (3, S) of two links at sample s."""
    x, y, z = p[0, s] - other_p[0, s], p[1, s] - other_p[1, s], p[2, s] - other_p[2, s]
    return np.sqrt(x * x + y * y + z * z)


@njit(cache=True, error_model="numpy")
def tighten(found, group, at, distance, one, other):
    """Enter an exact distance into the bounds of its pair, as the other samples see it; `at` itself is done (inf).

    Args:
        found: `Candidates`, changed in place.
        group: First of those that count, and one after the last.
        at: Which of them was measured.
        distance: What was measured (m).
        one: (S,) path of the link of one body (m).
        other: (S,) that of the other one.

    Returns:
        Which of the group has the lowest bound now.
    """
    which, bounds = found
    i, j, sample = which[at]
    here = one[sample] + other[sample]
    bounds[at] = np.inf
    for e in range(group[0], group[1]):
        if e != at and which[e, 0] == i and which[e, 1] == j:
            s = which[e, 2]
            bounds[e] = max(bounds[e], distance - abs(one[s] + other[s] - here))
    return lowest(bounds, group)


@njit(cache=True)
def lowest(bounds, group):
    """Which bound (m) of those from one to another is the lowest; the first one if there is none."""
    at = group[0]
    for e in range(group[0], group[1]):
        if bounds[e] < bounds[at]:
            at = e
    return at
