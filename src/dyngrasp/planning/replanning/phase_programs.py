"""The tracking programs of a plan's phases: which boundary states, which boxes, which bounds of the duration."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numba import njit

from dyngrasp.lanes import whole_lanes, widen
from dyngrasp.motion_arrays import PhaseArrays, Phases, interpolate
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTask
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.carried_descent import Descent, DescentSettings, bend
from dyngrasp.planning.replanning.interior_point import OPTIMAL
from dyngrasp.planning.replanning.joint_splines import Filters
from dyngrasp.planning.replanning.tracking_kernel import Weights, solve, write_motion
from dyngrasp.planning.replanning.tracking_qp import TrackingProblem, TrackingWeights, solve_tracking
from dyngrasp.signals import Array, JointState, read_only
from dyngrasp.trajectory import Trajectory

APPROACH, GRASP, DELIVER = range(3)

Rules = tuple[Weights, float, float, float, float, bool]  # of `TrackingSettings.rules`
Limits = tuple[Array, Array, float, float]  # of `limits_of`
States = tuple[tuple[Array, Array], ...]  # q and q̇ (n,) at the end of each phase


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

    @cached_property
    def rules(self) -> Rules:
        """What compiled code takes for all but the descents: weights, margin, fraction, shortest, longest, rows."""
        kept, bounds = (self.position_margin, self.velocity_fraction), (self.shortest, self.longest)
        return self.weights.numbers, *map(float, kept), *map(float, bounds), bool(self.paper_rows)  # type: ignore[return-value]


@lru_cache(maxsize=8)
def limits_of(task: GraspTask) -> Limits:
    """What compiled code takes for the limits of a task.

    Returns:
        Lower and upper position (rad), velocity (rad/s) and acceleration (rad/s²) of the arm (4, n) and of the hand
        (4, m); the least and the greatest duration of the grasp (s).
    """
    arm, hand, grasp = task.robot.limits, task.gripper, task.settings
    return (
        read_only([arm.position_lower, arm.position_upper, arm.velocity, arm.acceleration]),
        read_only([hand.lower, hand.upper, hand.velocity, hand.acceleration]),
        float(grasp.grasp_duration_min),
        float(grasp.grasp_duration_max),
    )


@njit(cache=True, error_model="numpy")
def track_phases(
    arm: Phases,
    hand: Phases,
    begun: int,
    start: float,
    states: States,
    gripper_open: Array,
    descent: Descent,
    limits: Limits,
    rules: Rules,
    filters: tuple[Filters, ...],
    arm_motions: tuple[Array, ...],
    hand_motions: tuple[Array, ...],
) -> tuple[int, int, tuple[float, float, float], int]:
    """Solve the program of each phase from `begun` on, until one fails.

    Args:
        arm: The running plan's, as of `GraspPlan.arrays`.
        hand: The same.
        begun: The phase in which the new motion begins, APPROACH or GRASP.
        start: How long after the beginning of that phase (s).
        states: Of the new targets.
        gripper_open: (m,) where the hand is at the end of the approach (rad).
        descent: Of `carried_descent`.
        limits: Of `limits_of`.
        rules: Of `TrackingSettings`.
        filters: Of `joint_splines.filters`; as many grid points of each phase are tracked, its last ones.
        arm_motions: (3, N+1, n) for each phase, overwritten by q, q̇, q̈.
        hand_motions: (3, N+1, m) for the approach, overwritten by q, q̇, q̈ on the grid of the arm; (2, M+1, m) for each
            phase that has not begun, overwritten by q̇, q̈ of the same path in its new time.

    Returns:
        The phase that failed, or how many there are; its outcome; the durations (s); iterations of the interior point
        method over all phases.
    """
    T, iterations, outcome, paper_rows = np.array([arm[0][0], arm[1][0], arm[2][0]]), 0, OPTIMAL, rules[5]
    for phase in range(begun, 3):
        held = (phase == begun or paper_rows, paper_rows)
        if phase == APPROACH:
            outcome, T[phase], steps = _approach(
                arm[phase], hand[phase], start, states[phase], gripper_open, descent, held, limits, rules,
                filters[phase], arm_motions[phase], hand_motions[phase],
            )  # fmt: skip
        elif phase == begun:
            outcome, steps = _rest_of_grasp(
                arm[phase], states[phase], held, limits, rules, filters[phase], arm_motions[phase]
            )
        else:
            outcome, T[phase], steps = _whole(
                arm[phase], hand[phase], phase == GRASP, states[phase - 1], states[phase], held, limits, rules,
                filters[phase], arm_motions[phase],
            )  # fmt: skip
            if outcome == OPTIMAL:
                stretch(hand[phase], T[phase], hand_motions[phase])
        iterations += steps
        if outcome != OPTIMAL:
            return phase, outcome, (T[0], T[1], T[2]), iterations
    return 3, outcome, (T[0], T[1], T[2]), iterations


@njit(cache=True, error_model="numpy")
def _approach(arm, hand, start, end, gripper_open, descent, held, limits, rules, filters, arm_motion, hand_motion):
    """The rest of the approach, bent to the descent; a hand that moves is tracked with the arm, on one clock."""
    weights, margin, fraction, shortest, longest, paper_rows = rules
    arm_limits, hand_limits, _, _ = limits
    entry, postures, weight = descent
    N, n, m = arm[1].shape[0] - 1, arm[1].shape[1], hand[1].shape[1]
    T = arm[0] - start
    write_rest(hand, start, hand_motion)
    joints = n + m if np.any(hand_motion[1:]) else n
    wanted = np.zeros((3, N + 1, whole_lanes(joints)))
    write_rest(arm, start, wanted)
    for j in range(n, joints):
        wanted[:, :, j] = hand_motion[:, :, j - n]
    ends, node_weights, boxes = np.zeros((2, 3, joints)), np.zeros(N + 1), np.empty((4, joints))
    ends[0] = wanted[:, 0, :joints]
    if len(postures) > 0:
        bend(entry, postures, T, wanted)
        node_weights[entry:] = weight * weights[2]
    ends[1, 0, :n], ends[1, 1, :n], ends[1, 2, :n] = end[0], end[1], wanted[2, N, :n]
    inner_boxes(ends, arm_limits, margin, fraction, boxes)
    for j in range(n, joints):
        ends[1, 0, j] = gripper_open[j - n]
        boxes[:, j] = hand_limits[:, j - n]
        boxes[0, j], boxes[1, j] = min(boxes[0, j], ends[0, 0, j]), max(boxes[1, j], ends[0, 0, j])
    durations, z = (shortest * T, longest * T), np.empty_like(wanted)
    outcome, T_new, steps, _, _ = solve(
        wanted, T, ends, held, weights, node_weights, boxes, paper_rows, durations, filters, z
    )
    write_motion(z, wanted, T_new, T, ends, held, paper_rows, 0, arm_motion)
    if joints > n:
        write_motion(z, wanted, T_new, T, ends, held, paper_rows, n, hand_motion)
    return outcome, T_new, steps


@njit(cache=True, error_model="numpy")
def _rest_of_grasp(arm, end, held, limits, rules, filters, motion):
    """What is left of the grasp, in the time that it had; what is past stays."""
    N, whole = arm[1].shape[0] - 1, arm[1:]
    row = N + 1 - filters[0].size
    T = (N - row) / N * arm[0]
    for kind in range(3):
        motion[kind, :row] = whole[kind][:row]
    begin = arm[1][row], arm[2][row]
    outcome, _, steps = _between(arm, T, begin, end, held, (T, T), limits, rules, filters, motion)
    return outcome, steps


@njit(cache=True, error_model="numpy")
def _whole(arm, hand, grasps, begin, end, held, limits, rules, filters, motion):
    """A phase that has not begun; its duration may change, but not to less than the hand needs."""
    _, _, _, shortest, longest, _ = rules
    _, hand_limits, grasp_min, grasp_max = limits
    T = arm[0]
    least, most = max(shortest * T, _hand_needs(hand, hand_limits)), longest * T
    if grasps:
        # The plan's own duration stays admissible, whoever chose it.
        least = max(least, min(grasp_min, T))
        most = min(most, max(grasp_max, T, least))
    return _between(arm, T, begin, end, held, (least, most), limits, rules, filters, motion)


@njit(cache=True, error_model="numpy")
def _between(arm, T, begin, end, held, durations, limits, rules, filters, motion):
    """A motion near the last grid points of a phase, which took T (s), between two states (q, q̇)."""
    weights, margin, fraction, _, _, paper_rows = rules
    whole, K, n = arm[1:], filters[0].size, arm[1].shape[1]
    wanted = np.empty((3, K, whole_lanes(n)))
    for kind in range(3):
        widen(whole[kind][len(whole[kind]) - K :], wanted[kind])
    ends, boxes, z = np.empty((2, 3, n)), np.empty((4, n)), np.empty_like(wanted)
    for i in range(2):
        ends[0, i], ends[1, i] = begin[i], end[i]
    ends[0, 2], ends[1, 2] = wanted[2, 0, :n], wanted[2, K - 1, :n]
    inner_boxes(ends, limits[0], margin, fraction, boxes)
    outcome, T_new, steps, _, _ = solve(
        wanted, T, ends, held, weights, np.zeros(K), boxes, paper_rows, durations, filters, z
    )
    write_motion(z, wanted, T_new, T, ends, held, paper_rows, 0, motion)
    return outcome, T_new, steps


@njit(cache=True, error_model="numpy")
def write_rest(trajectory: PhaseArrays, start: float, motion: Array) -> None:
    """Write q, q̇, q̈ (3, M+1, ≥ n) at M+1 times from `start` (s) to the end."""
    M = motion.shape[1] - 1
    interpolate(trajectory, start + (trajectory[0] - start) / M * np.arange(M + 1), motion)


@njit(cache=True, error_model="numpy")
def stretch(trajectory: PhaseArrays, duration: float, rates: Array) -> None:
    """Write q̇, q̈ (2, M+1, m) of the same path in another time."""
    ratio, old = trajectory[0] / duration, trajectory[2:]
    for kind in range(2):
        factor, before, now = ratio ** (kind + 1), old[kind].ravel(), rates[kind].ravel()
        for i in range(before.size):
            now[i] = factor * before[i]


@njit(cache=True, error_model="numpy")
def _hand_needs(hand, limits):
    """The least duration in which the hand's limits (4, m) allow the same path (s)."""
    duration, _, velocity, acceleration = hand
    return duration * max(_largest_share(velocity, limits[2]), np.sqrt(_largest_share(acceleration, limits[3])))


@njit(cache=True, error_model="numpy")
def _largest_share(rates, limits):
    """Largest |rate| of (M+1, m) over its limit (m,)."""
    largest, inverse = 0.0, 1.0 / limits
    for k in range(rates.shape[0]):
        for j in range(limits.size):
            largest = max(largest, abs(rates[k, j]) * inverse[j])
    return largest


@njit(cache=True, error_model="numpy")
def inner_boxes(ends: Array, limits: Array, margin: float, fraction: float, boxes: Array) -> None:
    """Write the boxes (4, ≥ n) of the arm: its limits (4, n) less what is kept from them.

    But never less than the states at both ends (2, 3, ≥ n) need.
    """
    for j in range(limits.shape[1]):
        lower, upper, velocity = limits[0, j], limits[1, j], limits[2, j]
        lowest, highest = min(ends[0, 0, j], ends[1, 0, j]), max(ends[0, 0, j], ends[1, 0, j])
        fastest = max(abs(ends[0, 1, j]), abs(ends[1, 1, j]))
        boxes[0, j] = max(min(lower + margin, lowest), lower)
        boxes[1, j] = min(max(upper - margin, highest), upper)
        boxes[2, j] = min(max(fraction * velocity, fastest), velocity)
        boxes[3, j] = limits[3, j]


def hold_start(
    motion: Trajectory, state: JointState, end: BoundaryState, task: GraspTask, settings: TrackingSettings
) -> Trajectory | None:
    """The motion nearest to a given one, in the same time, with the first acceleration of `state`; None if none is.

    Solvers of whole phases choose the first acceleration freely; at a splice it is what the running plan has there.
    """
    start = np.array([state.position, state.velocity, state.acceleration])
    stop = np.array([end.position, end.velocity, motion.acceleration[-1]])
    lower, upper, speed, effort = boxes = np.empty((4, task.robot.n))
    inner_boxes(
        np.array([start, stop]), limits_of(task)[0], settings.position_margin, settings.velocity_fraction, boxes
    )
    T, weights, paper = motion.duration, settings.weights, settings.paper_rows
    problem = TrackingProblem(motion, start, stop, True, False, lower, upper, speed, effort, T, T, weights, paper)
    solution = solve_tracking(problem)
    return solution.trajectory if solution.status is Status.CONVERGED else None
