"""Linear systems whose matrix is banded but for one last row and column: banded Cholesky and a scalar Schur complement.

    [ B   c ] [ x ]   [ b ]        B = L Lᵀ,   σ = γ − cᵀ B⁻¹ c,
    [ cᵀ  γ ] [ y ] = [ β ]        y = (β − cᵀ B⁻¹ b) / σ,   x = B⁻¹ b − y B⁻¹ c.

The matrix is positive definite exactly if the factorisation of B succeeds and σ > 0. Work and memory grow linearly with
the number of unknowns.

Storage: `band[j, d]` is the entry in row j + d and column j, 0 ≤ d ≤ bandwidth, so that a column of the lower triangle
lies contiguously and every inner loop below runs along it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.signals import Array

# A pivot must keep this share of its diagonal entry: what is left below it is rounding.
PIVOT_SHARE = 1e-14


@njit(cache=True, error_model="numpy")
def cholesky(band: Array) -> bool:
    """Replace the lower band of B by that of L, right-looking.

    Args:
        band: (size, bandwidth + 1), overwritten.

    Returns:
        Whether B is numerically positive definite; if not, `band` is left in an undefined state.
    """
    size, width = band.shape
    threshold = np.empty(size)
    for j in range(size):
        threshold[j] = PIVOT_SHARE * band[j, 0]
    for j in range(size):
        pivot = band[j, 0]
        if not (pivot > threshold[j] and pivot > 0.0 and np.isfinite(pivot)):
            return False
        root = np.sqrt(pivot)
        inverse = 1.0 / root
        band[j, 0] = root
        below = min(width, size - j)
        for d in range(1, below):
            band[j, d] *= inverse
        for d in range(1, below):
            factor = band[j, d]
            for e in range(below - d):
                band[j + d, e] -= factor * band[j, d + e]
    return True


@njit(cache=True, error_model="numpy")
def solve_in_place(lower: Array, x: Array) -> None:
    """Overwrite the right-hand side x (size,) by the solution of L Lᵀ x = b."""
    size, width = lower.shape
    for j in range(size):
        value = x[j] / lower[j, 0]
        x[j] = value
        for d in range(1, min(width, size - j)):
            x[j + d] -= value * lower[j, d]
    for j in range(size - 1, -1, -1):
        value = x[j]
        for d in range(1, min(width, size - j)):
            value -= lower[j, d] * x[j + d]
        x[j] = value / lower[j, 0]


@njit(cache=True, error_model="numpy")
def schur_complement(lower: Array, column: Array, corner: float, solved_column: Array) -> float:
    """σ = γ − cᵀ B⁻¹ c; writes B⁻¹ c into `solved_column` (size,)."""
    solved_column[:] = column
    solve_in_place(lower, solved_column)
    complement = corner
    for j in range(column.size):
        complement -= column[j] * solved_column[j]
    return complement


@njit(cache=True, error_model="numpy")
def solve_bordered(lower: Array, solved_column: Array, complement: float, x: Array, beta: float) -> float:
    """Solve with the last row and column; x (size,) holds b and is overwritten by the solution.

    Args:
        lower: L from `cholesky`.
        solved_column: B⁻¹ c from `schur_complement`.
        complement: σ from there.
        x: (size,) b, overwritten.
        beta: Last entry of the right-hand side.

    Returns:
        y, the last unknown.
    """
    # cᵀ B⁻¹ b = (B⁻¹ c)ᵀ b: the product is taken before b is overwritten, so c itself is not needed.
    projected = beta
    for j in range(x.size):
        projected -= solved_column[j] * x[j]
    y = projected / complement
    solve_in_place(lower, x)
    for j in range(x.size):
        x[j] -= y * solved_column[j]
    return y
