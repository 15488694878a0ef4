"""The filters against the trapezoidal rule, the bands against their dense sums, the factorisation against numpy."""

import numpy as np
import pytest

from dyngrasp.lanes import whole_lanes
from dyngrasp.planning.replanning.joint_splines import (
    factorise,
    filtered,
    filters,
    pull_back,
    push_forward,
    sequence,
    substitute,
    substitute_both,
    unknowns_of,
)

RNG = np.random.default_rng(0)


def dense_map(N, held):
    """(N−1, 3, N+1) derivative of q, w, a by each unknown, by differences of the full map: it is linear."""
    columns = []
    zero = np.zeros((2, 3, 1))
    for i in range(N - 1):
        x = np.zeros((N - 1, 1))
        x[i] = 1.0
        r, z = np.empty((N + 3, 1)), np.empty((3, N + 1, 1))
        sequence(x, zero, held, r)
        filtered(r, z)
        columns.append(z[:, :, 0])
    return np.array(columns)


@pytest.mark.parametrize("held", [(False, False), (True, False), (True, True)])
@pytest.mark.parametrize("N", [4, 5, 17])
def test_every_sequence_obeys_the_trapezoidal_rule_and_its_boundary(N, held):
    n = 3
    x, values = RNG.normal(size=(N - 1, n)), RNG.normal(size=(2, 3, n))
    r, z = np.empty((N + 3, n)), np.empty((3, N + 1, n))
    sequence(x, values, held, r)
    filtered(r, z)
    q, w, a = z
    half = 0.5 / N
    # a is of the size N² here, so that rounding in w is too
    assert np.abs(np.diff(q, axis=0) - half * (w[1:] + w[:-1])).max() < 1e-14 * N**2
    assert np.abs(np.diff(w, axis=0) - half * (a[1:] + a[:-1])).max() < 1e-14 * N**3
    for end, k in ((0, 0), (1, N)):
        assert np.allclose(q[k], values[end, 0], atol=1e-14)
        assert np.allclose(w[k], values[end, 1], atol=1e-13 * N)
        if held[end]:
            assert np.allclose(a[k], values[end, 2], atol=1e-13 * N**2)


@pytest.mark.parametrize("held", [(False, False), (True, False), (False, True), (True, True)])
@pytest.mark.parametrize("ends_cost", [True, False])
def test_taps_and_bands_are_those_of_the_full_map(held, ends_cost):
    N = 9
    first, taps, bands = filters(N, *held, ends_cost)
    full = dense_map(N, held)
    from_taps = np.zeros_like(full)
    for k in range(N + 1):
        from_taps[first[k] : first[k] + 3, :, k] = taps[k]
    assert np.abs(from_taps - full).max() < 1e-12
    counted = full[:, :, :] if ends_cost else full[:, :, 1:N]
    for kind in range(3):
        gram = counted[:, kind] @ counted[:, kind].T
        band = np.zeros_like(gram)
        for d in range(3):
            band += np.diag(bands[kind, : N - 1 - d, d], -d)
        lower = np.tril(gram)
        assert np.abs(band - lower).max() < 1e-12 * np.abs(gram).max()


def padded(rows):
    """Rows of whole lanes with zeros behind the joints."""
    wide = np.zeros((*rows.shape[:-1], whole_lanes(rows.shape[-1])))
    wide[..., : rows.shape[-1]] = rows
    return wide


@pytest.mark.parametrize("n", [2, 8, 11])
@pytest.mark.parametrize("N", [4, 12])
def test_pull_back_is_the_transpose_of_push_forward(N, n):
    _, taps, _ = filters(N, True, False, True)
    dx, dual = padded(RNG.normal(size=(N - 1, n))), padded(RNG.normal(size=(3, N + 1, n)))
    z, gradient = np.zeros_like(dual), np.zeros_like(dx)
    push_forward(taps, dx, z)
    for kind in range(3):
        pull_back(kind, taps, dual[kind], gradient)
    assert np.isclose((z * dual).sum(), (dx * gradient).sum(), rtol=1e-12)


@pytest.mark.parametrize("N", [4, 12])
def test_push_forward_is_the_sequence_of_a_motion_that_rests_at_its_ends(N):
    dx = padded(RNG.normal(size=(N - 1, 3)))
    _, taps, _ = filters(N, False, False, True)
    r, z, expected = np.empty((N + 3, 8)), np.zeros((3, N + 1, 8)), np.empty((3, N + 1, 8))
    push_forward(taps, dx, z)
    sequence(dx, np.zeros((2, 3, 8)), (False, False), r)
    filtered(r, expected)
    assert np.abs(z - expected).max() < 1e-14 * N**2


def test_unknowns_of_a_sequence_are_those_that_it_was_made_of():
    N, T = 9, 1.7
    x, values = padded(RNG.normal(size=(N - 1, 3))), padded(RNG.normal(size=(2, 3, 3)))
    r, z, found = np.empty((N + 3, 8)), np.empty((3, N + 1, 8)), np.empty_like(x)
    sequence(x, values, (False, False), r)
    filtered(r, z)
    z[2] /= T**2  # q̈ of a
    unknowns_of(z, T, found)
    assert np.abs(found - x).max() < 1e-13


@pytest.mark.parametrize("size", [3, 4, 40])
@pytest.mark.parametrize("n", [5, 8, 11])
def test_factorisation_solves_pentadiagonal_systems(size, n):
    matrices = np.zeros((n, size, size))
    for j in range(n):
        B = np.tril(np.triu(RNG.normal(size=(size, size)), -2))
        matrices[j] = B @ B.T + size * np.eye(size)
    matrices = np.array([np.tril(np.triu(m, -2), 2) for m in matrices])
    band = np.zeros((size, 3, whole_lanes(n)))
    band[:, 0] = 1.0
    for j in range(n):
        for d in range(3):
            band[: size - d, d, j] = np.diagonal(matrices[j], -d)
    b, c = RNG.normal(size=(2, size, n))
    x, y, z = padded(b), padded(b), padded(c)
    factorise(band)
    substitute(band, x)
    substitute_both(band, y, z)
    for side, solution in ((b, x), (b, y), (c, z)):
        expected = np.array([np.linalg.solve(matrices[j], side[:, j]) for j in range(n)]).T
        assert np.abs(solution - padded(expected)).max() < 1e-12
