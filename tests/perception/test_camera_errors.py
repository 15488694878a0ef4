"""Errors that one camera's frames share: what averaging leaves of them, and whether the filter says so."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from scipy.stats import chi2

from dyngrasp.perception.pose_filter import PoseFilter, PoseFilterSettings
from dyngrasp.perception.pose_track import CameraErrors, CameraPose, view_change
from dyngrasp.signals import PoseEstimate

FRAME = 1 / 30
SIGMA = np.repeat([6e-4, np.deg2rad(0.3)], 3)
R = np.diag(SIGMA**2)
STILL = PoseFilterSettings.still()


def seen_at_rest(random, t, view):
    """A pose of the part at the world's origin as a camera measures it that has the part at `view`."""
    return CameraPose(pin.exp6(random.normal(size=6) * SIGMA).inverse(), R, t, t, T_camera_object=view)


def test_what_frames_share_is_not_averaged_away():
    """In one view the mount's error and what repeats in the corners stay; only the white share is averaged."""
    random = np.random.default_rng(6)
    camera = CameraErrors(mount=(5e-4, 1e-3), repeating=0.6)
    pose_filter = PoseFilter(replace(STILL, camera=camera))
    view = pin.SE3(pin.exp3(np.array([3.0, 0.2, 0.1])), np.array([0.02, -0.03, 0.4]))
    for k in range(200):
        pose_filter.update(seen_at_rest(random, k * FRAME, view))
    by_mount = view.toActionMatrixInverse() * np.repeat(camera.mount, 3)
    expected = 0.6 * R + by_mount @ by_mount.T
    covariance = pose_filter.estimate(k * FRAME).covariance
    np.testing.assert_allclose(covariance, expected, rtol=0.1, atol=0.02 * expected.max())


def test_what_repeats_is_averaged_as_the_view_changes():
    random = np.random.default_rng(7)
    ends = []
    for change in (0.0, 0.1):
        pose_filter = PoseFilter(replace(STILL, camera=CameraErrors(mount=(0.0, 0.0), repeating=0.9, view_change=0.35)))
        for k in range(100):
            view = pin.SE3(pin.exp3(np.array([0.0, 0.0, k * change])), np.array([0.0, 0.0, 0.4]))
            pose_filter.update(seen_at_rest(random, k * FRAME, view))
        ends.append(np.diag(pose_filter.estimate(k * FRAME).covariance))
    # Ten radians over 0.35: some 14 independent views, each of them counted with what lies between.
    assert (ends[1] < 0.15 * ends[0]).all()


@pytest.mark.parametrize("believed", [0.0, 0.02], ids=["known", "believed 20 mm and 9° aside"])
def test_the_normalised_error_is_that_of_a_camera_with_such_errors(believed):
    """Mount, repeating and white errors drawn as the filter takes them; a first look far from the prior included."""
    random, camera = np.random.default_rng(8), CameraErrors(mount=(3e-4, 1e-3), repeating=0.85)
    normalised = []
    for _ in range(60):
        mount = pin.exp6(random.normal(size=6) * np.repeat(camera.mount, 3))
        aside = np.repeat([believed, 8 * believed], 3)
        true = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3) * 0.3)
        prior = None
        if believed:
            prior = PoseEstimate(true * pin.exp6(random.normal(size=6) * aside), np.diag(aside**2), -FRAME, -FRAME)
        pose_filter = PoseFilter(replace(STILL, camera=camera), prior)
        repeating, before = random.normal(size=6), None
        for k in range(20):
            view = pin.SE3(pin.exp3(np.array([3.0, 0.1, 0.02 * k])), np.array([0.0, 0.0, 0.5 - 0.01 * k]))
            if before is not None:
                kept = np.exp(-view_change(before, view) / camera.view_change)
                repeating = kept * repeating + np.sqrt(1 - kept**2) * random.normal(size=6)
            before = view
            white = np.sqrt(1 - camera.repeating) * random.normal(size=6)
            of_view = SIGMA * (np.sqrt(camera.repeating) * repeating + white)
            T_camera_object = view * pin.exp6(of_view)
            T = true * view.inverse() * mount * T_camera_object
            t = k * FRAME
            pose_filter.update(CameraPose(T, R, t, t + 0.01, T_camera_object=T_camera_object))
        estimate = pose_filter.estimate(t)
        e = pin.log6(estimate.T_world_object.actInv(true)).vector
        normalised.append(e @ np.linalg.solve(estimate.covariance, e))
    low, high = chi2.ppf([0.005, 0.995], 6 * len(normalised)) / len(normalised)
    assert low < np.mean(normalised) < high
