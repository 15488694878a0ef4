"""Frames recorded and replayed: the same estimates to the last bit; and what the loop does when nothing is seen."""

from dataclasses import replace
from typing import cast

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.closed_loop.recorded_poses import RecordedPoses
from dyngrasp.closed_loop.replanning_loop import ReplanningLoop, ReplanningSettings, grasp_point_deviation
from dyngrasp.closed_loop.vision_record import ARRAY_NAMES, VisionRecord
from dyngrasp.errors import InputFileError, InvalidProblem
from dyngrasp.models.catalogue import load_camera
from dyngrasp.perception.marker_detection import MarkerCorners
from dyngrasp.perception.marker_pose import MarkerPoseSolver, corners_in_object
from dyngrasp.perception.part_tracker import Frame, PartTracker, PartTrackerSettings
from dyngrasp.perception.pose_filter import PoseFilterSettings, PoseUnknown
from dyngrasp.perception.pose_track import CameraErrors
from dyngrasp.planning.replanning.replanner import Replanner
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.plant import Truth

RATE = 30.0
ABOVE = np.deg2rad([0.0, -5.0, 0.0, -95.0, 0.0, 90.0, 0.0])
CAMERA = load_camera("ava1000").scaled(640, 480)

# A source that looked at the truth would fail here.
UNSEEN = cast(Truth, None)


class Approach:
    """An arm that moves over the part, seen by the camera's equations with noise; no renderer."""

    def __init__(self, planned):
        self.task = planned.task
        part = self.task.grasp_object
        spot = self.camera_at(ABOVE).translation[:2]
        self.T_part = pin.SE3(pin.utils.rotate("z", 2.6), np.array([spot[0] + 0.02, spot[1], 0.1]))
        self.prior = PoseEstimate(
            self.T_part * pin.exp6(np.array([0.012, -0.016, 0.0, 0.0, 0.0, 0.05])),
            np.diag(np.repeat([0.03, 0.17], 3) ** 2),
            0.0,
            0.0,
        )
        self.facing = [marker for marker in part.markers if (self.T_part * marker.T_object_marker).rotation[2, 2] > 0.9]

    def camera_at(self, q):
        task = self.task
        return task.robot.forward_kinematics(q) * task.gripper.T_flange_hand * CAMERA.T_hand_camera

    def frames(self, count, seed=0, blind_from=np.inf):
        """Pictures of the markers on the upper side, to 0.2 pixels; from one time on nothing is seen."""
        rng = np.random.default_rng(seed)
        speed = np.deg2rad([4.0, 3.0, 0.0, 0.0, 0.0, -4.0, 5.0])
        taken = []
        for k in range(count):
            t = k / RATE
            q = ABOVE + speed * t
            T = self.camera_at(q).actInv(self.T_part)
            markers = []
            for marker in self.facing if t < blind_from else ():
                pixels, _ = CAMERA.project(np.array([T.act(p) for p in corners_in_object(marker)]))
                markers.append(MarkerCorners(marker.id, pixels + rng.normal(scale=0.2, size=(4, 2))))
            taken.append(Frame(t, t + 0.013, q, tuple(markers)))
        assert len(self.facing) >= 2
        return taken

    def tracker(self, prior=True, **settings):
        solver = MarkerPoseSolver(CAMERA, self.task.grasp_object)
        return PartTracker(
            solver,
            self.task.robot,
            self.task.gripper,
            self.prior if prior else None,
            PartTrackerSettings(**settings),
        )


@pytest.fixture(scope="module")
def approach(planned):
    return Approach(planned)


def numbers(estimate):
    parts = (estimate.T_world_object.homogeneous, estimate.covariance, estimate.twist_world)
    return np.concatenate([np.ravel(part) for part in parts])


def live(tracker, frames, asked):
    """As the camera does it: a frame becomes known after its capture, questions come in between."""
    answers, left = [], list(frames)
    for t in asked:
        while left and left[0].t_capture <= t:
            tracker.expect(left.pop(0))
        answers.append(tracker.estimate(t))
    return answers


ASKED = np.arange(1, 13) * 0.1


def test_a_replay_gives_the_same_estimates_bit_for_bit(approach, tmp_path):
    tracker = approach.tracker()
    answers = live(tracker, approach.frames(36), ASKED)
    # Asking less often than pictures come must not matter, nor must a stay on disk.
    record = VisionRecord(
        approach.task.robot.joint_names, CAMERA, approach.prior, tuple(tracker.reports), meta={"a": 1}
    )
    record.save(tmp_path / "vision.npz")
    loaded = VisionRecord.load(tmp_path / "vision.npz")
    assert loaded.prior is not None
    solver = MarkerPoseSolver(loaded.camera, approach.task.grasp_object)
    replayed = PartTracker(solver, approach.task.robot, approach.task.gripper, loaded.prior)
    source = RecordedPoses(replayed, reversed(loaded.frames))
    for t, answer in zip(ASKED, answers, strict=True):
        np.testing.assert_array_equal(numbers(source.estimate(None, t)), numbers(answer))
    assert len(replayed.reports) == len(tracker.reports) == 36
    for one, other, stored in zip(replayed.reports, tracker.reports, loaded.reports, strict=True):
        assert one.verdict == other.verdict == stored.verdict
        assert one.ratio == other.ratio == stored.ratio
        np.testing.assert_array_equal(numbers(one.estimate), numbers(other.estimate))
        np.testing.assert_array_equal(numbers(stored.estimate), numbers(other.estimate))
    assert loaded.meta == {"a": 1}
    assert loaded.arm_joints == approach.task.robot.joint_names


def test_other_settings_give_other_estimates_of_the_same_frames(approach):
    frames = approach.frames(20)
    mounts = [CameraErrors(mount=(mount, 0.0)) for mount in (0.0, 2e-3)]
    trackers = [approach.tracker(filter=replace(PoseFilterSettings.still(), camera=camera)) for camera in mounts]
    exact, doubtful = (RecordedPoses(tracker, frames).estimate(None, 0.7).covariance for tracker in trackers)
    # The hand hardly turns: what the mount may be off by, the part may be off by.
    assert (np.linalg.eigvalsh(doubtful[:3, :3] - exact[:3, :3]) > (1e-3) ** 2).all()


def test_without_a_prior_the_first_frames_begin(approach, tmp_path):
    tracker = approach.tracker(prior=False)
    with pytest.raises(PoseUnknown):
        tracker.estimate(0.0)
    for frame in approach.frames(8):
        tracker.look(frame)
    known = [report.estimate is not None for report in tracker.reports]
    assert known == [False] * 3 + [True] * 5
    record = VisionRecord(approach.task.robot.joint_names, CAMERA, None, tuple(tracker.reports))
    record.save(tmp_path / "vision.npz")
    loaded = VisionRecord.load(tmp_path / "vision.npz")
    assert loaded.prior is None
    assert [report.estimate is not None for report in loaded.reports] == known


def test_an_episode_in_which_nothing_was_filmed_can_be_stored(approach, tmp_path):
    record = VisionRecord(approach.task.robot.joint_names, CAMERA, approach.prior, ())
    record.save(tmp_path / "vision.npz")
    assert VisionRecord.load(tmp_path / "vision.npz").reports == ()


@pytest.mark.parametrize("lacking", ["missing", "text", "marker_id", "format"])
def test_files_that_are_no_record_are_refused(approach, tmp_path, lacking):
    path = tmp_path / "vision.npz"
    if lacking == "text":
        path.write_text("no archive")
    elif lacking != "missing":
        VisionRecord(approach.task.robot.joint_names, CAMERA, approach.prior, ()).save(path)
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in ("header", *ARRAY_NAMES)}
        if lacking == "format":
            arrays["header"] = np.array(str(arrays["header"]).replace("dyngrasp.vision", "dyngrasp.sound"))
        else:
            del arrays[lacking]
        np.savez(path, **arrays)
    with pytest.raises(InputFileError, match=r"vision\.npz"):
        VisionRecord.load(path)


def test_the_deviation_of_the_grasp_point_counts_turns(planned):
    grasp = planned.targets.grasp
    p = grasp.T_object_grasp.translation
    assert np.linalg.norm(p[:2]) > 0 or abs(p[2]) > 0
    turn = np.diag([0.0, 0.0, 0.0, 0.02**2, 0.02**2, 0.02**2])
    shift = np.diag([0.003**2, 0.001**2, 0.001**2, 0.0, 0.0, 0.0])
    T = planned.targets.T_world_object
    assert grasp_point_deviation(PoseEstimate(T, shift, 0.0, 0.0), grasp) == pytest.approx(0.003)
    expected = 0.02 * np.linalg.norm(p)
    assert grasp_point_deviation(PoseEstimate(T, turn, 0.0, 0.0), grasp) == pytest.approx(expected)


class TestNothingIsSeen:
    """The fingers hide the markers: the filter coasts, and past the bound no update is taken."""

    BLIND = 1.0

    def loop(self, planned, approach, bound, **settings):
        frames = approach.frames(75, blind_from=self.BLIND)
        source = RecordedPoses(approach.tracker(**settings), frames)
        loop = ReplanningLoop(
            Replanner(planned.task, clock=lambda: 0.0),
            source,
            planned.plan,
            planned.targets,
            ReplanningSettings(rate=10.0, latency=0.02, largest_deviation=bound),
        )
        return loop, source

    def test_updates_end_when_the_bound_is_passed_and_not_before(self, planned, approach):
        moving = PoseFilterSettings()
        loop, source = self.loop(planned, approach, 0.005, filter=moving)
        asked, deviations = [], []
        for k in range(250):
            t = k * 0.01
            due = k % 10 == 0
            loop.plan_at(t, due, UNSEEN)
            if due:
                asked.append(t)
                deviations.append(grasp_point_deviation(source.estimate(None, t), planned.targets.grasp))
        # In the hand it does not matter any more where the part was.
        in_hand = loop.newest.phase_ends[1]
        vague = [t for t, deviation in zip(asked, deviations, strict=True) if deviation > 0.005 and t < in_hand]
        assert loop.not_taken == vague
        taken = [event.t for event in loop.events]
        assert sorted(taken + vague) == asked
        # Before anything has arrived the prior of 30 mm is too vague; then all is taken until some time after the loss.
        assert vague[0] == 0.0
        lost = [t for t in vague if t > 0.0]
        assert lost[0] > self.BLIND
        assert lost == [t for t in asked if lost[0] <= t < in_hand]
        assert len(lost) >= 4
        assert {event.result.message for event in loop.events if event.t >= in_hand} == {"the part is in the hand"}
        # White acceleration of density 0.05 m/s²/√Hz: 5 mm after (3·(0.005/0.05)²)^⅓ = 0.31 s if pose and velocity were
        # known exactly; they are not, and turns of the part move the grasp point too.
        assert lost[0] <= self.BLIND + 0.35

    def test_a_part_that_lies_still_stays_known(self, planned, approach):
        loop, _ = self.loop(planned, approach, 0.005)
        for k in range(250):
            loop.plan_at(k * 0.01, k % 10 == 0, UNSEEN)
        assert loop.not_taken == [0.0]

    def test_without_a_bound_every_update_is_taken(self, planned, approach):
        loop, _ = self.loop(planned, approach, np.inf, filter=PoseFilterSettings())
        for k in range(250):
            loop.plan_at(k * 0.01, k % 10 == 0, UNSEEN)
        assert loop.not_taken == []

    @pytest.mark.parametrize("bound", [0.0, -1.0, np.nan])
    def test_bounds_that_are_none_are_refused(self, bound):
        with pytest.raises(InvalidProblem):
            replace(ReplanningSettings(), largest_deviation=bound)
