"""The carried descent against rigid-body motions of pinocchio and against what a polynomial is."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.planning.grasp_targets import BoundaryState
from dyngrasp.planning.replanning.carried_descent import KNOTS, NO_DESCENT, DescentSettings, bend, carried_descent
from dyngrasp.planning.replanning.splice import rest_of
from dyngrasp.planning.replanning.target_update import target_updater

START = 0.7
SETTINGS = DescentSettings(earliest=0.4)


def displaced(T, x, y, turn):
    return pin.SE3(pin.utils.rotate("z", turn) @ T.rotation, T.translation + np.array([x, y, 0.0]))


def descent(plan, targets, previous, task):
    approach = plan.arrays[0][0]
    return carried_descent(approach, START, plan.start_time + START, targets, previous, task, SETTINGS)


def knots(entry, N):
    return [entry + round(i * (N - entry) / (KNOTS - 1)) for i in range(KNOTS)]


@pytest.mark.parametrize(("entry", "N", "n"), [(60, 100, 7), (20, 40, 6), (0, 9, 9), (96, 100, 1)])
def test_a_bent_motion_passes_the_knots_and_what_is_added_is_a_cubic(entry, N, n):
    rng = np.random.default_rng(entry)
    T, width = 1.7, 8 * (1 + (n - 1) // 8)
    before = np.zeros((3, N + 1, width))
    before[:, :, :n] = rng.normal(size=(3, N + 1, n))
    postures, motion = rng.normal(size=(KNOTS, n)), before.copy()
    bend(entry, postures, T, motion)
    assert np.array_equal(motion[:, :entry], before[:, :entry])
    assert not motion[:, :, n:].any()
    assert np.abs(motion[0, knots(entry, N), :n] - postures).max() < 1e-14
    q, w, a = (motion - before)[:, entry:, :n]
    dt = T / N
    # Of a cubic second differences are the second derivative, and of its derivative central differences are.
    # What rounding leaves of a difference of numbers of size q, over the square of a step.
    tolerance = 1e-15 * np.abs(q).max() / dt**2 + 1e-12 * np.abs(a).max()
    assert np.abs((q[2:] - 2 * q[1:-1] + q[:-2]) / dt**2 - a[1:-1]).max() < 10 * tolerance
    assert np.abs((w[2:] - w[:-2]) / (2 * dt) - a[1:-1]).max() < 10 * tolerance


def test_a_part_at_rest_takes_the_descent_with_it(plan, targets, task):
    new = target_updater(task).update(targets, displaced(targets.T_world_object, 0.01, -0.006, 0.05))
    entry, postures, weight = descent(plan, new, targets, task)
    rest, N = rest_of(plan.arm[0], START, plan.arm[0].intervals), plan.arm[0].intervals
    flange = task.robot.forward_kinematics
    carry = flange(new.pregrasp.position) * flange(rest.position[-1]).inverse()
    for k, q in zip(knots(entry, N), postures, strict=True):
        off = (carry * flange(rest.position[k])).actInv(flange(q))
        assert np.abs(pin.log6(off).vector).max() < 1e-9
    assert np.array_equal(postures[-1], new.pregrasp.position)
    time_left = (1 - entry / N) * rest.duration
    assert weight == pytest.approx((SETTINGS.stiffness / time_left) ** 4, rel=1e-12)


def test_it_begins_at_the_height_that_is_asked(plan, targets, task):
    entry, _, _ = descent(plan, targets, targets, task)
    N, T_flange_grasp = plan.arm[0].intervals, target_updater(task).T_flange_grasp(targets.gripper_open)
    frames = [task.robot.forward_kinematics(q) * T_flange_grasp for q in rest_of(plan.arm[0], START, N).position]
    heights = [frames[-1].rotation[:, 2] @ (frame.translation - frames[-1].translation) for frame in frames]
    # Heights are above the pre-grasp here.
    begin = SETTINGS.height * task.grasp_object.funnel.z_threshold - task.settings.pregrasp_distance
    assert SETTINGS.earliest * N < entry < N - KNOTS
    assert heights[entry] <= begin < heights[entry - 1]


def test_parts_that_move_are_followed(plan, targets, task):
    """Seen from the part where it is at each time, the flange is where it was, up to the displacement of the end."""
    updater, T = target_updater(task), targets.T_world_object
    meet, lasts = float(plan.phase_ends[1]), float(plan.durations[1])
    old = updater.update(targets, T, np.array([0.01, 0.02, 0.0, 0.0, 0.0, 0.1]), meet, lasts)
    twist = np.array([0.02, -0.01, 0.0, 0.0, 0.0, -0.05])
    new = updater.update(targets, displaced(T, 0.005, 0.0, 0.02), twist, meet, lasts)
    entry, postures, _ = descent(plan, new, old, task)
    rest, N = rest_of(plan.arm[0], START, plan.arm[0].intervals), plan.arm[0].intervals
    flange, end = task.robot.forward_kinematics, plan.start_time + plan.arm[0].duration

    def from_part(targets, t, q):
        return targets.T_world_object_at(t).actInv(flange(q))

    carry = from_part(new, end, new.pregrasp.position) * from_part(old, end, rest.position[-1]).inverse()
    for k, q in zip(knots(entry, N), postures, strict=True):
        t = plan.start_time + START + k / N * rest.duration
        off = (carry * from_part(old, t, rest.position[k])).actInv(from_part(new, t, q))
        assert np.abs(pin.log6(off).vector).max() < 1e-9


def test_what_the_arm_cannot_follow_is_left_free(plan, targets, task):
    """A pre-grasp at the end of a straight arm: on the way there joints would have to flip or to reach farther."""
    straight = replace(targets, pregrasp=BoundaryState(np.zeros(7), np.zeros(7)))
    assert descent(plan, targets, targets, task) is not NO_DESCENT
    assert descent(plan, straight, targets, task) is NO_DESCENT
