"""Whether a plan may be executed: every constraint evaluated anew, by other means than the solver's.

The torques come from recursive Newton-Euler with its velocity terms (the planner uses symbolic M v + g and bounds), the
funnel from the paper's formula as it stands, clearances from the collision geometry. The audit is part of every cycle
of replanning: all samples of a plan go through compiled loops at once, and between two grid points it looks only where
a constraint could be broken there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit

from dyngrasp.models.batch_dynamics import compose, link_poses, side_by_side
from dyngrasp.planning.clearance import clearance_entries
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import PartMotion, part_motion
from dyngrasp.planning.plan_samples import at_grid_points, between
from dyngrasp.planning.problem import AuditEntry, AuditReport
from dyngrasp.planning.worst_values import ROWS, PlanModels, hand_in_grasp_frame, plan_models
from dyngrasp.signals import Array
from dyngrasp.trajectory import JOIN_TOLERANCE, PHASE_NAMES, GraspPlan, largest_defect, largest_difference

# An arm slower than this, in parts of its joints' speed limits, has come to a standstill: half as much again as what is
# called one when an episode is judged, for tracking is not exact. At both ends of a plan this part of it may be slower.
LEAST_SPEED, AT_REST = 0.015, 0.02

# Rounding of a ratio to a limit after a solver that stops at 1e-8 in its own scaling.
RATIO_TOLERANCE = 1e-6

# Rounding of a length (m): ten times below what any sensor or actuator of the cell resolves.
LENGTH_TOLERANCE = 1e-6

# The trapezoid between two grid points of a curved tube or funnel leaves it by a chord's height (m).
CHORD_TOLERANCE = 5e-5


# Tolerance and unit of each of `ROWS`.
_TOLERANCES = (
    *7 * ((RATIO_TOLERANCE, "of limit"),),
    *3 * ((CHORD_TOLERANCE, "m"),),
    (1e-4, "rad"),
    (RATIO_TOLERANCE, "of the grip"),
)


def audit(
    plan: GraspPlan,
    targets: GraspTargets,
    task: GraspTask,
    since: float = -np.inf,
    wall: Callable[[Array], Array] = np.ones_like,
) -> AuditReport:
    """Evaluate every constraint of a plan.

    Args:
        plan: Any plan, whoever made it.
        targets: The boundary states and the grasp that it was made for.
        task: Arm, gripper, part and settings.
        since: What comes before this time (s) is past and not looked at; before the end of the plan.
        wall: What part of its height the wall of the funnel has at times (M,) (s): all of it, but where a motion begins
            outside.

    Returns:
        One entry a constraint, each with the worst value, its bound and its time. A plan that fails one must not be
        executed.
    """
    models, part = plan_models(task, targets.grasp.name), part_motion(targets)
    return AuditReport(
        (
            *_consistency(plan),
            *_boundaries(plan, targets, part, models, task.settings.pregrasp_distance, since),
            *_along(plan, part, models, since, wall),
            *clearance_entries(task, targets, plan, since),
        )
    )


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


def _along(
    plan: GraspPlan, part: PartMotion, models: PlanModels, since: float, wall: Callable[[Array], Array]
) -> list[AuditEntry]:
    """The constraints on every sample; those of a phase without samples are left out."""
    grid = at_grid_points(plan, since)
    table, suspects = models.worst_values(grid, part, wall(grid.times[: grid.stops[0]]))
    worst = table.tolist()
    if suspects.any():
        finer = between(plan, grid, suspects)
        inside, _ = models.worst_values(finer, part, wall(finer.times[: finer.stops[0]]))
        worst = [_worse(*rows) for rows in zip(worst, inside.tolist(), ROWS, strict=True)]
    rows = zip(worst, ROWS, models.bounds.tolist(), _TOLERANCES, strict=True)
    return [
        AuditEntry(name, value, bound, at_least, tolerance, unit, time, getattr(plan, of)[int(joint)] if of else "")
        for (value, time, joint), (name, at_least, of), bound, (tolerance, unit) in rows
        if joint >= 0.0
    ]


def _worse(one: list[float], other: list[float], row: tuple[str, bool, str]) -> list[float]:
    """That of two rows of the table which has the worse value; NaN is worst."""
    value, less = (-one[0], -other[0]) if row[1] else (one[0], other[0])
    return one if other[2] < 0.0 or value != value or less <= value else other


def _consistency(plan: GraspPlan) -> list[AuditEntry]:
    """Defects of the dynamics, and jumps of position and velocity at T_1 and T_2, over arm and gripper."""
    arm, gripper, ends = plan.arrays
    defects, *jumps = _violations(arm, gripper)
    worst = _worst_of(defects)
    start, phase = ends[worst] - arm[worst][0], PHASE_NAMES[worst]
    entries = [AuditEntry("dynamics", defects[worst], 0.0, False, 1e-9, "rad, rad/s", start, phase)]
    for name, unit, found in zip(("position", "velocity"), ("rad", "rad/s"), jumps, strict=True):
        worst = _worst_of(found)
        entries.append(AuditEntry(f"join_{name}", found[worst], 0.0, False, JOIN_TOLERANCE, unit, ends[worst]))
    return entries


def _worst_of(values: tuple[float, ...]) -> int:
    """Index of the first NaN, or else of the largest."""
    return max(range(len(values)), key=lambda i: np.inf if values[i] != values[i] else values[i])


@njit(cache=True)
def _violations(arm, gripper):
    """Of the dynamics in each phase, of continuity of position and of velocity at each join; a NaN is the largest."""
    defects, jumps = np.zeros(3), np.zeros((2, 2))
    for phases in (arm, gripper):
        for i in range(3):
            defects[i] = _larger(largest_defect(phases[i]), defects[i])
        for i in range(2):
            (_, q, w, _), (_, q_next, w_next, _) = phases[i], phases[i + 1]
            jumps[0, i] = _larger(largest_difference(q[-1], q_next[0]), jumps[0, i])
            jumps[1, i] = _larger(largest_difference(w[-1], w_next[0]), jumps[1, i])
    return (defects[0], defects[1], defects[2]), (jumps[0, 0], jumps[0, 1]), (jumps[1, 0], jumps[1, 1])


@njit(cache=True)
def _larger(a, b):
    return b if a <= b or b != b else a


def _boundaries(
    plan: GraspPlan, targets: GraspTargets, part: PartMotion, models: PlanModels, above: float, since: float
) -> list[AuditEntry]:
    """Where the hand really is at T_1, T_2, T_3, from the plan's joints alone, against where it was sent."""
    arm, gripper, ends = plan.arrays
    errors, lift, rest = _boundary_errors(
        arm, gripper, ends, targets.place.position, targets.gripper_closed, models.hand, part, models.grasp_on_part,
        above, targets.moving,
    )  # fmt: skip
    entries = []
    names = ("pregrasp", "grasp", "place")
    for time, name, (distance, angle) in zip(ends, names, errors.tolist(), strict=True):
        if time >= since:
            entries.append(AuditEntry(f"{name}_position", distance, 0.0, False, LENGTH_TOLERANCE, "m", time))
            entries.append(AuditEntry(f"{name}_angle", angle, 0.0, False, 1e-5, "rad", time))
    entries.append(AuditEntry("lift_velocity", lift, 0.0, True, LENGTH_TOLERANCE, "m/s", ends[1]))
    entries.append(AuditEntry("rest_at_place", rest, 0.0, False, JOIN_TOLERANCE, "rad/s", ends[2]))
    return entries


@njit(cache=True, error_model="numpy")
def _boundary_errors(arm, gripper, ends, q_place, q_h_place, hand, part, grasp_on_part, above, moving):
    """Distance (m) and angle (rad) of the hand from where it was sent at the ends of the phases, (3, 2).

    It was sent `above` the grasp frame, onto it, and to where a posture of arm and gripper has it at the place. Second
    comes its velocity upwards at the grasp (m/s), third the largest velocity of a joint at the place (rad/s).
    """
    arm_indices, hand_indices, tree, (links, turns, shifts) = hand
    q, q_h = np.empty((q_place.size, 4)), np.empty((q_h_place.size, 4))
    for i in range(3):
        q[:, i], q_h[:, i] = arm[i][1][-1], gripper[i][1][-1]
    q[:, 3], q_h[:, 3] = q_place, q_h_place
    both = side_by_side(q, q_h, arm_indices, hand_indices)
    R, p = np.empty((both.shape[0], 3, 3, 4)), np.empty((both.shape[0], 3, 4))
    link_poses(both, tree, R, p)
    hand_R, hand_p = np.empty((3, 3, 3, 4)), np.empty((3, 3, 4))
    for f in range(3):
        compose(R[links[f]], p[links[f]], turns[f], shifts[f], hand_R[f], hand_p[f])
    times = np.array([ends[0], ends[1], ends[2]])
    offset, angle = hand_in_grasp_frame(hand_R, hand_p, part, grasp_on_part, times)
    offset[2, 0] -= above
    if moving:
        # A part that is not taken when it was to be rides on.
        rotation, _, twist, arrival = part
        late = max(ends[1] - arrival, 0.0)
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    offset[a, 1] -= late * grasp_on_part[0][b, a] * rotation[c, b] * twist[c]
    chord = 0.0
    for a in range(3):
        offset[a, 2] = (hand_p[1, a, 2] + hand_p[2, a, 2] - hand_p[1, a, 3] - hand_p[2, a, 3]) / 2
        for b in range(3):
            chord += (hand_R[0, a, b, 2] - hand_R[0, a, b, 3]) ** 2
    angle[2] = 2.0 * np.arcsin(min(np.sqrt(chord / 8.0), 1.0))
    errors = np.empty((3, 2))
    for k in range(3):
        errors[k, 0] = np.sqrt(offset[0, k] ** 2 + offset[1, k] ** 2 + offset[2, k] ** 2)
        errors[k, 1] = angle[k]
    lift, w = 0.0, arm[1][2][-1]
    for i in range(arm_indices.size):
        j = arm_indices[i]
        # Third row of axis × lever, for a joint that turns about its z axis.
        x, y = (
            (hand_p[1, 0, 1] + hand_p[2, 0, 1]) / 2 - p[j, 0, 1],
            (hand_p[1, 1, 1] + hand_p[2, 1, 1]) / 2 - p[j, 1, 1],
        )
        lift += w[i] * (R[j, 0, 2, 1] * y - R[j, 1, 2, 1] * x)
    last = arm[2][2][-1]
    return errors, lift, largest_difference(last, np.zeros(last.size))
