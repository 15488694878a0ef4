"""The fit finds the parameters that errors were drawn with."""

from pathlib import Path

import numpy as np
import pytest

from dyngrasp.experiments.pose_noise_fit import MOUNT_ERROR, PoseErrors, fit_pose_noise
from dyngrasp.experiments.scenario import load_scenario

FILMS, FRAMES, STEP = 200, 40, 1 / 30


def drawn(position, angle, tau, seed=0):
    """Errors of approaches from 0.4 m to 0.1 m; the first three frames of each know nothing."""
    rng = np.random.default_rng(seed)
    distance = np.tile(np.linspace(0.4, 0.1, FRAMES), FILMS)
    kept = np.exp(-STEP / tau)
    unit = np.empty((FILMS, FRAMES, 6))
    unit[:, 0] = rng.normal(size=(FILMS, 6))
    for k in range(1, FRAMES):
        unit[:, k] = kept * unit[:, k - 1] + np.sqrt(1 - kept**2) * rng.normal(size=(FILMS, 6))
    terms = np.array([position, angle])
    deviation = np.repeat(terms[:, :1] + terms[:, 1:] * distance**2, 3, axis=0).T
    filtered = deviation * unit.reshape(-1, 6)
    filtered[np.tile(np.arange(FRAMES) < 3, FILMS)] = np.nan
    times = np.tile(np.linspace(0.0, STEP * (FRAMES - 1), FRAMES), FILMS)
    ball = rng.normal(size=(4000, 3))
    ball *= 1e-3 * rng.uniform(size=(4000, 1)) ** (1 / 3) / np.linalg.norm(ball, axis=1)[:, None]
    turn = rng.normal(size=(4000, 3))
    turn *= np.deg2rad(0.3) * rng.uniform(size=(4000, 1)) / np.linalg.norm(turn, axis=1)[:, None]
    film = np.repeat(np.arange(float(FILMS)), FRAMES)
    return PoseErrors(film, times, distance, filtered, filtered, np.hstack([ball, turn]))


def test_parameters_are_found():
    position, angle = (5e-5, 2e-3), (1e-3, 3e-2)
    fit = fit_pose_noise(drawn(position, angle, tau=0.4))
    s = fit.settings
    # 200 films of about three correlation times and three axes: deviations are known to some 2 %, τ to 5 %.
    for d in (0.12, 0.25, 0.4):
        expected = np.repeat([position[0] + position[1] * d**2, angle[0] + angle[1] * d**2], 3)
        np.testing.assert_allclose(s.deviation(d), expected, rtol=0.08)
    assert s.correlation_time == pytest.approx(0.4, rel=0.15)
    assert s.residual_position == pytest.approx(1e-3, rel=0.05)
    assert s.residual_angle == pytest.approx(np.deg2rad(0.3), rel=0.05)
    rows = fit.rows()
    assert rows[0]["from_m"] == pytest.approx(0.1)
    assert rows[-1]["to_m"] == pytest.approx(0.4)
    for row in rows:
        assert row["films"] == FILMS
        assert row["filter_mm"] == pytest.approx(row["model_mm"], rel=0.15)
        assert row["filter_deg"] == pytest.approx(row["model_deg"], rel=0.15)


def test_errors_that_do_not_grow_are_constant():
    s = fit_pose_noise(drawn((2e-4, 0.0), (2e-3, 0.0), tau=0.2, seed=1)).settings
    np.testing.assert_allclose(s.deviation(0.25), np.repeat([2e-4, 2e-3], 3), rtol=0.05)
    assert s.frame_position_growth * 0.4**2 < 0.1 * s.frame_position


def test_the_mounts_error_is_that_of_the_camera_scenario():

    camera = load_scenario(Path(__file__).parents[2] / "scenarios" / "camera_sdh2.toml").camera
    assert (1e-3 * camera.mount_mm, np.deg2rad(camera.mount_deg)) == pytest.approx(MOUNT_ERROR)
