"""The interior point method of the tracking program, on the rows that matter.

Which rows matter shows on the way: it begins with those near the optimum without rows, and as it closes in takes up
others that its point comes near to, with slacks of their own.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.replanning.active_set import bordered_step, finish, newton_matrix
from dyngrasp.planning.replanning.box_rows import collect, impose, scatter
from dyngrasp.planning.replanning.joint_splines import (
    TAPS,
    Indices,
    factorise,
    push_forward,
    subtract,
    write,
)
from dyngrasp.signals import Array

OPTIMAL, INFEASIBLE, ITERATION_LIMIT, NONFINITE = 0, 1, 2, 3

# Rows are looked for when the complementarity, over the cost, first falls below this and each time it has fallen by as
# much again; those closer to their bound than this are taken up, with slacks no smaller than that.
LOOK_BELOW, LOOK_NEAR = 0.03, 1e-2

# The end is tried when the complementarity, over the cost, first falls below this and all rows are met as well as this,
# and each time it has fallen to a tenth. Rows are thought to be active whose multiplier, over the cost, is more than
# this share of their slack.
FINISH_BELOW, FINISH_NEAR, FINISH_SHARE = 1e-5, 1e-2, 1.0

# Guesses at most, and the penalty in units of the cost over the square of the violation that it is the price of. Higher
# ones cost digits: what rounding leaves of a row times the penalty is an error of its multiplier.
FINISH_ROUNDS, PENALTY = 10, 1e4


@njit(cache=True, error_model="numpy")
def interior_point(
    codes: Indices,
    rows: int,
    a_ends: tuple[bool, bool],
    first: Indices,
    taps: Array,
    base: Array,
    base_column: Array,
    corner: float,
    g_T: float,
    slope: Array,
    dx: Array,
    T: float,
    T_lin: float,
    z: Array,
    boxes: Array,
    rates: Array,
    duration: tuple[float, float],
    free_T: bool,
    unit: float,
    violation: float,
    max_iterations: int,
    multipliers: Array,
) -> tuple[int, float, int, int]:
    """Mehrotra's predictor–corrector from a point that minimises the cost without rows.

    Args:
        codes: Rows to impose, see `box_rows`; appended to. Those of T are always imposed where T is free.
        rows: How many codes there are at first.
        a_ends: See `collect`.
        first: Of `filters`.
        taps: Of `filters`.
        base: (N−1, 3) bands of the Hessian of the cost, the same for all joints.
        base_column: (N−1, W) derivatives of its gradient by T.
        corner: Second derivative of the cost by T.
        g_T: First derivative of the cost by T at the start; that by the unknowns is zero there.
        slope: (3, K, W) how q, w, a change with T at constant x.
        dx: (N−1, W), added to: the steps taken.
        T: At the start (s).
        T_lin: Where the rows are linear (s).
        z: (3, K, W) q, w, a at the start, overwritten by those in the end.
        boxes: See `bound`.
        rates: See `bound`.
        duration: Bounds of T (s).
        free_T: Whether T is a variable.
        unit: Typical size of the cost.
        violation: Largest violation of a row at the start, > 0.
        max_iterations: Of the method.
        multipliers: Written: λ of each row, those of T last.

    Returns:
        Outcome, T, iterations, number of rows in the end.
    """
    _, K, width = z.shape
    size = K - 2
    all_rows = 6 * K * boxes.shape[1]
    m = all_rows + 2
    # A row is g = … + cs T + Σ_b along[b] x[f + b, j]: three unknowns of a joint, W apart in memory from `at` on.
    at, along, cs, g = np.empty(m, np.int64), np.empty((m, TAPS)), np.empty(m), np.empty(m)
    imposed, found = np.zeros(all_rows, np.bool_), np.empty(all_rows, np.int64)
    for i in range(rows):
        imposed[codes[i]] = True
    impose(codes, 0, rows, T, T_lin, z, slope, boxes, rates, first, taps, at, along, cs, g)
    shortest, longest = duration
    cs[rows], cs[rows + 1] = 1.0 / longest, -1.0 / longest
    g[rows], g[rows + 1] = (T - shortest) / longest, (longest - T) / longest
    at[rows : rows + 2], along[rows : rows + 2] = 0, 0.0

    used = rows + 2 if free_T else rows
    floor = max(violation, 1e-2)
    s, lam, omega = np.empty(m), np.empty(m), np.empty(m)
    # Divisions are the dearest of what is done for a row.
    per_s, per_lam = np.empty(m), np.empty(m)
    ds, dlam = np.empty(m), np.empty(m)
    active = np.empty(m, np.bool_)
    mu = 0.1 * unit / max(used, 1)
    for i in range(used):
        s[i] = max(g[i], floor)
        lam[i] = mu / s[i]
    band, column, solved = np.empty((size, 3, width)), np.empty((size, width)), np.empty((size, width))
    step, step_T = np.empty((size, width)), 0.0
    # ∇f − Gᵀ λ: each step takes its length of what is left.
    residual = np.zeros((size, width))
    residual_T = g_T - scatter(lam, -1.0, 0, used, width, at, along, cs, residual.ravel())
    flat_step = step.ravel()
    # Steps that z has not followed yet: it is asked for only when rows are looked for.
    ahead, ahead_T = np.zeros((size, width)), 0.0
    outcome = ITERATION_LIMIT
    iterations = 0
    look_below, finish_below = LOOK_BELOW, FINISH_BELOW
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
                for array in (s, lam, g, cs):
                    array[new], array[new + 1] = array[rows], array[rows + 1]
                at[new : new + 2], along[new : new + 2] = 0, 0.0
                impose(codes, rows, new, T, T_lin, z, slope, boxes, rates, first, taps, at, along, cs, g)
                for i in range(rows, new):
                    s[i] = max(g[i], LOOK_NEAR)
                    lam[i] = mean / s[i]
                    primal = max(primal, abs(g[i] - s[i]))
                residual_T -= scatter(lam, -1.0, rows, new, width, at, along, cs, residual.ravel())
                used += new - rows
                rows = new
        if not np.isfinite(mean + primal + residual_T):
            return NONFINITE, T, iteration, rows
        if mean * used <= finish_below * unit and primal <= FINISH_NEAR:
            finish_below *= 0.1
            for i in range(used):
                active[i] = lam[i] > FINISH_SHARE * unit * s[i]
            found_all, step_T = finish(
                FINISH_ROUNDS,
                PENALTY * unit / violation**2,
                used,
                at,
                along,
                cs,
                g,
                lam,
                active,
                residual,
                residual_T,
                base,
                base_column,
                corner,
                free_T,
                band,
                column,
                solved,
                step,
                omega,
            )
            if found_all:
                T += step_T
                ahead_T += step_T
                subtract(-1.0, step, ahead)
                outcome = OPTIMAL
                break
        if mean * used <= 1e-12 * unit and primal <= 1e-11:
            outcome = OPTIMAL
            break
        if mean > 1e14 * unit:
            outcome = INFEASIBLE
            break
        if iteration == max_iterations:
            break
        for i in range(used):
            per_s[i], per_lam[i] = 1.0 / s[i], 1.0 / lam[i]
            omega[i] = lam[i] * per_s[i]
        complement = newton_matrix(omega, used, at, along, cs, base, base_column, corner, band, column)
        factorise(band)
        sigma_mu = 0.0
        for corrected in range(2):
            # Right-hand side: −∇f + Gᵀ((σμ − Δs Δλ)/s − ω (g − s)), for Δs = GΔ + g − s, Δλ = … .
            for i in range(used):
                second = sigma_mu - ds[i] * dlam[i] if corrected == 1 else 0.0
                dlam[i] = second * per_s[i] - omega[i] * (g[i] - s[i]) - lam[i]
            write(-1.0, residual, step)
            step_T = -residual_T + scatter(dlam, 1.0, 0, used, width, at, along, cs, flat_step)
            complement, step_T = bordered_step(corrected == 0, free_T, band, column, complement, solved, step, step_T)
            keep = 1.0 if corrected == 0 else 0.995
            shrink_primal, shrink_dual = keep, keep
            for i in range(used):
                change = cs[i] * step_T
                for b in range(TAPS):
                    change += along[i, b] * flat_step[at[i] + b * width]
                ds[i] = change + g[i] - s[i]
                dlam[i] -= omega[i] * change
                shrink_primal = max(shrink_primal, -ds[i] * per_s[i])
                shrink_dual = max(shrink_dual, -dlam[i] * per_lam[i])
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
            # Δg = Δs − (g − s)
            g[i] += length * (ds[i] - g[i] + s[i])
            s[i] += length * ds[i]
            lam[i] += length * dlam[i]
        T += length * step_T
        ahead_T += length * step_T
        subtract(-length, step, ahead)
        write(1.0 - length, residual, residual)
        residual_T *= 1.0 - length
    _follow(taps, slope, ahead, ahead_T, dx, z)
    multipliers[rows : rows + 2] = 0.0
    multipliers[:used] = lam[:used]
    return outcome, T, iterations, rows


@njit(cache=True, error_model="numpy")
def _follow(taps: Array, slope: Array, ahead: Array, ahead_T: float, dx: Array, z: Array) -> None:
    """Add steps (N−1, W) of the unknowns, and one of T, to dx and z; the former are zero afterwards."""
    push_forward(taps, ahead, z)
    subtract(-ahead_T, slope, z)
    subtract(-1.0, ahead, dx)
    ahead[:] = 0.0
