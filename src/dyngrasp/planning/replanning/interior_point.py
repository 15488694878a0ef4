"""The interior point method of the tracking program, on the rows that matter.

Which rows matter shows on the way: it begins with those near the optimum without rows, and as it closes in takes up
others that its point comes near to, with slacks of their own.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.replanning.box_rows import bound, collect
from dyngrasp.planning.replanning.joint_splines import (
    TAPS,
    Indices,
    factorise,
    product,
    pull_back,
    push_forward,
    substitute,
    weigh,
)
from dyngrasp.signals import Array

OPTIMAL, INFEASIBLE, ITERATION_LIMIT, NONFINITE = 0, 1, 2, 3

# Rows are looked for when the complementarity, over the cost, first falls below this and each time it has fallen by as
# much again; those closer to their bound than this are taken up, with slacks no smaller than that.
LOOK_BELOW, LOOK_NEAR = 0.3, 1e-2


@njit(cache=True, error_model="numpy")
def interior_point(
    codes: Indices,
    rows: int,
    a_ends: tuple[bool, bool],
    first: Indices,
    taps: Array,
    base: Array,
    weights: Array,
    node_weights: Array,
    slope: Array,
    by_T: Array,
    stiffness_T: float,
    error: Array,
    gradient_T: float,
    dx: Array,
    T: float,
    T_lin: float,
    z: Array,
    boxes: Array,
    rates: Array,
    duration: tuple[float, float],
    free_T: bool,
    ends_cost: bool,
    unit: float,
    max_iterations: int,
    multipliers: Array,
) -> tuple[int, float, int, int]:
    """Mehrotra's predictor–corrector from a point that minimises the cost without rows.

    Args:
        codes: Rows to impose; appended to. Those of T are always imposed where T is free.
        rows: How many codes there are at first.
        a_ends: See `collect`.
        first: Of `filters`.
        taps: Of `filters`.
        base: (N−1, 3) band of the Hessian of the cost, the same for every joint.
        weights: (3,) weights of q, w, a in the cost.
        node_weights: (K,) added to the weight of q at each grid point.
        slope: (3, K, n) how q, w, a change with T at constant x.
        by_T: (3, K, n) how the errors change with T.
        stiffness_T: Second derivative of the cost's own term in T.
        error: (3, K, n) errors at the start.
        gradient_T: First derivative of the cost's own term in T at the start.
        dx: (N−1, n), added to: the steps taken.
        T: At the start (s).
        T_lin: Where the rows are linear (s).
        z: (3, K, n) q, w, a at the start, overwritten by those in the end.
        boxes: See `bound`.
        rates: See `bound`.
        duration: Bounds of T (s).
        free_T: Whether T is a variable.
        ends_cost: Whether the cost counts both end points.
        unit: Typical size of the cost.
        max_iterations: Of the method.
        multipliers: Written: λ of each row, those of T last.

    Returns:
        Outcome, T, iterations, number of rows in the end.
    """
    _, K, n = z.shape
    size = K - 2
    all_rows = 6 * K * n
    m = all_rows + 2
    # A row is g = … + cs T + Σ_b along[b] x[f + b, j]: three unknowns of a joint, n apart in memory from `at` on.
    at, along, cs, g = np.empty(m, np.int64), np.empty((m, TAPS)), np.empty(m), np.empty(m)
    imposed, found = np.zeros(all_rows, np.bool_), np.empty(all_rows, np.int64)
    for i in range(rows):
        imposed[codes[i]] = True
    _impose(codes, 0, rows, n, K, T, T_lin, z, slope, boxes, rates, first, taps, at, along, cs, g)
    shortest, longest = duration
    limited_T = free_T and longest < np.inf
    cs[rows], cs[rows + 1] = 1.0 / longest, -1.0 / longest
    g[rows], g[rows + 1] = (T - shortest) / longest, (longest - T) / longest

    used = rows + 2 if limited_T else rows
    least = 0.0
    for i in range(used):
        least = min(least, g[i])
    floor = max(-least, 1e-2)
    s, lam, omega, target = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    # Divisions are the dearest of what is done for a row.
    per_s, per_lam = np.empty(m), np.empty(m)
    ds, dlam, dg = np.zeros(m), np.zeros(m), np.zeros(m)
    mu = 0.1 * unit / max(used, 1)
    for i in range(used):
        s[i] = max(g[i], floor)
        lam[i] = mu / s[i]
    band, column, solved = np.empty((size, 3, n)), np.empty((size, n)), np.empty((size, n))
    gradient, step, dual = np.empty((size, n)), np.empty((size, n)), np.empty_like(z)
    flat_band, flat_column, flat_step = band.ravel(), column.ravel(), step.ravel()
    # Steps that z has not followed yet: it is asked for only when rows are looked for.
    ahead, ahead_T = np.zeros((size, n)), 0.0
    k_first, k_last = (0, K) if ends_cost else (1, K - 1)
    weigh(by_T, weights, node_weights, k_first, k_last, dual)
    corner = stiffness_T + product(dual, by_T)
    pull_back(taps, dual, column)
    base_column = column.copy()
    # The cost is quadratic: its gradient follows from the steps.
    weigh(error, weights, node_weights, k_first, k_last, dual)
    g_T = gradient_T + product(dual, by_T)
    pull_back(taps, dual, gradient)
    outcome = ITERATION_LIMIT
    iterations = 0
    look_below = LOOK_BELOW
    for iteration in range(max_iterations + 1):
        iterations = iteration
        mean, primal = 0.0, 0.0
        for i in range(used):
            mean += s[i] * lam[i]
            primal = max(primal, abs(g[i] - s[i]))
        mean /= used
        if mean * used <= look_below * unit:
            look_below = LOOK_BELOW * mean * used / unit
            _follow(taps, slope, ahead, ahead_T, dx, z)
            ahead_T = 0.0
            count, _ = collect(z, T, T_lin, boxes, rates, LOOK_NEAR, a_ends, found)
            new = rows
            for i in range(count):
                if not imposed[found[i]]:
                    imposed[found[i]] = True
                    codes[new] = found[i]
                    new += 1
            if new > rows:
                # The rows of T stay the last.
                for array in (s, lam, g, cs, ds, dlam, dg):
                    array[new], array[new + 1] = array[rows], array[rows + 1]
                _impose(codes, rows, new, n, K, T, T_lin, z, slope, boxes, rates, first, taps, at, along, cs, g)
                for i in range(rows, new):
                    s[i] = max(g[i], LOOK_NEAR)
                    lam[i] = mean / s[i]
                    primal = max(primal, abs(g[i] - s[i]))
                used += new - rows
                rows = new
        if not np.isfinite(mean + primal + g_T):
            return NONFINITE, T, iteration, rows
        if mean * used <= 1e-12 * unit and primal <= 1e-11:
            outcome = OPTIMAL
            break
        if mean > 1e14 * unit:
            outcome = INFEASIBLE
            break
        if iteration == max_iterations:
            break
        # Newton matrix.
        for i in range(size):
            for d in range(3):
                band[i, d, :] = base[i, d]
        column[:] = base_column
        c_T = corner
        for i in range(used):
            per_s[i], per_lam[i] = 1.0 / s[i], 1.0 / lam[i]
            omega[i] = lam[i] * per_s[i]
            c_T += omega[i] * cs[i] * cs[i]
            if i < rows:
                # The same place in an array of three numbers an unknown: (f, 0, j) instead of (f, j).
                in_band = 3 * at[i] - 2 * (at[i] % n)
                for b in range(TAPS):
                    weight = omega[i] * along[i, b]
                    flat_column[at[i] + b * n] += cs[i] * weight
                    for d in range(TAPS - b):
                        flat_band[in_band + (3 * b + d) * n] += weight * along[i, b + d]
        factorise(band)
        if free_T:
            solved[:] = column
            substitute(band, solved)
            complement = c_T
            for i in range(size):
                for j in range(n):
                    complement -= column[i, j] * solved[i, j]
        else:
            complement = 1.0
        sigma_mu = 0.0
        for corrected in range(2):
            # Right-hand side: −∇f + Gᵀ((σμ − Δs Δλ)/s − ω (g − s)), for Δs = GΔ + g − s, Δλ = … .
            for i in range(used):
                second = ds[i] * dlam[i] if corrected == 1 else 0.0
                target[i] = (sigma_mu - second) * per_s[i] - omega[i] * (g[i] - s[i])
            step[:] = -gradient
            r_T = -g_T + _scatter(target, rows, used, n, at, along, cs, flat_step)
            dT = 0.0
            if free_T:
                dT = r_T
                for i in range(size):
                    for j in range(n):
                        dT -= solved[i, j] * step[i, j]
                dT /= complement
            substitute(band, step)
            if free_T:
                for i in range(size):
                    for j in range(n):
                        step[i, j] -= dT * solved[i, j]
            for i in range(used):
                dg[i] = cs[i] * dT
                if i < rows:
                    for b in range(TAPS):
                        dg[i] += along[i, b] * flat_step[at[i] + b * n]
            keep = 1.0 if corrected == 0 else 0.995
            shrink_primal, shrink_dual = keep, keep
            for i in range(used):
                second = ds[i] * dlam[i] if corrected == 1 else 0.0
                ds_i = dg[i] + g[i] - s[i]
                dlam_i = (sigma_mu - second) * per_s[i] - lam[i] - omega[i] * ds_i
                ds[i], dlam[i] = ds_i, dlam_i
                shrink_primal = max(shrink_primal, -ds_i * per_s[i])
                shrink_dual = max(shrink_dual, -dlam_i * per_lam[i])
            step_primal, step_dual = keep / shrink_primal, keep / shrink_dual
            if corrected == 0:
                after = 0.0
                for i in range(used):
                    after += (s[i] + step_primal * ds[i]) * (lam[i] + step_dual * dlam[i])
                after /= used
                sigma_mu = max((after / mean) ** 3 * mean, 1e-15 * unit / used)
        # One step length for both keeps the gradient's share of the rows consistent in a quadratic program.
        length = min(step_primal, step_dual)
        for i in range(used):
            s[i] += length * ds[i]
            lam[i] += length * dlam[i]
            g[i] += length * dg[i]
        T += length * dT
        ahead_T += length * dT
        g_T += length * corner * dT
        for i in range(size):
            for j in range(n):
                move = length * step[i, j]
                ahead[i, j] += move
                g_T += base_column[i, j] * move
                gradient[i, j] += base[i, 0] * move + length * dT * base_column[i, j]
            if i + 1 < size:
                for j in range(n):
                    gradient[i, j] += base[i, 1] * length * step[i + 1, j]
                    gradient[i + 1, j] += base[i, 1] * length * step[i, j]
            if i + 2 < size:
                for j in range(n):
                    gradient[i, j] += base[i, 2] * length * step[i + 2, j]
                    gradient[i + 2, j] += base[i, 2] * length * step[i, j]
    _follow(taps, slope, ahead, ahead_T, dx, z)
    multipliers[:] = 0.0
    multipliers[:used] = lam[:used]
    return outcome, T, iterations, rows


@njit(cache=True, error_model="numpy")
def _follow(taps: Array, slope: Array, ahead: Array, ahead_T: float, dx: Array, z: Array) -> None:
    """Add steps (N−1, n) of the unknowns, and one of T, to dx and z; the former are zero afterwards."""
    push_forward(taps, ahead, z)
    z += ahead_T * slope
    dx += ahead
    ahead[:] = 0.0


@njit(cache=True, error_model="numpy")
def _impose(
    codes: Indices,
    begin: int,
    end: int,
    n: int,
    K: int,
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
    for i in range(begin, end):
        j = codes[i] % n
        k = (codes[i] // n) % K
        kind = codes[i] // (n * K * 2)
        sign = 1.0 - 2.0 * ((codes[i] // (n * K)) % 2)
        b, c, scale = bound(kind, k, j, sign, T_lin, boxes, rates)
        at[i] = first[k] * n + j
        for tap in range(TAPS):
            along[i, tap] = -scale * sign * taps[k, tap, kind]
        cs[i] = (c - sign * slope[kind, k, j]) * scale
        g[i] = (b + c * (T - T_lin) - sign * z[kind, k, j]) * scale


@njit(cache=True, error_model="numpy")
def _scatter(y: Array, rows: int, used: int, n: int, at: Indices, along: Array, cs: Array, out: Array) -> float:
    """Add Gᵀ y to out ((N−1) n,); return the part of T."""
    by_T = 0.0
    for i in range(used):
        by_T += y[i] * cs[i]
        if i < rows:
            for b in range(TAPS):
                out[at[i] + b * n] += y[i] * along[i, b]
    return by_T
