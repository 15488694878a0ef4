"""The benchmark's rows on a few pictures."""

import numpy as np
import pytest

from dyngrasp.errors import RenderingUnavailable
from dyngrasp.experiments.bench_perception import FRAMES, bench_perception
from dyngrasp.simulation import gl_backend


def test_rows_hold_times_and_errors():
    try:
        gl_backend.require()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    rows = bench_perception(2, seed=3, resolution=(640, 480), distances=(0.45,))
    stages = {row["stage"]: row for row in rows}
    assert list(stages) == ["detect", "pose", "filter", "frame", "accuracy"]
    for name in ("detect", "pose", "filter", "frame"):
        row = stages[name]
        assert row["n"] == 2 * FRAMES
        assert 0 < row["median_ms"] <= row["p99_ms"] <= row["max_ms"]
    accuracy = stages["accuracy"]
    assert accuracy["acquired"] == accuracy["runs"] == 2
    # The bounds that are asked of the larger pictures; a wrong pose of a square would be off by 20 mm.
    assert 0 < accuracy["rms_mm"] < 1.5
    assert 0 < accuracy["rms_deg"] < 0.7
    assert np.isfinite(accuracy["nees"])
