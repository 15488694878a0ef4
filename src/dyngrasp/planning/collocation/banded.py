"""Linear systems whose matrix is a band of blocks but for one last row and column: Cholesky's factorisation.

    [ B   c ] [ x ]   [ b ]        B = L Lᵀ,   l = L⁻¹ c,   σ = γ − lᵀ l,
    [ cᵀ  γ ] [ y ] = [ β ]        y = (β − lᵀ L⁻¹ b) / σ,   x = L⁻ᵀ (L⁻¹ b − y l).

The matrix is positive definite exactly if the factorisation of B succeeds and σ > 0. Work and memory grow linearly with
the number of unknowns.

Storage: the unknowns come in blocks of n, and a block knows the next two. `band[i, p]` is column p of block i from the
top of its diagonal block down: three runs of W ≥ n numbers, one for each block of rows, zero past the n-th. A vector is
(blocks, W) alike, so that what a column acts on is one run of memory. Two blocks of zeros end both, and there is no end
to look out for. Above the diagonal B has zeros and L nothing of interest; on it L has the inverse of its pivots.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.signals import Array

BLOCKS = 3  # in a column of the band
BEYOND = BLOCKS - 1  # blocks of zeros at the end

# A pivot must keep this share of its diagonal entry: what is left below it is rounding.
PIVOT_SHARE = 1e-14


@njit(cache=True, error_model="numpy")
def cholesky(band: Array) -> bool:
    """Replace the lower band of B by that of L, right-looking.

    Args:
        band: (blocks + 2, n, 3W), overwritten.

    Returns:
        Whether B is numerically positive definite; if not, `band` is left in an undefined state.
    """
    blocks, n, width = band.shape
    blocks -= BEYOND
    W = width // BLOCKS
    threshold = np.empty((blocks, n))
    for i in range(blocks):
        for p in range(n):
            threshold[i, p] = PIVOT_SHARE * band[i, p, p]
    for i in range(blocks):
        for p in range(n):
            column = band[i, p]
            pivot = column[p]
            if not (pivot > threshold[i, p] and pivot > 0.0 and np.isfinite(pivot)):
                return False
            inverse = 1.0 / np.sqrt(pivot)
            for d in range(width):
                column[d] *= inverse
            for q in range(p + 1, n):
                factor, target = column[q], band[i, q]
                for d in range(width):
                    target[d] -= factor * column[d]
            below = column[W:]
            for q in range(n):
                factor, target = below[q], band[i + 1, q]
                for d in range(2 * W):
                    target[d] -= factor * below[d]
            lowest = column[2 * W :]
            for q in range(n):
                factor, target = lowest[q], band[i + 2, q]
                for d in range(W):
                    target[d] -= factor * lowest[d]
            column[p] = inverse
    return True


@njit(cache=True, error_model="numpy")
def forward(lower: Array, x: Array) -> None:
    """Overwrite x (blocks + 2, W) by L⁻¹ x."""
    blocks, n, width = lower.shape
    W = width // BLOCKS
    numbers = x.reshape(x.size)
    for i in range(blocks - BEYOND):
        for p in range(n):
            column, below = lower[i, p, p:], numbers[i * W + p : i * W + width]
            value = below[0] * column[0]
            for d in range(1, width - p):
                below[d] -= value * column[d]
            below[0] = value


@njit(cache=True, error_model="numpy", fastmath={"reassoc"})
def backward(lower: Array, x: Array) -> None:
    """Overwrite x (blocks + 2, W) by L⁻ᵀ x."""
    blocks, n, width = lower.shape
    W = width // BLOCKS
    numbers = x.reshape(x.size)
    for i in range(blocks - BEYOND - 1, -1, -1):
        for p in range(n - 1, -1, -1):
            column, below = lower[i, p, p:], numbers[i * W + p : i * W + width]
            value = below[0]
            for d in range(1, width - p):
                value -= column[d] * below[d]
            below[0] = value * column[0]


@njit(cache=True, error_model="numpy")
def product(x: Array, y: Array) -> float:
    """xᵀ y of two vectors (blocks + 2, W)."""
    total = 0.0
    for i in range(x.shape[0]):
        for p in range(x.shape[1]):
            total += x[i, p] * y[i, p]
    return total


@njit(cache=True, error_model="numpy")
def solve_bordered(lower: Array, border: Array, complement: float, x: Array, beta: float, longest: float) -> float:
    """Solve with the last row and column; x holds b and is overwritten by the solution.

    Args:
        lower: L from `cholesky`.
        border: l = L⁻¹ c from `forward`.
        complement: σ = γ − lᵀ l.
        x: (blocks + 2, W) b, overwritten.
        beta: Last entry of the right-hand side.
        longest: A last unknown beyond it is cut to that: as if γ had been larger.

    Returns:
        y, the last unknown.
    """
    forward(lower, x)
    y = 0.0
    if longest > 0.0:
        y = (beta - product(border, x)) / complement
        y = min(max(y, -longest), longest) if np.isfinite(y) else y
        for i in range(x.shape[0]):
            for p in range(x.shape[1]):
                x[i, p] -= y * border[i, p]
    backward(lower, x)
    return y
