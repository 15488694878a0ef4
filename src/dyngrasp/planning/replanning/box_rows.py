"""The boxes of the tracking program as one-sided rows g ≥ 0.

Only rows near their bound are handed to the method: of some 2800 a phase about twenty are ever active. A row is named
by a code,

    code = ((kind · 2 + side) · K + k) · n + joint,   kind 0 … 2 for q, w, a; side 0 upper, 1 lower;

and the bounds of T by the two codes that follow the last one. Values are in units of the half-width of the box.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.lanes import LANES, any_below, lanes_of, load
from dyngrasp.planning.replanning.joint_splines import TAPS, Indices
from dyngrasp.signals import Array

# Beyond this a bound is none (rad, rad/s, rad/s²): nothing that moves in a cell comes near it.
UNBOUNDED = 1e8


@njit(cache=True, error_model="numpy")
def bound(
    kind: int, k: int, j: int, sign: float, T_lin: float, boxes: Array, rates: Array
) -> tuple[float, float, float]:
    """b, c and 1/scale of the row (b + c (T − T_lin) − sign z) / scale ≥ 0.

    Args:
        kind: 0 … 2 for q, w, a.
        k: Grid point.
        j: Joint.
        sign: +1 for the upper side, −1 for the lower one.
        T_lin: Duration about which rows are linear (s).
        boxes: (4, n) q_min, q_max, q̇_max, v_max.
        rates: (2, K, W) sides of the paper's boxes: how w and a change with T at constant q̇ and v; or (2, 0, W) for
            the exact rows |w| ≤ T q̇_max, |a| ≤ T_lin² v_max + 2 T_lin v_max (T − T_lin) ≤ T² v_max.
    """
    if kind == 0:
        scale = 2.0 / (boxes[1, j] - boxes[0, j])
        return (boxes[1, j] if sign > 0 else -boxes[0, j]), 0.0, scale
    if kind == 1:
        limit = boxes[2, j]
        c = limit if rates.shape[1] == 0 else sign * rates[0, k, j]
        return T_lin * limit, c, 1.0 / (T_lin * limit)
    limit = boxes[3, j]
    c = 2 * T_lin * limit if rates.shape[1] == 0 else sign * rates[1, k, j]
    return T_lin * T_lin * limit, c, 1.0 / (T_lin * T_lin * limit)


@njit(cache=True, error_model="numpy")
def collect(
    z: Array,
    T: float,
    T_lin: float,
    boxes: Array,
    rates: Array,
    margin: float,
    a_ends: tuple[bool, bool],
    codes: Indices,
) -> tuple[int, float]:
    """Write the codes of the rows closer to their bound than `margin`; return their number and the least row.

    The least one is infinite where all are met and none is that close. Values z are (3, K, W), W ≥ n whole lanes.
    """
    _, K, width = z.shape
    n = boxes.shape[1]
    count, least, shift, closest = 0, np.inf, T - T_lin, max(margin, 0.0)
    watched = lanes_of(closest)
    # Lanes beyond the joints are never near a bound.
    scales, highest, lowest = np.ones(width), np.full(width, np.inf), np.full(width, -np.inf)
    for kind in range(3):
        # Only the paper's rows differ from grid point to grid point, and they by what is taken off the value below.
        paper = kind > 0 and rates.shape[1] > 0
        for j in range(n):
            b, c, scales[j] = bound(kind, 0, j, 1.0, T_lin, boxes, rates)
            highest[j] = b if paper else b + c * shift
            b, c, _ = bound(kind, 0, j, -1.0, T_lin, boxes, rates)
            lowest[j] = -b if paper else -b - c * shift
            if kind > 0 and boxes[kind + 1, j] >= UNBOUNDED:
                highest[j], lowest[j] = np.inf, -np.inf
        first = 0 if kind == 2 and a_ends[0] else 1
        last = K if kind == 2 and a_ends[1] else K - 1
        values, drift = z[kind].ravel(), rates[max(kind - 1, 0)].ravel()
        for j in range(0, width, LANES):
            high, low, scale = load(highest, j, LANES), load(lowest, j, LANES), load(scales, j, LANES)
            for k in range(first, last):
                value = load(values, k * width + j, LANES)
                if paper:
                    value = value - shift * load(drift, k * width + j, LANES)
                above, below = (high - value) * scale, (value - low) * scale
                # Few grid points have a row near its bound; only there joints are looked at one by one.
                if any_below(above, watched) or any_below(below, watched):
                    for joint in range(j, min(j + LANES, n)):
                        alone = values[k * width + joint] - (shift * drift[k * width + joint] if paper else 0.0)
                        upper, lower = (highest[joint] - alone) * scales[joint], (alone - lowest[joint]) * scales[joint]
                        for side, g in ((0, upper), (1, lower)):
                            if g < closest:
                                least = min(least, g)
                            if g < margin:
                                codes[count] = ((kind * 2 + side) * K + k) * n + joint
                                count += 1
    return count, least


@njit(cache=True, error_model="numpy")
def impose(
    codes: Indices,
    begin: int,
    end: int,
    T: float,
    T_lin: float,
    z: Array,
    slope: Array,
    boxes: Array,
    rates: Array,
    first: Indices,
    taps: Array,
    at: Indices,
    along: Array,
    cs: Array,
    g: Array,
) -> None:
    """Decode some rows, and write their values g, their derivatives cs by T, and those by the unknowns."""
    _, K, width = z.shape
    n = boxes.shape[1]
    for i in range(begin, end):
        j = codes[i] % n
        k = (codes[i] // n) % K
        kind = codes[i] // (n * K * 2)
        sign = 1.0 - 2.0 * ((codes[i] // (n * K)) % 2)
        b, c, scale = bound(kind, k, j, sign, T_lin, boxes, rates)
        at[i] = first[k] * width + j
        for tap in range(TAPS):
            along[i, tap] = -scale * sign * taps[k, tap, kind]
        cs[i] = (c - sign * slope[kind, k, j]) * scale
        g[i] = (b + c * (T - T_lin) - sign * z[kind, k, j]) * scale


@njit(cache=True, error_model="numpy")
def scatter(
    y: Array, factor: float, begin: int, end: int, width: int, at: Indices, along: Array, cs: Array, out: Array
) -> float:
    """Add a multiple of Gᵀ y, of some rows, to out ((N−1) W,); return the part of T without that factor."""
    by_T = 0.0
    for i in range(begin, end):
        by_T += y[i] * cs[i]
        for b in range(TAPS):
            out[at[i] + b * width] += factor * y[i] * along[i, b]
    return by_T
