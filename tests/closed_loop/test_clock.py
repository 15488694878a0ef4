"""Rates derived from the control rate."""

import numpy as np
import pytest

from dyngrasp.closed_loop.clock import Clock
from dyngrasp.errors import InvalidProblem


@pytest.mark.parametrize("period", [1e-3, 125e-6])
def test_slower_rates_keep_their_mean(period):
    ticks = list(Clock(period, start=2.0, end=5.0, replan_rate=30.0, record_rate=250.0))
    assert len(ticks) == round(3.0 / period)
    assert [sum(getattr(t, name) for t in ticks) for name in ("replan", "record")] == [90, 750]
    replans = np.array([t.t for t in ticks if t.replan])
    # Each falls on the first tick at or after its due time.
    late = replans - (2.0 + np.arange(90) / 30.0)
    assert late.min() > -1e-9
    assert late.max() < period + 1e-9


def test_times_do_not_drift():
    *_, last = Clock(1e-3, start=0.0, end=100.0)
    assert last.t == pytest.approx(99.999, abs=1e-9)


def test_a_rate_of_zero_never_comes():
    assert not any(t.replan for t in Clock(1e-3, 0.0, 0.1, replan_rate=0.0))


@pytest.mark.parametrize(
    "wrong",
    [{"period": 0.0}, {"period": float("nan")}, {"end": -1.0}, {"record_rate": -1.0}, {"replan_rate": 1001.0}],
)
def test_refuses_what_makes_no_clock(wrong):
    with pytest.raises(InvalidProblem, match="clock"):
        Clock(**({"period": 1e-3, "start": 0.0, "end": 1.0} | wrong))
