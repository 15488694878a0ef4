"""Replanning in physics: it delivers where the first plan cannot, joins without a jump, and keeps its latency."""

import itertools
import time
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.closed_loop.episode import EpisodeSettings, grasp_controller, run_episode
from dyngrasp.closed_loop.pose_source import NoisyPoses, TruePoses
from dyngrasp.closed_loop.replanning_loop import ReplanningLoop, ReplanningSettings
from dyngrasp.errors import InvalidProblem
from dyngrasp.experiments.metrics import judge
from dyngrasp.perception.pose_noise import PoseNoise, PoseNoiseSettings
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.replanner import Path, Replanner
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.scene import build_scene
from dyngrasp.simulation.variation import PlantVariation


@pytest.fixture(scope="module")
def replanner(planned):
    planner = CollocationPlanner(planned.task, CollocationSettings(effort_weight=0.1, intervals=60))
    return Replanner(planned.task, None, StructuredSolver(), planner, lambda: 0.0)


def episode(planned, offset, replanner=None, source=None, settings=None):
    """The part stands at `offset` from where the plan expects it; with a replanner the source tells."""
    task, plan = planned.task, planned.plan
    plant = MujocoPlant(
        build_scene(task.robot, task.gripper, task.grasp_object, PlantVariation.draw(np.random.default_rng(2), 7)),
        plan.arm[0].position[0],
        plan.gripper[0].position[0],
        planned.targets.T_world_object * offset,
        t=plan.start_time,
    )
    loop = None
    if replanner is not None:
        loop = ReplanningLoop(replanner, source or TruePoses(), plan, planned.targets, settings)
    controller = grasp_controller(task, planned.targets.grasp, 1e-3)
    record = run_episode(plan, plant, controller, EpisodeSettings(), replanning=loop)
    last, targets = (plan, planned.targets) if loop is None else (loop.newest, loop.targets)
    return record, loop, judge(last, record, task, targets.grasp)


OFF = pin.SE3(pin.utils.rotate("z", np.deg2rad(4.0)), np.array([0.008, 0.012, 0.0]))


@pytest.fixture(scope="module")
def replanned(planned, replanner):
    return episode(planned, OFF, replanner)


def test_a_part_beside_its_place_is_delivered_with_replanning_and_not_without(planned, replanned):
    _, loop, outcome = replanned
    assert outcome.success, outcome.cause
    assert loop.events
    _, _, without = episode(planned, OFF)
    assert not without.success


def test_what_the_controller_is_asked_for_does_not_jump(replanned):
    record, loop, _ = replanned
    published = [event for event in loop.events if event.result.ok]
    assert len(published) >= 3
    step = np.diff(record.t)[:, None]
    # Between samples of the record (4 ms) the plan moves by its velocity; a jump would add to that.
    moved = np.abs(np.diff(record.arm_planned, axis=0))
    expected = np.maximum(np.abs(record.arm_planned_velocity[1:]), np.abs(record.arm_planned_velocity[:-1])) * step
    assert (moved - expected).max() < 1e-4


def test_every_answer_is_used_only_when_it_is_there(replanned):
    _, loop, _ = replanned
    for event in loop.events:
        assert event.ready == pytest.approx(event.t + 0.02)
        assert not event.late
        if event.result.ok:
            assert event.result.splice >= event.ready - 1e-9
    starts = [event.t for event in loop.events]
    assert np.diff(starts).min() > 0.099


def test_answers_after_their_splice_are_late_and_change_nothing(planned, replanner):
    _, loop, outcome = episode(planned, OFF, replanner, settings=ReplanningSettings(latency=0.03))
    assert loop is not None
    assert loop is not None
    usable = [event for event in loop.events if event.result.path is not Path.KEPT]
    assert usable
    assert all(event.late for event in usable if event.result.path is not Path.FRESH)
    assert loop.newest is planned.plan
    assert not outcome.success


def measured(planned, planner):
    """A replanner whose deadline is this machine's, in a loop that waits for each answer as long as it took."""
    replanner = Replanner(planned.task, None, StructuredSolver(), planner)
    # What is compiled or loaded at a first call is no part of a cycle.
    replanner.replan(planned.plan, planned.targets, planned.plan.start_time)
    record, loop, _ = episode(planned, OFF, replanner, settings=ReplanningSettings(latency=None))
    assert loop is not None
    return record, loop, replanner


def test_a_measured_latency_is_the_time_that_the_answer_took(planned, replanner):
    record, loop, real = measured(planned, replanner.full.planner)
    assert loop.events
    for event in loop.events:
        assert event.ready == pytest.approx(event.t + 1e-3 * event.result.timings_ms["total"])
        if event.result.ok:
            # Whatever the load of the machine: the clock is looked at last, and what took longer is no result.
            budget = real.settings.fresh_budget if event.result.path is Path.FRESH else real.settings.budget
            assert event.result.timings_ms["total"] <= 1e3 * budget
            assert not event.late
    # No question is asked before the answer to the former is there.
    for first, second in itertools.pairwise(loop.events):
        assert second.t >= first.ready - 1e-9
    # What ran is, at every moment, the newest plan that had been there by its splice.
    ran = [(planned.plan.start_time, planned.plan)]
    ran += [(event.result.splice, event.result.plan) for event in loop.events if event.result.ok]
    for t, asked in zip(record.t[::50], record.arm_planned[::50], strict=True):
        latest = [plan for start, plan in ran if start <= t + 1e-9][-1]
        np.testing.assert_allclose(asked, latest.sample(t).arm.position, atol=1e-9)


def test_a_machine_too_slow_for_the_budget_publishes_nothing(planned, replanner, monkeypatch):
    from dyngrasp.planning.replanning import attempt

    track = attempt.track

    def slow_track(*arguments):
        time.sleep(0.025)
        return track(*arguments)

    monkeypatch.setattr(attempt, "track", slow_track)
    _, loop, _ = measured(planned, replanner.full.planner)
    tracked = [event for event in loop.events if "tracking" in event.result.timings_ms]
    assert len(tracked) >= 5
    assert all(event.result.status is Status.DEADLINE_MISSED for event in tracked)
    assert loop.newest is planned.plan


def test_what_a_nearing_camera_reveals_is_enough(planned, replanner):
    T_object_grasp = planned.targets.grasp.T_object_grasp
    # The loop believes the part where the plan has it; the truth lies OFF from there.
    believed = (OFF * T_object_grasp).actInv(T_object_grasp)
    source = NoisyPoses(PoseNoise(believed, T_object_grasp, PoseNoiseSettings(reveal_from=0.2, reveal_to=0.08), 4))
    record, loop, outcome = episode(planned, OFF, replanner, source)
    assert loop is not None
    assert outcome.success, outcome.cause
    assert len(record) > 0
    assert loop is not None
    first = loop.events[0].result.targets.T_world_object
    assert np.abs(first.translation - planned.targets.T_world_object.translation).max() < 0.02


@pytest.mark.parametrize("bad", [{"rate": 0.0}, {"rate": np.inf}, {"latency": -0.01}, {"latency": np.nan}])
def test_bad_settings_are_refused(bad):
    with pytest.raises(InvalidProblem):
        replace(ReplanningSettings(), **bad)
