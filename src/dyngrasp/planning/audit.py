"""Whether a plan may be executed: every constraint evaluated anew, by other means than the solver's.

The torques come from recursive Newton-Euler with its velocity terms (the planner uses symbolic M v + g and bounds), the
funnel from the paper's formula as it stands, clearances from the collision geometry. The audit is part of every cycle
of replanning: all samples of a plan go through compiled loops at once, and between two grid points it looks only where
a constraint could be broken there.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import lru_cache

import numpy as np
import pinocchio as pin
from numba import njit

from dyngrasp.models.assembly import Assembly, assemble
from dyngrasp.models.batch_dynamics import Attachments, BatchModel, wrench_on
from dyngrasp.models.kinematic_tree import frames_named
from dyngrasp.models.pinch import pad_loads
from dyngrasp.planning.clearance import clearance_entries, waypoints_of
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.plan_samples import PlanSamples, Row, at_grid_points, between, worse
from dyngrasp.planning.problem import AuditEntry, AuditReport
from dyngrasp.signals import Array
from dyngrasp.trajectory import JOIN_TOLERANCE, PHASE_NAMES, GraspPlan, Trajectory, largest_difference

# An arm slower than this, in parts of its joints' speed limits, has come to a standstill: half as much again as what is
# called one when an episode is judged, for tracking is not exact. At both ends of a plan this part of it may be slower.
LEAST_SPEED, AT_REST = 0.015, 0.02

# Rounding of a ratio to a limit after a solver that stops at 1e-8 in its own scaling.
RATIO_TOLERANCE = 1e-6

# Rounding of a length (m): ten times below what any sensor or actuator of the cell resolves.
LENGTH_TOLERANCE = 1e-6

# The trapezoid between two grid points of a curved tube or funnel leaves it by a chord's height (m).
CHORD_TOLERANCE = 5e-5


class _Models:
    """What does not change from plan to plan: arrays of the arm empty and loaded, frames of flange and pads."""

    def __init__(self, task: GraspTask, grasp_name: str) -> None:
        grasp = next(grasp for grasp in task.grasp_object.grasps if grasp.name == grasp_name)
        robot = task.robot
        self.empty = BatchModel.from_pinocchio(task.robot_empty.loaded_model)
        self.loaded = BatchModel.from_pinocchio(task.robot_loaded(grasp).loaded_model)
        self.assembly: Assembly = assemble(robot, task.gripper)
        self.tree = BatchModel.from_pinocchio(self.assembly.pin_model)
        pads = (frames_named(self.assembly.pin_model, name)[0] for name in task.gripper.pads)
        ids = [self.assembly.flange_id, *pads]
        frames = [self.assembly.pin_model.frames[i] for i in ids]
        placed = [(int(frame.parentJoint), pin.SE3(frame.placement)) for frame in frames]
        # The axes of the pinch are those of the hand; only its origin depends on the fingers.
        hand = placed[0][1] * task.T_flange_open
        self.hand_frames: Attachments = self.tree.attach([(placed[0][0], hand), *placed[1:]])
        held = self.loaded.attach([(robot.n, robot.T_last_flange * task.T_flange_closed(grasp))])
        self.T_link_held = pin.SE3(held.rotations[0], held.positions[0])
        self.held_body = (self.T_link_held * grasp.T_object_grasp.inverse()).act(task.grasp_object.spatial_inertia)
        self.pinch = task.pinch(grasp)

    def hand(self, q: Array, q_h: Array) -> tuple[Array, Array]:
        """The grasp frame as the hand holds it, in the world: rotations (M, 3, 3), positions of G (M, 3).

        For arm (n, M) and gripper (m, M) positions.
        """
        both = np.empty((self.tree.parents.size, q.shape[1]))
        both[self.assembly.arm_indices], both[self.assembly.hand_indices] = q, q_h
        R, p = self.tree.poses(both, self.hand_frames)
        return np.moveaxis(R[0], -1, 0), (p[1] + p[2]).T / 2


@lru_cache(maxsize=8)
def _models(task: GraspTask, grasp_name: str) -> _Models:
    return _Models(task, grasp_name)


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
    models = _models(task, targets.grasp.name)
    grid = at_grid_points(plan, since)
    rows = _rows(grid, plan, targets, task, models, wall)
    worst = [row.entry(grid.times) for row in rows]
    finer = between(plan, grid, rows)
    if finer is not None:
        inside = {row.name: row.entry(finer.times) for row in _rows(finer, plan, targets, task, models, wall)}
        worst = [worse(entry, inside.get(entry.name, entry)) for entry in worst]
    entries = [
        _dynamics(plan),
        *_joins(plan),
        *_boundaries(plan, targets, task, models, since),
        *worst,
        *clearance_entries(task, targets, waypoints_of(plan, since)),
    ]
    return AuditReport(tuple(entries))


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


def _rows(
    samples: PlanSamples,
    plan: GraspPlan,
    targets: GraspTargets,
    task: GraspTask,
    models: _Models,
    wall: Callable[[Array], Array],
) -> list[Row]:
    """The constraints on every sample; those of a phase without samples are left out."""
    approach, grasp, deliver = samples.phases
    empty = slice(0, grasp.stop)
    rows = _boxes(samples, plan, task)
    torques = np.empty_like(samples.q)
    torques[:, empty], _ = models.empty.inverse_dynamics(*samples.arm(empty))
    torques[:, deliver], motion = models.loaded.inverse_dynamics(*samples.arm(deliver))
    ratios = np.abs(torques) / task.robot.limits.torque[:, None]
    rows.append(Row("torque", ratios, 0, 1.0, RATIO_TOLERANCE, "of limit", names=plan.arm_joints))
    if empty.stop:
        R, G = models.hand(samples.q[:, empty], samples.q_h[:, empty])
        G, angles = _seen_from_grasp(R, G, samples.times[empty], targets)
        if approach.stop:
            rows.append(_funnel(G[approach], wall(samples.times[approach]), task))
        if grasp.stop > grasp.start:
            rows += _reversal(G[grasp], angles[grasp], grasp.start, task)
    if deliver.stop > deliver.start:
        rows.append(_hold(motion, deliver.start, models))
    return rows


def _dynamics(plan: GraspPlan) -> AuditEntry:
    defects = [max(a.dynamics_defect(), g.dynamics_defect()) for a, g in zip(plan.arm, plan.gripper, strict=True)]
    worst = int(np.argmax(defects))
    start = float(plan.phase_ends[worst] - plan.durations[worst])
    return AuditEntry("dynamics", defects[worst], 0.0, False, 1e-9, "rad, rad/s", start, PHASE_NAMES[worst])


def _joins(plan: GraspPlan) -> list[AuditEntry]:
    """Jumps of position and velocity at T_1 and T_2, over arm and gripper."""
    entries = []
    for name, unit in (("position", "rad"), ("velocity", "rad/s")):
        jumps = [
            max(largest_difference(getattr(a, name)[-1], getattr(b, name)[0]) for a, b in pairs)
            for pairs in zip(_neighbours(plan.arm), _neighbours(plan.gripper), strict=True)
        ]
        worst = int(np.argmax(jumps))
        time = float(plan.phase_ends[worst])
        entries.append(AuditEntry(f"join_{name}", jumps[worst], 0.0, False, JOIN_TOLERANCE, unit, time))
    return entries


def _neighbours(phases: tuple[Trajectory, ...]) -> list[tuple[Trajectory, Trajectory]]:
    return list(itertools.pairwise(phases))


def _boundaries(
    plan: GraspPlan, targets: GraspTargets, task: GraspTask, models: _Models, since: float
) -> list[AuditEntry]:
    """Where the hand really is at T_1, T_2, T_3, from the plan's joints alone, against where it was sent."""
    ends = [phase.position[-1] for phase in plan.arm]
    fingers = [phase.position[-1] for phase in plan.gripper]
    R, G = models.hand(np.array([*ends, targets.place.position]).T, np.array([*fingers, targets.gripper_closed]).T)
    inside, angles = _seen_from_grasp(R[:2], G[:2], plan.phase_ends[:2], targets)
    above = np.array([0.0, 0.0, task.settings.pregrasp_distance])
    # A part that is not taken when it was to be rides on.
    late = max(float(plan.phase_ends[1]) - targets.grasp_time, 0.0) if targets.moving else 0.0
    rode = late * targets.T_world_grasp.rotation.T @ targets.twist_world[:3]
    errors = (
        ("pregrasp", inside[0] - above, angles[0]),
        ("grasp", inside[1] - rode, angles[1]),
        ("place", G[2] - G[3], _angles(R[2], R[3])),
    )
    entries = []
    for time, (name, offset, angle) in zip(plan.phase_ends.tolist(), errors, strict=True):
        if time < since:
            continue
        distance = float(np.linalg.norm(offset))
        entries.append(AuditEntry(f"{name}_position", distance, 0.0, False, LENGTH_TOLERANCE, "m", time))
        entries.append(AuditEntry(f"{name}_angle", float(angle), 0.0, False, 1e-5, "rad", time))
    q, w = plan.arm[1].position[-1], plan.arm[1].velocity[-1]
    twist = task.robot.jacobian(q) @ w
    lever = G[1] - task.robot.forward_kinematics(q).translation
    lift = float(twist[2] + twist[3] * lever[1] - twist[4] * lever[0])
    time = float(plan.phase_ends[1])
    entries.append(AuditEntry("lift_velocity", lift, 0.0, True, LENGTH_TOLERANCE, "m/s", time))
    rest = float(np.abs(plan.arm[2].velocity[-1]).max())
    entries.append(AuditEntry("rest_at_place", rest, 0.0, False, JOIN_TOLERANCE, "rad/s", plan.end_time))
    return entries


def _seen_from_grasp(R: Array, G: Array, times: Array, targets: GraspTargets) -> tuple[Array, Array]:
    """G (M, 3) in the grasp frame where the part is at each time, and the angle of the hand against it (M,)."""
    if not targets.moving:
        T = targets.T_world_grasp
        return (G - T.translation) @ T.rotation, _angles(R, T.rotation)
    R_part, p_part = targets.part_poses(times)
    R_grasp = R_part @ targets.grasp.T_object_grasp.rotation
    origin = p_part + R_part @ targets.grasp.T_object_grasp.translation
    return ((G - origin)[:, None] @ R_grasp)[:, 0], _angles(R, R_grasp)


def _angles(R: Array, other: Array) -> Array:
    """Angle (...) between rotations (..., 3, 3); from their difference, which is exact near zero."""
    chord = np.sqrt(((R - other) ** 2).sum(axis=(-2, -1)) / 8)
    return 2 * np.arcsin(np.minimum(chord, 1.0))


def _boxes(samples: PlanSamples, plan: GraspPlan, task: GraspTask) -> list[Row]:
    """Positions, velocities and accelerations of arm and gripper as parts of their limits."""
    limits, gripper = task.robot.limits, task.gripper
    table = (
        ("position", _off_centre(samples.q, limits.position_lower, limits.position_upper), plan.arm_joints),
        ("velocity", np.abs(samples.w) / limits.velocity[:, None], plan.arm_joints),
        ("acceleration", np.abs(samples.v) / limits.acceleration[:, None], plan.arm_joints),
        ("gripper_position", _off_centre(samples.q_h, gripper.lower, gripper.upper), plan.gripper_joints),
        ("gripper_velocity", np.abs(samples.w_h) / gripper.velocity[:, None], plan.gripper_joints),
        ("gripper_acceleration", np.abs(samples.v_h) / gripper.acceleration[:, None], plan.gripper_joints),
    )
    return [
        Row(name, values, 0, 1.0, RATIO_TOLERANCE, "of limit", names=names, straight=name.endswith("acceleration"))
        for name, values, names in table
    ]


def _off_centre(q: Array, lower: Array, upper: Array) -> Array:
    """Distance of q (n, M) from the middle of the range over its half-width."""
    return np.abs(q - ((upper + lower) / 2)[:, None]) / ((upper - lower) / 2)[:, None]


def _funnel(G: Array, wall: Array, task: GraspTask) -> Row:
    """h(q) of eq. (6): how high G (m, 3) is in the grasp frame above the inverted Gaussian of eq. (5) times `wall`."""
    funnel = task.grasp_object.funnel
    x, y, z = G.T
    bell = np.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2))
    height = z - wall * funnel.z_threshold * (1.0 - bell)
    return Row("funnel", height[None], 0, 0.0, CHORD_TOLERANCE, "m", at_least=True)


def _reversal(G: Array, angles: Array, first: int, task: GraspTask) -> list[Row]:
    """G stays on the grasp axis, does not pass far below the grasp frame, and the hand does not turn as it closes."""
    settings, (x, y, z) = task.settings, G.T
    return [
        Row("grasp_axis", np.hypot(x, y)[None], first, settings.lateral_tolerance, CHORD_TOLERANCE, "m"),
        Row("grasp_dip", z[None], first, -settings.dip_tolerance, CHORD_TOLERANCE, "m", at_least=True),
        Row("grasp_tilt", angles[None], first, settings.tilt_tolerance, 1e-4, "rad"),
    ]


def _hold(motion: Array, first: int, models: _Models) -> Row:
    """Share of its friction that the busier pad needs to carry the part, velocity terms included.

    The safety factor of the planner is not applied here: at 1 the part would just slip.
    """
    wrench, T = wrench_on(models.held_body, motion), models.T_link_held
    force = T.rotation.T @ wrench[:3]
    moment = T.rotation.T @ (wrench[3:] - pin.skew(T.translation) @ wrench[:3])
    loads = pad_loads(force, moment, models.pinch)
    shares = [np.sqrt(load) / np.maximum(normal, 1e-9) for load, normal in loads]
    return Row("hold", np.maximum(*shares)[None], first, 1.0, RATIO_TOLERANCE, "of the grip")
