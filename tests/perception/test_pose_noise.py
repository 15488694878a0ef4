"""What the noise model reveals and when."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.experiments.scenario import PoseSection
from dyngrasp.perception.pose_noise import PoseNoise, PoseNoiseSettings

T_OBJECT_GRASP = pin.SE3(pin.utils.rotate("x", 0.2), np.array([0.01, -0.02, 0.05]))
FIRST = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.1])), np.array([0.02, 0.0, 0.0]))
T = pin.SE3(pin.utils.rotate("z", 1.0), np.array([0.6, 0.1, 0.0]))
WITHOUT_RESIDUAL = {"residual_position": 0.0, "residual_angle": 0.0}
WITHOUT_NOISE = {"frame_position": 0.0, "frame_angle": 0.0, "frame_position_growth": 0.0, "frame_angle_growth": 0.0}
SILENT = PoseNoiseSettings(**WITHOUT_RESIDUAL, **WITHOUT_NOISE)


def error(noise, distance, t=1.0):
    """Of the estimated grasp frame in the true one, seen from a distance."""
    T_grasp = T * T_OBJECT_GRASP
    eye = T_grasp.translation + np.array([0.0, 0.0, distance])
    estimate = noise.estimate(T, eye, t)
    return pin.log6(T_grasp.actInv(estimate.T_world_object * T_OBJECT_GRASP)).vector


def test_far_away_all_of_the_first_error_is_there_and_near_none():
    noise = PoseNoise(FIRST, T_OBJECT_GRASP, SILENT, 0)
    assert np.allclose(error(noise, 1.0), pin.log6(FIRST).vector, atol=1e-12)
    assert np.abs(error(noise, 0.1)).max() < 1e-12
    half = (SILENT.reveal_from + SILENT.reveal_to) / 2
    assert np.allclose(error(noise, half), 0.5 * pin.log6(FIRST).vector, atol=1e-12)


def test_the_residual_is_drawn_once_within_its_size_and_stays():
    settings = PoseNoiseSettings(**WITHOUT_NOISE)
    for seed in range(20):
        noise = PoseNoise(FIRST, T_OBJECT_GRASP, settings, seed)
        first, again = error(noise, 0.1), error(noise, 0.1)
        assert np.allclose(first, again, atol=1e-12)
        # log6 mixes turn and offset: at half a degree by less than a hundredth
        assert np.linalg.norm(first[:3]) < 1.01 * settings.residual_position
        assert np.linalg.norm(first[3:]) < 1.01 * settings.residual_angle
        assert np.abs(first).max() > 0


@pytest.mark.parametrize("distance", [0.05, 0.3])
def test_frames_scatter_as_stated_and_the_covariance_says_so(distance):
    settings = PoseNoiseSettings(**WITHOUT_RESIDUAL, correlation_time=0.1)
    noise = PoseNoise(pin.SE3.Identity(), T_OBJECT_GRASP, settings, 3)
    # Ten correlation times apart: independent.
    errors = np.array([error(noise, distance, float(t)) for t in range(400)])
    expected = settings.deviation(distance)
    assert expected[0] == pytest.approx(settings.frame_position + settings.frame_position_growth * distance**2)
    # 400 draws: the standard deviation is known to 3.5 %, four times that is not passed by chance
    assert np.allclose(errors.std(axis=0), expected, rtol=0.15)
    eye = (T * T_OBJECT_GRASP).translation + np.array([0.0, 0.0, distance])
    covariance = noise.estimate(T, eye, 400.0).covariance
    assert np.allclose(np.sqrt(np.diag(covariance)), expected)


def test_noise_lasts_as_long_as_stated():
    settings = PoseNoiseSettings(**WITHOUT_RESIDUAL, correlation_time=0.5)
    noise = PoseNoise(pin.SE3.Identity(), T_OBJECT_GRASP, settings, 4)
    step, steps = 0.1, 6000
    unit = np.array([error(noise, 0.2, k * step) for k in range(steps)]) / settings.deviation(0.2)
    for lag in (1, 5, 10):
        found = np.mean(unit[lag:] * unit[:-lag], axis=0) / np.mean(unit**2, axis=0)
        # 600 s are 600 independent values an axis, six axes: known to 0.02, four times that.
        assert found.mean() == pytest.approx(np.exp(-lag * step / settings.correlation_time), abs=0.08)
    independent = PoseNoise(
        pin.SE3.Identity(), T_OBJECT_GRASP, PoseNoiseSettings(**WITHOUT_RESIDUAL, correlation_time=0.0), 4
    )
    unit = np.array([error(independent, 0.2, k * step) for k in range(2000)]) / settings.deviation(0.2)
    assert abs(np.mean(unit[1:] * unit[:-1])) < 0.04


def test_a_scenario_without_keys_has_the_models_own_noise():
    section, settings = PoseSection(), PoseNoiseSettings()
    assert settings.residual_position == pytest.approx(1e-3 * section.residual_mm)
    assert settings.residual_angle == pytest.approx(np.deg2rad(section.residual_deg))
    assert settings.frame_position == pytest.approx(1e-3 * section.frame_mm)
    assert settings.frame_position_growth == pytest.approx(1e-3 * section.frame_mm_per_m2)
    assert settings.frame_angle == pytest.approx(np.deg2rad(section.frame_deg))
    assert settings.frame_angle_growth == pytest.approx(np.deg2rad(section.frame_deg_per_m2))
    assert settings.correlation_time == section.correlation_s


def test_equal_seeds_give_equal_estimates():
    a, b, c = (PoseNoise(FIRST, T_OBJECT_GRASP, PoseNoiseSettings(), seed) for seed in (5, 5, 6))
    assert np.array_equal(error(a, 0.2), error(b, 0.2))
    assert not np.array_equal(error(a, 0.2), error(c, 0.2))


@pytest.mark.parametrize(
    "bad",
    [
        {"reveal_to": 0.5},
        {"reveal_to": -0.1},
        {"frame_position": -1e-3},
        {"residual_angle": np.nan},
        {"correlation_time": -1.0},
    ],
)
def test_bad_settings_are_refused(bad):
    with pytest.raises(InvalidProblem):
        PoseNoiseSettings(**bad)
