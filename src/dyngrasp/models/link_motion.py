"""How links move, as it is seen from one frame: paths that bound what their bodies do from one sample to another.

The index of the sample is the last of every array; the compiled functions take the arrays of one link.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from dyngrasp.signals import Array

# A path this short (m) is none: far below what any of the distances is known to.
STILL = 1e-9


class Motion(NamedTuple):
    """How F links move through S samples, seen from one frame.

    A point that is ρ away from the middle of its link has covered `shift` + ρ `turn` since the first sample, at most.

    Attributes:
        R: (F, 3, 3, S) rotations.
        p: (F, 3, S) positions (m).
        shift: (F, S) path of the middle of each link (m).
        turn: (F, S) sum of 2 sin(θ/2) over the turns θ from sample to sample.
    """

    R: Array
    p: Array
    shift: Array
    turn: Array

    def path(self, link: int, reach: float) -> Array:
        """(S,) path of a body that extends by `reach` (m) from the middle of its link, at most (m)."""
        return self.shift[link] + reach * self.turn[link]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def follow(R, p, middles):
    """`Motion` for poses of links (F, 3, 3, S), (F, 3, S) and the middles of their bodies (F, 3)."""
    links, samples = p.shape[0], p.shape[2]
    shift, turn = np.zeros((links, samples)), np.zeros((links, samples))
    row = np.empty(samples)
    for k in range(links):
        for a in range(3):
            for s in range(samples):
                row[s] = p[k, a, s] + R[k, a, 0, s] * middles[k, 0] + R[k, a, 1, s] * middles[k, 1] + (
                    R[k, a, 2, s] * middles[k, 2]
                )  # fmt: skip
            _add_squared_steps(row, shift[k])
            for b in range(3):
                _add_squared_steps(R[k, a, b], turn[k])
        for s in range(samples):
            # 2 sin(θ/2) is the Frobenius norm of the change over √2.
            shift[k, s], turn[k, s] = np.sqrt(shift[k, s]), np.sqrt(turn[k, s] / 2)
        path = angle = 0.0
        for s in range(samples):
            path += shift[k, s]
            angle += turn[k, s]
            shift[k, s], turn[k, s] = path, angle
    return Motion(R, p, shift, turn)


@njit(cache=True, error_model="numpy", fastmath={"contract"}, inline="always")
def _add_squared_steps(row, total):
    """total[s] += (row[s] − row[s − 1])², from the second sample on."""
    for s in range(1, row.size):
        total[s] += (row[s] - row[s - 1]) ** 2


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def seen_from(R_view, p_view, R, p):
    """Poses of links (F, 3, 3, S), (F, 3, S) as seen from a frame that moves too, (3, 3, S), (3, S)."""
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
def write_path(shift, turn, reach, path):
    """Write (S,) how far (m) a body which extends by `reach` (m) from the middle of its link has moved, at most."""
    for s in range(path.size):
        path[s] = shift[s] + reach * turn[s]


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def paths_of(shift, turn, reaches):
    """(F, S) paths (m) of links that extend by `reaches` (F,) from their middles (m)."""
    paths = np.empty((reaches.size, shift.shape[1]))
    for k in range(reaches.size):
        write_path(shift[k], turn[k], reaches[k], paths[k])
    return paths


@njit(cache=True, error_model="numpy", inline="always")
def next_beyond(path, s, stop, room):
    """First sample after s, or `stop`, at which a path (S,), which never shrinks, is longer by more than `room` (m).

    While a body stays where it is, so does its distance: without room it must move for the next one to count.
    """
    allowed = path[s] + max(room, STILL)
    if path[stop - 1] <= allowed:
        return stop
    low, high = s + 1, stop - 1
    while low < high:
        middle = (low + high) // 2
        if path[middle] <= allowed:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def span(R, p, ends, halves, low, high, first, last):
    """Corners (3, S) of the boxes along the axes around a box that a link carries, from one sample to another.

    The box is given by half its edges (3, 3); its centre is in the middle of `ends` (2, 3).
    """
    x, y, z = (ends[0, 0] + ends[1, 0]) / 2, (ends[0, 1] + ends[1, 1]) / 2, (ends[0, 2] + ends[1, 2]) / 2
    for a in range(3):
        X, Y, Z, origin = R[a, 0, first:last], R[a, 1, first:last], R[a, 2, first:last], p[a, first:last]
        lowest, highest = low[a, first:last], high[a, first:last]
        for s in range(origin.size):
            extent = 0.0
            for c in range(3):
                extent += abs(X[s] * halves[c, 0] + Y[s] * halves[c, 1] + Z[s] * halves[c, 2])
            middle = origin[s] + X[s] * x + Y[s] * y + Z[s] * z
            lowest[s], highest[s] = middle - extent, middle + extent
