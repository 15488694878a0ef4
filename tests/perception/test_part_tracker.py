"""Frames into poses: when they count, where the hand was, and which poses are good enough for the filter."""

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.errors import InvalidProblem
from dyngrasp.models.catalogue import load_camera
from dyngrasp.perception.marker_detection import MarkerCorners
from dyngrasp.perception.marker_pose import MarkerPoseSolver, corners_in_object
from dyngrasp.perception.part_tracker import Frame, PartTracker, PartTrackerSettings
from dyngrasp.perception.pose_filter import PoseUnknown, Verdict
from dyngrasp.signals import PoseEstimate

Q = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])
CAMERA = load_camera("ava1000").scaled(640, 480)


@pytest.fixture(scope="module")
def looking(robot, gripper, casting):
    """A function that makes frames of a part below the hand, and where that part is."""

    def camera_at(q):
        return robot.forward_kinematics(q) * gripper.T_flange_hand * CAMERA.T_hand_camera

    T_part = pin.SE3(pin.utils.rotate("z", 2.6), np.array([*camera_at(Q).translation[:2], 0.1]))
    facing = [marker for marker in casting.markers if (T_part * marker.T_object_marker).rotation[2, 2] > 0.9]
    assert len(facing) >= 2

    def frame(t, receipt=None, q=Q, count=2, noise=0.0, seed=0):
        rng = np.random.default_rng(seed)
        T = camera_at(q).actInv(T_part)
        markers = []
        for marker in facing[:count]:
            pixels, _ = CAMERA.project(np.array([T.act(p) for p in corners_in_object(marker)]))
            markers.append(MarkerCorners(marker.id, pixels + rng.normal(scale=noise or 1e-9, size=(4, 2))))
        return Frame(t, t if receipt is None else receipt, q, tuple(markers))

    return frame, T_part


@pytest.fixture
def tracker(robot, gripper, casting, looking):
    def make(prior=True, **settings):
        believed = looking[1] * pin.SE3(np.eye(3), np.array([0.01, -0.01, 0.0]))
        wide = PoseEstimate(believed, np.diag(np.repeat([0.03, 0.1], 3) ** 2), 0.0, 0.0)
        solver = MarkerPoseSolver(CAMERA, casting)
        return PartTracker(solver, robot, gripper, wide if prior else None, PartTrackerSettings(**settings))

    return make


def distance(estimate, T):
    return np.linalg.norm(estimate.T_world_object.translation - T.translation)


def test_a_frame_counts_from_its_receipt_on(tracker, looking):
    frame, T_part = looking
    tracker = tracker()
    tracker.expect(frame(0.010, receipt=0.030))
    before, after = tracker.estimate(0.0299), tracker.estimate(0.030)
    assert distance(before, T_part) == pytest.approx(0.01 * np.sqrt(2))
    assert distance(after, T_part) < 1e-3
    (report,) = tracker.reports
    assert report.verdict is Verdict.ACCEPTED
    assert report.estimate is not None
    assert report.estimate.t_capture == 0.030


def test_the_hand_is_where_it_was_at_the_capture(tracker, looking):
    frame, T_part = looking
    moved = Q + np.deg2rad([3.0, -2.0, 0.0, 2.0, 0.0, 0.0, 4.0])
    first, second = tracker(), tracker()
    for one, q in ((first, Q), (second, moved)):
        one.look(frame(0.0, q=q))
    np.testing.assert_allclose(distance(first.estimate(0.0), T_part), 0.0, atol=2e-4)
    np.testing.assert_allclose(distance(second.estimate(0.0), T_part), 0.0, atol=2e-4)
    # The same corners with another posture are another place.
    seen = frame(0.0, q=moved)
    third = tracker()
    third.look(Frame(0.0, 0.0, Q, seen.markers))
    assert distance(third.estimate(0.0), T_part) > 5e-3


def test_what_few_markers_say_is_not_enough(tracker, looking):
    frame, _ = looking
    one_marker = tracker(least_markers=2, largest_tilt=1e-6).look(frame(0.0, count=1, noise=0.2))
    assert one_marker.frame.seen != ()
    assert one_marker.verdict is None
    trusted = tracker(least_markers=1).look(frame(0.0, count=1, noise=0.2))
    assert trusted.verdict is not None


def test_a_frame_without_markers_is_reported_and_asks_nobody(tracker):
    report = tracker().look(Frame(0.0, 0.013, Q, ()))
    assert report.verdict is None
    assert report.frame.seen == ()
    assert report.estimate is not None


def test_before_anything_is_known_there_is_no_estimate(tracker, looking):
    frame, _ = looking
    tracker = tracker(prior=False)
    assert tracker.look(frame(0.0)).estimate is None
    with pytest.raises(PoseUnknown):
        tracker.estimate(0.1)


def test_impossible_settings_are_refused():
    with pytest.raises(InvalidProblem):
        PartTrackerSettings(least_markers=0)
