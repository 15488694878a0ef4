"""The tracking programs of a plan's phases: which boundary states, which boxes, which bounds of the duration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets, GraspTask
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.carried_descent import DescentSettings
from dyngrasp.planning.replanning.tracking_qp import TrackingProblem, TrackingWeights, solve_tracking
from dyngrasp.signals import Array, JointState
from dyngrasp.trajectory import GraspPlan, Trajectory

APPROACH, GRASP, DELIVER = range(3)


@dataclass(frozen=True)
class TrackingSettings:
    """How the rest of a plan follows new targets.

    Attributes:
        weights: Of the deviations from the running plan.
        velocity_fraction: Part of the speed limits that a plan may use, as the planner's; the rest serves the
            controller.
        position_margin: Distance kept from the position limits (rad), less where a boundary state is closer.
        shortest, longest: Bounds on a duration, as shares of the one before.
        paper_rows: See `TrackingProblem`.
        descents: Ways through the funnel, the gentlest first; a way is tried where the audit refuses the ones before.
    """

    weights: TrackingWeights = field(default_factory=TrackingWeights)
    velocity_fraction: float = 0.95
    position_margin: float = 0.01
    shortest: float = 0.5
    longest: float = 2.0
    paper_rows: bool = False
    descents: tuple[DescentSettings, ...] = (DescentSettings(earliest=0.6), DescentSettings())


def whole_phase(
    plan: GraspPlan, phase: int, start: BoundaryState, end: BoundaryState, task: GraspTask, settings: TrackingSettings
) -> TrackingProblem:
    """The program of a phase that has not begun."""
    reference = plan.arm[phase]
    shortest = max(settings.shortest * reference.duration, hand_needs(plan.gripper[phase], task))
    longest = settings.longest * reference.duration
    if phase == GRASP:
        # The plan's own duration stays admissible, whoever chose it.
        shortest = max(shortest, min(task.settings.grasp_duration_min, reference.duration))
        longest = min(longest, max(task.settings.grasp_duration_max, reference.duration, shortest))
    return program_between(
        reference,
        np.array((start.position, start.velocity, reference.acceleration[0])),
        np.array((end.position, end.velocity, reference.acceleration[-1])),
        (settings.paper_rows, settings.paper_rows),
        (shortest, longest),
        task,
        settings,
    )


def hand_needs(trajectory: Trajectory, task: GraspTask) -> float:
    """The least duration in which the hand's limits allow the same path (s)."""
    by_velocity = _largest_share(trajectory.velocity, task.gripper.velocity)
    by_acceleration = _largest_share(trajectory.acceleration, task.gripper.acceleration)
    return trajectory.duration * max(by_velocity, math.sqrt(by_acceleration))


@njit(cache=True, error_model="numpy")
def _largest_share(rates: Array, limits: Array) -> float:
    """Largest |rate| of (N+1, n) over its limit (n,)."""
    largest = 0.0
    for j in range(limits.size):
        for k in range(rates.shape[0]):
            largest = max(largest, abs(rates[k, j]) / limits[j])
    return largest


def splice_program(
    reference: Trajectory,
    state: JointState,
    end: BoundaryState,
    task: GraspTask,
    settings: TrackingSettings,
    node_weights: Array | None,
) -> TrackingProblem:
    """The program of the arm from its state at the splice."""
    return program_between(
        reference,
        np.array((state.position, state.velocity, state.acceleration)),
        np.array((end.position, end.velocity, reference.acceleration[-1])),
        (True, settings.paper_rows),
        (settings.shortest * reference.duration, settings.longest * reference.duration),
        task,
        settings,
        node_weights,
    )


def with_hand(
    arm: TrackingProblem, hand: Trajectory, state: JointState, targets: GraspTargets, task: GraspTask
) -> TrackingProblem:
    """The same program with the moving joints of the hand beside those of the arm."""
    gripper = task.gripper
    zero = np.zeros_like(targets.gripper_open)
    start = np.array([state.position, state.velocity, state.acceleration])
    end = np.array([targets.gripper_open, zero, zero])
    reference = Trajectory(
        arm.reference.duration,
        np.hstack([arm.reference.position, hand.position]),
        np.hstack([arm.reference.velocity, hand.velocity]),
        np.hstack([arm.reference.acceleration, hand.acceleration]),
    )
    return TrackingProblem(
        reference,
        np.hstack([arm.start, start]),
        np.hstack([arm.end, end]),
        arm.hold_start_acceleration,
        arm.hold_end_acceleration,
        np.concatenate([arm.position_lower, np.minimum(gripper.lower, start[0])]),
        np.concatenate([arm.position_upper, np.maximum(gripper.upper, start[0])]),
        np.concatenate([arm.velocity_limit, gripper.velocity]),
        np.concatenate([arm.acceleration_limit, gripper.acceleration]),
        arm.min_duration,
        arm.max_duration,
        arm.weights,
        arm.paper_rows,
        arm.node_weights,
    )


def program_between(
    reference: Trajectory,
    start: Array,
    end: Array,
    held: tuple[bool, bool],
    durations: tuple[float, float],
    task: GraspTask,
    settings: TrackingSettings,
    node_weights: Array | None = None,
) -> TrackingProblem:
    """The program between two states (3, n), its boxes the limits less what a plan keeps from them.

    Args:
        reference: The motion that it stays near.
        start: Position, velocity and acceleration.
        end: The same there.
        held: Whether the accelerations are given.
        durations: Bounds of ΔT (s).
        task: Whose limits.
        settings: How.
        node_weights: See `TrackingProblem`.
    """
    limits, boxes = task.robot.limits, np.empty((3, len(start[0])))
    margin, fraction = settings.position_margin, settings.velocity_fraction
    _inner_boxes(start, end, limits.position_lower, limits.position_upper, limits.velocity, margin, fraction, boxes)
    return TrackingProblem(
        reference,
        start,
        end,
        *held,
        boxes[0],
        boxes[1],
        boxes[2],
        limits.acceleration,
        *durations,
        settings.weights,
        settings.paper_rows,
        node_weights,
    )


@njit(cache=True, error_model="numpy")
def _inner_boxes(start, end, lower, upper, velocity, margin, fraction, boxes):
    """Write q_min, q_max, q̇_max: the limits less what is kept from them, but never less than both ends need."""
    for j in range(lower.size):
        lowest, highest = min(start[0, j], end[0, j]), max(start[0, j], end[0, j])
        fastest = max(abs(start[1, j]), abs(end[1, j]))
        boxes[0, j] = max(min(lower[j] + margin, lowest), lower[j])
        boxes[1, j] = min(max(upper[j] - margin, highest), upper[j])
        boxes[2, j] = min(max(fraction * velocity[j], fastest), velocity[j])


def hold_start(
    motion: Trajectory, state: JointState, end: BoundaryState, task: GraspTask, settings: TrackingSettings
) -> Trajectory | None:
    """The motion nearest to a given one, in the same time, with the first acceleration of `state`; None if none is.

    Solvers of whole phases choose the first acceleration freely; at a splice it is what the running plan has there.
    """
    problem = program_between(
        motion,
        np.array([state.position, state.velocity, state.acceleration]),
        np.array([end.position, end.velocity, motion.acceleration[-1]]),
        (True, False),
        (motion.duration, motion.duration),
        task,
        settings,
    )
    solution = solve_tracking(problem)
    return solution.trajectory(problem) if solution.status is Status.CONVERGED else None
