"""The arm stands and looks: when that ends, what it gives, and that the episode goes on where it ended."""

from dataclasses import replace

import numpy as np
import pytest

from dyngrasp.closed_loop.episode import EpisodeSettings, grasp_controller, run_episode
from dyngrasp.closed_loop.first_look import FirstLookSettings, take_first_look
from dyngrasp.closed_loop.pose_source import TruePoses
from dyngrasp.closed_loop.record import Recorder
from dyngrasp.errors import InvalidProblem
from dyngrasp.perception.pose_filter import PoseUnknown
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import build_scene
from dyngrasp.simulation.variation import PlantVariation

PERIOD = 1e-3


class Averaging:
    """A sensor that finds the part after some time and knows it ever better: its variance falls with every second."""

    def __init__(self, found: float, deviation: float):
        self.found, self.deviation = found, deviation

    def estimate(self, truth, t):
        if t < self.found - PERIOD / 2:
            raise PoseUnknown("not seen yet")
        deviation = self.deviation / np.sqrt(1.0 + 10.0 * (t - self.found))
        # Rotations so well known that the translation alone counts.
        return PoseEstimate(truth.T_world_part, np.diag(np.repeat([deviation, 1e-9], 3) ** 2), t, t)


class Look:
    """A plant that deviates as in the studies, and what became of a look in it."""

    def __init__(self, planned, source, settings=None):
        task, plan = planned.task, planned.plan
        self.q, self.hand = plan.arm[0].position[0], plan.gripper[0].position[0]
        scene = build_scene(
            task.robot, task.gripper, task.grasp_object, PlantVariation.draw(np.random.default_rng(2), 7)
        )
        self.plant = MujocoPlant(scene, self.q, self.hand, planned.targets.T_world_object)
        self.recorder = Recorder(plan.arm_joints, plan.gripper_joints, PERIOD)
        self.controller = grasp_controller(task, planned.targets.grasp, PERIOD)
        self.labels = set()
        grasps = task.grasp_object.grasps
        self.found = take_first_look(
            self.q, self.hand, grasps, self.plant, self.controller, source, self.recorder, settings,
            progress=lambda t, label: self.labels.add(label),
        )  # fmt: skip


@pytest.mark.parametrize(
    ("source", "settings", "ended"),
    [
        # Known to 2 mm from the first moment on.
        (Averaging(0.0, 1.9e-3), FirstLookSettings(planning=0.01), 0.0),
        # 2.5 mm at 50 ms; (2.5/2)² = 1 + 10 · 56.25 ms.
        (Averaging(0.05, 2.5e-3), FirstLookSettings(planning=0.01), 0.107),
        (Averaging(0.0, 1.9e-3), FirstLookSettings(shortest=0.08, planning=0.0), 0.08),
        # Never known to 2 mm: what is known then must do.
        (Averaging(0.05, 0.1), FirstLookSettings(longest=0.1, planning=0.03), 0.1),
    ],
)
def test_it_ends_when_the_grasp_point_is_known_well_enough_or_time_is_up(planned, source, settings, ended):
    look = Look(planned, source, settings)
    found = look.found
    assert found.began == 0.0
    assert found.ended == pytest.approx(ended, abs=1e-9)
    assert found.start_time == pytest.approx(ended + settings.planning, abs=1e-9)
    # The plant stands where the motion begins: time has passed for it.
    assert look.plant.t == pytest.approx(found.start_time, abs=1e-9)
    assert found.estimate is not None
    assert found.estimate.t_capture == pytest.approx(ended, abs=1e-9)
    assert found.deviation == pytest.approx(np.sqrt(found.estimate.covariance[0, 0]), rel=1e-3)
    assert found.truth.T_world_part == found.estimate.T_world_object


def test_what_is_never_seen_is_not_found(planned):
    look = Look(planned, Averaging(9.0, 1e-3), FirstLookSettings(longest=0.1, planning=0.0))
    assert look.found.estimate is None
    assert look.found.deviation == np.inf
    assert look.found.ended == pytest.approx(0.1, abs=1e-9)


def test_the_arm_stands_meanwhile_and_the_record_goes_on_through_the_episode(planned):
    look = Look(planned, TruePoses(), FirstLookSettings(shortest=0.2, planning=0.05))
    assert look.labels == {"first look"}
    start = look.found.start_time
    plan = replace(planned.plan, start_time=start)
    # The look and the first 0.1 s of the motion; the whole of an episode takes long.
    settings = EpisodeSettings(hold_time=0.1 - (plan.end_time - start))
    record = run_episode(plan, look.plant, look.controller, settings, recorder=look.recorder)
    # Each sample is due on a grid of 4 ms of its own part of the time.
    assert record.t[0] == 0.0
    assert (np.diff(record.t) <= 4e-3 + 1e-9).all()
    assert record.t[-1] == pytest.approx(start + 0.1, abs=5e-3)
    standing = record.t < start
    assert standing.sum() == pytest.approx(0.25 * settings.record_rate, abs=1)
    # Held by its controller against gravity and a payload that is off: it sags by less than a plan is followed to.
    assert np.abs(record.arm_measured[standing] - look.q).max() < 1e-3
    assert np.abs(record.arm_velocity[standing]).max() < 0.02
    np.testing.assert_array_equal(record.arm_planned[standing], np.tile(look.q, (standing.sum(), 1)))
    assert np.abs(record.arm_velocity[-1]).max() > 0.02


@pytest.mark.parametrize(
    "settings",
    [
        {"deviation": 0.0},
        {"deviation": np.nan},
        {"longest": 0.0},
        {"shortest": 3.0},
        {"planning": -0.1},
        {"longest": np.inf},
    ],
)
def test_impossible_settings_are_refused(settings):
    with pytest.raises(InvalidProblem):
        FirstLookSettings(**settings)
