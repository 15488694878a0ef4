"""What the noise model reveals and when."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.perception.pose_noise import PoseNoise, PoseNoiseSettings

T_OBJECT_GRASP = pin.SE3(pin.utils.rotate("x", 0.2), np.array([0.01, -0.02, 0.05]))
FIRST = pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.1])), np.array([0.02, 0.0, 0.0]))
T = pin.SE3(pin.utils.rotate("z", 1.0), np.array([0.6, 0.1, 0.0]))
SILENT = PoseNoiseSettings(residual_position=0.0, residual_angle=0.0, frame_position=0.0, frame_angle=0.0)


def error(noise, distance):
    """Of the estimated grasp frame in the true one, seen from a distance."""
    T_grasp = T * T_OBJECT_GRASP
    eye = T_grasp.translation + np.array([0.0, 0.0, distance])
    estimate = noise.estimate(T, eye, 1.0)
    return pin.log6(T_grasp.actInv(estimate.T_world_object * T_OBJECT_GRASP)).vector


def test_far_away_all_of_the_first_error_is_there_and_near_none():
    noise = PoseNoise(FIRST, T_OBJECT_GRASP, SILENT, 0)
    assert np.allclose(error(noise, 1.0), pin.log6(FIRST).vector, atol=1e-12)
    assert np.abs(error(noise, 0.1)).max() < 1e-12
    half = (SILENT.reveal_from + SILENT.reveal_to) / 2
    assert np.allclose(error(noise, half), 0.5 * pin.log6(FIRST).vector, atol=1e-12)


def test_the_residual_is_drawn_once_within_its_size_and_stays():
    settings = PoseNoiseSettings(frame_position=0.0, frame_angle=0.0)
    for seed in range(20):
        noise = PoseNoise(FIRST, T_OBJECT_GRASP, settings, seed)
        first, again = error(noise, 0.1), error(noise, 0.1)
        assert np.allclose(first, again, atol=1e-12)
        # log6 mixes turn and offset: at half a degree by less than a hundredth
        assert np.linalg.norm(first[:3]) < 1.01 * settings.residual_position
        assert np.linalg.norm(first[3:]) < 1.01 * settings.residual_angle
        assert np.abs(first).max() > 0


def test_frames_scatter_as_stated_and_the_covariance_says_so():
    settings = PoseNoiseSettings(residual_position=0.0, residual_angle=0.0)
    noise = PoseNoise(pin.SE3.Identity(), T_OBJECT_GRASP, settings, 3)
    errors = np.array([error(noise, 0.1) for _ in range(400)])
    # 400 draws: the standard deviation is known to 3.5 %, four times that is not passed by chance
    assert np.allclose(errors[:, :3].std(axis=0), settings.frame_position, rtol=0.15)
    assert np.allclose(errors[:, 3:].std(axis=0), settings.frame_angle, rtol=0.15)
    covariance = noise.estimate(T, T.translation, 0.0).covariance
    assert np.allclose(np.sqrt(np.diag(covariance)), np.repeat([settings.frame_position, settings.frame_angle], 3))


def test_equal_seeds_give_equal_estimates():
    a, b, c = (PoseNoise(FIRST, T_OBJECT_GRASP, PoseNoiseSettings(), seed) for seed in (5, 5, 6))
    assert np.array_equal(error(a, 0.2), error(b, 0.2))
    assert not np.array_equal(error(a, 0.2), error(c, 0.2))


@pytest.mark.parametrize(
    "bad", [{"reveal_to": 0.5}, {"reveal_to": -0.1}, {"frame_position": -1e-3}, {"residual_angle": np.nan}]
)
def test_bad_settings_are_refused(bad):
    with pytest.raises(InvalidProblem):
        PoseNoiseSettings(**bad)
