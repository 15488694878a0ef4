"""Which bodies may come near each other as they move, and how near at least: for many samples at once, compiled.

How far a body can have moved from one sample to another bounds how much any of its distances can have changed: after a
sample that is far the next ones are skipped, and one exact distance says something about its neighbours. All bodies of
a link are first looked at as one.

Bounds hold for signed distances: a penetration counts negative with the depth by which the bodies would have to part.
Links, samples and volumes are those of `bounding_volumes`; the link with index 0 is the world.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.bounding_volumes import (
    Bodies,
    Pieces,
    gap,
    lower_end,
    lowest_corner,
    segment_distance,
    segment_gap,
)
from dyngrasp.models.link_motion import Motion, next_beyond, paths_of, span, write_path
from dyngrasp.signals import Array


@dataclass(frozen=True, eq=False)
class Candidates:
    """K pairs of bodies that may come near, and lower bounds of their distance at some samples.

    At the samples that are not among those of a pair it is farther apart than asked for, or does not count.

    Attributes:
        pairs: (K, 2) bodies by number.
        stops: (K + 1,) where the samples of a pair end, those of the next one begin; 0 first.
        samples: (E,) of one pair after the other.
        bounds: (E,) m.
    """

    pairs: NDArray[np.int64]
    stops: NDArray[np.int64]
    samples: NDArray[np.int64]
    bounds: Array


def near_ground(motion: Motion, bodies: Bodies, horizon: float) -> Candidates:
    """Bodies on moving links that may be lower than `horizon` (m), each paired with the ground: number −1."""
    return Candidates(
        *_near_ground(
            motion.R, motion.p, motion.shift, motion.turn, bodies.members, bodies.firsts, bodies.ends, bodies.radii,
            bodies.reaches, bodies.link_ends, bodies.link_radii, bodies.link_reaches, horizon,
        )
    )  # fmt: skip


def pieces_near_ground(motion: Motion, pieces: Pieces, start: int, horizon: float) -> Candidates:
    """Pieces of the last link that may be lower than `horizon` (m) from sample `start` on; the ground is number −1."""
    return Candidates(
        *_pieces_near_ground(
            motion.R[-1], motion.p[-1], motion.shift[-1], motion.turn[-1], pieces.low, pieces.high,
            pieces.around, pieces.reaches, pieces.first, start, horizon,
        )
    )  # fmt: skip


def near_pieces(
    motion: Motion, bodies: Bodies, pieces: Pieces, windows: NDArray[np.int64], horizon: float
) -> Candidates:
    """Bodies that may come nearer than `horizon` to pieces.

    Args:
        motion: As seen from the part.
        bodies: Volumes around the bodies.
        pieces: Boxes around the pieces.
        windows: (B, 2) first sample that counts for each body, and one after the last.
        horizon: m.
    """
    return Candidates(
        *_near_pieces(
            motion.R, motion.p, motion.shift, motion.turn, bodies.members, bodies.firsts, bodies.ends, bodies.halves,
            bodies.rounding, bodies.reaches, bodies.link_ends, bodies.link_radii, bodies.link_reaches,
            pieces.low, pieces.high, pieces.around, pieces.first, windows, horizon,
        )
    )  # fmt: skip


def near_each_other(motion: Motion, bodies: Bodies, link_pairs: NDArray[np.int64], horizon: float) -> Candidates:
    """Bodies, one on each of a pair of links (Q, 2), that may come nearer than `horizon` (m)."""
    return Candidates(
        *_near_each_other(
            motion.R, motion.p, motion.shift, motion.turn, bodies.members, bodies.firsts, bodies.ends, bodies.radii,
            bodies.reaches, bodies.link_ends, bodies.link_radii, bodies.link_reaches, link_pairs, horizon,
        )
    )  # fmt: skip


@njit(cache=True, error_model="numpy")
def _near_ground(
    R, p, shift, turn, members, firsts, ends, radii, reaches, link_ends, link_radii, link_reaches, horizon
):
    """The arrays of `Candidates`: lower ends of capsules above z = 0, first the one around all bodies of a link."""
    samples = p.shape[2]
    pairs, stops, at, bounds = _space(radii.size, samples)
    n = e = 0
    paths, path = paths_of(shift, turn, link_reaches), np.empty(samples)
    for k in range(1, link_radii.size):
        if firsts[k] == firsts[k + 1]:
            continue
        begin = 0
        while begin < samples:
            bound = lower_end(R[k], p[k], link_ends[k], begin) - link_radii[k]
            if bound < horizon:
                break
            begin = next_beyond(paths[k], begin, samples, bound - horizon)
        if begin >= samples:
            continue
        for m in range(firsts[k], firsts[k + 1]):
            b, s = members[m], begin
            write_path(shift[k], turn[k], reaches[b], path)
            while s < samples:
                bound = lower_end(R[k], p[k], ends[b], s) - radii[b]
                if bound < horizon:
                    at[e], bounds[e] = s, bound
                    e += 1
                s = next_beyond(path, s, samples, bound - horizon)
            n = _finish(pairs, stops, n, e, b, -1)
    return pairs[:n], stops[: n + 1], at[:e], bounds[:e]


@njit(cache=True, error_model="numpy")
def _pieces_near_ground(R, p, shift, turn, low, high, around, reaches, number, start, horizon):
    """The arrays of `Candidates`: lowest corners of boxes, first the one around all pieces."""
    samples = p.shape[1]
    pairs, stops, at, bounds = _space(reaches.size, samples)
    n = e = 0
    path, begin = np.empty(samples), start
    write_path(shift, turn, reaches.max(), path)
    while begin < samples:
        bound = lowest_corner(R, p, around[0], around[1], begin)
        if bound < horizon:
            break
        begin = next_beyond(path, begin, samples, bound - horizon)
    if begin < samples:
        for i in range(reaches.size):
            write_path(shift, turn, reaches[i], path)
            s = begin
            while s < samples:
                bound = lowest_corner(R, p, low[i], high[i], s)
                if bound < horizon:
                    at[e], bounds[e] = s, bound
                    e += 1
                s = next_beyond(path, s, samples, bound - horizon)
            n = _finish(pairs, stops, n, e, number + i, -1)
    return pairs[:n], stops[: n + 1], at[:e], bounds[:e]


@njit(cache=True, error_model="numpy")
def _near_pieces(
    R, p, shift, turn, members, firsts, ends, halves, rounding, reaches, link_ends, link_radii, link_reaches,
    low, high, around, number, windows, horizon,
):  # fmt: skip
    """The arrays of `Candidates`: gaps between boxes along the axes of the part.

    First a link as a whole against all pieces, then a body against all, then against each; what is far at one of these
    steps until some sample is not looked at before it.
    """
    samples, count = p.shape[2], low.shape[0]
    pairs, stops, at, bounds = _space(reaches.size * count, samples)
    n = e = 0
    paths, path = paths_of(shift, turn, link_reaches), np.empty(samples)
    own_low, own_high = np.empty((3, samples)), np.empty((3, samples))
    for k in range(link_radii.size):
        begin, end = samples, 0
        for m in range(firsts[k], firsts[k + 1]):
            b = members[m]
            if windows[b, 0] < windows[b, 1]:
                begin, end = min(begin, windows[b, 0]), max(end, windows[b, 1])
        while begin < end:
            bound = segment_gap(R[k], p[k], link_ends[k], begin, around[0], around[1]) - link_radii[k]
            if bound < horizon:
                break
            begin = next_beyond(paths[k], begin, end, bound - horizon)
        if begin >= end:
            continue
        for m in range(firsts[k], firsts[k + 1]):
            b = members[m]
            first, last = max(begin, windows[b, 0]), windows[b, 1]
            if first >= last:
                continue
            # Against so many pieces nearly every sample is looked at.
            span(R[k], p[k], ends[b], halves[b], own_low, own_high, first, last)
            write_path(shift[k], turn[k], reaches[b], path)
            while first < last:
                bound = gap(own_low, own_high, first, around[0], around[1]) - rounding[b]
                if bound < horizon:
                    break
                first = next_beyond(path, first, last, bound - horizon)
            if first >= last:
                continue
            for i in range(count):
                s = first
                while s < last:
                    bound = gap(own_low, own_high, s, low[i], high[i]) - rounding[b]
                    if bound < horizon:
                        at[e], bounds[e] = s, bound
                        e += 1
                    s = next_beyond(path, s, last, bound - horizon)
                n = _finish(pairs, stops, n, e, b, number + i)
    return pairs[:n], stops[: n + 1], at[:e], bounds[:e]


@njit(cache=True, error_model="numpy")
def _near_each_other(
    R, p, shift, turn, members, firsts, ends, radii, reaches, link_ends, link_radii, link_reaches, link_pairs, horizon
):
    """The arrays of `Candidates`: distances of capsules: of two links, then of a body and a link, then of bodies."""
    samples = p.shape[2]
    pairs, stops, at, bounds = _space(radii.size**2 // 2, samples)
    n = e = 0
    paths, own, path = paths_of(shift, turn, link_reaches), np.empty(samples), np.empty(samples)
    for q in range(link_pairs.shape[0]):
        j, k = link_pairs[q, 0], link_pairs[q, 1]
        _add(paths[j], paths[k], path)
        begin = 0
        while begin < samples:
            apart = segment_distance(R[j], p[j], link_ends[j], R[k], p[k], link_ends[k], begin)
            bound = apart - link_radii[j] - link_radii[k]
            if bound < horizon:
                break
            begin = next_beyond(path, begin, samples, bound - horizon)
        if begin >= samples:
            continue
        for o in range(firsts[j], firsts[j + 1]):
            b, first = members[o], begin
            write_path(shift[j], turn[j], reaches[b], own)
            _add(own, paths[k], path)
            while first < samples:
                apart = segment_distance(R[j], p[j], ends[b], R[k], p[k], link_ends[k], first)
                bound = apart - radii[b] - link_radii[k]
                if bound < horizon:
                    break
                first = next_beyond(path, first, samples, bound - horizon)
            if first >= samples:
                continue
            for m in range(firsts[k], firsts[k + 1]):
                c, s = members[m], first
                write_path(shift[k], turn[k], reaches[c], path)
                _add(own, path, path)
                while s < samples:
                    apart = segment_distance(R[j], p[j], ends[b], R[k], p[k], ends[c], s)
                    bound = apart - radii[b] - radii[c]
                    if bound < horizon:
                        at[e], bounds[e] = s, bound
                        e += 1
                    s = next_beyond(path, s, samples, bound - horizon)
                n = _finish(pairs, stops, n, e, b, c)
    return pairs[:n], stops[: n + 1], at[:e], bounds[:e]


@njit(cache=True, error_model="numpy")
def _add(one, other, path):
    for s in range(path.size):
        path[s] = one[s] + other[s]


@njit(cache=True, error_model="numpy")
def tighten(samples, bounds, path_one, path_other, at, distance):
    """Enter an exact distance into the bounds of one pair, as its neighbours see it; `at` itself is done (inf).

    Args:
        samples: (E,) of the pair.
        bounds: (E,) changed in place.
        path_one: (S,) of one body (m).
        path_other: (S,) of the other one.
        at: Which of the samples was measured.
        distance: What was measured (m).

    Returns:
        Which bound is now the least.
    """
    here, least = path_one[samples[at]] + path_other[samples[at]], 0
    bounds[at] = np.inf
    for e in range(samples.size):
        if e != at:
            s = samples[e]
            bounds[e] = max(bounds[e], distance - abs(path_one[s] + path_other[s] - here))
        if bounds[e] < bounds[least]:
            least = e
    return least


@njit(cache=True)
def lowest(stops, bounds):
    """(K,) which of the bounds (E,) of each pair is the lowest."""
    least = stops[:-1].copy()
    for k in range(least.size):
        for e in range(stops[k], stops[k + 1]):
            if bounds[e] < bounds[least[k]]:
                least[k] = e
    return least


@njit(cache=True)
def nearest_pair(least, bounds):
    """Which of the pairs has the lowest bound of all, and that bound (m), for the answer of `lowest`."""
    pair = 0
    for k in range(least.size):
        if bounds[least[k]] < bounds[least[pair]]:
            pair = k
    return pair, bounds[least[pair]]


@njit(cache=True)
def _space(most, samples):
    """Arrays of `Candidates` for so many pairs; memory that is never written costs nothing."""
    size = most * samples
    stops = np.empty(most + 1, np.int64)
    stops[0] = 0
    return np.empty((most, 2), np.int64), stops, np.empty(size, np.int64), np.empty(size)


@njit(cache=True, inline="always")
def _finish(pairs, stops, n, e, one, other):
    """Number of pairs after this one, which counts if there are bounds since the last."""
    if e > stops[n]:
        pairs[n, 0], pairs[n, 1], stops[n + 1] = one, other, e
        return n + 1
    return n
