"""The interior point method of the tracking program, on the rows that matter."""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.replanning.box_rows import bound
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


@njit(cache=True, error_model="numpy")
def interior_point(
    codes: Indices,
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
) -> tuple[int, float, int]:
    """Mehrotra's predictor–corrector from a point that minimises the cost without rows.

    Args:
        codes: Rows to impose; those of T are always imposed where T is free.
        first: Of `filters`.
        taps: Of `filters`.
        base: (N−1, 3, n) band of the Hessian of the cost.
        weights: (3, n) weights of q, w, a in the cost.
        node_weights: (K,) added to the weight of q at each grid point.
        slope: (3, K, n) how q, w, a change with T at constant x.
        by_T: (3, K, n) how the errors change with T.
        stiffness_T: Second derivative of the cost's own term in T.
        error: (3, K, n) errors at the start, changed along.
        gradient_T: First derivative of the cost's own term in T at the start.
        dx: (N−1, n), added to: the steps taken.
        T: At the start (s).
        T_lin: Where the rows are linear (s).
        z: (3, K, n) q, w, a at the start, changed along.
        boxes: See `bound`.
        rates: See `bound`.
        duration: Bounds of T (s).
        free_T: Whether T is a variable.
        ends_cost: Whether the cost counts both end points.
        unit: Typical size of the cost.
        max_iterations: Of the method.
        multipliers: (len(codes) + 2,) written: λ of each row, those of T last.

    Returns:
        Outcome, T, iterations.
    """
    _, K, n = z.shape
    size = K - 2
    rows = codes.size
    m = rows + 2
    kinds, nodes, joints = np.empty(rows, np.int64), np.empty(rows, np.int64), np.empty(rows, np.int64)
    signs, cs, scales, g = np.empty(rows), np.empty(m), np.empty(rows), np.empty(m)
    for i in range(rows):
        j = codes[i] % n
        k = (codes[i] // n) % K
        kind = codes[i] // (n * K * 2)
        sign = 1.0 - 2.0 * ((codes[i] // (n * K)) % 2)
        b, c, scale = bound(kind, k, j, sign, T_lin, boxes, rates)
        kinds[i], nodes[i], joints[i], signs[i], scales[i] = kind, k, j, sign, scale
        cs[i] = (c - sign * slope[kind, k, j]) * scale
        g[i] = (b + c * (T - T_lin) - sign * z[kind, k, j]) * scale
    shortest, longest = duration
    limited_T = free_T and longest < np.inf
    cs[rows], cs[rows + 1] = 1.0 / longest, -1.0 / longest
    g[rows], g[rows + 1] = (T - shortest) / longest, (longest - T) / longest

    used = m if limited_T else rows
    least = 0.0
    for i in range(used):
        least = min(least, g[i])
    floor = max(-least, 1e-2)
    s, lam, ds, dlam, dg, omega, target = (
        np.empty(m),
        np.empty(m),
        np.zeros(m),
        np.zeros(m),
        np.zeros(m),
        np.empty(m),
        np.empty(m),
    )
    mu = 0.1 * unit / max(used, 1)
    for i in range(used):
        s[i] = max(g[i], floor)
        lam[i] = mu / s[i]
    band, column, solved = np.empty_like(base), np.empty((size, n)), np.empty((size, n))
    gradient, step, dual = np.empty((size, n)), np.empty((size, n)), np.empty_like(z)
    dz = np.empty_like(z)
    k_first, k_last = (0, K) if ends_cost else (1, K - 1)
    dual[:] = 0.0
    weigh(by_T, weights, node_weights, k_first, k_last, dual)
    corner = stiffness_T + product(dual, by_T)
    pull_back(first, taps, dual, column)
    base_column = column.copy()
    outcome = ITERATION_LIMIT
    iterations = 0
    for iteration in range(max_iterations + 1):
        iterations = iteration
        # Gradient of the cost.
        weigh(error, weights, node_weights, k_first, k_last, dual)
        g_T = gradient_T + product(dual, by_T)
        pull_back(first, taps, dual, gradient)
        # Residuals.
        mean, primal = 0.0, 0.0
        for i in range(used):
            mean += s[i] * lam[i]
            primal = max(primal, abs(g[i] - s[i]))
        mean /= used
        stationarity = 0.0
        target[:used] = -lam[:used]
        r_T = -g_T
        step[:] = -gradient
        r_T += _scatter(target, -1.0, rows, used, kinds, nodes, joints, signs, scales, cs, first, taps, step)
        for i in range(size):
            for j in range(n):
                stationarity = max(stationarity, abs(step[i, j]))
        if not np.isfinite(mean + primal + stationarity):
            return NONFINITE, T, iteration
        if mean * used <= 1e-12 * unit and primal <= 1e-11:
            outcome = OPTIMAL
            break
        if mean > 1e14 * unit:
            outcome = INFEASIBLE
            break
        if iteration == max_iterations:
            break
        # Newton matrix.
        band[:] = base
        column[:] = base_column
        c_T = corner
        for i in range(used):
            omega[i] = lam[i] / s[i]
            c_T += omega[i] * cs[i] * cs[i]
            if i < rows:
                kind, k, j = kinds[i], nodes[i], joints[i]
                f = first[k]
                weight = omega[i] * scales[i] * scales[i]
                cross = -omega[i] * cs[i] * scales[i] * signs[i]
                for b in range(TAPS):
                    t_b = taps[k, b, kind]
                    column[f + b, j] += cross * t_b
                    for d in range(TAPS - b):
                        band[f + b, d, j] += weight * t_b * taps[k, b + d, kind]
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
        step_primal, step_dual = 1.0, 1.0
        for corrected in range(2):
            # Right-hand side: −∇f + Gᵀ((σμ − Δs Δλ)/s − ω (g − s)), for Δs = GΔ + g − s, Δλ = … .
            for i in range(used):
                second = ds[i] * dlam[i] if corrected == 1 else 0.0
                target[i] = (sigma_mu - second) / s[i] - omega[i] * (g[i] - s[i])
            step[:] = -gradient
            r_T = -g_T + _scatter(target, 1.0, rows, used, kinds, nodes, joints, signs, scales, cs, first, taps, step)
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
                change = cs[i] * dT
                if i < rows:
                    kind, k, j = kinds[i], nodes[i], joints[i]
                    f = first[k]
                    along = 0.0
                    for b in range(TAPS):
                        along += taps[k, b, kind] * step[f + b, j]
                    change -= scales[i] * signs[i] * along
                dg[i] = change
            keep = 1.0 if corrected == 0 else 0.995
            step_primal, step_dual = 1.0, 1.0
            for i in range(used):
                second = ds[i] * dlam[i] if corrected == 1 else 0.0
                ds_i = dg[i] + g[i] - s[i]
                dlam_i = (sigma_mu - second) / s[i] - lam[i] - omega[i] * ds_i
                ds[i], dlam[i] = ds_i, dlam_i
                if ds_i < 0:
                    step_primal = min(step_primal, -keep * s[i] / ds_i)
                if dlam_i < 0:
                    step_dual = min(step_dual, -keep * lam[i] / dlam_i)
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
        gradient_T += length * dT * stiffness_T
        dz[:] = 0.0
        push_forward(first, taps, step, dz)
        for i in range(size):
            for j in range(n):
                dx[i, j] += length * step[i, j]
        for kind in range(3):
            for k in range(K):
                for j in range(n):
                    error[kind, k, j] += length * (dz[kind, k, j] + by_T[kind, k, j] * dT)
                    z[kind, k, j] += length * (dz[kind, k, j] + slope[kind, k, j] * dT)
    multipliers[:] = 0.0
    multipliers[:used] = lam[:used]
    return outcome, T, iterations


@njit(cache=True, error_model="numpy")
def _scatter(
    y: Array,
    factor: float,
    rows: int,
    used: int,
    kinds: Indices,
    nodes: Indices,
    joints: Indices,
    signs: Array,
    scales: Array,
    cs: Array,
    first: Indices,
    taps: Array,
    out: Array,
) -> float:
    """Add factor · Gᵀ y to out (N−1, n); return the part of T."""
    by_T = 0.0
    for i in range(used):
        value = factor * y[i]
        by_T += value * cs[i]
        if i < rows:
            kind, k, j = kinds[i], nodes[i], joints[i]
            f = first[k]
            value *= -scales[i] * signs[i]
            for b in range(TAPS):
                out[f + b, j] += value * taps[k, b, kind]
    return by_T
