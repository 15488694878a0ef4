"""Block-banded Cholesky and the bordered solve against dense linear algebra."""

import numpy as np
import pytest

from dyngrasp.planning.collocation import banded
from dyngrasp.planning.collocation.work_arrays import padded

# Backward error of Cholesky: a modest multiple of size · 2⁻⁵³ for matrices of this condition (about 1e3).
ROUNDING = 1e-11


def stored(dense: np.ndarray, n: int) -> np.ndarray:
    """The lower band of a matrix of blocks of n as `banded` keeps it."""
    blocks, W = len(dense) // n, padded(n)
    band = np.zeros((blocks + banded.BEYOND, n, banded.BLOCKS * W))
    for i in range(blocks):
        for e in range(min(banded.BLOCKS, blocks - i)):
            block = dense[(i + e) * n : (i + e + 1) * n, i * n : (i + 1) * n]
            band[i, :, e * W : e * W + n] = (np.tril(block) if e == 0 else block).T
    return band


def vector(x: np.ndarray, n: int) -> np.ndarray:
    kept = np.zeros((x.size // n + banded.BEYOND, padded(n)))
    kept[: -banded.BEYOND, :n] = x.reshape(-1, n)
    return kept


def numbers(kept: np.ndarray, n: int) -> np.ndarray:
    return kept[: -banded.BEYOND, :n].ravel()


def matrix(blocks: int, n: int, seed: int) -> np.ndarray:
    """A positive definite matrix whose blocks of n reach to the next but one."""
    random = np.random.default_rng(seed)
    i = np.arange(blocks * n) // n
    dense = np.where(np.abs(np.subtract.outer(i, i)) < banded.BLOCKS, random.normal(size=(blocks * n, blocks * n)), 0.0)
    dense += dense.T
    return dense + (0.1 - np.linalg.eigvalsh(dense)[0]) * np.eye(blocks * n)


@pytest.mark.parametrize(("blocks", "n"), [(1, 1), (2, 3), (3, 7), (40, 1), (30, 7), (12, 8), (20, 9)])
def test_factor_is_lapacks(blocks, n):
    dense = matrix(blocks, n, blocks)
    band = stored(dense, n)
    assert banded.cholesky(band)
    expected = stored(np.linalg.cholesky(dense), n)
    for p in range(n):
        np.testing.assert_allclose(band[:-2, p, p + 1 :], expected[:-2, p, p + 1 :], rtol=1e-9, atol=ROUNDING)
        np.testing.assert_allclose(band[:-2, p, p], 1 / expected[:-2, p, p], rtol=1e-9)


def test_both_substitutions():
    n, random = 7, np.random.default_rng(4)
    dense = matrix(25, n, 2)
    band, factor = stored(dense, n), np.linalg.cholesky(dense)
    assert banded.cholesky(band)
    b = random.normal(size=len(dense))
    x = vector(b, n)
    banded.forward(band, x)
    np.testing.assert_allclose(numbers(x, n), np.linalg.solve(factor, b), rtol=1e-9, atol=ROUNDING)
    assert banded.product(x, x) == pytest.approx(b @ np.linalg.solve(dense, b), rel=1e-9)
    banded.backward(band, x)
    np.testing.assert_allclose(numbers(x, n), np.linalg.solve(dense, b), rtol=1e-9, atol=ROUNDING)
    # What pads a vector stays zero, so that it can be used again.
    assert (x[:, n:] == 0.0).all()
    assert (x[-banded.BEYOND :] == 0.0).all()


def test_indefinite_matrices_are_refused():
    for seed in range(20):
        dense = matrix(8, 4, seed)
        lowest = np.linalg.eigvalsh(dense)[0]
        assert not banded.cholesky(stored(dense - 1.01 * lowest * np.eye(32), 4))
        assert banded.cholesky(stored(dense - 0.99 * lowest * np.eye(32), 4))


def test_a_number_that_is_none_is_refused():
    band = stored(matrix(4, 3, 0), 3)
    band[1, 1, 2] = np.nan
    assert not banded.cholesky(band)


def bordered(n: int, seed: int, share: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """A matrix with a last row and column, its band's factor, the last row of the factor, and the complement.

    The last entry is `share` of the least that makes the matrix positive definite.
    """
    dense = matrix(12, n, seed)
    column = np.random.default_rng(seed).normal(size=len(dense))
    corner = share * float(column @ np.linalg.solve(dense, column))
    full = np.block([[dense, column[:, None]], [column[None, :], np.array([[corner]])]])
    band, border = stored(dense, n), vector(column, n)
    assert banded.cholesky(band)
    banded.forward(band, border)
    return full, band, border, corner - banded.product(border, border)


def test_bordered_system_is_solved():
    n = 5
    full, band, border, complement = bordered(n, 3, 2.0)
    rhs = np.random.default_rng(1).normal(size=len(full))
    x = vector(rhs[:-1], n)
    y = banded.solve_bordered(band, border, complement, x, rhs[-1], np.inf)
    np.testing.assert_allclose(full @ np.append(numbers(x, n), y), rhs, atol=1e-10)


@pytest.mark.parametrize("longest", [0.0, 1e-3])
def test_a_last_unknown_that_is_cut(longest):
    """The others then solve their own equations with what is left of it."""
    n = 5
    full, band, border, complement = bordered(n, 3, 2.0)
    rhs = np.random.default_rng(1).normal(size=len(full))
    x = vector(rhs[:-1], n)
    y = banded.solve_bordered(band, border, complement, x, rhs[-1], longest)
    assert abs(y) == longest
    np.testing.assert_allclose((full @ np.append(numbers(x, n), y))[:-1], rhs[:-1], atol=1e-10)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_the_complement_tells_definiteness(share):
    full, _, _, complement = bordered(4, 5, share)
    assert (complement > 0) == (np.linalg.eigvalsh(full)[0] > 0)
