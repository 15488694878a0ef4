"""All motions that obey the trapezoidal rule between two boundary states, as one free sequence a joint.

With s = t/T, w = T q̇, a = T² q̈ and h = 1/N the trapezoidal rule, eq. (3b), has as its solutions exactly the three-tap
filters of a sequence r[−1 … N+1],

    q[k] = (r[k−1] + 2 r[k] + r[k+1]) / 4,   w[k] = (r[k+1] − r[k−1]) / (2 h),   a[k] = (r[k+1] − 2 r[k] + r[k−1]) / h².

Position and velocity at an end fix the two neighbours of r[0] (of r[N]) by r[±1] = 2 q − r[0] ± h T q̇. Where the
acceleration is given as well, as at a splice, it fixes r[0] = q − h² T² q̈ / 4 too. The unknowns are x = (r[0], r[2],
…, r[N−2], r[N]), N − 1 a joint, of which the first or the last may be held.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.lanes import LANES, lanes_of, load, store
from dyngrasp.signals import Array

Indices = NDArray[np.int64]
Motion = tuple[Array, Array, Array]  # q, q̇, q̈, each (N+1, n)
Filters = tuple[Indices, Array, Array]  # of `filters`

POSITION, RATE, CURVATURE = 0, 1, 2
TAPS = 3


@lru_cache(maxsize=64)
def filters(intervals: int, hold_start: bool, hold_end: bool, ends_cost: bool) -> Filters:
    """How grid points depend on the unknowns, and the bands of Σ_k zᵀz.

    Args:
        intervals: N ≥ 4.
        hold_start: Whether r[0] is given.
        hold_end: Whether r[N] is given.
        ends_cost: Whether the sums run over all grid points or over k = 1 … N−1.

    Returns:
        `first` (N+1,), index of the first unknown of a grid point; `taps` (N+1, 3, 3), coefficients [k, tap, q/w/a]
        with zeros at held unknowns; `bands` (3, N−1, 3), lower bands [q/w/a, column, diagonal] of Σ_k tap tapᵀ.
    """
    N, h = intervals, 1.0 / intervals
    size = N - 1
    weights = np.array([[0.25, -0.5 / h, 1 / h**2], [0.5, 0.0, -2 / h**2], [0.25, 0.5 / h, 1 / h**2]])
    rows = np.zeros((N + 1, size, 3))
    column = {0: 0, N: size - 1} | {i: i - 1 for i in range(2, N - 1)}
    mirrored = {-1: 0, 1: 0, N - 1: size - 1, N + 1: size - 1}
    for k in range(N + 1):
        for step in (-1, 0, 1):
            i = k + step
            if i in mirrored:
                # r[±1] = … − r[0]: an eliminated value counts for its neighbour at the end, with the opposite sign.
                rows[k, mirrored[i]] -= weights[step + 1]
            else:
                rows[k, column[i]] += weights[step + 1]
    if hold_start:
        rows[:, 0] = 0.0
    if hold_end:
        rows[:, -1] = 0.0
    first = np.clip(np.arange(N + 1, dtype=np.int64) - 2, 0, size - TAPS)
    taps = np.stack([rows[k, first[k] : first[k] + TAPS] for k in range(N + 1)])
    counted = slice(None) if ends_cost else slice(1, N)
    bands = np.zeros((3, size, TAPS))
    for kind in range(3):
        gram = rows[counted, :, kind].T @ rows[counted, :, kind]
        for d in range(TAPS):
            bands[kind, : size - d, d] = np.diagonal(gram, -d)
    for array in (first, taps, bands):
        array.setflags(write=False)
    return first, taps, bands


@njit(cache=True, error_model="numpy")
def boundary(T: float, T_ref: float, ends: Array, reference: Array, linear: bool, values: Array, slopes: Array) -> None:
    """Write q, w, a at both ends and their derivatives by T, both (2, 3, W), zero after the n joints.

    Exactly they are q, T q̇, T² q̈ of `ends` (2, 3, n). The paper's program knows them to first order about the
    reference: T* q̇ + q̇* (T − T*) and T*² q̈ + 2 T* v* (T − T*).
    """
    for end in range(2):
        k = 0 if end == 0 else -1
        for j in range(ends.shape[2]):
            q, rate, curvature = ends[end, 0, j], ends[end, 1, j], ends[end, 2, j]
            values[end, 0, j], slopes[end, 0, j] = q, 0.0
            if linear:
                slopes[end, 1, j] = reference[1, k, j]
                slopes[end, 2, j] = 2 * T_ref * reference[2, k, j]
                values[end, 1, j] = T_ref * rate + slopes[end, 1, j] * (T - T_ref)
                values[end, 2, j] = T_ref * T_ref * curvature + slopes[end, 2, j] * (T - T_ref)
            else:
                values[end, 1, j], slopes[end, 1, j] = T * rate, rate
                values[end, 2, j], slopes[end, 2, j] = T * T * curvature, 2 * T * curvature


@njit(cache=True, error_model="numpy")
def unknowns_of(reference: Array, T: float, x: Array) -> None:
    """Write the unknowns (N−1, W) of a motion q, q̇, q̈ (3, N+1, W): r = q − h² T² q̈ / 4."""
    size, width = x.shape
    factor = (T / (size + 1)) ** 2 / 4
    inner, q, curvature = x[1 : size - 1].ravel(), reference[0, 2:size].ravel(), reference[2, 2:size].ravel()
    for i in range(inner.size):
        inner[i] = q[i] - factor * curvature[i]
    for j in range(width):
        x[0, j] = reference[0, 0, j] - factor * reference[2, 0, j]
        x[size - 1, j] = reference[0, size + 1, j] - factor * reference[2, size + 1, j]


@njit(cache=True, error_model="numpy")
def sequence(x: Array, values: Array, held: tuple[bool, bool], r: Array) -> None:
    """Write r (N+3, n) from the unknowns x (N−1, n) and q, w, a at both ends (2, 3, n)."""
    size, n = x.shape
    h = 1.0 / (size + 1)
    write(1.0, x[1 : size - 1], r[3 : size + 1])
    for end in range(2):
        at = 1 if end == 0 else size + 2
        for j in range(n):
            middle = x[0, j] if end == 0 else x[size - 1, j]
            if held[end]:
                middle = values[end, 0, j] - h * h * values[end, 2, j] / 4
            r[at, j] = middle
            r[at - 1, j] = 2 * values[end, 0, j] - middle - h * values[end, 1, j]
            r[at + 1, j] = 2 * values[end, 0, j] - middle + h * values[end, 1, j]


@njit(cache=True, error_model="numpy")
def plain_taps(kind: int, K: int) -> tuple[float, float, float]:
    """Weights of r[k−1], r[k], r[k+1] in q, w or a of grid point k of K."""
    N = float(K - 1)
    if kind == POSITION:
        return 0.25, 0.5, 0.25
    return (-0.5 * N, 0.0, 0.5 * N) if kind == RATE else (N * N, -2.0 * N * N, N * N)


@njit(cache=True, error_model="numpy")
def filtered(r: Array, z: Array) -> None:
    """Write q, w, a (3, N+1, n) of a sequence r (N+3, n)."""
    K = z.shape[1]
    first, second, third = r[:K].ravel(), r[1 : 1 + K].ravel(), r[2 : 2 + K].ravel()
    q, w, a = z[0].ravel(), z[1].ravel(), z[2].ravel()
    half_rate, curvature = 0.5 * (K - 1), float((K - 1) * (K - 1))
    for i in range(q.size):
        before, here, after = first[i], second[i], third[i]
        q[i] = 0.25 * (before + after) + 0.5 * here
        w[i] = half_rate * (after - before)
        a[i] = curvature * ((after - here) - (here - before))


@njit(cache=True, error_model="numpy")
def pull_back(kind: int, taps: Array, dual: Array, gradient: Array) -> None:
    """Add to `gradient` (N−1, W) the derivatives by x of Σ dual · z[kind], `dual` (N+1, W)."""
    K, width = dual.shape
    before, here, after = plain_taps(kind, K)
    flat, out = dual.ravel(), gradient.ravel()
    for j in range(0, width, LANES):
        # What the interior unknowns do, then what the first and the last one do.
        dual_0, dual_1 = load(flat, width + j, LANES), load(flat, 2 * width + j, LANES)
        for i in range(1, K - 3):
            at = i * width + j
            dual_2 = load(flat, at + 2 * width, LANES)
            store(load(out, at, LANES) + after * dual_0 + here * dual_1 + before * dual_2, out, at, LANES)
            dual_0, dual_1 = dual_1, dual_2
    for k in range(TAPS):
        for j in range(width):
            gradient[0, j] += taps[k, 0, kind] * dual[k, j]
            gradient[K - 3, j] += taps[K - TAPS + k, TAPS - 1, kind] * dual[K - TAPS + k, j]


@njit(cache=True, error_model="numpy")
def push_forward(taps: Array, dx: Array, z: Array) -> None:
    """Add the change of q, w, a with dx (N−1, W) to z (3, N+1, W)."""
    _, K, width = z.shape
    flat = dx.ravel()
    for kind in range(3):
        before, here, after = plain_taps(kind, K)
        out = z[kind].ravel()
        for j in range(0, width, LANES):
            # What the interior unknowns do, then what the first and the last one do.
            dx_2, dx_1 = lanes_of(0.0), lanes_of(0.0)
            for k in range(1, K - 1):
                at = k * width + j
                dx_0 = load(flat, at, LANES) if k < K - 3 else lanes_of(0.0)
                store(load(out, at, LANES) + after * dx_0 + here * dx_1 + before * dx_2, out, at, LANES)
                dx_2, dx_1 = dx_1, dx_0
        for k in range(TAPS):
            for j in range(width):
                z[kind, k, j] += taps[k, 0, kind] * dx[0, j]
                z[kind, K - TAPS + k, j] += taps[K - TAPS + k, TAPS - 1, kind] * dx[K - 3, j]


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def product(a: Array, b: Array) -> float:
    """Σ a · b over two arrays of one shape; the order of the sum is the compiler's."""
    total, x, y = 0.0, a.ravel(), b.ravel()
    for i in range(x.size):
        total += x[i] * y[i]
    return total


@njit(cache=True, error_model="numpy")
def spread_band(base: Array, band: Array) -> None:
    """Write the bands (N−1, 3) of one matrix for every joint, (N−1, 3, W)."""
    width = band.shape[2]
    one, all_joints = base.ravel(), band.ravel()
    for i in range(one.size):
        for j in range(0, width, LANES):
            store(lanes_of(one[i]), all_joints, i * width + j, LANES)


@njit(cache=True, error_model="numpy")
def factorise(band: Array) -> None:
    """Replace bands (N−1, 3, W) of W pentadiagonal matrices by L and D⁻¹ of L D Lᵀ; joints lie side by side."""
    size, _, width = band.shape
    flat, zero = band.ravel(), lanes_of(0.0)
    for j in range(0, width, LANES):
        # What the last two columns leave of the diagonal, and the last one of the entry below it.
        off_pivot, off_next_pivot, off_below = zero, zero, zero
        for i in range(size):
            at = 3 * i * width + j
            inverse = 1.0 / (load(flat, at, LANES) - off_pivot)
            below, second = load(flat, at + width, LANES) - off_below, load(flat, at + 2 * width, LANES)
            l1, l2 = below * inverse, second * inverse
            store(inverse, flat, at, LANES)
            store(l1, flat, at + width, LANES)
            store(l2, flat, at + 2 * width, LANES)
            off_pivot, off_next_pivot, off_below = off_next_pivot + l1 * below, l2 * second, l1 * second


@njit(cache=True, error_model="numpy")
def substitute(band: Array, x: Array) -> None:
    """Overwrite the right-hand sides x (N−1, W) by the solutions."""
    size, width = x.shape
    L, b, zero = band.ravel(), x.ravel(), lanes_of(0.0)
    for j in range(0, width, LANES):
        x_2, x_1, l1, l2, next_l2 = zero, zero, zero, zero, zero
        for i in range(size):
            at, in_band = i * width + j, 3 * i * width + j
            x_0 = load(b, at, LANES) - l2 * x_2 - l1 * x_1
            store(x_0, b, at, LANES)
            x_2, x_1 = x_1, x_0
            l2, l1, next_l2 = next_l2, load(L, in_band + width, LANES), load(L, in_band + 2 * width, LANES)
        x_2, x_1 = zero, zero
        for i in range(size - 1, -1, -1):
            at, in_band = i * width + j, 3 * i * width + j
            inverse = load(L, in_band, LANES)
            l1, l2 = load(L, in_band + width, LANES), load(L, in_band + 2 * width, LANES)
            x_0 = load(b, at, LANES) * inverse - l2 * x_2 - l1 * x_1
            store(x_0, b, at, LANES)
            x_2, x_1 = x_1, x_0


@njit(cache=True, error_model="numpy")
def substitute_both(band: Array, x: Array, y: Array) -> None:
    """`substitute` for two right-hand sides; side by side they take little longer than one."""
    size, width = x.shape
    L, b, c, zero = band.ravel(), x.ravel(), y.ravel(), lanes_of(0.0)
    for j in range(0, width, LANES):
        x_2, x_1, y_2, y_1, l1, l2, next_l2 = zero, zero, zero, zero, zero, zero, zero
        for i in range(size):
            at, in_band = i * width + j, 3 * i * width + j
            x_0 = load(b, at, LANES) - l2 * x_2 - l1 * x_1
            y_0 = load(c, at, LANES) - l2 * y_2 - l1 * y_1
            store(x_0, b, at, LANES)
            store(y_0, c, at, LANES)
            x_2, x_1, y_2, y_1 = x_1, x_0, y_1, y_0
            l2, l1, next_l2 = next_l2, load(L, in_band + width, LANES), load(L, in_band + 2 * width, LANES)
        x_2, x_1, y_2, y_1 = zero, zero, zero, zero
        for i in range(size - 1, -1, -1):
            at, in_band = i * width + j, 3 * i * width + j
            inverse = load(L, in_band, LANES)
            l1, l2 = load(L, in_band + width, LANES), load(L, in_band + 2 * width, LANES)
            x_0 = load(b, at, LANES) * inverse - l2 * x_2 - l1 * x_1
            y_0 = load(c, at, LANES) * inverse - l2 * y_2 - l1 * y_1
            store(x_0, b, at, LANES)
            store(y_0, c, at, LANES)
            x_2, x_1, y_2, y_1 = x_1, x_0, y_1, y_0


@njit(cache=True, error_model="numpy")
def write(factor: float, a: Array, out: Array) -> None:
    """Write a multiple of an array of the same shape; flat, for an assignment of arrays is no vector loop."""
    x, y = a.ravel(), out.ravel()
    for i in range(x.size):
        y[i] = factor * x[i]


@njit(cache=True, error_model="numpy")
def subtract(factor: float, a: Array, out: Array) -> None:
    """Subtract a multiple of an array from another."""
    x, y = a.ravel(), out.ravel()
    for i in range(x.size):
        y[i] -= factor * x[i]
