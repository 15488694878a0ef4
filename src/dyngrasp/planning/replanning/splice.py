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
from numba import njit

from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import MIN_INTERVALS, Status
from dyngrasp.planning.replanning.carried_descent import carried_descent
from dyngrasp.planning.replanning.phase_programs import (
    APPROACH,
    GRASP,
    TrackingSettings,
    program_between,
    splice_program,
    whole_phase,
    with_hand,
)
from dyngrasp.planning.replanning.tracking_qp import TrackingSolution, solve_tracking
from dyngrasp.signals import frozen
from dyngrasp.trajectory import GraspPlan, PlanSample, Trajectory, interpolate


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
    motion = np.empty((3, intervals + 1, trajectory.position.shape[1]))
    _write_rest(trajectory.duration, trajectory.position, trajectory.velocity, trajectory.acceleration, start, motion)
    return Trajectory.of(trajectory.duration - start, motion)


@njit(cache=True, error_model="numpy")
def _write_rest(duration, position, velocity, acceleration, start, motion):
    """Write q, q̇, q̈ (3, M+1, n) at M+1 times from `start` (s) to the end."""
    M = motion.shape[1] - 1
    times = start + (duration - start) / M * np.arange(M + 1)
    interpolate((duration, position, velocity, acceleration), times, motion)


@njit(cache=True)
def _stands(velocity, acceleration):
    """Whether all rates (N+1, n) are zero."""
    for array in (velocity, acceleration):
        for rate in array.flat:
            if rate != 0.0:
                return False
    return True


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
    velocity, acceleration = trajectory.velocity * ratio, trajectory.acceleration * ratio**2
    return Trajectory(duration, trajectory.position, frozen(velocity), frozen(acceleration))


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
    still = _stands(hand.velocity, hand.acceleration)
    if not still:
        hand = rest_of(hand, local, N)
        still = _stands(hand.velocity, hand.acceleration)
    weights = None
    if not settings.paper_rows:
        carried = carried_descent(reference, splice, targets, previous, task, settings.descents[way])
        if carried is not None:
            reference, weights = carried
            weights *= settings.weights.acceleration
    problem = splice_program(reference, state.arm, targets.pregrasp, task, settings, weights)
    if not still:
        problem = with_hand(problem, hand, state.gripper, targets, task)
    solution = solve_tracking(problem)
    if solution.status is not Status.CONVERGED:
        return solution, plan.arm[APPROACH], plan.gripper[APPROACH]
    both = solution.trajectory(problem)
    if still:
        return solution, both, Trajectory(both.duration, hand.position, hand.velocity, hand.acceleration)
    columns = (slice(0, n), slice(n, None))
    arm, fingers = (
        Trajectory(both.duration, both.position[:, c], both.velocity[:, c], both.acceleration[:, c]) for c in columns
    )
    return solution, arm, fingers


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
    problem = program_between(
        rest,
        np.array([rest.position[0], rest.velocity[0], rest.acceleration[0]]),
        np.array([targets.grasped.position, targets.grasped.velocity, rest.acceleration[-1]]),
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
