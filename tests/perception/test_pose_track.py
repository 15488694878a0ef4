"""The error dynamics of the track against finite differences and against what random motions really do."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.perception.pose_track import MotionSettings, TrackState, begin, correct, innovation, predict
from dyngrasp.signals import PoseEstimate

QUIET = MotionSettings((0.0, 0.0), (0.0, 0.0), (0.0, 0.0))


def state(seed=1, covariance=None):
    random = np.random.default_rng(seed)
    T = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3))
    A = random.normal(size=(12, 12)) * np.repeat([1e-3, 5e-3, 2e-2, 5e-2], 3)[:, None]
    return TrackState(0.4, T, random.normal(size=6), A @ A.T if covariance is None else covariance)


def disturbed(s: TrackState, delta: np.ndarray) -> TrackState:
    return TrackState(s.t, s.T_world_object * pin.exp6(delta[:6]), s.twist_world + delta[6:], s.covariance)


def difference(true: TrackState, mean: TrackState) -> np.ndarray:
    e = pin.log6(mean.T_world_object.actInv(true.T_world_object)).vector
    return np.concatenate([e, true.twist_world - mean.twist_world])


def test_errors_grow_as_the_covariance_does():
    s, t, step = state(), 0.4 + 0.3, 1e-6
    ahead = predict(s, t, QUIET)
    columns = []
    for axis in range(12):
        ends = [difference(predict(disturbed(s, sign * step * np.eye(12)[axis]), t, QUIET), ahead) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    F = np.column_stack(columns)
    expected = F @ s.covariance @ F.T
    # Central differences with a step of 1e-6: 1e-9 relative and better.
    np.testing.assert_allclose(ahead.covariance, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def test_prediction_in_two_steps_is_that_in_one():
    motion = MotionSettings((0.3, 0.5), (0.4, 0.7), (1e-3, 2e-3))
    s = state()
    once = predict(s, 0.9, motion)
    twice = predict(predict(s, 0.55, motion), 0.9, motion)
    np.testing.assert_allclose(once.T_world_object.homogeneous, twice.T_world_object.homogeneous, atol=1e-12)
    # A turning body mixes angular noise of both halves; 20 rad/s·0.5 s would show, 1 rad/s over 0.5 s stays below 3 %.
    np.testing.assert_allclose(np.diag(once.covariance), np.diag(twice.covariance), rtol=0.03)
    np.testing.assert_allclose(once.covariance[:3, :3], twice.covariance[:3, :3], rtol=1e-3, atol=1e-6)


def test_constant_velocity_is_what_it_says():
    s = state()
    ahead = predict(s, 1.4, QUIET)
    np.testing.assert_allclose(
        ahead.T_world_object.translation, s.T_world_object.translation + s.twist_world[:3], atol=1e-12
    )
    np.testing.assert_allclose(
        ahead.T_world_object.rotation, pin.exp3(s.twist_world[3:]) @ s.T_world_object.rotation, atol=1e-12
    )
    assert predict(s, s.t, QUIET) is s


def test_white_acceleration_spreads_as_predicted():
    motion = MotionSettings((0.0, 0.0), (0.3, 0.6), (2e-3, 4e-3))
    random = np.random.default_rng(4)
    mean = TrackState(0.0, pin.SE3(pin.exp3(np.array([0.3, -0.8, 0.5])), np.zeros(3)), np.zeros(6), np.zeros((12, 12)))
    T, steps, runs = 0.6, 60, 1500
    h = T / steps
    errors = np.empty((runs, 12))
    for run in range(runs):
        pose, twist = mean.T_world_object, np.zeros(6)
        for _ in range(steps):
            walk = random.normal(size=6) * np.repeat([2e-3, 4e-3], 3) * np.sqrt(h)
            pose = pose * pin.exp6(walk)
            before = twist
            twist = twist + random.normal(size=6) * np.repeat([0.3, 0.6], 3) * np.sqrt(h)
            mid = 0.5 * (before + twist)
            pose = pin.SE3(pin.exp3(mid[3:] * h) @ pose.rotation, pose.translation + mid[:3] * h)
        errors[run] = difference(TrackState(T, pose, twist, np.zeros((12, 12))), mean)
    sample = np.cov(errors.T)
    predicted = predict(mean, T, motion).covariance
    # A variance from 1500 runs has a standard deviation of 3.7 %; the largest of twelve stays within four of them.
    np.testing.assert_allclose(np.diag(sample), np.diag(predicted), rtol=0.15)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    np.testing.assert_allclose(sample / scale, predicted / scale, atol=0.12)


def test_a_correction_is_bayes_rule():
    # Small errors make the group flat: the Kalman filter is then the product of two Gaussians.
    s = state(covariance=np.diag(np.repeat([1e-3, 2e-3, 1e-2, 2e-2], 3) ** 2))
    s = predict(s, 0.5, QUIET)
    measured = s.T_world_object * pin.exp6(np.array([1, -2, 0.5, 2, 1, -1]) * 1e-5)
    R = np.diag(np.repeat([5e-4, 1e-3], 3) ** 2)
    corrected = correct(s, PoseEstimate(measured, R, 0.5, 0.5))
    # The error of the measurement is one of T_measured, the difference one of T: they differ by the logarithm's slope.
    slope = pin.Jlog6(s.T_world_object.actInv(measured))
    information = np.linalg.inv(s.covariance)
    information[:6, :6] += np.linalg.inv(slope @ R @ slope.T)
    expected = np.linalg.inv(information)
    np.testing.assert_allclose(corrected.covariance, expected, rtol=1e-3, atol=1e-10)
    r, S, distance = innovation(s, PoseEstimate(measured, R, 0.5, 0.5))
    moved = expected[:, :6] @ np.linalg.solve(slope @ R @ slope.T, r)
    np.testing.assert_allclose(difference(corrected, s), moved, rtol=1e-3, atol=1e-10)
    assert distance == pytest.approx(r @ np.linalg.inv(S) @ r)


def test_a_track_begins_with_its_measurement():
    R = np.diag(np.arange(1.0, 7.0)) * 1e-6
    estimate = PoseEstimate(pin.SE3.Identity(), R, 2.0, 2.1)
    begun = begin(estimate, MotionSettings((0.2, 0.4)))
    assert begun.t == 2.0
    np.testing.assert_array_equal(begun.covariance[:6, :6], R)
    np.testing.assert_allclose(np.sqrt(np.diag(begun.covariance)[6:]), [0.2] * 3 + [0.4] * 3)


@pytest.mark.parametrize("pair", [(-1.0, 0.0), (0.0, np.nan), (1.0,)])
def test_impossible_motions_are_refused(pair):
    with pytest.raises(InvalidProblem, match="acceleration"):
        MotionSettings(acceleration=pair)
