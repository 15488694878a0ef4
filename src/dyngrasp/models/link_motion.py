"""How links move: poses, and paths that bound what their bodies do from one sample to another.

The index of the sample is the last of every array. The frame of a link is brought to the middle of what it carries
first: no point of that is then farther from the origin than the link reaches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dyngrasp.signals import Array

# A path this short (m) is none: far below what any of the distances is known to.
STILL = 1e-9


class Motion(NamedTuple):
    """How F links move through S samples; the first is the world, the last one the part.

    Attributes:
        R: (F, 3, 3, S) rotations.
        p: (F, 3, S) middles of what the links carry (m).
        paths: (2, F, S) how far any point of what a link carries has moved since the first sample, and how much its
            distance from any point of the part has changed, at most (m).
    """

    R: Array
    p: Array
    paths: Array


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def to_middles(R, p, middles):
    """Move the origins p (F, 3, S) of links with rotations R (F, 3, 3, S) to points (F, 3) in their frames (m)."""
    for k in range(p.shape[0]):
        for a in range(3):
            x, y, z, origin = R[k, a, 0], R[k, a, 1], R[k, a, 2], p[k, a]
            for s in range(origin.size):
                origin[s] += x[s] * middles[k, 0] + y[s] * middles[k, 1] + z[s] * middles[k, 2]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def paths_in_world(R, p, reaches, paths):
    """Write the paths (F, S) of links (F, 3, 3, S), (F, 3, S) that reach so far (F,) from their origins (m).

    A point at the distance r moves by |Δp| + r · 2 sin(θ/2) at most, if its link turns by θ.
    """
    shift, turn = np.empty(p.shape[2]), np.empty(p.shape[2])
    # The world stays where it is.
    paths[0] = 0.0
    for k in range(1, p.shape[0]):
        shift[:], turn[:] = 0.0, 0.0
        _add_squared_steps(p[k], shift)
        for a in range(3):
            _add_squared_steps(R[k, a], turn)
        path = paths[k]
        for s in range(path.size):
            # 2 sin(θ/2) is the Frobenius norm of the change over √2.
            path[s] = np.sqrt(shift[s]) + reaches[k] * np.sqrt(turn[s] / 2)
        for s in range(1, path.size):
            path[s] += path[s - 1]


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _add_squared_steps(rows, total):
    """total[s] += |rows[:, s] − rows[:, s − 1]|², for three rows, from the second sample on."""
    x, y, z = rows[0], rows[1], rows[2]
    for s in range(1, total.size):
        total[s] += (x[s] - x[s - 1]) ** 2 + (y[s] - y[s - 1]) ** 2 + (z[s] - z[s - 1]) ** 2


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def paths_from_part(paths, q, hand, levers, lifted, seen):
    """Write how much distances (F, S) from the part, the last link, may change.

    By the paths of link and part together. But from sample `lifted` on the part is fixed to the hand: what changes its
    distance from a link of the hand are joints of the hand alone.

    Args:
        paths: (F, S) of `paths_in_world`.
        q: (n, S) of all joints (rad).
        hand: (m,) which of them are the hand's.
        levers: (F,) no point of a link of the hand is farther from any joint between it and the part (m); negative for
            other links.
        lifted: First sample at which the part is fixed to the hand.
        seen: (F, S) to write in (m).
    """
    links, samples = paths.shape
    part, turned = paths[-1], np.zeros(samples)
    for i in hand:
        for s in range(lifted + 1, samples):
            turned[s] += abs(q[i, s] - q[i, s - 1])
    for s in range(lifted + 1, samples):
        turned[s] += turned[s - 1]
    for k in range(links - 1):
        own, out = paths[k], seen[k]
        together = samples if levers[k] < 0.0 else min(lifted + 1, samples)
        for s in range(together):
            out[s] = own[s] + part[s]
        for s in range(together, samples):
            out[s] = out[lifted] + levers[k] * turned[s]
    seen[-1] = 0.0


@njit(cache=True, error_model="numpy", inline="always")
def next_beyond(one, other, s, stop, room):
    """First sample after s, or `stop`, at which two paths (S,) have grown by more than `room` (m) together.

    While bodies stay where they are, so does their distance: without room one must move for the next sample to count.
    """
    allowed = one[s] + other[s] + max(room, STILL)
    if one[stop - 1] + other[stop - 1] <= allowed:
        return stop
    low, high = s + 1, stop - 1
    while low < high:
        middle = (low + high) // 2
        if one[middle] + other[middle] <= allowed:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def look_from(R_view, p_view, R, p, s, pose):
    """Write the pose (3, 4) of a link (3, 3, S), (3, S) as seen from another one, at sample s."""
    for a in range(3):
        x, y, z = R_view[0, a, s], R_view[1, a, s], R_view[2, a, s]
        for b in range(3):
            pose[a, b] = x * R[0, b, s] + y * R[1, b, s] + z * R[2, b, s]
        pose[a, 3] = x * (p[0, s] - p_view[0, s]) + y * (p[1, s] - p_view[1, s]) + z * (p[2, s] - p_view[2, s])
