import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from dyngrasp.experiments.statistics import timing_summary, wilson


@given(st.integers(1, 2000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_agrees_with_scipy(counts):
    successes, trials = counts
    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    ours = wilson(successes, trials)
    assert ours.low == pytest.approx(interval.low, abs=1e-12)
    assert ours.high == pytest.approx(interval.high, abs=1e-12)
    assert ours.low <= ours.share <= ours.high


def test_the_papers_nineteen_of_twenty_says_little():
    ours, rival = wilson(19, 20), wilson(15, 20)
    assert ours.low < rival.high


def test_no_trials_know_nothing():
    assert (wilson(0, 0).low, wilson(0, 0).high) == (0.0, 1.0)
    assert math.isnan(wilson(0, 0).share)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 3), (4, 3)])
def test_impossible_counts(successes, trials):
    with pytest.raises(ValueError, match="successes"):
        wilson(successes, trials)


def test_timing_summary_leaves_out_what_was_not_measured():
    summary = timing_summary([1.0, 2.0, np.nan, 9.0])
    assert summary == {"median_ms": 2.0, "p99_ms": pytest.approx(8.86), "max_ms": 9.0, "n": 3}
    assert timing_summary([])["n"] == 0
