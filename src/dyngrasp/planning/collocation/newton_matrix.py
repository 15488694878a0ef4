"""Objective, and the matrix of the Newton system, Hessian of the Lagrangian plus Jᵀ Ω J: band, column of T, corner.

At one grid point everything depends on u = (q, v) through the constraints' rows and on q, w, a and T through boxes and
objective. With v = a / T² the chain rule takes second derivatives by (q, v) to those by (q, a, T); the three-tap filter
takes them to the unknowns x.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.collocation.three_tap import CURVATURE, POSITION, RATE, TAPS, ThreeTap
from dyngrasp.planning.collocation.work_arrays import WorkArrays
from dyngrasp.signals import Array


@njit(cache=True, error_model="numpy")
def objective(a: Array, T: float, rho: float) -> float:
    """T + ρ Δt Σ |v|² = T + ρ / (N T³) Σ |a|² of a (N+1, n)."""
    effort = 0.0
    for k in range(a.shape[0]):
        for j in range(a.shape[1]):
            effort += a[k, j] * a[k, j]
    return T + rho / (a.shape[0] - 1) / T**3 * effort


@njit(cache=True, error_model="numpy")
def objective_slope(a: Array, da: Array, T: float, dT: float, rho: float) -> float:
    """How the objective changes to first order with steps da (N+1, n) and dT."""
    weight = rho / (a.shape[0] - 1) / T**3
    effort, product = 0.0, 0.0
    for k in range(a.shape[0]):
        for j in range(a.shape[1]):
            effort += a[k, j] * a[k, j]
            product += a[k, j] * da[k, j]
    return (1.0 - 3.0 * weight / T * effort) * dT + 2.0 * weight * product


@njit(cache=True, error_model="numpy")
def add_objective_gradient(a: Array, T: float, rho: float, factor: float, dual: Array) -> float:
    """Add factor · ∂f/∂a to dual[CURVATURE] (N+1, n); return factor · ∂f/∂T."""
    K, n = a.shape
    weight = factor * rho / (K - 1) / T**3
    effort = 0.0
    for k in range(K):
        for j in range(n):
            effort += a[k, j] * a[k, j]
            dual[CURVATURE, k, j] += 2 * weight * a[k, j]
    return factor - 3 * weight / T * effort


@njit(cache=True, error_model="numpy")
def assemble(
    work: WorkArrays,
    T: float,
    tap: ThreeTap,
    limits: tuple,
    omega: Array,
    multiplier: Array,
    rho: float,
    factor: float,
    curvature: float,
    shift: float,
    column: Array,
) -> float:
    """Write the band in `work` and the column of T; return the corner.

    Args:
        work: The present point with the derivatives of the rows.
        T: Duration there (s).
        tap: The map to q, w, a.
        limits: `LimitRows.arguments`.
        omega: (K · R + 2,) Ω of the one-sided rows.
        multiplier: (K · R + 2,) λ of the same.
        rho: Weight of the effort.
        factor: Weight of the objective, 1, or 0 where only the violation counts.
        curvature: Part of the second derivatives of the rows to take, 1, or 0 for Gauss and Newton's matrix.
        shift: Multiple of the identity added to the second derivatives by a: the inertia correction.
        column: ((K−2) n,), overwritten.
    """
    z, v, weights, jacobian, hessian, band = work.z, work.v, work.weights, work.jacobian, work.hessian, work.band
    first, taps, _, slope = tap
    _, half_width, velocity, acceleration, lo, up, _, _, scale, free, _, longest, fixed = limits
    _, K, n = z.shape
    m = jacobian.shape[1]
    R = (omega.size - 2) // K
    T2 = T * T
    per_T2 = 1.0 / T2
    effort = factor * rho / (K - 1) / (T2 * T)
    band[:] = 0.0
    column[:] = 0.0
    corner = 0.0 if fixed else (omega[omega.size - 2] + omega[omega.size - 1]) / longest**2

    width = (n + 7) // 8 * 8
    qq, qa, aq, aa = np.zeros((n, width)), np.zeros((n, width)), np.zeros((n, width)), np.zeros((n, width))
    by_q, by_a = np.zeros(width), np.zeros(width)
    run = np.empty((n, TAPS * n))
    ww = np.empty(n)
    qT, wT, aT = np.empty(n), np.empty(n), np.empty(n)
    row_stiffness = np.empty(m)
    by_v = np.empty(n)

    for k in range(K):
        end = k == 0 or k == K - 1
        at = k * R
        boxes = at + 4 * velocity.size + 2 * acceleration.size

        for i in range(m):
            row_stiffness[i] = 0.0
        for i in range(lo.size):
            row_stiffness[lo[i]] += omega[boxes + i]
        for i in range(up.size):
            row_stiffness[up[i]] += omega[boxes + lo.size + i]
        for j in range(n):
            by_v[j] = 0.0
        # Blocks by (q, v): qq, aq and aa; qa is the transpose of aq.
        for i in range(n):
            for j in range(n):
                qq[i, j] = -curvature * hessian[k, i, j]
                aq[i, j] = -curvature * hessian[k, n + i, j]
                aa[i, j] = -curvature * hessian[k, n + i, n + j]
        for r in range(m):
            if free[r] == 0.0 and end:
                continue
            stiff = row_stiffness[r] * scale[r] * scale[r]
            for j in range(n):
                by_q[j] = jacobian[k, r, j]
            for i in range(n):
                here = stiff * by_q[i]
                for j in range(width):
                    qq[i, j] += here * by_q[j]
            if free[r] == 0.0:
                continue
            for j in range(n):
                by_a[j] = jacobian[k, r, n + j]
            for i in range(n):
                here = stiff * by_a[i]
                for j in range(width):
                    aq[i, j] += here * by_q[j]
                    aa[i, j] += here * by_a[j]
            for j in range(n):
                by_v[j] += curvature * weights[k, r] * by_a[j]
        # Chain rule to (q, a, T): v = a / T², ∂v/∂T = −2 v / T.
        for i in range(n):
            qT[i], aT[i] = 0.0, 0.0
        for i in range(n):
            dv = -2.0 / T * v[k, i]
            for j in range(n):
                qT[j] += aq[i, j] * dv
                aT[j] += aa[i, j] * dv
        for i in range(n):
            for j in range(n):
                aq[i, j] *= per_T2
                aa[i, j] *= per_T2 * per_T2
                qa[j, i] = aq[i, j]
        for i in range(n):
            # Second derivatives of v times the rows' multipliers enter with the sign of −λ g.
            corner += aT[i] * (-2.0 / T * v[k, i]) - 6.0 / T2 * by_v[i] * v[k, i]
            a = z[CURVATURE, k, i]
            aT[i] = aT[i] / T2 + 2.0 / (T2 * T) * by_v[i] - 6.0 * effort / T * a
            aa[i, i] += 2.0 * effort + shift
            corner += 12.0 * effort / T2 * a * a
            if end or velocity.size == 0:
                ww[i], wT[i] = 0.0, 0.0
                continue
            qq[i, i] += (omega[at + i] + omega[at + n + i]) / half_width[i] ** 2
            plus, minus = omega[at + 2 * n + i], omega[at + 3 * n + i]
            ww[i] = (plus + minus) / velocity[i] ** 2
            wT[i] = (plus - minus) / velocity[i]
            corner += plus + minus
        for i in range(acceleration.size):
            plus, minus = omega[at + 4 * n + i], omega[at + 5 * n + i]
            aa[i, i] += (plus + minus) / acceleration[i] ** 2
            aT[i] += 2.0 * T * (plus - minus) / acceleration[i]
            corner += 4.0 * T2 * (plus + minus)
            corner -= curvature * 2.0 * (multiplier[at + 4 * n + i] + multiplier[at + 5 * n + i])

        if k <= 2 or k >= K - 3:
            # Near the ends q, w and a depend on T themselves.
            for i in range(n):
                q, w, a = slope[POSITION, k, i], slope[RATE, k, i], slope[CURVATURE, k, i]
                corner += 2.0 * (q * qT[i] + w * wT[i] + a * aT[i]) + w * w * ww[i]
                for j in range(n):
                    q_j, a_j = slope[POSITION, k, j], slope[CURVATURE, k, j]
                    corner += q * (qq[i, j] * q_j + 2.0 * qa[i, j] * a_j) + a * aa[i, j] * a_j
            for i in range(n):
                wT[i] += ww[i] * slope[RATE, k, i]
                for j in range(n):
                    qT[i] += qq[i, j] * slope[POSITION, k, j] + qa[i, j] * slope[CURVATURE, k, j]
                    aT[i] += aq[i, j] * slope[POSITION, k, j] + aa[i, j] * slope[CURVATURE, k, j]

        for b in range(TAPS):
            q_b, w_b, a_b = taps[k, b, POSITION], taps[k, b, RATE], taps[k, b, CURVATURE]
            col = (first[k] + b) * n
            for i in range(n):
                column[col + i] += q_b * qT[i] + w_b * wT[i] + a_b * aT[i]
            # Blocks on and below the diagonal in the columns of unknown b, side by side and transposed: the part of
            # column j from the diagonal down is then one run of band[col + j]. qq and aa are symmetric, qa and aq each
            # other's transpose.
            blocks = TAPS - b
            for e in range(blocks):
                q_e, w_e, a_e = taps[k, b + e, POSITION], taps[k, b + e, RATE], taps[k, b + e, CURVATURE]
                cqq, cqa, caq, caa = q_e * q_b, q_e * a_b, a_e * q_b, a_e * a_b
                for j in range(n):
                    for i in range(n):
                        run[j, e * n + i] = cqq * qq[j, i] + cqa * aq[j, i] + caq * qa[j, i] + caa * aa[j, i]
                    run[j, e * n + j] += w_e * w_b * ww[j]
            for j in range(n):
                for d in range(blocks * n - j):
                    band[col + j, d] += run[j, j + d]
    return float(corner)
