"""A good plan passes; for every entry something makes that one fail and no other; NaN never passes."""

import copy
from dataclasses import replace

import numpy as np
import pytest

from dyngrasp.planning.audit import audit, standstill
from dyngrasp.planning.part_motion import part_motion, part_poses
from dyngrasp.planning.problem import AuditEntry
from dyngrasp.trajectory import PHASE_NAMES, Trajectory

from .failing_cases import BODIES, PLANS, TASKS, unchecked

ENTRIES = (
    "dynamics",
    "join_position",
    "join_velocity",
    "pregrasp_position",
    "pregrasp_angle",
    "grasp_position",
    "grasp_angle",
    "place_position",
    "place_angle",
    "lift_velocity",
    "rest_at_place",
    "position",
    "velocity",
    "acceleration",
    "gripper_position",
    "gripper_velocity",
    "gripper_acceleration",
    "torque",
    "funnel",
    "grasp_axis",
    "grasp_dip",
    "grasp_tilt",
    "hold",
    "ground_clearance",
    "part_clearance",
    "self_clearance",
    "carried_clearance",
)


def failures(plan, targets, task) -> list[str]:
    return [entry.name for entry in audit(plan, targets, task).failures]


def test_a_good_plan_passes(plan, targets, task):
    report = audit(plan, targets, task)
    assert report.ok
    assert tuple(entry.name for entry in report.entries) == ENTRIES
    for entry in report.entries:
        assert plan.start_time <= entry.time <= plan.end_time


def test_there_is_a_failure_for_every_entry():
    assert set(PLANS) | set(TASKS) | set(BODIES) == set(ENTRIES)


@pytest.mark.parametrize("name", PLANS)
def test_a_plan_for_which_only_this_fails(plan, targets, task, name):
    assert failures(PLANS[name](plan, task), targets, task) == [name]


@pytest.mark.parametrize("name", TASKS)
def test_a_task_for_which_only_this_fails(plan, targets, task, name):
    assert failures(plan, targets, TASKS[name](task, plan)) == [name]


@pytest.mark.parametrize("name", BODIES)
def test_bodies_for_which_only_this_fails(plan, targets, task, name):
    assert failures(plan, targets, BODIES[name](task, targets)) == [name]


@pytest.mark.parametrize("array", ["position", "velocity", "acceleration"])
@pytest.mark.parametrize("of", ["arm", "gripper"])
@pytest.mark.parametrize("phase", range(3), ids=PHASE_NAMES)
def test_not_a_number_never_passes(plan, targets, task, of, phase, array):
    """A trajectory refuses it; were it to slip through, the audit would not."""
    trajectories = [copy.copy(trajectory) for trajectory in getattr(plan, of)]
    values = getattr(trajectories[phase], array).copy()
    values[17, 1] = np.nan
    values.setflags(write=False)
    object.__setattr__(trajectories[phase], array, values)
    bad = unchecked(plan, **{of: tuple(trajectories)})
    failed = failures(bad, targets, task)
    assert array in failed or f"gripper_{array}" in failed
    if array == "position":
        assert {"ground_clearance", "part_clearance", "self_clearance"} <= set(failed)


def test_nan_entries_fail_whatever_they_compare_with():
    for worst, bound, tolerance in ((np.nan, 1.0, 0.0), (0.0, np.nan, 0.0), (0.0, 1.0, np.nan)):
        for at_least in (False, True):
            assert not AuditEntry("torque", worst, bound, at_least, tolerance, "", 0.0).ok


def test_what_is_past_is_not_looked_at(plan, targets, task):
    """Fingers that close too fast count until they have closed, and no longer."""
    strict = TASKS["gripper_velocity"](task, plan)
    fastest = audit(plan, targets, strict)["gripper_velocity"].time
    assert plan.phase_ends[0] < fastest < plan.phase_ends[1]
    for since, failed in (
        (-np.inf, ["gripper_velocity"]),
        (plan.phase_ends[0] - 0.2, ["gripper_velocity"]),
        (fastest - 0.02, ["gripper_velocity"]),
        (fastest + 0.05, []),
        (plan.phase_ends[1], []),
    ):
        report = audit(plan, targets, strict, since=float(since))
        assert [entry.name for entry in report.failures] == failed
        assert ("funnel" in [entry.name for entry in report.entries]) == (since < plan.phase_ends[0])
        of_the_whole_plan = {"dynamics", "join_position", "join_velocity"}
        assert all(entry.time >= since for entry in report.entries if entry.name not in of_the_whole_plan)


def test_only_the_delivery_is_left(plan, targets, task):
    report = audit(plan, targets, task, since=float(plan.phase_ends[1]) + 0.1)
    assert report.ok
    names = {entry.name for entry in report.entries}
    assert not names & {"funnel", "grasp_axis", "grasp_dip", "grasp_tilt", "pregrasp_position", "grasp_angle"}
    assert {"torque", "hold", "place_position", "part_clearance", "carried_clearance"} <= names


def test_a_part_elsewhere_is_noticed(plan, targets, task):
    """The boundary states rest on where the part is said to be, not on what the plan says of it."""
    elsewhere = targets.T_world_object.copy()
    elsewhere.translation = elsewhere.translation + np.array([2e-6, 0.0, 0.0])
    assert failures(plan, replace(targets, T_world_object=elsewhere), task) == ["pregrasp_position", "grasp_position"]


def test_a_moving_part_is_followed(plan, targets, task):
    """A part that stands still is where it was; one that came by is not where this plan expects it at the pre-grasp."""
    grasp_time = float(plan.phase_ends[1])
    spin = replace(targets, grasp_time=grasp_time, twist_world=np.array([0, 0, 0, 0, 0, 0.002]))
    # The grasp lies on the axis of this turn, so that only the angle at the pre-grasp differs.
    assert failures(plan, spin, task) == ["pregrasp_angle"]
    angle = audit(plan, spin, task)["pregrasp_angle"].worst
    assert angle == pytest.approx(0.002 * plan.durations[1], rel=1e-6)
    drift = replace(targets, grasp_time=grasp_time, twist_world=np.array([1e-4, 0, 0, 0, 0, 0]))
    assert failures(plan, drift, task) == ["pregrasp_position"]
    T, twist = targets.T_world_object, np.array([0.1, -0.2, 0.05, 0.3, -0.4, 0.5])
    moving = replace(targets, grasp_time=2.0, twist_world=twist)
    times = np.array([0.0, 1.3, 2.0, 2.5])
    for part in (moving, replace(moving, twist_world=np.array([0.1, 0, 0, 0, 0, 0])), targets):
        R, p = np.empty((3, 3, 4)), np.empty((3, 4))
        part_poses(part_motion(part), times, R, p)
        for k, t in enumerate(times):
            expected = part.T_world_object_at(t)
            np.testing.assert_allclose(R[..., k], expected.rotation, atol=1e-14)
            np.testing.assert_allclose(p[:, k], expected.translation, atol=1e-14)
    assert moving.T_world_object_at(2.5) == T


def test_entry_of_that_name_or_those_there_are(plan, targets, task):
    report = audit(plan, targets, task)
    assert report["torque"].name == "torque"
    with pytest.raises(KeyError, match="funnel"):
        report["torqe"]


def test_a_plan_that_stops_on_its_way_is_told_from_one_that_does_not(plan, task):
    entry = standstill(plan, task)
    assert entry.ok
    # What the entry looks at every half grid step is on a finer grid no slower than a little.
    times = np.linspace(
        plan.start_time + 0.02 * plan.durations.sum(), plan.end_time - 0.02 * plan.durations.sum(), 5000
    )
    speeds = [np.abs(plan.sample(t).arm.velocity / task.robot.limits.velocity).max() for t in times]
    assert entry.worst == pytest.approx(min(speeds), abs=2e-3)
    assert np.abs(plan.sample(entry.time).arm.velocity / task.robot.limits.velocity).max() == pytest.approx(entry.worst)
    # The same path on a clock τ(s) that starts and ends as it did but stands still at a quarter: τ' = 1 − sin 2πs.
    arm = plan.arm[0]
    s = np.linspace(0.0, 1.0, arm.intervals + 1)
    rate, curvature = 1.0 - np.sin(2 * np.pi * s[:, None]), -2 * np.pi * np.cos(2 * np.pi * s[:, None])
    q, w, v = arm.sample_many(arm.duration * (s + (np.cos(2 * np.pi * s) - 1.0) / (2 * np.pi)))
    stopping = Trajectory(arm.duration, q, w * rate, v * rate**2 + w * curvature / arm.duration)
    found = standstill(replace(plan, arm=(stopping, *plan.arm[1:])), task)
    assert not found.ok
    assert found.time == pytest.approx(plan.start_time + 0.25 * arm.duration, abs=arm.duration / arm.intervals)
    # What is past does not count.
    assert standstill(replace(plan, arm=(stopping, *plan.arm[1:])), task, plan.start_time + 0.5 * arm.duration).ok


def test_a_velocity_that_is_no_number_is_no_motion(plan, task):
    broken, velocity = copy.copy(plan.arm[1]), plan.arm[1].velocity.copy()
    velocity[40, 1] = np.nan
    velocity.setflags(write=False)
    object.__setattr__(broken, "velocity", velocity)
    assert not standstill(unchecked(plan, arm=(plan.arm[0], broken, plan.arm[2])), task).ok
