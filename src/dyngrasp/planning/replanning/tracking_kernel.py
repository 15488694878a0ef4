"""The tracking program of one phase in compiled code."""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.replanning.box_rows import UNBOUNDED, collect
from dyngrasp.planning.replanning.interior_point import INFEASIBLE, OPTIMAL, interior_point
from dyngrasp.planning.replanning.joint_splines import (
    TAPS,
    Indices,
    boundary,
    factorise,
    filtered,
    product,
    pull_back,
    push_forward,
    sequence,
    substitute,
    weigh,
)
from dyngrasp.signals import Array

# A row may be violated by this much of its half-width: a tenth of what the audit forgives as rounding.
VIOLATION = 1e-9

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
    reference: Array,
    T_ref: float,
    ends: Array,
    held: tuple[bool, bool],
    weights: Array,
    node_weights: Array,
    duration_weight: float,
    ends_cost: bool,
    boxes: Array,
    paper_rows: bool,
    duration: tuple[float, float],
    first: Indices,
    taps: Array,
    bands: Array,
    max_iterations: int,
    z: Array,
    codes: Indices,
    multipliers: Array,
) -> tuple[int, float, int, int]:
    """Minimise ½ Σ_k Σ_j Q_q δq² + Q_q̇ δq̇² + Q_v δv² + ½ Σ_k Q_ΔT δT² between two boundary states, within boxes.

    Args:
        reference: (3, K, n) q*, q̇*, v*.
        T_ref: ΔT* (s).
        ends: (2, 3, n) position, velocity, acceleration at both ends.
        held: Whether the acceleration is given at the start and at the end.
        weights: (3, n) Q_q, Q_q̇, Q_v.
        node_weights: (K,) added to Q_q at each grid point.
        duration_weight: Q_ΔT of one grid point.
        ends_cost: Whether the sums run over all grid points or over k = 1 … N−1.
        boxes: (4, n) q_min, q_max, q̇_max, v_max.
        paper_rows: The boxes of eq. (13c), which are linear about the reference, instead of the exact ones.
        duration: Bounds of T (s); equal ones fix it.
        first: Of `filters`.
        taps: Of `filters`.
        bands: Of `filters`.
        max_iterations: Of the interior point method.
        z: (3, K, n), overwritten by q, w, a; with `paper_rows` their linear model about the reference.
        codes: At least 12 K n integers, overwritten by the codes of the rows that were imposed.
        multipliers: As many floats and two more, overwritten by their multipliers, the last two those of T.

    Returns:
        Outcome, T, iterations of the interior point method, number of rows imposed.
    """
    _, K, n = reference.shape
    size = K - 2
    free_T = duration[1] - duration[0] > 1e-12
    T = min(max(T_ref, duration[0]), duration[1])
    k_first, k_last = (0, K) if ends_cost else (1, K - 1)
    stiffness_T = duration_weight * (k_last - k_first)

    scaled = np.empty((3, n))
    for j in range(n):
        scaled[0, j] = weights[0, j]
        scaled[1, j] = weights[1, j] / T_ref**2
        scaled[2, j] = weights[2, j] / T_ref**4
    base = np.empty((size, 3, n))
    for i in range(size):
        for d in range(3):
            for j in range(n):
                base[i, d, j] = (
                    scaled[0, j] * bands[0, i, d] + scaled[1, j] * bands[1, i, d] + scaled[2, j] * bands[2, i, d]
                )
    for k in range(k_first, k_last):
        if node_weights[k] > 0.0:
            for b in range(TAPS):
                for d in range(TAPS - b):
                    value = node_weights[k] * taps[k, b, 0] * taps[k, b + d, 0]
                    for j in range(n):
                        base[first[k] + b, d, j] += value
    for end in range(2):
        if held[end]:
            base[0 if end == 0 else size - 1, 0, :] = 1.0
    band = base.copy()
    factorise(band)

    x, r, nothing = np.empty((size, n)), np.empty((K + 2, n)), np.zeros((size, n))
    values, slopes = np.empty((2, 3, n)), np.empty((2, 3, n))
    h2 = 1.0 / (K - 1) ** 2
    for i in range(size):
        k = 0 if i == 0 else (K - 1 if i == size - 1 else i + 1)
        for j in range(n):
            x[i, j] = reference[0, k, j] - h2 / 4 * T_ref * T_ref * reference[2, k, j]

    error, by_T, slope, dual = np.empty_like(z), np.empty_like(z), np.empty_like(z), np.zeros_like(z)
    gradient, column, solved = np.empty((size, n)), np.empty((size, n)), np.empty((size, n))
    moving_ends = False
    for end in range(2):
        for j in range(n):
            moving_ends = moving_ends or (held[end] and ends[end, 2, j] != 0.0)
    T_lin, gradient_T = T, 0.0
    # A given acceleration enters as T² q̈: the program is solved twice, the second time about the T of the first.
    passes = 2 if moving_ends and free_T and not paper_rows else 1
    for _ in range(passes):
        T_lin = T
        boundary(T, T_ref, ends, reference, paper_rows, values, slopes)
        sequence(x, values, held, r)
        filtered(r, z)
        # The sequence is linear: at constant x it changes with T as it would from slopes at the ends and x = 0.
        sequence(nothing, slopes, held, r)
        filtered(r, slope)
        corner, gradient_T = stiffness_T, stiffness_T * (T - T_ref)
        g_T = gradient_T
        shift = T - T_ref
        for k in range(K):
            for j in range(n):
                w_by_T, a_by_T = reference[1, k, j], 2 * T_ref * reference[2, k, j]
                by_T[0, k, j] = slope[0, k, j]
                by_T[1, k, j] = slope[1, k, j] - w_by_T
                by_T[2, k, j] = slope[2, k, j] - a_by_T
                error[0, k, j] = z[0, k, j] - reference[0, k, j]
                error[1, k, j] = z[1, k, j] - T_ref * reference[1, k, j] - w_by_T * shift
                error[2, k, j] = z[2, k, j] - T_ref * T_ref * reference[2, k, j] - a_by_T * shift
        weigh(error, scaled, node_weights, k_first, k_last, dual)
        g_T += product(dual, by_T)
        pull_back(first, taps, dual, gradient)
        dT = 0.0
        if free_T:
            weigh(by_T, scaled, node_weights, k_first, k_last, dual)
            corner += product(dual, by_T)
            pull_back(first, taps, dual, column)
            solved[:] = column
            substitute(band, solved)
            complement = corner
            dT = -g_T
            for i in range(size):
                for j in range(n):
                    complement -= column[i, j] * solved[i, j]
                    dT += solved[i, j] * gradient[i, j]
            dT /= complement
            # For given T the rest follows: at a bound of T the program is solved by clipping, for it is convex.
            dT = min(max(dT, duration[0] - T), duration[1] - T)
        substitute(band, gradient)
        if free_T:
            for i in range(size):
                for j in range(n):
                    gradient[i, j] += dT * solved[i, j]
        for i in range(size):
            for j in range(n):
                gradient[i, j] = -gradient[i, j]
                x[i, j] += gradient[i, j]
        T += dT
        gradient_T += stiffness_T * dT
    # What the last step did to q, w, a, with the row of T² linear as the program has it.
    for kind in range(3):
        for k in range(K):
            for j in range(n):
                error[kind, k, j] += by_T[kind, k, j] * dT
                z[kind, k, j] += slope[kind, k, j] * dT
    push_forward(first, taps, gradient, z)
    push_forward(first, taps, gradient, error)

    rates = np.empty((2, K if paper_rows else 0, n))
    if paper_rows:
        rates[0] = reference[1]
        rates[1] = 2 * T_ref * reference[2]
        T_lin = T_ref
    a_ends = (not held[0], not held[1])
    count, least = collect(z, T, T_lin, boxes, rates, NEAR, a_ends, codes)
    iterations, outcome = 0, OPTIMAL
    if least < -VIOLATION:
        weigh(error, scaled, node_weights, k_first, k_last, dual)
        cost = 0.5 * (stiffness_T * (T - T_ref) ** 2 + product(dual, error))
        # The cost of moving by what is violated is the scale of a program whose free optimum costs next to nothing.
        unit = max(cost, 0.5 * (stiffness_T + np.sum(scaled[0])) * least * least, 1e-9)
        x_free, z_free, error_free = x.copy(), z.copy(), error.copy()
        T_free, gradient_free = T, gradient_T
        for attempt in range(3):
            x[:], z[:], error[:], T = x_free, z_free, error_free, T_free
            outcome, T, steps, count = interior_point(
                codes,
                count,
                a_ends,
                first,
                taps,
                base,
                scaled,
                node_weights,
                slope,
                by_T,
                stiffness_T,
                error,
                gradient_free,
                x,
                T,
                T_lin,
                z,
                boxes,
                rates,
                duration,
                free_T,
                ends_cost,
                unit,
                max_iterations,
                multipliers,
            )
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
    else:
        count = 0
        multipliers[:] = 0.0
    if not paper_rows:
        boundary(T, T_ref, ends, reference, False, values, slopes)
        sequence(x, values, held, r)
        filtered(r, z)
    return outcome, T, iterations, count
