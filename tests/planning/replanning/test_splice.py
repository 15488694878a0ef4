"""What is tracked of each phase, against the same program stated and solved alone."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.phase_programs import TrackingSettings
from dyngrasp.planning.replanning.splice import rest_of, splice_time, stretched, track
from dyngrasp.planning.replanning.target_update import updated_targets
from dyngrasp.planning.replanning.tracking_qp import TrackingProblem, TrackingWeights, solve_tracking
from dyngrasp.trajectory import Trajectory

NAMES = ("position", "velocity", "acceleration")
PAPER = TrackingSettings(weights=TrackingWeights(0.1, 0.1, 1.0, 100.0), paper_rows=True)
EXACT = TrackingSettings(weights=TrackingWeights(0.1, 0.0, 1.0, 50.0))


@pytest.fixture(scope="module")
def moved_targets(targets, task):
    T = targets.T_world_object
    turned = pin.SE3(pin.utils.rotate("z", 0.03) @ T.rotation, T.translation + np.array([0.008, -0.005, 0.0]))
    return updated_targets(targets, turned, task)


def tracked(plan, targets, task, splice, settings):
    candidate = track(plan, targets, task, splice, settings)
    assert candidate.status is Status.CONVERGED
    assert candidate.splice == splice
    assert candidate.plan is not None
    return candidate.plan


def states(reference, start, end):
    first, last = (np.array([getattr(reference, name)[k] for name in NAMES]) for k in (0, -1))
    if start is not None:
        first[:2] = start.position, start.velocity
    last[:2] = end.position, end.velocity
    return first, last


def alone(reference, start, end, held, durations, task, settings):
    """The program between two states within the arm's limits, by its public form."""
    limits = task.robot.limits
    first, last = states(reference, start, end)
    margin, fraction = settings.position_margin, settings.velocity_fraction
    problem = TrackingProblem(
        reference,
        first,
        last,
        held[0],
        held[1],
        limits.position_lower + margin,
        limits.position_upper - margin,
        fraction * limits.velocity,
        limits.acceleration,
        durations[0],
        durations[1],
        settings.weights,
        settings.paper_rows,
    )
    return solve_tracking(problem).trajectory


def assert_same(a, b):
    assert a.duration == pytest.approx(b.duration, rel=1e-12)
    for name in NAMES:
        # Accelerations are second differences over 1/N²: rounding times some 1e4 on numbers of size ten.
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0.0, atol=1e-9)


def assert_same_path(path, old, duration):
    """The hand's: the same positions in another time."""
    assert path.duration == duration
    ratio = old.duration / duration
    assert np.array_equal(path.position, old.position)
    np.testing.assert_allclose(path.velocity, old.velocity * ratio, rtol=1e-14, atol=0.0)
    np.testing.assert_allclose(path.acceleration, old.acceleration * ratio**2, rtol=1e-14, atol=0.0)


@pytest.mark.parametrize("settings", [EXACT, PAPER], ids=["exact", "paper"])
def test_phases_ahead_are_tracked_whole(plan, moved_targets, task, settings):
    followed = tracked(plan, moved_targets, task, 0.4, settings)
    assert followed.start_time == 0.4
    held, new = (settings.paper_rows, settings.paper_rows), moved_targets
    for phase, start, end in ((1, new.pregrasp, new.grasped), (2, new.grasped, new.place)):
        reference, hand = plan.arm[phase], plan.gripper[phase]
        needs = hand.duration * max(
            (np.abs(hand.velocity) / task.gripper.velocity).max(),
            np.sqrt((np.abs(hand.acceleration) / task.gripper.acceleration).max()),
        )
        shortest, longest = max(0.5 * reference.duration, needs), 2.0 * reference.duration
        if phase == 1:
            shortest = max(shortest, min(task.settings.grasp_duration_min, reference.duration))
            longest = min(longest, max(task.settings.grasp_duration_max, reference.duration))
        assert_same(followed.arm[phase], alone(reference, start, end, held, (shortest, longest), task, settings))
        assert_same_path(followed.gripper[phase], hand, followed.arm[phase].duration)


def test_the_approach_is_tracked_from_the_splice(plan, moved_targets, task):
    followed = tracked(plan, moved_targets, task, 0.4, PAPER)
    rest = rest_of(plan.arm[0], 0.4 - plan.start_time, plan.arm[0].intervals)
    bounds = 0.5 * rest.duration, 2.0 * rest.duration
    assert_same(followed.arm[0], alone(rest, None, moved_targets.pregrasp, (True, True), bounds, task, PAPER))
    hand = followed.gripper[0]
    assert hand.duration == followed.arm[0].duration
    assert not hand.velocity.any()
    assert not hand.acceleration.any()
    assert (hand.position == plan.gripper[0].position[-1]).all()


@pytest.mark.parametrize("settings", [EXACT, PAPER], ids=["exact", "paper"])
def test_in_the_grasp_its_past_and_its_time_stay(plan, moved_targets, task, settings):
    splice = splice_time(plan, plan.phase_ends[0] + 0.3 * plan.durations[1])
    followed, whole = tracked(plan, moved_targets, task, splice, settings), plan.arm[1]
    assert followed.start_time == plan.start_time
    row = round((splice - plan.phase_ends[0]) / whole.duration * whole.intervals)
    left = (whole.intervals - row) / whole.intervals * whole.duration
    rest = Trajectory(left, *(getattr(whole, name)[row:] for name in NAMES))
    held = (True, settings.paper_rows)
    expected = alone(rest, None, moved_targets.grasped, held, (left, left), task, settings)
    grasp = followed.arm[1]
    assert grasp.duration == whole.duration
    for name in NAMES:
        assert np.array_equal(getattr(grasp, name)[:row], getattr(whole, name)[:row])
        np.testing.assert_allclose(getattr(grasp, name)[row:], getattr(expected, name), rtol=0.0, atol=1e-9)
        for part in ("arm", "gripper"):
            old, new = getattr(plan, part), getattr(followed, part)
            assert np.array_equal(getattr(old[0], name), getattr(new[0], name))
        assert np.array_equal(getattr(plan.gripper[1], name), getattr(followed.gripper[1], name))


def test_the_first_phase_that_fails_is_named(plan, moved_targets, task):
    # In half the time and at a tenth of the speed nothing gets there.
    settings = replace(EXACT, velocity_fraction=0.1, longest=0.5, shortest=0.4)
    candidate = track(plan, moved_targets, task, 0.4, settings)
    assert candidate.plan is None
    assert candidate.status in (Status.INFEASIBLE, Status.ITERATION_LIMIT)
    assert candidate.message == f"no motion within the boxes in phase 1 ({candidate.status})"
    assert candidate.iterations > 0


def test_a_stretched_path_is_the_same_path(plan):
    path = plan.gripper[1]
    assert_same_path(stretched(path, 1.3 * path.duration), path, 1.3 * path.duration)
