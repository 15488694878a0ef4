"""Eight numbers as one value: operators against numpy, and nothing read or written beyond a row."""

import numpy as np
import pytest
from numba import njit

from dyngrasp.lanes import (
    LANES,
    any_below,
    lanes_of,
    load,
    narrow,
    store,
    sum_of,
    whole_lanes,
    widen,
)

RNG = np.random.default_rng(0)


@njit
def combined(a, b, out):
    x, y = load(a, 0, LANES), load(b, 0, LANES)
    store((2.0 * x - y / 3.0) * y + (1.0 / x - 0.5), out, 0, LANES)
    return sum_of(x)


@njit
def below(a, bound):
    return any_below(load(a, 0, LANES), lanes_of(bound))


def test_operators_are_those_of_numbers():
    a, b, out = RNG.uniform(1.0, 2.0, LANES), RNG.normal(size=LANES), np.empty(LANES)
    total = combined(a, b, out)
    # Products and sums may be rounded once instead of twice.
    assert np.abs(out - ((2 * a - b / 3) * b + (1 / a - 0.5))).max() < 1e-14
    assert np.isclose(total, a.sum(), rtol=1e-15)


@pytest.mark.parametrize("lane", range(LANES))
def test_any_lane_below_is_seen_and_none_that_is_not_a_number(lane):
    a = np.ones(LANES)
    assert not below(a, 1.0)
    a[lane] = np.nan
    assert not below(a, 1.0)
    a[lane] = 0.9
    assert below(a, 1.0)


@pytest.mark.parametrize("n", [1, 2, 7, 8, 9, 16, 17])
def test_rows_are_widened_with_zeros_and_narrowed_without_touching_what_follows(n):
    count = 5
    rows, wide = RNG.normal(size=(count, n)), np.full((count, whole_lanes(n)), np.nan)
    widen(rows, wide)
    assert np.array_equal(wide[:, :n], rows)
    assert not wide[:, n:].any()
    around = np.full(n * (count + 2) + 2 * LANES, 7.0)
    narrow(0.5, wide, 0, around[LANES : LANES + n * count].reshape(count, n))
    assert np.array_equal(around[LANES : LANES + n * count], 0.5 * rows.ravel())
    assert (np.delete(around, slice(LANES, LANES + n * count)) == 7.0).all()


@pytest.mark.parametrize(("first", "n"), [(7, 1), (7, 4), (3, 4), (6, 10)])
def test_some_columns_are_narrowed(first, n):
    wide = RNG.normal(size=(5, 16))
    out = np.empty((5, n))
    narrow(2.0, wide, first, out)
    assert np.array_equal(out, 2.0 * wide[:, first : first + n])
