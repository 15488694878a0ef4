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

from dataclasses import dataclass, field, replace

import numpy as np

from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets, GraspTask
from dyngrasp.planning.problem import MIN_INTERVALS, Status
from dyngrasp.planning.replanning.carried_descent import DescentSettings, carried_descent
from dyngrasp.planning.replanning.tracking_qp import TrackingProblem, TrackingSolution, TrackingWeights, solve_tracking
from dyngrasp.signals import Array, JointState
from dyngrasp.trajectory import GraspPlan, PlanSample, Trajectory

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


@dataclass(frozen=True)
class Candidate:
    """A plan that has not been audited yet.

    Attributes:
        status: `converged`, or what the first failing phase said.
        plan: None unless converged.
        splice: When it takes over (s).
        solutions: Of the phases tracked.
        message: Which phase failed.
    """

    status: Status
    plan: GraspPlan | None
    splice: float
    solutions: tuple[TrackingSolution, ...] = ()
    message: str = ""

    @property
    def iterations(self) -> int:
        """Of the interior point method over all phases; 0 where no box was active."""
        return sum(solution.iterations for solution in self.solutions)


def splice_time(plan: GraspPlan, wanted: float) -> float:
    """The first time from `wanted` on at which the plan may be cut: any, but a grid point while the hand closes (s)."""
    if plan.phase_at(wanted) != GRASP:
        return wanted
    start = plan.phase_ends[APPROACH]
    step = plan.durations[GRASP] / plan.arm[GRASP].intervals
    return float(start + step * np.ceil((wanted - start) / step - 1e-6))


def rest_of(trajectory: Trajectory, start: float, intervals: int) -> Trajectory:
    """What is left of a motion after `start` (s), on a grid of its own; obeys the trapezoidal rule only nearly."""
    times = np.linspace(start, trajectory.duration, intervals + 1)
    return Trajectory(trajectory.duration - start, *trajectory.sample_many(times))


def track(
    plan: GraspPlan,
    targets: GraspTargets,
    task: GraspTask,
    splice: float,
    settings: TrackingSettings,
    way: int = 0,
    previous: GraspTargets | None = None,
    state: PlanSample | None = None,
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
        state: Of the plan at the splice, if it is known already.
    """
    begun = plan.phase_at(splice)
    state = state or plan.sample(splice)
    solutions: list[TrackingSolution] = []
    arm, hand = list(plan.arm), list(plan.gripper)
    for phase in range(begun, 3):
        if phase == APPROACH:
            solution, arm[phase], hand[phase] = _approach(plan, state, targets, task, splice, settings, way, previous)
        elif phase == begun:
            solution, arm[phase] = _rest_of_grasp(plan, targets, task, splice, settings)
        else:
            start, end = (targets.pregrasp, targets.grasped) if phase == GRASP else (targets.grasped, targets.place)
            problem = whole_phase(plan, phase, start, end, task, settings)
            solution = solve_tracking(problem)
            if solution.status is Status.CONVERGED:
                arm[phase] = solution.trajectory(problem)
                hand[phase] = stretched(plan.gripper[phase], arm[phase].duration)
        solutions.append(solution)
        if solution.status is not Status.CONVERGED:
            message = f"no motion within the boxes in phase {phase + 1} ({solution.status})"
            return Candidate(solution.status, None, splice, tuple(solutions), message)
    start_time = splice if begun == APPROACH else plan.start_time
    new = GraspPlan(tuple(arm), tuple(hand), start_time, plan.arm_joints, plan.gripper_joints)  # type: ignore[arg-type]
    return Candidate(Status.CONVERGED, new, splice, tuple(solutions))


def stretched(trajectory: Trajectory, duration: float) -> Trajectory:
    """The same path in another time."""
    ratio = trajectory.duration / duration
    if ratio == 1.0:
        return trajectory
    return Trajectory(duration, trajectory.position, trajectory.velocity * ratio, trajectory.acceleration * ratio**2)


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
    zero = np.zeros_like(start.position)
    return _program(
        reference,
        np.stack([start.position, start.velocity, reference.acceleration[0] if settings.paper_rows else zero]),
        np.stack([end.position, end.velocity, reference.acceleration[-1] if settings.paper_rows else zero]),
        (settings.paper_rows, settings.paper_rows),
        (shortest, longest),
        task,
        settings,
    )


def hand_needs(trajectory: Trajectory, task: GraspTask) -> float:
    """The least duration in which the hand's limits allow the same path (s)."""
    gripper = task.gripper
    by_velocity = float((np.abs(trajectory.velocity) / gripper.velocity).max())
    by_acceleration = float((np.abs(trajectory.acceleration) / gripper.acceleration).max())
    return trajectory.duration * max(by_velocity, np.sqrt(by_acceleration))


def _approach(
    plan: GraspPlan,
    state: PlanSample,
    targets: GraspTargets,
    task: GraspTask,
    splice: float,
    settings: TrackingSettings,
    way: int,
    previous: GraspTargets | None,
) -> tuple[TrackingSolution, Trajectory, Trajectory]:
    local = splice - (plan.phase_ends[APPROACH] - plan.durations[APPROACH])
    N, n = plan.arm[APPROACH].intervals, task.robot.n
    reference, hand = rest_of(plan.arm[APPROACH], local, N), plan.gripper[APPROACH]
    still = not (hand.velocity.any() or hand.acceleration.any())
    if not still:
        hand = rest_of(hand, local, N)
        still = not (hand.velocity.any() or hand.acceleration.any())
    weights = None
    if not settings.paper_rows:
        carried = carried_descent(reference, splice, targets, previous, task, settings.descents[way])
        if carried is not None:
            reference, weights = carried
    problem = _splice_program(reference, state.arm, targets.pregrasp, task, settings)
    if weights is not None:
        problem = replace(problem, node_weights=weights * settings.weights.acceleration)
    if not still:
        problem = _with_hand(problem, hand, state.gripper, targets, task)
    solution = solve_tracking(problem)
    if solution.status is not Status.CONVERGED:
        return solution, plan.arm[APPROACH], plan.gripper[APPROACH]
    both = solution.trajectory(problem)
    if still:
        zero = np.zeros((N + 1, hand.position.shape[1]))
        return solution, both, Trajectory(both.duration, zero + hand.position[-1], zero, zero)
    columns = (slice(0, n), slice(n, None))
    arm, fingers = (
        Trajectory(both.duration, both.position[:, c], both.velocity[:, c], both.acceleration[:, c]) for c in columns
    )
    return solution, arm, fingers


def _splice_program(
    reference: Trajectory, state: JointState, end: BoundaryState, task: GraspTask, settings: TrackingSettings
) -> TrackingProblem:
    """The program of the arm from its state at the splice."""
    return _program(
        reference,
        np.stack([state.position, state.velocity, state.acceleration]),
        np.stack([end.position, end.velocity, reference.acceleration[-1]]),
        (True, settings.paper_rows),
        (settings.shortest * reference.duration, settings.longest * reference.duration),
        task,
        settings,
    )


def _with_hand(
    arm: TrackingProblem, hand: Trajectory, state: JointState, targets: GraspTargets, task: GraspTask
) -> TrackingProblem:
    """The same program with the moving joints of the hand beside those of the arm."""
    gripper = task.gripper
    zero = np.zeros_like(targets.gripper_open)
    start = np.stack([state.position, state.velocity, state.acceleration])
    end = np.stack([targets.gripper_open, zero, zero])
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


def _rest_of_grasp(
    plan: GraspPlan, targets: GraspTargets, task: GraspTask, splice: float, settings: TrackingSettings
) -> tuple[TrackingSolution, Trajectory]:
    whole = plan.arm[GRASP]
    step = whole.duration / whole.intervals
    node = round((splice - plan.phase_ends[APPROACH]) / step)
    node = min(max(node, 0), whole.intervals - MIN_INTERVALS)
    rest = Trajectory(
        step * (whole.intervals - node), whole.position[node:], whole.velocity[node:], whole.acceleration[node:]
    )
    problem = _program(
        rest,
        np.stack([rest.position[0], rest.velocity[0], rest.acceleration[0]]),
        np.stack([targets.grasped.position, targets.grasped.velocity, rest.acceleration[-1]]),
        (True, settings.paper_rows),
        (rest.duration, rest.duration),
        task,
        settings,
    )
    solution = solve_tracking(problem)
    if solution.status is not Status.CONVERGED:
        return solution, whole
    new = solution.trajectory(problem)
    joined = (
        np.vstack([old[:node], ahead])
        for old, ahead in (
            (whole.position, new.position),
            (whole.velocity, new.velocity),
            (whole.acceleration, new.acceleration),
        )
    )
    return solution, Trajectory(whole.duration, *joined)


def _program(
    reference: Trajectory,
    start: Array,
    end: Array,
    held: tuple[bool, bool],
    durations: tuple[float, float],
    task: GraspTask,
    settings: TrackingSettings,
) -> TrackingProblem:
    limits = task.robot.limits
    lowest, highest = np.minimum(start[0], end[0]), np.maximum(start[0], end[0])
    inner_lower = limits.position_lower + settings.position_margin
    inner_upper = limits.position_upper - settings.position_margin
    fastest = np.maximum(np.abs(start[1]), np.abs(end[1]))
    return TrackingProblem(
        reference,
        start,
        end,
        *held,
        np.maximum(np.minimum(inner_lower, lowest), limits.position_lower),
        np.minimum(np.maximum(inner_upper, highest), limits.position_upper),
        np.minimum(np.maximum(settings.velocity_fraction * limits.velocity, fastest), limits.velocity),
        limits.acceleration,
        *durations,
        settings.weights,
        settings.paper_rows,
    )


def hold_start(
    motion: Trajectory, state: JointState, end: BoundaryState, task: GraspTask, settings: TrackingSettings
) -> Trajectory | None:
    """The motion nearest to a given one, in the same time, with the first acceleration of `state`; None if none is.

    Solvers of whole phases choose the first acceleration freely; at a splice it is what the running plan has there.
    """
    problem = _program(
        motion,
        np.stack([state.position, state.velocity, state.acceleration]),
        np.stack([end.position, end.velocity, motion.acceleration[-1]]),
        (True, False),
        (motion.duration, motion.duration),
        task,
        settings,
    )
    solution = solve_tracking(problem)
    return solution.trajectory(problem) if solution.status is Status.CONVERGED else None
