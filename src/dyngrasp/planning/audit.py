"""Whether a plan may be executed: every constraint evaluated anew, on a finer grid, by other means than the solver's.

The torques come from Pinocchio's full inverse dynamics with its velocity terms (the planner uses symbolic M v + g and
bounds), the funnel from the paper's formula as it stands, clearances from the collision geometry.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from dyngrasp.models.robot import RobotModel
from dyngrasp.planning.clearance import clearance_entries
from dyngrasp.planning.grasp_targets import GRAVITY, GraspTargets, GraspTask
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
    """One phase on the fine grid: times on the plan's clock (M,), arm (M, n) and gripper (M, m) states."""

    phase: str
    times: Array
    q: Array
    w: Array
    v: Array
    q_h: Array
    w_h: Array
    v_h: Array


def audit(plan: GraspPlan, targets: GraspTargets, task: GraspTask) -> AuditReport:
    """Evaluate every constraint of a plan.

    Args:
        plan: Any plan, whoever made it.
        targets: The boundary states and the grasp that it was made for.
        task: Arm, gripper, part and settings.

    Returns:
        One entry a constraint, each with the worst value, its bound and its time. A plan that fails one must not be
        executed.
    """
    phases = [_sample(plan, i) for i in range(len(PHASE_NAMES))]
    robots = (task.robot_empty, task.robot_empty, task.robot_loaded(targets.grasp))
    approach, grasp, deliver = phases
    entries = [
        _dynamics(plan),
        *_joins(plan),
        *_boundaries(plan, targets, task),
        *_box_entries("", phases, task.robot, plan.arm_joints),
        *_gripper_entries(phases, task),
        _torque(phases, robots, plan.arm_joints),
        _funnel(approach, targets, task),
        *_reversal(grasp, targets, task),
        _hold(deliver, targets, task),
        *clearance_entries(
            task,
            targets,
            {phase.phase: (phase.times, phase.q, phase.q_h) for phase in phases},
        ),
    ]
    return AuditReport(tuple(entries))


def _sample(plan: GraspPlan, i: int) -> _Samples:
    arm, gripper = plan.arm[i], plan.gripper[i]
    local = np.linspace(0.0, arm.duration, SUBSTEPS * max(arm.intervals, gripper.intervals) + 1)
    start = plan.phase_ends[i] - arm.duration
    return _Samples(PHASE_NAMES[i], start + local, *arm.sample_many(local), *gripper.sample_many(local))


def _at_most(
    name: str, values: Array, times: Array, bound: float, tolerance: float, unit: str, names=None
) -> AuditEntry:
    """Entry for values (M,) or (M, k) that must not exceed `bound`; `names` are those of the k columns."""
    table = values[:, None] if values.ndim == 1 else values
    # A NaN is the worst value there can be, and must not hide behind a comparison that it fails silently.
    row, column = np.unravel_index(np.argmax(np.where(np.isnan(table), np.inf, table)), table.shape)
    detail = names[column] if names else ""
    return AuditEntry(name, float(table[row, column]), bound, False, tolerance, unit, float(times[row]), detail)


def _at_least(name: str, values: Array, times: Array, bound: float, tolerance: float, unit: str) -> AuditEntry:
    row = int(np.argmin(np.where(np.isnan(values), -np.inf, values)))
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


def _boundaries(plan: GraspPlan, targets: GraspTargets, task: GraspTask) -> list[AuditEntry]:
    """Where the hand really is at T_1, T_2, T_3, from the plan's joints alone, against where it was sent."""
    settings = task.settings
    above = pin.SE3(np.eye(3), np.array([0.0, 0.0, settings.pregrasp_distance]))
    place = task.robot.forward_kinematics(targets.place.position)
    wanted = (
        targets.T_world_grasp * above,
        targets.T_world_grasp,
        place * _grasp_in_flange(task, targets.gripper_closed),
    )
    entries = []
    for name, i, T_wanted in zip(("pregrasp", "grasp", "place"), range(3), wanted, strict=True):
        T_flange = task.robot.forward_kinematics(plan.arm[i].position[-1])
        error = pin.log6(T_wanted.actInv(T_flange * _grasp_in_flange(task, plan.gripper[i].position[-1])))
        time = float(plan.phase_ends[i])
        distance, angle = float(np.linalg.norm(error.linear)), float(np.linalg.norm(error.angular))
        entries.append(AuditEntry(f"{name}_position", distance, 0.0, False, LENGTH_TOLERANCE, "m", time))
        entries.append(AuditEntry(f"{name}_angle", angle, 0.0, False, 1e-5, "rad", time))
    lift = _tip_velocity(task, plan.arm[1].position[-1], plan.arm[1].velocity[-1], plan.gripper[1].position[-1])[2]
    entries.append(
        AuditEntry("lift_velocity", float(lift), 0.0, True, LENGTH_TOLERANCE, "m/s", float(plan.phase_ends[1]))
    )
    rest = float(np.abs(plan.arm[2].velocity[-1]).max())
    entries.append(AuditEntry("rest_at_place", rest, 0.0, False, JOIN_TOLERANCE, "rad/s", plan.end_time))
    return entries


def _grasp_in_flange(task: GraspTask, q_h: Array) -> pin.SE3:
    return task.gripper.T_flange_hand * task.gripper.T_hand_grasp(q_h)


def _tip_velocity(task: GraspTask, q: Array, w: Array, q_h: Array) -> Array:
    """(3,) world velocity of the point of the hand where G is (m/s), the gripper taken as still."""
    T_flange = task.robot.forward_kinematics(q)
    lever = T_flange.rotation @ _grasp_in_flange(task, q_h).translation
    twist = task.robot.jacobian(q) @ w
    return twist[:3] + np.cross(twist[3:], lever)


def _box_entries(prefix: str, phases: list[_Samples], robot: RobotModel, names: tuple[str, ...]) -> list[AuditEntry]:
    limits = robot.limits
    middle, half = (
        (limits.position_upper + limits.position_lower) / 2,
        (limits.position_upper - limits.position_lower) / 2,
    )
    times = np.concatenate([p.times for p in phases])
    ratios: dict[str, Callable[[_Samples], Array]] = {
        "position": lambda p: np.abs(p.q - middle) / half,
        "velocity": lambda p: np.abs(p.w) / limits.velocity,
        "acceleration": lambda p: np.abs(p.v) / limits.acceleration,
    }
    return [
        _at_most(
            prefix + name, np.concatenate([ratio(p) for p in phases]), times, 1.0, RATIO_TOLERANCE, "of limit", names
        )
        for name, ratio in ratios.items()
    ]


def _gripper_entries(phases: list[_Samples], task: GraspTask) -> list[AuditEntry]:
    gripper = task.gripper
    middle, half = (gripper.upper + gripper.lower) / 2, (gripper.upper - gripper.lower) / 2
    times = np.concatenate([p.times for p in phases])
    table = {
        "gripper_position": np.concatenate([np.abs(p.q_h - middle) / half for p in phases]),
        "gripper_velocity": np.concatenate([np.abs(p.w_h) / gripper.velocity for p in phases]),
        "gripper_acceleration": np.concatenate([np.abs(p.v_h) / gripper.acceleration for p in phases]),
    }
    names = gripper.joint_names
    return [_at_most(name, v, times, 1.0, RATIO_TOLERANCE, "of limit", names) for name, v in table.items()]


def _torque(phases: list[_Samples], robots: tuple[RobotModel, ...], names: tuple[str, ...]) -> AuditEntry:
    """Full inverse dynamics, velocity terms included, against the whole torque limit; the part counts in phase 3."""
    ratios = np.concatenate(
        [
            [
                np.abs(robot.inverse_dynamics(q, w, v)) / robot.limits.torque
                for q, w, v in zip(p.q, p.w, p.v, strict=True)
            ]
            for p, robot in zip(phases, robots, strict=True)
        ]
    )
    times = np.concatenate([p.times for p in phases])
    return _at_most("torque", ratios, times, 1.0, RATIO_TOLERANCE, "of limit", names)


def _grasp_point(task: GraspTask, p: _Samples) -> tuple[Array, Array]:
    """World position of G (M, 3) and the grasp frame's rotation as the hand holds it (M, 3, 3)."""
    positions, rotations = [], []
    for q, q_h in zip(p.q, p.q_h, strict=True):
        T = task.robot.forward_kinematics(q) * _grasp_in_flange(task, q_h)
        positions.append(T.translation.copy())
        rotations.append(T.rotation.copy())
    return np.array(positions), np.array(rotations)


def _funnel(approach: _Samples, targets: GraspTargets, task: GraspTask) -> AuditEntry:
    """h(q) of eq. (7): the height of G in the grasp frame above the inverted Gaussian of eq. (6)."""
    funnel, T = task.grasp_object.funnel, targets.T_world_grasp
    G, _ = _grasp_point(task, approach)
    x, y, z = ((G - T.translation) @ T.rotation).T
    bell = np.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2))
    return _at_least("funnel", z - funnel.z_threshold * (1.0 - bell), approach.times, 0.0, CHORD_TOLERANCE, "m")


def _reversal(grasp: _Samples, targets: GraspTargets, task: GraspTask) -> list[AuditEntry]:
    """G stays on the grasp axis, does not pass far below the grasp frame, and the hand does not tilt as it closes."""
    settings, T = task.settings, targets.T_world_grasp
    G, rotations = _grasp_point(task, grasp)
    x, y, z = ((G - T.translation) @ T.rotation).T
    tilt = np.arccos(np.clip(rotations[:, :, 2] @ T.rotation[:, 2], -1.0, 1.0))
    lateral = np.hypot(x, y)
    return [
        _at_most("grasp_axis", lateral, grasp.times, settings.lateral_tolerance, CHORD_TOLERANCE, "m"),
        _at_least("grasp_dip", z, grasp.times, -settings.dip_tolerance, CHORD_TOLERANCE, "m"),
        _at_most("grasp_tilt", tilt, grasp.times, settings.tilt_tolerance, 1e-4, "rad"),
    ]


def _hold(deliver: _Samples, targets: GraspTargets, task: GraspTask) -> AuditEntry:
    """Share of the pinch's friction limit surface that the part asks for as it is carried, velocity terms included.

    Two pads pressed with N hold a tangential force 2 μ N and a moment 2 t N about the closing axis; the limit surface
    is taken as an ellipse. The safety factor is not applied here: at 1 the part would just slip.
    """
    part, gripper, robot = task.grasp_object, task.gripper, task.robot
    model, data = robot.pin_model, robot.pin_model.createData()
    frame = model.getFrameId(robot.tip_frame)
    in_flange = _grasp_in_flange(task, targets.gripper_closed)
    part_in_grasp = targets.grasp.T_object_grasp.inverse().act(part.spatial_inertia)
    gravity = pin.Motion(np.array([0.0, 0.0, GRAVITY]), np.zeros(3))
    shares = []
    for q, w, v in zip(deliver.q, deliver.w, deliver.v, strict=True):
        pin.forwardKinematics(model, data, q, w, v)
        pin.updateFramePlacement(model, data, frame)
        velocity = in_flange.actInv(pin.getFrameVelocity(model, data, frame, pin.LOCAL))
        acceleration = in_flange.actInv(pin.getFrameAcceleration(model, data, frame, pin.LOCAL))
        upward = pin.Motion((data.oMf[frame] * in_flange).rotation.T @ gravity.linear, np.zeros(3))
        wrench = part_in_grasp * (acceleration + upward) + velocity.cross(part_in_grasp * velocity)
        tangential = float(np.hypot(wrench.linear[0], wrench.linear[2])) / (
            2 * part.friction.sliding * gripper.pinch_force
        )
        torsion = float(wrench.angular[1]) / (2 * part.friction.torsional * gripper.pinch_force)
        shares.append(np.hypot(tangential, torsion))
    return _at_most("hold", np.array(shares), deliver.times, 1.0, RATIO_TOLERANCE, "of the grip")
