"""The rest of a plan towards new targets: one tracking program a phase, joined to the running plan at the splice.

The approach is cut at the splice and what is left of it laid on a grid of its own; the new plan begins there. The hand
goes on with what is left of its motion: at rest it stays at rest, moving it is tracked with the arm on one clock.

While the hand closes the duration is kept: its motion then stays exactly what it was, within its limits and without a
jump. The splice falls on the next grid point, the past of the phase stays in the plan, and only the arm's rest is
tracked.

Phases that have not begun are tracked whole. Their duration may change, but for a closing hand not below what its
limits need.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import MIN_INTERVALS, Status
from dyngrasp.planning.replanning.carried_descent import NO_DESCENT, carried_descent
from dyngrasp.planning.replanning.joint_splines import filters
from dyngrasp.planning.replanning.phase_programs import (
    APPROACH,
    GRASP,
    TrackingSettings,
    limits_of,
    stretch,
    track_phases,
    write_rest,
)
from dyngrasp.planning.replanning.tracking_qp import STATUS
from dyngrasp.signals import frozen
from dyngrasp.trajectory import GraspPlan, Trajectory


@dataclass(frozen=True)
class Candidate:
    """A plan that has not been audited yet.

    Attributes:
        status: `converged`, or what the first failing phase said.
        plan: None unless converged.
        splice: When it takes over (s).
        iterations: Of the interior point method over all phases; 0 where no box was active.
        message: Which phase failed.
    """

    status: Status
    plan: GraspPlan | None
    splice: float
    iterations: int
    message: str = ""


def splice_time(plan: GraspPlan, wanted: float) -> float:
    """The first time from `wanted` on at which the plan may be cut: any, but a grid point while the hand closes (s)."""
    if plan.phase_at(wanted) != GRASP:
        return wanted
    start = plan.phase_ends[APPROACH]
    step = plan.durations[GRASP] / plan.arm[GRASP].intervals
    return float(start + step * np.ceil((wanted - start) / step - 1e-6))


def rest_of(trajectory: Trajectory, start: float, intervals: int) -> Trajectory:
    """What is left of a motion after `start` (s), on a grid of its own; obeys the trapezoidal rule only nearly."""
    motion = np.empty((3, intervals + 1, trajectory.position.shape[1]))
    write_rest(trajectory.arrays, float(start), motion)
    return Trajectory.of(trajectory.duration - start, motion)


def stretched(trajectory: Trajectory, duration: float) -> Trajectory:
    """The same path in another time."""
    rates = np.empty((2, *trajectory.position.shape))
    stretch(trajectory.arrays, float(duration), rates)
    return Trajectory(duration, trajectory.position, frozen(rates)[0], rates[1])


def track(
    plan: GraspPlan,
    targets: GraspTargets,
    task: GraspTask,
    splice: float,
    settings: TrackingSettings,
    way: int = 0,
    previous: GraspTargets | None = None,
) -> Candidate:
    """Continue a plan from the splice on to new targets.

    Args:
        plan: The running plan, whoever made it.
        targets: Boundary states of the phases ahead.
        task: Arm, gripper, part.
        splice: From `splice_time`; before the delivery begins.
        settings: How.
        way: Which of the descents.
        previous: What the plan was made for; only a moving part makes a difference.
    """
    arm, hand, ends = plan.arrays
    begun, paper, descent = plan.phase_at(splice), settings.paper_rows, NO_DESCENT
    start, row = float(splice - (ends[begun] - arm[begun][0])), 0
    if begun == GRASP:
        N = plan.arm[GRASP].intervals
        row = min(max(round(start / arm[GRASP][0] * N), 0), N - MIN_INTERVALS)
    elif not paper:
        descent = carried_descent(arm[APPROACH], start, splice, targets, previous, task, settings.descents[way])
    shapes = [motion[1].shape for motion in arm]
    grids = [filters(shape[0] - 1, paper, paper, not paper) for shape in shapes]
    grids[begun] = filters(shapes[begun][0] - 1 - row, True, paper, not paper)
    motions = [np.empty((3, *shape)) for shape in shapes]
    fingers = [np.empty((3, shapes[APPROACH][0], len(targets.gripper_open)))]
    fingers += [np.empty((2, *motion[1].shape)) for motion in hand[GRASP:]]
    pregrasp, grasped, place = targets.pregrasp, targets.grasped, targets.place
    failed, outcome, durations, iterations = track_phases(
        arm,
        hand,
        begun,
        start,
        (
            (pregrasp.position, pregrasp.velocity),
            (grasped.position, grasped.velocity),
            (place.position, place.velocity),
        ),
        targets.gripper_open,
        descent,
        limits_of(task),
        settings.rules,
        tuple(grids),
        tuple(motions),
        tuple(fingers),
    )
    if failed < len(arm):
        message = f"no motion within the boxes in phase {failed + 1} ({STATUS[outcome]})"
        return Candidate(STATUS[outcome], None, splice, iterations, message)
    new_arm, new_hand = list(arm), list(hand)
    for phase in range(begun, len(arm)):
        T, q, path = durations[phase], frozen(motions[phase]), frozen(fingers[phase])
        new_arm[phase] = T, q[0], q[1], q[2]
        if phase == APPROACH:
            new_hand[phase] = T, path[0], path[1], path[2]
        elif phase > begun:
            new_hand[phase] = T, hand[phase][1], path[0], path[1]
    begin = splice if begun == APPROACH else plan.start_time
    new = GraspPlan.of(tuple(new_arm), tuple(new_hand), begin, plan.arm_joints, plan.gripper_joints)
    return Candidate(Status.CONVERGED, new, splice, iterations)
