"""Which bodies may come near each other as they move, and how near at least: for many samples at once, compiled.

How far a body can have moved from one sample to another bounds how much any of its distances can have changed: after a
sample that is far the next ones are skipped, and one exact distance says something about its neighbours. All bodies of
a link are first looked at as one.

Bounds hold for signed distances: a penetration counts negative with the depth by which the bodies would have to part.
Links, samples and volumes are those of `bounding_volumes`; the link with index 0 is the world.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.models.bounding_volumes import gap, lower_end, lowest_corner, segment_distance, segment_gap
from dyngrasp.models.link_motion import next_beyond, paths_of, span, write_path
from dyngrasp.signals import Array


class Candidates(NamedTuple):
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


@njit(cache=True)
def space_for(pairs, bounds):
    """`Candidates` with room for so many pairs, and for so many bounds of all of them together."""
    stops = np.empty(pairs + 1, np.int64)
    stops[0] = 0
    return Candidates(np.empty((pairs, 2), np.int64), stops, np.empty(bounds, np.int64), np.empty(bounds))


@njit(cache=True)
def first_of(found, pairs):
    """The `Candidates` of the first pairs."""
    size = found.stops[pairs]
    return Candidates(found.pairs[:pairs], found.stops[: pairs + 1], found.samples[:size], found.bounds[:size])


@njit(cache=True, inline="always")
def _is_full(found, n, e, samples):
    """Whether there is no room for another pair after n of them, with e bounds, or not for all its samples."""
    return n + 1 >= found.stops.size or e + samples > found.samples.size


@njit(cache=True, inline="always")
def _note(found, e, sample, bound):
    """Enter the bound of one sample; number of bounds after this one."""
    found.samples[e], found.bounds[e] = sample, bound
    return e + 1


@njit(cache=True, inline="always")
def _finish(found, n, e, one, other):
    """Number of pairs after this one, which counts if there are bounds since the last."""
    if e > found.stops[n]:
        found.pairs[n, 0], found.pairs[n, 1], found.stops[n + 1] = one, other, e
        return n + 1
    return n


@njit(cache=True, error_model="numpy")
def add_near_ground(motion, bodies, horizon, found, n):
    """Add bodies on moving links that may be lower than `horizon` (m), each paired with the ground: number −1.

    Bounds are the lower ends of capsules above z = 0, first of the one around all bodies of a link.

    Args:
        motion: `Motion` as seen from the world.
        bodies: `Bodies`.
        horizon: m.
        found: `Candidates` with room for more.
        n: Number of pairs in them; −1 if they were full before.

    Returns:
        Number of pairs now; −1 if there is not room for all.
    """
    if n < 0:
        return -1
    R, p, shift, turn = motion
    samples, e = p.shape[2], found.stops[n]
    paths, path = paths_of(shift, turn, bodies.link_reaches), np.empty(samples)
    for k in range(1, bodies.link_radii.size):
        if bodies.firsts[k] == bodies.firsts[k + 1]:
            continue
        begin = 0
        while begin < samples:
            bound = lower_end(R[k], p[k], bodies.link_ends[k], begin) - bodies.link_radii[k]
            if bound < horizon:
                break
            begin = next_beyond(paths[k], begin, samples, bound - horizon)
        if begin >= samples:
            continue
        for m in range(bodies.firsts[k], bodies.firsts[k + 1]):
            if _is_full(found, n, e, samples):
                return -1
            b, s = bodies.members[m], begin
            write_path(shift[k], turn[k], bodies.reaches[b], path)
            while s < samples:
                bound = lower_end(R[k], p[k], bodies.ends[b], s) - bodies.radii[b]
                if bound < horizon:
                    e = _note(found, e, s, bound)
                s = next_beyond(path, s, samples, bound - horizon)
            n = _finish(found, n, e, b, -1)
    return n


@njit(cache=True, error_model="numpy")
def add_pieces_near_ground(motion, pieces, start, horizon, found, n):
    """Add pieces of the last link that may be lower than `horizon` (m) from sample `start` on; the ground is number −1.

    Bounds are the lowest corners of boxes, first of the one around all pieces. Other arguments and the answer are those
    of `add_near_ground`.
    """
    if n < 0:
        return -1
    R, p, shift, turn = motion.R[-1], motion.p[-1], motion.shift[-1], motion.turn[-1]
    samples, e = p.shape[1], found.stops[n]
    path, begin = np.empty(samples), start
    write_path(shift, turn, pieces.reaches.max(), path)
    while begin < samples:
        bound = lowest_corner(R, p, pieces.around[0], pieces.around[1], begin)
        if bound < horizon:
            break
        begin = next_beyond(path, begin, samples, bound - horizon)
    if begin < samples:
        for i in range(pieces.reaches.size):
            if _is_full(found, n, e, samples):
                return -1
            write_path(shift, turn, pieces.reaches[i], path)
            s = begin
            while s < samples:
                bound = lowest_corner(R, p, pieces.low[i], pieces.high[i], s)
                if bound < horizon:
                    e = _note(found, e, s, bound)
                s = next_beyond(path, s, samples, bound - horizon)
            n = _finish(found, n, e, pieces.first + i, -1)
    return n


@njit(cache=True, error_model="numpy")
def add_near_pieces(motion, bodies, pieces, windows, horizon, found, n):
    """Add bodies that may come nearer than `horizon` (m) to pieces.

    Bounds are gaps between boxes along the axes of the part: first a link as a whole against all pieces, then a capsule
    around a body against all, then the body against each; what is far at one of these steps until some sample is not
    looked at before it. Other arguments and the answer are those of `add_near_ground`.

    Args:
        motion: `Motion` as seen from the part.
        bodies: `Bodies`.
        pieces: `Pieces`.
        windows: (B, 2) first sample that counts for each body, and one after the last.
        horizon: m.
        found: As there.
        n: As there.
    """
    if n < 0:
        return -1
    R, p, shift, turn = motion
    samples, e = p.shape[2], found.stops[n]
    paths, path = paths_of(shift, turn, bodies.link_reaches), np.empty(samples)
    own_low, own_high = np.empty((3, samples)), np.empty((3, samples))
    for k in range(bodies.link_radii.size):
        begin, end = samples, 0
        for m in range(bodies.firsts[k], bodies.firsts[k + 1]):
            b = bodies.members[m]
            if windows[b, 0] < windows[b, 1]:
                begin, end = min(begin, windows[b, 0]), max(end, windows[b, 1])
        while begin < end:
            bound = segment_gap(R[k], p[k], bodies.link_ends[k], begin, pieces.around) - bodies.link_radii[k]
            if bound < horizon:
                break
            begin = next_beyond(paths[k], begin, end, bound - horizon)
        if begin >= end:
            continue
        for m in range(bodies.firsts[k], bodies.firsts[k + 1]):
            b = bodies.members[m]
            first, last = max(begin, windows[b, 0]), windows[b, 1]
            if first >= last:
                continue
            write_path(shift[k], turn[k], bodies.reaches[b], path)
            while first < last:
                bound = segment_gap(R[k], p[k], bodies.ends[b], first, pieces.around) - bodies.radii[b]
                if bound < horizon:
                    break
                first = next_beyond(path, first, last, bound - horizon)
            if first >= last:
                continue
            # Against so many pieces nearly every sample is looked at.
            span(R[k], p[k], bodies.ends[b], bodies.halves[b], own_low, own_high, first, last)
            for i in range(pieces.reaches.size):
                if _is_full(found, n, e, samples):
                    return -1
                s = first
                while s < last:
                    bound = gap(own_low, own_high, s, pieces.low[i], pieces.high[i]) - bodies.rounding[b]
                    if bound < horizon:
                        e = _note(found, e, s, bound)
                    s = next_beyond(path, s, last, bound - horizon)
                n = _finish(found, n, e, b, pieces.first + i)
    return n


@njit(cache=True, error_model="numpy")
def add_near_each_other(motion, bodies, link_pairs, horizon, found, n):
    """Add bodies, one on each of a pair of links (Q, 2), that may come nearer than `horizon` (m).

    Bounds are distances of capsules: of two links, then of a body and a link, then of bodies. Other arguments and the
    answer are those of `add_near_ground`.
    """
    if n < 0:
        return -1
    R, p, shift, turn = motion
    ends, radii, reaches, firsts = bodies.ends, bodies.radii, bodies.reaches, bodies.firsts
    link_ends, link_radii = bodies.link_ends, bodies.link_radii
    samples, e = p.shape[2], found.stops[n]
    paths, own, path = paths_of(shift, turn, bodies.link_reaches), np.empty(samples), np.empty(samples)
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
            b, first = bodies.members[o], begin
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
                if _is_full(found, n, e, samples):
                    return -1
                c, s = bodies.members[m], first
                write_path(shift[k], turn[k], reaches[c], path)
                _add(own, path, path)
                while s < samples:
                    apart = segment_distance(R[j], p[j], ends[b], R[k], p[k], ends[c], s)
                    bound = apart - radii[b] - radii[c]
                    if bound < horizon:
                        e = _note(found, e, s, bound)
                    s = next_beyond(path, s, samples, bound - horizon)
                n = _finish(found, n, e, b, c)
    return n


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
def nearest_pair(least, bounds, first, last):
    """Which of some pairs has the lowest bound of all, and that bound (m), for the answer of `lowest`."""
    pair = first
    for k in range(first, last):
        if bounds[least[k]] < bounds[least[pair]]:
            pair = k
    return pair, bounds[least[pair]]
