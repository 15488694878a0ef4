"""The filter on rendered approaches: as uncertain as it says, and a filter that is wrong by a factor is found out."""

import numpy as np
import pytest
from scipy.stats import chi2

from dyngrasp.errors import RenderingUnavailable
from dyngrasp.experiments.filmed_approach import film_set
from dyngrasp.experiments.filter_consistency import MOUNT_SHIFT, MOUNT_TURN, Outcome, draw_mount, follow, summary
from dyngrasp.simulation import gl_backend

RUNS, FRAMES, SEED = 3, 20, 71


@pytest.fixture(scope="module")
def filmed():
    """A function that runs the filter over the same films again, with standard deviations times a factor."""
    try:
        gl_backend.require()
    except RenderingUnavailable as error:
        pytest.skip(str(error))
    with film_set(seed=SEED) as films:
        shot = []
        for motion in ("still", "conveyor"):
            for run in range(RUNS):
                rng = np.random.default_rng([SEED, run, motion == "still"])
                shot.append((films.shoot(rng, motion, frames=FRAMES), motion, draw_mount(rng)))

        def outcomes(scale):
            return [follow(films, film, motion, mount, scale) for film, motion, mount in shot]

        yield outcomes


def bounds(runs):
    # One in a thousand for a filter that is right; factors of three in the standard deviation are 54 and 0.7.
    return chi2.ppf([0.0005, 0.9995], 6 * runs) / runs


def test_errors_on_rendered_pictures_are_as_large_as_the_filter_says(filmed):
    outcomes = filmed(1.0)
    for row in (*summary("still", outcomes[:RUNS]), *summary("conveyor", outcomes[RUNS:])):
        low, high = bounds(RUNS)
        assert row["known"] == row["runs"] == RUNS
        assert low < row["nees"] < high
        assert row["refused_percent"] == 0.0
        # Mostly the mount, half a metre away; a wrong pose of a square would be off by 20 mm and 20 degrees.
        assert row["rms_mm"] < 3.0
        assert row["rms_deg"] < 1.5


@pytest.mark.parametrize("scale", [1 / 3, 3.0])
def test_a_filter_that_is_wrong_by_a_factor_of_three_is_found_out(filmed, scale):
    outcomes = filmed(scale)
    nees = np.mean([outcome.normalised for outcome in outcomes])
    low, high = bounds(2 * RUNS)
    assert nees < low / 2 if scale > 1.0 else nees > 1.5 * high


def test_mounts_are_as_wrong_as_stated_in_every_direction():
    rng = np.random.default_rng(0)
    mounts = [draw_mount(rng) for _ in range(200)]
    shifts = np.array([mount.translation for mount in mounts])
    np.testing.assert_allclose(np.linalg.norm(shifts, axis=1), MOUNT_SHIFT)
    # Directions are even: the mean of 200 unit vectors is about 0.07 long.
    assert np.linalg.norm(shifts.mean(axis=0)) < 0.2 * MOUNT_SHIFT
    assert all(np.arccos((np.trace(m.rotation) - 1) / 2) == pytest.approx(MOUNT_TURN, rel=1e-4) for m in mounts)


def test_a_row_counts_what_it_says():
    error = np.tile([[3e-3, 0.0, 4e-3, 0.0, 0.1, 0.0]], (4, 1))
    known = Outcome(error, np.full(4, 6.0), refused=0.25)
    unknown = Outcome(np.full((4, 6), np.nan), np.full(4, np.nan), refused=0.25)
    rows = summary("still", [known, known, unknown])
    assert [row["frames"] for row in rows] == [10, 20, 30, 40]
    for row in rows:
        assert (row["runs"], row["known"], row["within"]) == (3, 2, True)
        assert row["rms_mm"] == pytest.approx(5.0)
        assert row["rms_deg"] == pytest.approx(np.rad2deg(0.1))
        assert row["nees"] == 6.0
        assert row["refused_percent"] == pytest.approx(25.0)
        assert (row["low"], row["high"]) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 12) / 2))
    (empty, *_) = summary("still", [unknown])
    assert empty["known"] == 0
    assert not empty["within"]
