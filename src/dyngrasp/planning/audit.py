"""Whether a plan may be executed: every constraint evaluated anew, by other means than the solver's.

The torques come from recursive Newton-Euler with its velocity terms (the planner uses symbolic M v + g and bounds), the
funnel from the paper's formula as it stands, clearances from the collision geometry. The audit is part of every cycle
of replanning: all samples of a plan go through compiled loops at once, and between two grid points it looks only where
a constraint could be broken there.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.models.batch_dynamics import frame_poses, link_poses, side_by_side
from dyngrasp.motion_arrays import largest_defect, largest_difference
from dyngrasp.planning.audit_rows import DYNAMICS, JOIN, LIFT, PREGRASP, REST, ROWS, empty_table, enter
from dyngrasp.planning.clearance import clearance_entries
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import part_motion
from dyngrasp.planning.plan_models import plan_models
from dyngrasp.planning.plan_samples import at_grid_points, between
from dyngrasp.planning.problem import AuditEntry, AuditReport
from dyngrasp.planning.worst_values import WHOLE, Wall, enter_worst_values, hand_in_grasp_frame, write_angles
from dyngrasp.trajectory import PHASE_NAMES, GraspPlan

# An arm slower than this, in parts of its joints' speed limits, has come to a standstill: half as much again as what is
# called one when an episode is judged, for tracking is not exact. At both ends of a plan this part of it may be slower.
LEAST_SPEED, AT_REST = 0.015, 0.02


def audit(
    plan: GraspPlan, targets: GraspTargets, task: GraspTask, since: float = -np.inf, wall: Wall = WHOLE
) -> AuditReport:
    """Evaluate every constraint of a plan.

    Args:
        plan: Any plan, whoever made it.
        targets: The boundary states and the grasp that it was made for.
        task: Arm, gripper, part and settings.
        since: What comes before this time (s) is past and not looked at; before the end of the plan.
        wall: What there is of the funnel's wall: all of it, but where a motion begins outside.

    Returns:
        One entry a constraint, each with the worst value, its bound and its time; those of phases that are over are
        left out. A plan that fails one must not be executed.
    """
    models = plan_models(task, targets.grasp.name)
    place = targets.place.position, targets.gripper_closed
    table = _table(*plan.arrays, since, part_motion(targets), targets.moving, place, wall, models)
    names = {"phase": PHASE_NAMES, "arm": plan.arm_joints, "gripper": plan.gripper_joints}
    entries = [
        AuditEntry(name, worst, bound, at_least, tolerance, unit, time, names[of][int(whose)] if of else "")
        for (name, tolerance, unit, at_least, of), bound, (worst, time, whose) in zip(
            ROWS, models.bounds, table.tolist(), strict=True
        )
        if whose >= 0.0
    ]
    return AuditReport((*entries, *clearance_entries(task, targets, plan, since)))


@njit(cache=True, error_model="numpy")
def _table(arm, gripper, ends, since, part, moving, place, wall, models):
    """All of `ROWS` for `GraspPlan.arrays`; see `audit`. `place` is a posture of arm and gripper there."""
    table, grid = empty_table(), at_grid_points(arm, gripper, ends, since)
    _enter_defects(arm, gripper, ends, table)
    _enter_boundaries(arm, gripper, ends, since, part, moving, place, models, table)
    suspects = enter_worst_values(grid, part, wall, models, table)
    if suspects.any():
        enter_worst_values(between(arm, gripper, ends, grid, suspects), part, wall, models, table)
    return table


@njit(cache=True)
def _enter_defects(arm, gripper, ends, table):
    """Defects of the dynamics in each phase, and jumps of position and velocity at T_1 and T_2, of arm and gripper."""
    for phases in (arm, gripper):
        for i in range(3):
            enter(table[DYNAMICS], 1.0, largest_defect(phases[i]), ends[i] - arm[i][0], i)
        for i in range(2):
            (_, q, w, _), (_, q_next, w_next, _) = phases[i], phases[i + 1]
            enter(table[JOIN], 1.0, largest_difference(q[-1], q_next[0]), ends[i], 0)
            enter(table[JOIN + 1], 1.0, largest_difference(w[-1], w_next[0]), ends[i], 0)


@njit(cache=True, error_model="numpy")
def _enter_boundaries(arm, gripper, ends, since, part, moving, place, models, table):
    """Where the hand really is at T_1, T_2, T_3, from the plan's joints alone, against where it was sent.

    It was sent above the grasp frame, onto it, and to where a posture of arm and gripper has it at the place.
    """
    q, q_h = np.empty((place[0].size, 4)), np.empty((place[1].size, 4))
    for i in range(3):
        q[:, i], q_h[:, i] = arm[i][1][-1], gripper[i][1][-1]
    q[:, 3], q_h[:, 3] = place
    times = np.array([ends[0], ends[1], ends[2]])
    both = side_by_side(q, q_h, models.hand.arm_indices, models.hand.hand_indices)
    hand_R, hand_p = frame_poses(both, models.hand.tree, models.hand.frames)
    offset, angle = hand_in_grasp_frame(hand_R, hand_p, times, part, models.grasp_on_part)
    offset[2, 0] -= models.pregrasp
    if moving:
        # A part that is not taken when it was to be rides on.
        rotation, _, twist, arrival = part
        late = max(ends[1] - arrival, 0.0)
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    offset[a, 1] -= late * models.grasp_on_part[0][b, a] * rotation[c, b] * twist[c]
    for a in range(3):
        offset[a, 2] = (hand_p[1, a, 2] + hand_p[2, a, 2] - hand_p[1, a, 3] - hand_p[2, a, 3]) / 2
    write_angles(hand_R[0, :, :, 2:3], hand_R[0, :, :, 3:4], angle[2:])
    for i in range(3):
        if times[i] >= since:
            distance = np.sqrt(offset[0, i] ** 2 + offset[1, i] ** 2 + offset[2, i] ** 2)
            enter(table[PREGRASP + 2 * i], 1.0, distance, times[i], 0)
            enter(table[PREGRASP + 2 * i + 1], 1.0, angle[i], times[i], 0)
    R, p = np.empty((both.shape[0], 3, 3, 1)), np.empty((both.shape[0], 3, 1))
    link_poses(both[:, 1:2].copy(), models.hand.tree, R, p)
    lift, w = 0.0, arm[1][2][-1]
    for i in range(w.size):
        j = models.hand.arm_indices[i]
        # Third row of axis × lever, for a joint that turns about its z axis.
        x = (hand_p[1, 0, 1] + hand_p[2, 0, 1]) / 2 - p[j, 0, 0]
        y = (hand_p[1, 1, 1] + hand_p[2, 1, 1]) / 2 - p[j, 1, 0]
        lift += w[i] * (R[j, 0, 2, 0] * y - R[j, 1, 2, 0] * x)
    last = arm[2][2][-1]
    enter(table[LIFT], -1.0, lift, times[1], 0)
    enter(table[REST], 1.0, largest_difference(last, np.zeros(last.size)), times[2], 0)


def standstill(plan: GraspPlan, task: GraspTask, since: float = -np.inf) -> AuditEntry:
    """Whether the arm keeps moving until it puts the part down: the least max-norm of q̇/q̇max.

    No entry of `audit`: a plan that stops on its way can be executed, only nobody who grasps in motion wants it. Looked
    at is all but the first and last `AT_REST` of the plan, for it may begin at rest and ends so.

    Args:
        plan: Any plan.
        task: Arm and its limits.
        since: What comes before this time (s) is past.
    """
    arm, _, ends = plan.arrays
    slowest, time = _slowest(arm, ends, task.robot.limits.velocity, since, AT_REST * (plan.end_time - plan.start_time))
    return AuditEntry("standstill", slowest, LEAST_SPEED, True, 0.0, "of limit", time)


@njit(cache=True)
def _slowest(arm, ends, limit, since, at_ends):
    """Least max-norm of velocities over their limits (n,) from `since` on, but for a time `at_ends` of a plan (s).

    Looked at are the grid points and, half way between them, the quadratic that the velocity is there; the time of what
    is found comes second.
    """
    first, last = max(since, ends[0] - arm[0][0] + at_ends), ends[2] - at_ends
    least, time = np.inf, last
    for i in range(3):
        duration, _, velocity, acceleration = arm[i]
        N, begin = velocity.shape[0] - 1, ends[i] - duration
        step = duration / N
        for half in range(2 * N + 1):
            t, k = begin + half * step / 2, half // 2
            if t < first or t > last:
                continue
            speed = 0.0
            for j in range(limit.size):
                w = velocity[k, j]
                if half % 2:
                    w = (w + velocity[k + 1, j]) / 2 - step / 8 * (acceleration[k + 1, j] - acceleration[k, j])
                if w != w:
                    # A velocity that is no number is no motion.
                    return w, t
                speed = max(speed, abs(w) / limit[j])
                # One fast joint is enough.
                if speed >= least:
                    break
            if speed < least:
                least, time = speed, t
    return least, time
