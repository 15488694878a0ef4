"""What a scenario says of camera, motion and bound reaches the parts of the loop."""

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.closed_loop.pose_source import NoisyPoses
from dyngrasp.experiments.draws import draw_trial
from dyngrasp.experiments.replanning import pose_source, replanning_loop
from dyngrasp.experiments.scenario import load_scenario
from dyngrasp.experiments.trial import plan_trial, planner_for
from dyngrasp.experiments.vision import tracker_settings
from dyngrasp.experiments.workcell import load_workcell
from dyngrasp.perception.pose_track import MotionSettings
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.plant import Truth

SCENARIOS = Path(__file__).parents[2] / "scenarios"


def workcell(file, *overrides):
    return load_workcell(load_scenario(SCENARIOS / file, overrides), SCENARIOS / file)


def test_the_part_s_motion_is_the_filter_s():
    still = workcell("camera_sdh2.toml").scenario
    moving = workcell("camera_sdh2.toml", "pose.motion=constant_velocity").scenario
    assert tracker_settings(still).filter.motion == MotionSettings.still()
    velocity = tracker_settings(moving).filter.motion.first_velocity
    # A belt of 0.1 m/s must lie well within what is held possible.
    assert velocity[0] > 0.2
    assert tracker_settings(moving).filter.camera == tracker_settings(still).filter.camera


def truth(cell, trial, twist):
    arm, hand = np.zeros(cell.task.robot.n), cell.task.gripper.open_posture
    T = trial.T_world_object
    return Truth(
        t=0.0,
        T_world_part=T,
        part_twist=twist,
        p_world_support=np.zeros(3),
        T_world_hand=pin.SE3.Identity(),
        p_world_grasp_point=T.translation,
        arm_position=arm,
        arm_velocity=arm,
        gripper_position=hand,
        gripper_velocity=0.0 * hand,
        pad_force=np.zeros(2),
        contacts=(False,) * 5,
    )


@pytest.mark.parametrize("source", ["truth", "noise"])
def test_velocities_are_told_only_of_parts_that_move(source):
    told = {}
    for motion in ("still", "constant_velocity"):
        exact = ("pose.position_mm=0", "pose.rotation_deg=0")
        cell = workcell("static_sdh2.toml", *exact, f"pose.motion={motion}", f"pose.source={source}")
        trial = draw_trial(cell, 1)
        poses = pose_source(cell.scenario.pose, trial, cell.task.grasp_object.grasps[0])
        assert isinstance(poses, NoisyPoses) is (source == "noise")
        twist = np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.1])
        told[motion] = poses.estimate(truth(cell, trial, twist), 0.0).twist_world
    np.testing.assert_array_equal(told["still"], np.zeros(6))
    # The noise of one frame: 1 mm/s and 0.1 °/s per axis.
    np.testing.assert_allclose(told["constant_velocity"], [0.08, 0, 0, 0, 0, 0.1], atol=1e-2)


def test_the_bound_is_a_setting_and_judges_sources_with_a_covariance_of_their_own():
    cell = workcell("replan_20mm.toml", "replanner.largest_deviation_mm=3", "planner.intervals=30")
    trial, planner = draw_trial(cell, 1), planner_for(cell)
    planned = plan_trial(cell, trial, planner)
    plan, targets = planned.result.require(), planned.targets

    class Vague:
        def __init__(self, deviation):
            self.covariance = np.diag(np.repeat([deviation, 1e-6], 3) ** 2)

        def estimate(self, truth, t):
            return PoseEstimate(trial.T_world_object_believed, self.covariance, t, t)

    for deviation, taken in ((2.9e-3, 1), (3.1e-3, 0)):
        loop = replanning_loop(cell, trial, plan, targets, planner, Vague(deviation))
        assert loop is not None
        assert loop.settings.largest_deviation == 3e-3
        for t in (0.5, 0.6):
            loop.plan_at(t, t == 0.5, truth(cell, trial, np.zeros(6)))
        assert (len(loop.events), len(loop.not_taken)) == (taken, 1 - taken)
    noisy = replanning_loop(cell, trial, plan, targets, planner)
    assert noisy is not None
    assert noisy.settings.largest_deviation == np.inf


def test_the_camera_has_the_size_that_the_scenario_asks_for():
    small = workcell("camera_sdh2.toml").camera
    assert (small.width, small.height) == (640, 480)
    own = workcell("static_sdh2.toml").camera
    assert (own.width, own.height) == (1024, 1024)
