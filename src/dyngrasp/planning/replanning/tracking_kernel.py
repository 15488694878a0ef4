"""The tracking program of one phase in compiled code."""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.lanes import LANES, lanes_of, load, narrow, store, sum_of
from dyngrasp.planning.replanning.box_rows import UNBOUNDED, collect
from dyngrasp.planning.replanning.interior_point import INFEASIBLE, NONFINITE, OPTIMAL, interior_point
from dyngrasp.planning.replanning.joint_splines import (
    POSITION,
    RATE,
    TAPS,
    Filters,
    Indices,
    boundary,
    factorise,
    filtered,
    plain_taps,
    product,
    pull_back,
    sequence,
    spread_band,
    substitute,
    substitute_both,
    subtract,
    unknowns_of,
    write,
)
from dyngrasp.signals import Array

Weights = tuple[float, float, float, float]  # Q_q, Q_q̇, Q_v, Q_ΔT

# A row may be violated by this much of its half-width: a tenth of what the audit forgives as rounding.
VIOLATION = 1e-9

# Iterations of each run of the interior point method.
MAX_ITERATIONS = 60

# Rows this close to their bound without any of them imposed are the first guess of which may become active.
NEAR = 0.02


@njit(cache=True, error_model="numpy")
def distinct(codes: Indices) -> int:
    """Sort the codes, put each of them first once, and return how many there are."""
    codes.sort()
    count = 0
    for code in codes:
        if count == 0 or code != codes[count - 1]:
            codes[count] = code
            count += 1
    return count


@njit(cache=True, error_model="numpy")
def solve(
    wanted: Array,
    T_ref: float,
    ends: Array,
    held: tuple[bool, bool],
    weights: Weights,
    node_weights: Array,
    boxes: Array,
    paper_rows: bool,
    duration: tuple[float, float],
    filters: Filters,
    z: Array,
) -> tuple[int, float, int, Indices, Array]:
    """Minimise ½ Σ_k Σ_j Q_q δq² + Q_q̇ δq̇² + Q_v δv² + ½ Σ_k Q_ΔT δT² between two boundary states, within boxes.

    Args:
        wanted: (3, K, W) q*, q̇*, v* of n joints in whole lanes, zero behind them.
        T_ref: ΔT* (s).
        ends: (2, 3, n) position, velocity, acceleration at both ends.
        held: Whether the acceleration is given at the start and at the end.
        weights: Q_q, Q_q̇, Q_v, and Q_ΔT of one grid point.
        node_weights: (K,) added to Q_q at each grid point.
        boxes: (4, n) q_min, q_max, q̇_max, v_max; overwritten by what `box_rows` takes for unbounded.
        paper_rows: The boxes of eq. (13c), which are linear about the reference, instead of the exact ones, and sums
            over k = 1 … N−1 instead of all grid points.
        duration: Bounds of T (s); equal ones fix it.
        filters: Of `joint_splines.filters`.
        z: (3, K, W), overwritten by q, w, a; with `paper_rows` their linear model about the reference.

    Returns:
        Outcome, T, iterations of the interior point method, codes of the rows that were imposed, and their multipliers
        with those of the two bounds of T.
    """
    # Joints lie side by side in rows of whole lanes, W ≥ n numbers; what follows the joints is zero.
    _, K, width = wanted.shape
    n = ends.shape[2]
    first, taps, bands = filters
    boxes[:] = np.minimum(np.maximum(boxes, -UNBOUNDED), UNBOUNDED)
    size = K - 2
    free_T = duration[1] - duration[0] > 1e-12
    T = min(max(T_ref, duration[0]), duration[1])
    k_first, k_last = (1, K - 1) if paper_rows else (0, K)
    stiffness_T = weights[3] * (k_last - k_first)

    scaled = np.array([weights[0], weights[1] / T_ref**2, weights[2] / T_ref**4])
    base = np.zeros((size, 3))
    for kind in range(3):
        if scaled[kind] > 0.0:
            subtract(-scaled[kind], bands[kind], base)
    some_node = False
    for k in range(k_first, k_last):
        if node_weights[k] > 0.0:
            some_node = True
            for b in range(TAPS):
                for d in range(TAPS - b):
                    base[first[k] + b, d] += node_weights[k] * taps[k, b, 0] * taps[k, b + d, 0]
    if held[0]:
        base[0, 0] = 1.0
    if held[1]:
        base[size - 1, 0] = 1.0
    # All joints have the same weights, and until one of their rows is active the same matrix.
    band = np.empty((size, 3, width))
    spread_band(base, band)
    factorise(band)

    x, r, r_by_T = np.empty((size, width)), np.empty((K + 2, width)), np.zeros((K + 2, width))
    values, slopes, nothing = np.zeros((2, 3, width)), np.zeros((2, 3, width)), np.zeros((size, width))
    unknowns_of(wanted, T_ref, x)

    weight, dual, dual_by_T = np.zeros(K), np.empty((K, width)), np.empty((K, width))
    gradient, column, solved = np.empty((size, width)), np.empty((size, width)), np.zeros((size, width))
    moving_ends = False
    for end in range(2):
        for j in range(n):
            moving_ends = moving_ends or (held[end] and ends[end, 2, j] != 0.0)
    T_lin, dT, g_T, corner = T, 0.0, 0.0, 0.0
    # A given acceleration enters as T² q̈: the program is solved twice, the second time about the T of the first.
    passes = 2 if moving_ends and free_T and not paper_rows else 1
    for _ in range(passes):
        T_lin = T
        boundary(T, T_ref, ends, wanted, paper_rows, values, slopes)
        sequence(x, values, held, r)
        # The sequence is linear: at constant x it changes with T as it would from slopes at the ends and x = 0.
        sequence(nothing, slopes, held, r_by_T)
        g_T, corner = stiffness_T * (T - T_ref), stiffness_T
        gradient[:], column[:] = 0.0, 0.0
        for kind in range(3):
            if scaled[kind] > 0.0 or (kind == POSITION and some_node):
                weight[k_first:k_last] = scaled[kind]
                if kind == POSITION:
                    weight[k_first:k_last] += node_weights[k_first:k_last]
                by_T, by_TT = _duals(kind, weight, wanted[kind], T, T_ref, r, r_by_T, dual, dual_by_T)
                g_T += by_T
                corner += by_TT
                pull_back(kind, taps, dual, gradient)
                if free_T:
                    pull_back(kind, taps, dual_by_T, column)
        dT = 0.0
        if not free_T:
            substitute(band, gradient)
        else:
            write(1.0, column, solved)
            substitute_both(band, solved, gradient)
            dT = (product(column, gradient) - g_T) / (corner - product(column, solved))
            # For given T the rest follows: at a bound of T the program is solved by clipping, for it is convex.
            dT = min(max(dT, duration[0] - T), duration[1] - T)
            subtract(-dT, solved, gradient)
        subtract(1.0, gradient, x)
        T += dT
        g_T += corner * dT - product(column, gradient)
    # The last step with the row of T² linear, as the program has it.
    values += dT * slopes
    sequence(x, values, held, r)
    filtered(r, z)

    rates = np.empty((2, K if paper_rows else 0, width))
    if paper_rows:
        write(1.0, wanted[1], rates[0])
        write(2 * T_ref, wanted[2], rates[1])
        T_lin = T_ref
    a_ends = (not held[0], not held[1])
    iterations, outcome, count = 0, OPTIMAL, 0
    codes = np.empty(12 * K * n, np.int64)
    multipliers = np.empty(codes.size + 2)
    near, least = collect(z, T, T_lin, boxes, rates, NEAR, a_ends, codes)
    multipliers[:2] = 0.0
    constrained = least < -VIOLATION
    if constrained:
        count = near
        slope = np.empty_like(z)
        filtered(r_by_T, slope)
        # The cost of moving by what is violated is the scale of a program whose free optimum costs next to nothing.
        cost = _cost(wanted, T, T_ref, z, scaled, node_weights, k_first, k_last)
        cost += 0.5 * stiffness_T * (T - T_ref) ** 2
        violation = -least
        unit = max(cost, 0.5 * (stiffness_T + n * scaled[0]) * violation**2, 1e-9)
        x_free, z_free, T_free = x.copy(), z.copy(), T
        for attempt in range(3):
            x[:], z[:], T = x_free, z_free, T_free
            outcome, T, steps, count = interior_point(
                codes, count, a_ends, first, taps, base, column, corner, g_T, slope, x, T, T_lin, z, boxes, rates,
                duration, free_T, unit, violation, MAX_ITERATIONS, multipliers,
            )  # fmt: skip
            iterations += steps
            if outcome != OPTIMAL:
                break
            _, least = collect(z, T, T_lin, boxes, rates, -UNBOUNDED, a_ends, codes[count:])
            if least >= -VIOLATION:
                break
            if attempt == 0:
                # What the free optimum and the one so far come near to; seldom is anything else active in the end.
                near_free, _ = collect(z_free, T_free, T_lin, boxes, rates, NEAR, a_ends, codes)
                near, _ = collect(z, T, T_lin, boxes, rates, NEAR, a_ends, codes[near_free:])
                count = distinct(codes[: near_free + near])
            else:
                count, _ = collect(z_free, T_free, T_lin, boxes, rates, np.inf, a_ends, codes)
        if outcome == OPTIMAL and least < -VIOLATION:
            outcome = INFEASIBLE
    if not paper_rows and (constrained or moving_ends):
        boundary(T, T_ref, ends, wanted, False, values, slopes)
        sequence(x, values, held, r)
        filtered(r, z)
    if outcome == OPTIMAL and not (0.0 < T < np.inf and product(z, z) < np.inf):
        outcome = NONFINITE
    return outcome, T, iterations, codes[:count].copy(), multipliers[: count + 2].copy()


@njit(cache=True, error_model="numpy")
def _of_reference(kind: int, T: float, T_ref: float) -> tuple[float, float]:
    """What q*, q̇* or v* are multiplied by to be compared with q, w, a, and its derivative by T: 1, T, T² about T*."""
    if kind == POSITION:
        return 1.0, 0.0
    return (T, 1.0) if kind == RATE else (T_ref * (2 * T - T_ref), 2 * T_ref)


@njit(cache=True, error_model="numpy")
def _duals(
    kind: int,
    weight: Array,
    reference: Array,
    T: float,
    T_ref: float,
    r: Array,
    r_by_T: Array,
    dual: Array,
    dual_by_T: Array,
) -> tuple[float, float]:
    """Write the weighted deviations of q, w or a (N+1, W) and their derivatives by T; return those of the cost by T.

    The weights (N+1,) are those of the grid points.
    """
    K, width = reference.shape
    before, here, after = plain_taps(kind, K)
    factor, factor_by_T = _of_reference(kind, T, T_ref)
    wanted, rows, rows_by_T = reference.ravel(), r.ravel(), r_by_T.ravel()
    out, out_by_T = dual.ravel(), dual_by_T.ravel()
    by_T, by_TT = lanes_of(0.0), lanes_of(0.0)
    for j in range(0, width, LANES):
        r_0, r_1 = load(rows, j, LANES), load(rows, j + width, LANES)
        d_0, d_1 = load(rows_by_T, j, LANES), load(rows_by_T, j + width, LANES)
        for k in range(K):
            at = k * width + j
            r_2, d_2 = load(rows, at + 2 * width, LANES), load(rows_by_T, at + 2 * width, LANES)
            target = load(wanted, at, LANES)
            value = before * r_0 + here * r_1 + after * r_2 - factor * target
            slope = before * d_0 + here * d_1 + after * d_2 - factor_by_T * target
            weighted, weighted_by_T = weight[k] * value, weight[k] * slope
            store(weighted, out, at, LANES)
            store(weighted_by_T, out_by_T, at, LANES)
            by_T, by_TT = by_T + weighted * slope, by_TT + weighted_by_T * slope
            r_0, r_1, d_0, d_1 = r_1, r_2, d_1, d_2
    return sum_of(by_T), sum_of(by_TT)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _cost(
    reference: Array, T: float, T_ref: float, z: Array, scaled: Array, node_weights: Array, k_first: int, k_last: int
) -> float:
    """What the deviations of q, w, a (3, N+1, W) from the reference cost."""
    total, inside = 0.0, slice(k_first, k_last)
    for kind in range(3):
        factor, _ = _of_reference(kind, T, T_ref)
        reached, wanted = z[kind, inside].ravel(), reference[kind, inside].ravel()
        squares = 0.0
        for i in range(reached.size):
            squares += (reached[i] - factor * wanted[i]) ** 2
        total += scaled[kind] * squares
    for k in range(k_first, k_last):
        if node_weights[k] > 0.0:
            for j in range(z.shape[2]):
                total += node_weights[k] * (z[0, k, j] - reference[0, k, j]) ** 2
    return 0.5 * total


@njit(cache=True, error_model="numpy")
def write_motion(
    z: Array,
    wanted: Array,
    T: float,
    T_ref: float,
    ends: Array,
    held: tuple[bool, bool],
    paper_rows: bool,
    joint: int,
    motion: Array,
) -> None:
    """Write q, q̇, q̈ of the joints from `joint` on into the last rows of a motion (3, ≥ K, ≤ n).

    Both ends are to the last digit what was given there. With `paper_rows` it is the paper's update (15) of the
    reference.

    Args:
        z: (3, K, W) q, w, a of `solve`.
        wanted: Of `solve`.
        T: ΔT (s).
        T_ref: ΔT* (s).
        ends: Of `solve`.
        held: Of `solve`.
        paper_rows: Of `solve`.
        joint: The first one written.
        motion: What is written to.
    """
    _, K, width = z.shape
    n = motion.shape[2]
    for kind in range(3):
        rows = motion[kind, motion.shape[1] - K :]
        if paper_rows:
            factor, _ = _of_reference(kind, T, T_ref)
            scale, reached, target, out = T_ref**-kind, z[kind].ravel(), wanted[kind].ravel(), rows.ravel()
            for k in range(K):
                for j in range(0, n, LANES):
                    old = load(target, k * width + joint + j, n - j)
                    step = scale * (load(reached, k * width + joint + j, n - j) - factor * old)
                    store(old + step, out, k * n + j, n - j)
        else:
            narrow(T**-kind, z[kind], joint, rows)
            for end in range(2):
                if kind < 2 or held[end]:
                    rows[-end] = ends[end, kind, joint : joint + n]
