"""Banded Cholesky and the bordered solve against LAPACK and dense linear algebra."""

import numpy as np
import pytest
from scipy.linalg import cholesky_banded

from dyngrasp.planning.collocation import banded

# Backward error of Cholesky: a modest multiple of size · 2⁻⁵³ for matrices of this condition (about 1e3).
ROUNDING = 1e-11


def matrix(size: int, width: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A positive definite band matrix, dense and as columns of its lower triangle."""
    random = np.random.default_rng(seed)
    dense = np.zeros((size, size))
    for d in range(width):
        np.fill_diagonal(dense[d:], random.normal(size=size - d))
    dense = dense @ dense.T
    dense[np.abs(np.subtract.outer(range(size), range(size))) >= width] = 0.0
    dense += (0.1 - min(np.linalg.eigvalsh(dense)[0], 0.0)) * np.eye(size)
    band = np.zeros((size, width))
    for d in range(width):
        band[: size - d, d] = np.diagonal(dense, -d)
    return dense, band


@pytest.mark.parametrize(("size", "width"), [(1, 1), (6, 9), (21, 21), (40, 3), (150, 21), (231, 24)])
def test_factor_is_lapacks(size, width):
    _, band = matrix(size, min(width, size), size)
    expected = cholesky_banded(band.T, lower=True)
    wide = np.zeros((size, width))
    wide[:, : band.shape[1]] = band
    assert banded.cholesky(wide)
    for d in range(band.shape[1]):
        np.testing.assert_allclose(wide[: size - d, d], expected[d, : size - d], rtol=1e-9, atol=ROUNDING)


def test_indefinite_matrices_are_refused():
    for seed in range(20):
        dense, band = matrix(30, 6, seed)
        lowest = np.linalg.eigvalsh(dense)[0]
        below, above = band.copy(), band.copy()
        below[:, 0] -= 1.01 * lowest
        above[:, 0] -= 0.99 * lowest
        assert not banded.cholesky(below)
        assert banded.cholesky(above)


def test_a_number_that_is_none_is_refused():
    _, band = matrix(10, 3, 0)
    band[4, 1] = np.nan
    assert not banded.cholesky(band)


def test_bordered_system_is_solved():
    random = np.random.default_rng(1)
    dense, band = matrix(60, 12, 3)
    column, corner = random.normal(size=60), 5.0
    full = np.block([[dense, column[:, None]], [column[None, :], np.array([[corner]])]])
    rhs = random.normal(size=61)
    assert banded.cholesky(band)
    solved = np.empty(60)
    complement = banded.schur_complement(band, column, corner, solved)
    assert complement == pytest.approx(corner - column @ np.linalg.solve(dense, column), rel=1e-9)
    x = rhs[:-1].copy()
    y = banded.solve_bordered(band, solved, complement, x, rhs[-1])
    np.testing.assert_allclose(full @ np.append(x, y), rhs, atol=1e-10)


def test_the_complement_tells_definiteness():
    dense, band = matrix(30, 6, 5)
    column = np.random.default_rng(2).normal(size=30)
    enough = column @ np.linalg.solve(dense, column)
    assert banded.cholesky(band)
    for corner in (0.9 * enough, 1.1 * enough):
        full = np.block([[dense, column[:, None]], [column[None, :], np.array([[corner]])]])
        complement = banded.schur_complement(band, column, float(corner), np.empty(30))
        assert (complement > 0) == (np.linalg.eigvalsh(full)[0] > 0)
