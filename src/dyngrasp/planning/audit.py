"""Whether a plan may be executed: every constraint evaluated anew, by other means than the solver's.

The torques come from recursive Newton-Euler with its velocity terms (the planner uses symbolic M v + g and bounds), the
funnel from the paper's formula as it stands, clearances from the collision geometry. The audit is part of every cycle
of replanning: all samples of a plan go through compiled loops at once, and between two grid points it looks only where
a constraint could be broken there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
from numba import njit

from dyngrasp.models.batch_dynamics import compose
from dyngrasp.planning.clearance import clearance_entries
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.part_motion import PartMotion, part_motion
from dyngrasp.planning.plan_samples import at_grid_points, between, waypoints_of
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
            _dynamics(plan),
            *_joins(plan),
            *_boundaries(plan, targets, part, models, task.settings.pregrasp_distance, since),
            *_along(plan, part, models, since, wall),
            *clearance_entries(task, targets, waypoints_of(plan, since)),
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
    span = AT_REST * (plan.end_time - plan.start_time)
    first, last = max(since, plan.start_time + span), plan.end_time - span
    slowest, time = np.inf, last
    for arm, T in zip(plan.arm, plan.phase_ends.tolist(), strict=True):
        begin, limit = T - arm.duration, task.robot.limits.velocity
        speed, at = _slowest(arm.duration, arm.velocity, arm.acceleration, limit, first - begin, last - begin)
        # A NaN, once found, stays.
        if not speed >= slowest and slowest == slowest:
            slowest, time = speed, begin + at
    return AuditEntry("standstill", slowest, LEAST_SPEED, True, 0.0, "of limit", time)


@njit(cache=True)
def _slowest(duration, velocity, acceleration, limit, first, last):
    """Least max-norm of velocities (N+1, n) over their limits from `first` to `last` (s), and its time.

    Looked at are the grid points and, half way between them, the quadratic that the velocity is there.
    """
    N, n = velocity.shape[0] - 1, velocity.shape[1]
    step, least, time = duration / N, np.inf, last
    for half in range(2 * N + 1):
        t, k = half * step / 2, half // 2
        if t < first or t > last:
            continue
        speed = 0.0
        for i in range(n):
            w = velocity[k, i]
            if half % 2:
                w = (w + velocity[k + 1, i]) / 2 - step / 8 * (acceleration[k + 1, i] - acceleration[k, i])
            share = abs(w) / limit[i]
            if not share <= speed and speed == speed:
                speed = share
        if not speed >= least and least == least:
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


def _dynamics(plan: GraspPlan) -> AuditEntry:
    defects = [
        largest_defect(x.duration, x.position, x.velocity, x.acceleration)
        for phase in zip(plan.arm, plan.gripper, strict=True)
        for x in phase
    ]
    worst = _worst_of(defects)
    start, phase = float(plan.phase_ends[worst // 2]) - plan.arm[worst // 2].duration, PHASE_NAMES[worst // 2]
    return AuditEntry("dynamics", defects[worst], 0.0, False, 1e-9, "rad, rad/s", start, phase)


def _joins(plan: GraspPlan) -> list[AuditEntry]:
    """Jumps of position and velocity at T_1 and T_2, over arm and gripper."""
    pairs = (*itertools.pairwise(plan.arm), *itertools.pairwise(plan.gripper))
    jumps = [_jumps(a.position, a.velocity, b.position, b.velocity) for a, b in pairs]
    entries = []
    for name, unit, found in zip(("position", "velocity"), ("rad", "rad/s"), zip(*jumps, strict=True), strict=True):
        worst = _worst_of(found)
        time = float(plan.phase_ends[worst % 2])
        entries.append(AuditEntry(f"join_{name}", found[worst], 0.0, False, JOIN_TOLERANCE, unit, time))
    return entries


def _worst_of(values: Sequence[float]) -> int:
    """Index of the first NaN, or else of the largest."""
    return max(range(len(values)), key=lambda i: np.inf if values[i] != values[i] else values[i])


@njit(cache=True)
def _jumps(q, w, next_q, next_w):
    return largest_difference(q[-1], next_q[0]), largest_difference(w[-1], next_w[0])


def _boundaries(
    plan: GraspPlan, targets: GraspTargets, part: PartMotion, models: PlanModels, above: float, since: float
) -> list[AuditEntry]:
    """Where the hand really is at T_1, T_2, T_3, from the plan's joints alone, against where it was sent."""
    q = np.array([*(phase.position[-1] for phase in plan.arm), targets.place.position]).T
    q_h = np.array([*(phase.position[-1] for phase in plan.gripper), targets.gripper_closed]).T
    both = models.configurations(q, q_h)
    R, p = np.empty((len(both), 3, 3, 4)), np.empty((len(both), 3, 4))
    models.hand.link_poses(both, R, p)
    frames, w, ends = models.hand_frames, plan.arm[1].velocity[-1], plan.phase_ends
    errors, lift = _boundary_errors(
        R, p, frames.links, frames.rotations, frames.positions, *part, *models.grasp_on_part, ends, above,
        targets.moving, models.arm_indices, w,
    )  # fmt: skip
    entries = []
    names = ("pregrasp", "grasp", "place")
    for time, name, (distance, angle) in zip(ends.tolist(), names, errors.tolist(), strict=True):
        if time >= since:
            entries.append(AuditEntry(f"{name}_position", distance, 0.0, False, LENGTH_TOLERANCE, "m", time))
            entries.append(AuditEntry(f"{name}_angle", angle, 0.0, False, 1e-5, "rad", time))
    entries.append(AuditEntry("lift_velocity", lift, 0.0, True, LENGTH_TOLERANCE, "m/s", float(ends[1])))
    rest = float(np.abs(plan.arm[2].velocity[-1]).max())
    entries.append(AuditEntry("rest_at_place", rest, 0.0, False, JOIN_TOLERANCE, "rad/s", plan.end_time))
    return entries


@njit(cache=True, error_model="numpy")
def _boundary_errors(
    R, p, links, turns, shifts, rotation, position, twist, arrival, R_part_grasp, p_part_grasp, ends, above, moving,
    arm, w,
):  # fmt: skip
    """Distance (m) and angle (rad) of the hand from where it was sent, (3, 2), and its velocity upwards at the grasp.

    Links (n, 3, 3, 4), (n, 3, 4) are posed as at the ends of the phases and as the place asks for. The hand was sent
    `above` the grasp frame, onto it, and to the place. The arm has velocities w (n,) at the grasp.
    """
    hand_R, hand_p = np.empty((3, 3, 3, 4)), np.empty((3, 3, 4))
    for f in range(3):
        compose(R[links[f]], p[links[f]], turns[f], shifts[f], hand_R[f], hand_p[f])
    offset, angle = hand_in_grasp_frame(
        hand_R, hand_p, rotation, position, twist, arrival, R_part_grasp, p_part_grasp, ends
    )
    offset[2, 0] -= above
    if moving:
        # A part that is not taken when it was to be rides on.
        late = max(ends[1] - arrival, 0.0)
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    offset[a, 1] -= late * R_part_grasp[b, a] * rotation[c, b] * twist[c]
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
    lift = 0.0
    for i in range(arm.size):
        j = arm[i]
        # Third row of axis × lever, for a joint that turns about its z axis.
        x, y = (
            (hand_p[1, 0, 1] + hand_p[2, 0, 1]) / 2 - p[j, 0, 1],
            (hand_p[1, 1, 1] + hand_p[2, 1, 1]) / 2 - p[j, 1, 1],
        )
        lift += w[i] * (R[j, 0, 2, 1] * y - R[j, 1, 2, 1] * x)
    return errors, lift
