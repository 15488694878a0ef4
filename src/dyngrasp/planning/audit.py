"""Whether a plan may be executed: every constraint evaluated anew, on a finer grid, by other means than the solver's.

The torques come from recursive Newton-Euler with its velocity terms (the planner uses symbolic M v + g and bounds), the
funnel from the paper's formula as it stands, clearances from the collision geometry. All samples of a plan go through
compiled loops at once: the audit is part of every cycle of replanning.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.models.assembly import Assembly, assemble
from dyngrasp.models.batch_dynamics import Attachments, BatchModel, wrench_on
from dyngrasp.models.kinematic_tree import frames_named
from dyngrasp.models.pinch import pad_loads
from dyngrasp.planning.clearance import clearance_entries
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import AuditEntry, AuditReport
from dyngrasp.signals import Array
from dyngrasp.trajectory import JOIN_TOLERANCE, PHASE_NAMES, GraspPlan, Trajectory

# Samples between neighbouring grid points: an acceleration that is linear in between peaks at the ends, a velocity
# that is quadratic peaks once inside; four see it to a sixteenth of its height.
SUBSTEPS = 4

# Rounding of a ratio to a limit after a solver that stops at 1e-8 in its own scaling.
RATIO_TOLERANCE = 1e-6

# Rounding of a length (m): ten times below what any sensor or actuator of the cell resolves.
LENGTH_TOLERANCE = 1e-6

# The trapezoid between two grid points of a curved tube or funnel leaves it by a chord's height (m).
CHORD_TOLERANCE = 5e-5


@dataclass(frozen=True)
class _Samples:
    """A plan on the fine grid, phase after phase: times on its clock (M,), arm (M, n) and gripper (M, m) states.

    `phases` are the three slices of M.
    """

    phases: tuple[slice, slice, slice]
    times: Array
    q: Array
    w: Array
    v: Array
    q_h: Array
    w_h: Array
    v_h: Array


class _Models:
    """What does not change from plan to plan: arrays of the arm empty and loaded, frames of flange and pads."""

    def __init__(self, task: GraspTask, grasp_name: str) -> None:
        grasp = next(grasp for grasp in task.grasp_object.grasps if grasp.name == grasp_name)
        self.empty = BatchModel.from_pinocchio(task.robot_empty.loaded_model)
        self.loaded = BatchModel.from_pinocchio(task.robot_loaded(grasp).loaded_model)
        self.assembly: Assembly = assemble(task.robot, task.gripper)
        self.tree = BatchModel.from_pinocchio(self.assembly.pin_model)
        pads = (frames_named(self.assembly.pin_model, name)[0] for name in task.gripper.pads)
        ids = [self.assembly.flange_id, *pads]
        frames = [self.assembly.pin_model.frames[i] for i in ids]
        placed = [(int(frame.parentJoint), pin.SE3(frame.placement)) for frame in frames]
        # The axes of the pinch are those of the hand; only its origin depends on the fingers.
        hand = placed[0][1] * task.gripper.T_flange_hand * task.gripper.T_hand_grasp(task.gripper.open_posture)
        self.hand_frames: Attachments = self.tree.attach([(placed[0][0], hand), *placed[1:]])

    def hand(self, q: Array, q_h: Array) -> tuple[Array, Array]:
        """The grasp frame as the hand holds it, in the world: rotations (M, 3, 3), positions of G (M, 3)."""
        both = np.empty((len(q), self.tree.parents.size))
        both[:, self.assembly.arm_indices], both[:, self.assembly.hand_indices] = q, q_h
        R, p = self.tree.poses(both, self.hand_frames)
        return R[:, 0], (p[:, 1] + p[:, 2]) / 2


@lru_cache(maxsize=8)
def _models(task: GraspTask, grasp_name: str) -> _Models:
    return _Models(task, grasp_name)


def audit(plan: GraspPlan, targets: GraspTargets, task: GraspTask, since: float = -np.inf) -> AuditReport:
    """Evaluate every constraint of a plan.

    Args:
        plan: Any plan, whoever made it.
        targets: The boundary states and the grasp that it was made for.
        task: Arm, gripper, part and settings.
        since: What comes before this time (s) is past and not looked at; before the end of the plan.

    Returns:
        One entry a constraint, each with the worst value, its bound and its time. A plan that fails one must not be
        executed.
    """
    models = _models(task, targets.grasp.name)
    samples = _sample(plan, since)
    approach, grasp, deliver = samples.phases
    torques, _ = models.empty.inverse_dynamics(*(x[: grasp.stop] for x in (samples.q, samples.w, samples.v)))
    loaded, motion = models.loaded.inverse_dynamics(*(x[deliver] for x in (samples.q, samples.w, samples.v)))
    R, G = models.hand(samples.q[: grasp.stop], samples.q_h[: grasp.stop])
    G, angles = _seen_from_grasp(R, G, samples.times[: grasp.stop], targets)
    entries = [
        _dynamics(plan),
        *_joins(plan),
        *_boundaries(plan, targets, task, models, since),
        *_box_entries(samples, plan, task),
        _at_most(
            "torque",
            np.abs(np.concatenate([torques, loaded])) / task.robot.limits.torque,
            samples.times,
            1.0,
            RATIO_TOLERANCE,
            "of limit",
            plan.arm_joints,
        ),
        *_funnel(G[approach], samples.times[approach], task),
        *_reversal(G[grasp], angles[grasp], samples.times[grasp], task),
        _hold(motion, samples.times[deliver], targets, task, models),
        *clearance_entries(
            task,
            targets,
            {
                name: (samples.times[part], samples.q[part], samples.q_h[part])
                for name, part in zip(PHASE_NAMES, samples.phases, strict=True)
            },
        ),
    ]
    return AuditReport(tuple(entries))


def _sample(plan: GraspPlan, since: float) -> _Samples:
    tables, phases, end = [], [], 0
    for arm, gripper, T in zip(plan.arm, plan.gripper, plan.phase_ends, strict=True):
        count = SUBSTEPS * max(arm.intervals, gripper.intervals) + 1
        local = np.linspace(max(since - (T - arm.duration), 0.0), arm.duration, count if since < T else 0)
        tables.append((T - arm.duration + local, *arm.sample_many(local), *gripper.sample_many(local)))
        phases.append(slice(end, end + local.size))
        end += local.size
    return _Samples(tuple(phases), *(np.concatenate(column) for column in zip(*tables, strict=True)))


def _at_most(
    name: str,
    values: Array,
    times: Array,
    bound: float,
    tolerance: float,
    unit: str,
    names: tuple[str, ...] | None = None,
) -> AuditEntry:
    """Entry for values (M,) or (M, k) that must not exceed `bound`; `names` are those of the k columns."""
    # numpy's argmax and argmin stop at a NaN: it is the worst value there can be.
    table = values.reshape(times.size, -1)
    row, column = np.unravel_index(int(np.argmax(table)), table.shape)
    detail = names[column] if names else ""
    return AuditEntry(name, float(table[row, column]), bound, False, tolerance, unit, float(times[row]), detail)


def _at_least(name: str, values: Array, times: Array, bound: float, tolerance: float, unit: str) -> AuditEntry:
    row = int(np.argmin(values))
    return AuditEntry(name, float(values[row]), bound, True, tolerance, unit, float(times[row]))


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
            max(float(np.abs(getattr(a, name)[-1] - getattr(b, name)[0]).max()) for a, b in pairs)
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
    R, G = models.hand(np.array([*ends, targets.place.position]), np.array([*fingers, targets.gripper_closed]))
    inside, angles = _seen_from_grasp(R[:2], G[:2], plan.phase_ends[:2], targets)
    above = np.array([0.0, 0.0, task.settings.pregrasp_distance])
    errors = (
        ("pregrasp", inside[0] - above, angles[0]),
        ("grasp", inside[1], angles[1]),
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


def _box_entries(samples: _Samples, plan: GraspPlan, task: GraspTask) -> list[AuditEntry]:
    """Positions, velocities and accelerations of arm and gripper as parts of their limits."""
    limits, gripper = task.robot.limits, task.gripper
    table = (
        ("position", _off_centre(samples.q, limits.position_lower, limits.position_upper), plan.arm_joints),
        ("velocity", np.abs(samples.w) / limits.velocity, plan.arm_joints),
        ("acceleration", np.abs(samples.v) / limits.acceleration, plan.arm_joints),
        ("gripper_position", _off_centre(samples.q_h, gripper.lower, gripper.upper), plan.gripper_joints),
        ("gripper_velocity", np.abs(samples.w_h) / gripper.velocity, plan.gripper_joints),
        ("gripper_acceleration", np.abs(samples.v_h) / gripper.acceleration, plan.gripper_joints),
    )
    return [
        _at_most(name, values, samples.times, 1.0, RATIO_TOLERANCE, "of limit", names) for name, values, names in table
    ]


def _off_centre(q: Array, lower: Array, upper: Array) -> Array:
    """Distance from the middle of the range over its half-width."""
    return np.abs(q - (upper + lower) / 2) / ((upper - lower) / 2)


def _funnel(G: Array, times: Array, task: GraspTask) -> list[AuditEntry]:
    """h(q) of eq. (6): the height of G (M, 3) in the grasp frame above the inverted Gaussian of eq. (5)."""
    if not times.size:
        return []
    funnel = task.grasp_object.funnel
    x, y, z = G.T
    bell = np.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2))
    return [_at_least("funnel", z - funnel.z_threshold * (1.0 - bell), times, 0.0, CHORD_TOLERANCE, "m")]


def _reversal(G: Array, angles: Array, times: Array, task: GraspTask) -> list[AuditEntry]:
    """G stays on the grasp axis, does not pass far below the grasp frame, and the hand does not turn as it closes."""
    if not times.size:
        return []
    settings = task.settings
    lateral = np.hypot(G[:, 0], G[:, 1])
    return [
        _at_most("grasp_axis", lateral, times, settings.lateral_tolerance, CHORD_TOLERANCE, "m"),
        _at_least("grasp_dip", G[:, 2], times, -settings.dip_tolerance, CHORD_TOLERANCE, "m"),
        _at_most("grasp_tilt", angles, times, settings.tilt_tolerance, 1e-4, "rad"),
    ]


def _hold(motion: Array, times: Array, targets: GraspTargets, task: GraspTask, models: _Models) -> AuditEntry:
    """Share of its friction that the busier pad needs to carry the part, velocity terms included.

    The safety factor of the planner is not applied here: at 1 the part would just slip.
    """
    robot = task.robot
    in_flange = task.gripper.T_flange_hand * task.gripper.T_hand_grasp(targets.gripper_closed)
    frame = models.loaded.attach([(robot.n, robot.T_last_flange * in_flange)])
    T_link_grasp = pin.SE3(frame.rotations[0], frame.positions[0])
    body = (T_link_grasp * targets.grasp.T_object_grasp.inverse()).act(task.grasp_object.spatial_inertia)
    wrench = wrench_on(body, motion)
    force = wrench[:, :3] @ T_link_grasp.rotation
    moment = (wrench[:, 3:] - np.cross(T_link_grasp.translation, wrench[:, :3])) @ T_link_grasp.rotation
    loads = pad_loads(force.T, moment.T, task.pinch(targets.grasp))
    shares = [np.sqrt(load) / np.maximum(normal, 1e-9) for load, normal in loads]
    return _at_most("hold", np.maximum(*shares), times, 1.0, RATIO_TOLERANCE, "of the grip")
