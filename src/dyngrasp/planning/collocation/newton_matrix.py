"""Objective, and the matrix of the Newton system, Hessian of the Lagrangian plus Jᵀ Ω J: band, column of T, corner.

At one grid point everything depends on u = (q, v) through the constraints' rows and on q, w, a and T through boxes and
objective. With v = a / T² the chain rule takes second derivatives by (q, v) to those by (q, a, T); the three-tap filter
takes them to the unknowns x. Every entry is computed for all grid points at once: the last axis of an array is theirs
wherever its length is P.
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
) -> float:
    """Write the band and the column of T in `work`; return the corner.

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
    """
    _, half_width, velocity, acceleration, _, _, _, _, _, _, _, longest, fixed = limits
    qq, aq, aa = work.blocks[0], work.blocks[1], work.blocks[2]
    z, v = work.z, work.v
    _, K, n = z.shape
    R = (omega.size - 2) // K
    T2 = T * T
    effort = factor * rho / (K - 1) / (T2 * T)
    corner = 0.0 if fixed else (omega[omega.size - 2] + omega[omega.size - 1]) / longest**2

    by_v = _constraint_blocks(work, limits, omega, curvature)
    # Chain rule to (q, a, T): v = a / T², ∂v/∂T = −2 v / T.
    by_T = np.zeros((3, n, qq.shape[2]))
    qT, wT, aT = by_T[0], by_T[1], by_T[2]
    ww = np.zeros((n, K))
    _times_rates(aq, aa, v, T, qT, aT)
    for i in range(n):
        for j in range(n):
            cross, square = aq[i, j], aa[i, j]
            for k in range(cross.size):
                cross[k] /= T2
                square[k] /= T2 * T2
        for k in range(K):
            # Second derivatives of v times the rows' multipliers enter with the sign of −λ g.
            a = z[CURVATURE, k, i]
            corner += aT[i, k] * (-2.0 / T * v[k, i]) - 6.0 / T2 * by_v[i, k] * v[k, i] + 12.0 * effort / T2 * a * a
            aT[i, k] = aT[i, k] / T2 + 2.0 / (T2 * T) * by_v[i, k] - 6.0 * effort / T * a
            aa[i, i, k] += 2.0 * effort + shift
    for k in range(1, K - 1):
        at = k * R
        for i in range(velocity.size):
            qq[i, i, k] += (omega[at + i] + omega[at + n + i]) / half_width[i] ** 2
            plus, minus = omega[at + 2 * n + i], omega[at + 3 * n + i]
            ww[i, k] = (plus + minus) / velocity[i] ** 2
            wT[i, k] = (plus - minus) / velocity[i]
            corner += plus + minus
    for k in range(K):
        at = k * R + 4 * velocity.size
        for i in range(acceleration.size):
            plus, minus = omega[at + i], omega[at + n + i]
            aa[i, i, k] += (plus + minus) / acceleration[i] ** 2
            aT[i, k] += 2.0 * T * (plus - minus) / acceleration[i]
            corner += 4.0 * T2 * (plus + minus)
            corner -= curvature * 2.0 * (multiplier[at + i] + multiplier[at + n + i])
    for k in range(K):
        if k <= 2 or k >= K - 3:
            corner += _with_duration(work.blocks, ww, tap.slope, by_T, k)
    _border(tap, by_T, work.border)
    _band(tap, work.blocks, ww, work.band)
    return float(corner)


@njit(cache=True, error_model="numpy")
def _constraint_blocks(work: WorkArrays, limits: tuple, omega: Array, curvature: float) -> Array:
    """Write what the constraints' rows add by (q, q), (v, q) and (v, v); return Σ weights ∂c/∂v (n, P).

    The blocks by (q, q) and (v, v) are symmetric: the lower triangle is computed.
    """
    _, _, velocity, acceleration, lo, up, _, _, scale, free, _, _, _ = limits
    jacobian, hessian, weights = work.jacobian, work.hessian, work.weights
    qq, aq, aa = work.blocks[0], work.blocks[1], work.blocks[2]
    m, twice, P = jacobian.shape
    n, K = twice // 2, work.v.shape[0]
    R = (omega.size - 2) // K
    stiffness, stiff = np.zeros((m, P)), np.empty((m, twice, P))
    for k in range(K):
        at = k * R + 4 * velocity.size + 2 * acceleration.size
        for i in range(lo.size):
            stiffness[lo[i], k] += omega[at + i]
        at += lo.size
        for i in range(up.size):
            stiffness[up[i], k] += omega[at + i]
    for r in range(m):
        if free[r] == 0.0:
            stiffness[r, 0], stiffness[r, K - 1] = 0.0, 0.0
        for i in range(n if free[r] == 0.0 else twice):
            factor, slope, product = stiffness[r], jacobian[r, i], stiff[r, i]
            for k in range(P):
                product[k] = scale[r] * scale[r] * factor[k] * slope[k]
    for i in range(twice):
        for j in range(i + 1):
            if i < n:
                block = qq[i, j]
            elif j < n:
                block = aq[i - n, j]
            else:
                block = aa[i - n, j - n]
            second = hessian[i, j]
            for k in range(P):
                block[k] = -curvature * second[k]
            for r in range(m):
                if i >= n and free[r] == 0.0:
                    continue
                left, right = stiff[r, i], jacobian[r, j]
                for k in range(P):
                    block[k] += left[k] * right[k]
            if i < n:
                qq[j, i] = block
            elif j >= n:
                aa[j - n, i - n] = block
    by_v = np.zeros((n, P))
    for r in range(m):
        if free[r] == 0.0:
            continue
        for j in range(n):
            total, weight, slope = by_v[j], weights[r], jacobian[r, n + j]
            for k in range(P):
                total[k] += curvature * weight[k] * slope[k]
    return by_v


@njit(cache=True, error_model="numpy")
def _times_rates(aq: Array, aa: Array, v: Array, T: float, qT: Array, aT: Array) -> None:
    """Add the blocks times ∂v/∂T, the mixed derivatives by q or v and T, to qT and aT (n, P)."""
    n, _, P = aq.shape
    rate = np.zeros(P)
    for i in range(n):
        for k in range(v.shape[0]):
            rate[k] = -2.0 / T * v[k, i]
        for j in range(n):
            by_q, by_a, cross, square = qT[j], aT[j], aq[i, j], aa[i, j]
            for k in range(P):
                by_q[k] += cross[k] * rate[k]
                by_a[k] += square[k] * rate[k]


@njit(cache=True, error_model="numpy")
def _with_duration(blocks: Array, ww: Array, slope: Array, by_T: Array, k: int) -> float:
    """Near the ends q, w, a depend on T themselves: add to the derivatives by T at k, return what the corner gains."""
    qq, aq, aa = blocks[0], blocks[1], blocks[2]
    qT, wT, aT = by_T[0], by_T[1], by_T[2]
    n = qq.shape[0]
    corner = 0.0
    for i in range(n):
        q, w, a = slope[POSITION, k, i], slope[RATE, k, i], slope[CURVATURE, k, i]
        corner += 2.0 * (q * qT[i, k] + w * wT[i, k] + a * aT[i, k]) + w * w * ww[i, k]
        for j in range(n):
            q_j, a_j = slope[POSITION, k, j], slope[CURVATURE, k, j]
            corner += q * (qq[i, j, k] * q_j + 2.0 * aq[j, i, k] * a_j) + a * aa[i, j, k] * a_j
    for i in range(n):
        wT[i, k] += ww[i, k] * slope[RATE, k, i]
        for j in range(n):
            qT[i, k] += qq[i, j, k] * slope[POSITION, k, j] + aq[j, i, k] * slope[CURVATURE, k, j]
            aT[i, k] += aq[i, j, k] * slope[POSITION, k, j] + aa[i, j, k] * slope[CURVATURE, k, j]
    return corner


@njit(cache=True, error_model="numpy")
def _border(tap: ThreeTap, by_T: Array, border: Array) -> None:
    """Take derivatives by q, w or a and T (3, n, P) to those by x and T (K, W)."""
    border[:] = 0.0
    for k in range(tap.first.size):
        for b in range(TAPS):
            q_b, w_b, a_b = tap.taps[k, b]
            for i in range(by_T.shape[1]):
                border[tap.first[k] + b, i] += q_b * by_T[0, i, k] + w_b * by_T[1, i, k] + a_b * by_T[2, i, k]


@njit(cache=True, error_model="numpy")
def _band(tap: ThreeTap, blocks: Array, ww: Array, band: Array) -> None:
    """Take second derivatives by q, w and a to those by x.

    The taps of the column are applied first, then those of the row. All but two grid points at each end have k − 2 as
    the first of their unknowns.
    """
    qq, aq, aa = blocks[0], blocks[1], blocks[2]
    first, K, n = tap.first, tap.first.size, qq.shape[0]
    W = band.shape[2] // TAPS
    q, w, a = np.empty((TAPS, K)), np.empty((TAPS, K)), np.empty((TAPS, K))
    for k in range(K):
        for b in range(TAPS):
            q[b, k], w[b, k], a[b, k] = tap.taps[k, b]
    by_q, by_a, sums = np.empty(K), np.empty(K), np.empty((TAPS, K))
    inner_q, inner_a = by_q[2:], by_a[2:]
    for j in range(n):
        for i in range(n):
            # Above the diagonal stand zeros.
            nearest = 0 if i >= j else 1
            sums[:] = 0.0
            square, cross_j, cross_i, last = qq[i, j], aq[j, i], aq[i, j], aa[i, j]
            for b in range(TAPS - nearest):
                q_b, a_b = q[b], a[b]
                for k in range(K):
                    by_q[k] = q_b[k] * square[k] + a_b[k] * cross_j[k]
                    by_a[k] = q_b[k] * cross_i[k] + a_b[k] * last[k]
                for e in range(nearest, TAPS - b):
                    q_e, a_e, total = q[b + e, 2:], a[b + e, 2:], sums[e, b:]
                    for k in range(K - 4):
                        total[k] += q_e[k] * inner_q[k] + a_e[k] * inner_a[k]
                    for k in (0, 1, K - 2, K - 1):
                        sums[e, first[k] + b] += q[b + e, k] * by_q[k] + a[b + e, k] * by_a[k]
                    if i == j:
                        for k in range(K):
                            sums[e, first[k] + b] += w[b + e, k] * w[b, k] * ww[i, k]
            for e in range(TAPS):
                for c in range(K - 2):
                    band[c, j, e * W + i] = sums[e, c]
    band[K - 2 :] = 0.0
