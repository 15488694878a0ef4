"""Slacks, elastic variables and multipliers of the rows g ≥ 0: what an interior point iteration does to each row.

Every row may be violated at a price ν (Gould, Orban, Toint 2015, "An interior-point ℓ1-penalty method for nonlinear
optimization"): g = s − t with s, t > 0, and ν t is added to the objective. The logarithmic barrier of s and t gives,
for a barrier parameter μ,

    s λ = μ,      t (ν − λ) = μ,      s − t = g,

λ the multiplier of g. A strictly positive s and t exists for every x, hence the iterates of this problem are always
feasible and one merit function serves from the first iterate to the last. If λ < ν/2, g = μ/λ − μ/(ν − λ) > 0: the
solution for μ > 0 satisfies the row strictly.

A Newton step on the three equations with dg = J d, right-hand sides corrected by e_s and e_t (Mehrotra's second-order
terms):

    dλ = Ω (b − dg),   Ω = 1 / (s/λ + t/(ν − λ)),   b = (μ − e_s)/λ − (μ − e_t)/(ν − λ) − g,
    ds = (μ − e_s)/λ − s − s/λ dλ,                  dt = (μ − e_t)/(ν − λ) − t + t/(ν − λ) dλ.

All arrays have one entry a row.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.signals import Array

ROUNDING = 1e-12  # of a row in its scaled unit; accelerations are known to this


@njit(cache=True, error_model="numpy")
def start(g: Array, mu: float, price: float, least_slack: float, s: Array, t: Array, multiplier: Array) -> None:
    """Slacks for the rows as they are; a violated row begins with its violation as elastic variable."""
    for i in range(g.size):
        t[i] = mu / price
        s[i] = g[i] + t[i]
        if s[i] < least_slack:
            s[i] = least_slack
            t[i] = s[i] - g[i]
        multiplier[i] = min(mu / s[i], price / 2)


@njit(cache=True, error_model="numpy")
def stiffness(s: Array, t: Array, multiplier: Array, price: float, omega: Array) -> None:
    """Ω: by how much the multiplier falls when the row grows."""
    for i in range(s.size):
        omega[i] = 1.0 / (s[i] / multiplier[i] + t[i] / (price - multiplier[i]))


@njit(cache=True, error_model="numpy")
def target_multipliers(
    s: Array, t: Array, multiplier: Array, price: float, mu: float, e_s: Array, e_t: Array, omega: Array, y: Array
) -> None:
    """Write y = λ + Ω b: the multipliers after a Newton step that leaves the rows as they are."""
    for i in range(s.size):
        b = (mu - e_s[i]) / multiplier[i] - (mu - e_t[i]) / (price - multiplier[i]) - (s[i] - t[i])
        y[i] = multiplier[i] + omega[i] * b


@njit(cache=True, error_model="numpy")
def row_direction(
    dg: Array,
    s: Array,
    t: Array,
    multiplier: Array,
    price: float,
    mu: float,
    e_s: Array,
    e_t: Array,
    omega: Array,
    y: Array,
    ds: Array,
    dt: Array,
    dmultiplier: Array,
) -> None:
    """Write ds, dt and dλ that belong to the change dg of the rows."""
    for i in range(s.size):
        eta = price - multiplier[i]
        change = y[i] - multiplier[i] - omega[i] * dg[i]
        dmultiplier[i] = change
        ds[i] = (mu - e_s[i] - s[i] * change) / multiplier[i] - s[i]
        dt[i] = (mu - e_t[i] + t[i] * change) / eta - t[i]


@njit(cache=True, error_model="numpy")
def longest_steps(
    s: Array, t: Array, multiplier: Array, price: float, ds: Array, dt: Array, dmultiplier: Array, keep: float
) -> tuple[float, float]:
    """Largest steps ≤ 1 of slacks and of multipliers that leave each at least the share 1 − keep of its value."""
    # The extreme ratio is found first and divided once: divisions are what this loop would spend its time on.
    primal, dual = 1.0, 1.0
    for i in range(s.size):
        if primal * ds[i] < -keep * s[i]:
            primal = -keep * s[i] / ds[i]
        if primal * dt[i] < -keep * t[i]:
            primal = -keep * t[i] / dt[i]
        if dual * dmultiplier[i] < -keep * multiplier[i]:
            dual = -keep * multiplier[i] / dmultiplier[i]
        if dual * dmultiplier[i] > keep * (price - multiplier[i]):
            dual = keep * (price - multiplier[i]) / dmultiplier[i]
    return primal, dual


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def complementarity(
    s: Array,
    t: Array,
    multiplier: Array,
    price: float,
    ds: Array,
    dt: Array,
    dmultiplier: Array,
    primal: float,
    dual: float,
) -> tuple[float, float]:
    """Mean of s λ and sum of t (ν − λ) after steps of given lengths."""
    slack, elastic = 0.0, 0.0
    for i in range(s.size):
        after = multiplier[i] + dual * dmultiplier[i]
        slack += (s[i] + primal * ds[i]) * after
        elastic += (t[i] + primal * dt[i]) * (price - after)
    return slack / s.size, elastic


@njit(cache=True, error_model="numpy")
def second_order_terms(ds: Array, dt: Array, dmultiplier: Array, e_s: Array, e_t: Array) -> None:
    """What the affine step leaves of s λ and t (ν − λ) beyond first order."""
    for i in range(ds.size):
        e_s[i] = ds[i] * dmultiplier[i]
        e_t[i] = -dt[i] * dmultiplier[i]


@njit(cache=True, error_model="numpy")
def moved_slacks(
    g: Array,
    s: Array,
    t: Array,
    ds: Array,
    dt: Array,
    length: float,
    price: float,
    mu: float,
    s_new: Array,
    t_new: Array,
) -> None:
    """Slacks after a step, moved until s − t = g holds for the rows g at the new point.

    Neither move increases the merit beyond its linear prediction. Where the row turned out larger than predicted, a
    larger s lowers the barrier; where it turned out smaller, a larger t costs what the violation costs. And where a row
    holds with room to spare, both come down together until t is twice what the barrier would make it at least.
    """
    small = 2 * mu / price
    for i in range(g.size):
        s_new[i] = s[i] + length * ds[i]
        t_new[i] = t[i] + length * dt[i]
        gap = g[i] + t_new[i] - s_new[i]
        # A gap of rounding is none: carried into t it would keep t from going to zero with μ.
        if gap > ROUNDING:
            s_new[i] += gap
        elif gap < -ROUNDING:
            t_new[i] -= gap
        if g[i] > 2 * small and t_new[i] > small:
            t_new[i] = small
            s_new[i] = g[i] + small


@njit(cache=True, error_model="numpy")
def barrier(s: Array, t: Array, price: float, mu: float) -> float:
    """ν Σ t − μ Σ (ln s + ln t); `inf` if a slack is not positive."""
    cost, logarithms, product = 0.0, 0.0, 1.0
    for i in range(s.size):
        if not (s[i] > 0 and t[i] > 0):
            return np.inf
        cost += price * t[i]
        product *= s[i] * t[i]
        # One logarithm of a product is cheaper than many logarithms; the range of the product is watched.
        if product < 1e-200 or product > 1e200:
            logarithms += np.log(product)
            product = 1.0
    return cost - mu * (logarithms + np.log(product))


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract"})
def barrier_slope(s: Array, t: Array, ds: Array, dt: Array, price: float, mu: float) -> float:
    """Derivative of `barrier` along ds, dt."""
    slope = 0.0
    for i in range(s.size):
        slope += price * dt[i] - mu * (ds[i] * t[i] + dt[i] * s[i]) / (s[i] * t[i])
    return slope


@njit(cache=True, error_model="numpy")
def move_multipliers(
    multiplier: Array, dmultiplier: Array, length: float, s: Array, t: Array, price: float, mu: float, spread: float
) -> None:
    """Step the multipliers; then keep each within a factor `spread` of what μ and the slacks say (0: no such bound)."""
    for i in range(s.size):
        value = multiplier[i] + length * dmultiplier[i]
        if spread > 0:
            value = min(max(value, mu / (spread * s[i])), spread * mu / s[i])
            eta = min(max(price - value, mu / (spread * t[i])), spread * mu / t[i])
            value = price - eta if eta < price / 2 else value
        multiplier[i] = min(max(value, 1e-300), price * (1 - 1e-15))
