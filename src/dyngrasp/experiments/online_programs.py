"""The online program alone: cases with few and many active rows, and its times beside those of general solvers."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.errors import OutOfReach
from dyngrasp.experiments.statistics import timing_summary
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.general_solvers import solver_of
from dyngrasp.planning.replanning.lcqp import sparse_program
from dyngrasp.planning.replanning.phase_programs import APPROACH
from dyngrasp.planning.replanning.splice import rest_of
from dyngrasp.planning.replanning.target_update import updated_targets
from dyngrasp.planning.replanning.tracking_qp import (
    TrackingProblem,
    TrackingSolution,
    TrackingWeights,
    paper_step,
    solve_tracking,
)
from dyngrasp.trajectory import GraspPlan, Trajectory

# Of the program alone: like the paper's, with weight on everything.
_WEIGHTS = TrackingWeights(0.1, 0.1, 1.0, 100.0)

# Of the program alone: free, with a given number of active rows, and with speed limits at a given share of what the
# motion asks, where some sixty rows are active and three hundred at most.
QP_CASES = ("qp_free", "qp_active", "qp_many_active")
_ACTIVE_ROWS, _ROWS_BESIDE = 20, 5
_TIGHT_SHARE = 0.985

# A program that is solved in microseconds is timed so often, and the fastest of them counts: what else runs on the
# machine costs more than it. So are the general solvers.
_REPEATS = 3


def qp_problems(
    plan: GraspPlan, targets: GraspTargets, task: GraspTask, case: str, count: int, seed: int
) -> Iterator[TrackingProblem]:
    """Programs of the approach: random splices, the part moved by up to 3 cm and 8°.

    Args:
        plan: What is tracked.
        targets: What it was made for.
        task: Arm, gripper, part.
        case: One of `QP_CASES`: "qp_active" tightens the speed limits of each program until twenty rows are active.
        count: How many.
        seed: Of all draws.
    """
    rng = np.random.default_rng(seed)
    limits, made = task.robot.limits, 0
    while made < count:
        t = plan.start_time + rng.uniform(0.0, 0.8) * plan.durations[APPROACH]
        try:
            new = updated_targets(targets, _displaced(targets.T_world_object, rng, 0.03, 8.0), task)
        except OutOfReach:
            continue
        reference = _consistent(rest_of(plan.arm[APPROACH], t - plan.start_time, plan.arm[APPROACH].intervals))
        state, end = plan.sample(t).arm, new.pregrasp
        problem = TrackingProblem(
            reference,
            np.stack([state.position, state.velocity, state.acceleration]),
            np.stack([end.position, end.velocity, reference.acceleration[-1]]),
            True,
            True,
            limits.position_lower,
            limits.position_upper,
            limits.velocity,
            limits.acceleration,
            0.3 * reference.duration,
            3.0 * reference.duration,
            _WEIGHTS,
            paper_rows=True,
        )
        if case == "qp_many_active":
            problem = _tightened(problem, _TIGHT_SHARE)
        elif case == "qp_active":
            problem = _with_active_rows(problem)
        if problem is not None:
            made += 1
            yield problem


def _tightened(problem: TrackingProblem, share: float) -> TrackingProblem:
    """The program with speed limits at a share of what its reference asks, but no less than its ends need."""
    asked = np.abs(problem.reference.velocity).max(axis=0)
    at_ends = np.maximum(np.abs(problem.start[1]), np.abs(problem.end[1]))
    return replace(problem, velocity_limit=np.maximum(share * asked, 1.02 * at_ends))


def _with_active_rows(problem: TrackingProblem) -> TrackingProblem | None:
    """The program with the share of `_tightened` at which about `_ACTIVE_ROWS` are active, by bisection.

    None where no share does it: some programs brake from a speed that their limits may not fall below.
    """
    tightest, widest = 0.9, 1.3
    for _ in range(12):
        share = (tightest + widest) / 2
        tight = _tightened(problem, share)
        solution = solve_tracking(tight)
        rows = active_rows(solution) if solution.status is Status.CONVERGED else np.inf
        if rows == _ACTIVE_ROWS:
            return tight
        tightest, widest = (share, widest) if rows > _ACTIVE_ROWS else (tightest, share)
    return tight if abs(rows - _ACTIVE_ROWS) <= _ROWS_BESIDE else None


def active_rows(solution: TrackingSolution) -> int:
    """How many rows of a program have a multiplier, those of the bounds of ΔT apart."""
    return int((solution.multipliers[:-2] > 1e-6).sum()) if solution.iterations else 0


def _consistent(motion: Trajectory) -> Trajectory:
    """The nearest motion that obeys the trapezoidal rule, as eq. (9) supposes of a reference; samples nearly do."""
    start, end = (np.stack([motion.position[k], motion.velocity[k], motion.acceleration[k]]) for k in (0, -1))
    wide = np.full(motion.position.shape[1], np.inf)
    problem = TrackingProblem(
        motion, start, end, True, True, -wide, wide, wide, wide, motion.duration, motion.duration, _WEIGHTS
    )
    return solve_tracking(problem).trajectory


def structured_row(case: str, problems: Iterable[TrackingProblem]) -> dict[str, Any]:
    """Times and outcomes; solutions are not kept, for ten thousand of them take fresh memory that costs more time."""
    times, active, outcomes = [], [], []
    for problem in problems:
        solution = solve_tracking(problem)
        times.append(min(solution.elapsed_ms, *(solve_tracking(problem).elapsed_ms for _ in range(_REPEATS - 1))))
        active.append(active_rows(solution))
        outcomes.append(solution.status)
    return {
        "solver": "structured",
        "case": case,
        **timing_summary(times),
        "solved": outcomes.count(Status.CONVERGED),
        "infeasible": outcomes.count(Status.INFEASIBLE),
        "active_rows": float(np.median(active)),
    }


def peer_row(case: str, name: str, problems: list[TrackingProblem]) -> dict[str, Any]:
    """Times of a general solver, by name, and how far its minimisers are from ours."""
    solve = solver_of(name)
    if solve is None:
        return {
            "solver": name,
            "case": case,
            **timing_summary([]),
            "solved": 0,
            "active_rows": np.nan,
            "note": "not installed",
        }
    times, differences, active = np.full((_REPEATS, len(problems)), np.inf), [], []
    # Round by round: a solver that starts from its last answer must not start from this one.
    for repeat, (i, problem) in itertools.product(range(_REPEATS), enumerate(problems)):
        x, times[repeat, i] = solve(sparse_program(problem))
        if repeat > 0:
            continue
        ours = solve_tracking(problem)
        active.append(active_rows(ours))
        if ours.status is Status.CONVERGED and np.isfinite(x).all():
            differences.append(float(np.abs(paper_step(problem, ours).ravel() - x).max()))
    return {
        "solver": name,
        "case": case,
        **timing_summary(times.min(axis=0)),
        "solved": len(differences),
        "active_rows": float(np.median(active)),
        "difference_median": float(np.median(differences)) if differences else float("nan"),
    }


def _displaced(T: pin.SE3, rng: np.random.Generator, distance: float, degrees: float) -> pin.SE3:
    heading, turn = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(-degrees, degrees))
    offset = rng.uniform(0.0, distance) * np.array([np.cos(heading), np.sin(heading), 0.0])
    return pin.SE3(pin.utils.rotate("z", turn) @ T.rotation, T.translation + offset)
