"""How long replanning takes: the program alone and against others, whole cycles, the defect of the paper's update."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.experiments.bench_plan import PLACE_DEG, START_DEG
from dyngrasp.experiments.end_point_errors import end_point_rows
from dyngrasp.experiments.online_programs import QP_CASES, peer_row, qp_problems, structured_row
from dyngrasp.experiments.statistics import timing_summary
from dyngrasp.models.catalogue import load_gripper, load_object, load_robot
from dyngrasp.planning.audit import audit
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import GraspTargets, grasp_targets, moved
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.phase_programs import APPROACH
from dyngrasp.planning.replanning.replanner import Path, Replanner, ReplanResult
from dyngrasp.signals import PoseEstimate
from dyngrasp.trajectory import GraspPlan

RATE = 10.0  # replans a second in the sequences (Hz)

# What is left of the approach at a late move (s), and how far the part moves (mm); it turns by up to 1° for 4 mm.
LEFT = (2.0, 1.2, 0.8, 0.6, 0.45, 0.35, 0.25, 0.15)
MOVES = (2, 5, 10, 20, 30)

SEQUENCES = ("still", "drift", "step_3cm", "step_5cm", "moving")


@dataclass(frozen=True)
class Cell:
    """A task and the plan from which the replans start."""

    task: GraspTask
    targets: GraspTargets
    plan: GraspPlan
    planner: CollocationPlanner


def make_cell(effort_weight: float, yaw: float = 0.3) -> Cell:
    """The paper's arm, hand and part, planned with a weight ρ.

    Raises:
        PlanningFailed: There is no valid plan to start from.
    """
    robot, gripper, part = load_robot("iiwa14"), load_gripper("sdh2"), load_object("casting")
    task = GraspTask(robot, gripper, part, np.deg2rad(PLACE_DEG))
    T = pin.SE3(pin.utils.rotate("z", yaw), np.array([0.65, 0.0, part.rest_height]))
    q_start = np.deg2rad(START_DEG)
    planner = CollocationPlanner(task, CollocationSettings(effort_weight=effort_weight))
    targets = grasp_targets(T, task, q_start)
    return Cell(task, targets, planner.plan(q_start, targets).require(), planner)


def bench_replan(
    cycles: int,
    seed: int,
    effort_weight: float,
    against: tuple[str, ...] = (),
    progress: Callable[[str], None] = lambda words: None,
) -> list[dict[str, Any]]:
    """All rows of the benchmark.

    Args:
        cycles: Replans of each kind.
        seed: Of all draws.
        effort_weight: ρ of the plan that is replanned.
        against: Names of general solvers.
        progress: Told what is measured now.
    """
    cell = make_cell(effort_weight)
    # A pass of the garbage collector over all that was set up takes 0.1 s: it looks at what is new.
    gc.freeze()
    rows: list[dict[str, Any]] = []
    for case in QP_CASES:
        progress(f"{case}: structured")
        rows.append(structured_row(case, qp_problems(cell.plan, cell.targets, cell.task, case, cycles, seed)))
        # General solvers take up to a thousand times longer; a few dozen calls tell their median.
        few = list(qp_problems(cell.plan, cell.targets, cell.task, case, min(cycles, 40), seed)) if against else []
        for name in against:
            progress(f"{case}: {name}")
            rows.append(peer_row(case, name, few))
    # These need every way to a new plan: what is loaded at its first use is loaded before cycles are timed.
    progress("moves late in the approach")
    late = late_move_rows(cell, max(cycles // 100, 4), seed)
    rows += [*_cycle_rows(cell, cycles, seed, progress), *late]
    progress("end point errors of the two updates")
    rows += end_point_rows(cell.plan, cell.targets, cell.task, seed)
    return [row | {"rho": effort_weight} for row in rows]


def _cycle_rows(cell: Cell, cycles: int, seed: int, progress: Callable[[str], None]) -> list[dict[str, Any]]:
    replanner = Replanner(cell.task, None, StructuredSolver(), cell.planner)
    rng = np.random.default_rng([seed, 1])
    for sequence in SEQUENCES:
        # What is compiled or loaded at a first call is no part of a cycle.
        list(_sequence(cell, replanner, sequence, rng))
    counted: dict[str, list[float]] = {}
    outcome: dict[str, dict[str, int]] = {}
    for sequence in SEQUENCES:
        done = 0
        while done < cycles // len(SEQUENCES):
            for result, running in _sequence(cell, replanner, sequence, rng):
                done += 1
                for case in (sequence, _case_of(result)):
                    counted.setdefault(case, []).append(result.timings_ms["total"])
                    counts = outcome.setdefault(
                        case, {"published": 0, "published_invalid": 0, "late": 0, "kept": 0, "jumps": 0}
                    )
                    counts["published"] += result.ok
                    counts["kept"] += result.path is Path.KEPT
                    counts["late"] += result.status is Status.DEADLINE_MISSED
                    counts["published_invalid"] += result.ok and not _valid(result, cell.task)
                    counts["jumps"] += result.ok and splice_jump(running, result) > 1e-9
            progress(f"cycles, {sequence}: {done}")
    return [
        {"solver": "replanner", "case": case, **timing_summary(times), **outcome[case]}
        for case, times in counted.items()
    ]


def late_move_rows(cell: Cell, count: int, seed: int) -> list[dict[str, Any]]:
    """How many single moves of the part are followed, by what is left of the approach and by the size of the move.

    Deadlines are not kept here: the shares tell what can be followed, not how fast this machine is.
    """
    replanner = Replanner(cell.task, None, StructuredSolver(), cell.planner, lambda: 0.0)
    rng = np.random.default_rng([seed, 2])
    plan, T = cell.plan, cell.targets.T_world_object
    rows: list[dict[str, Any]] = []
    for left in LEFT:
        t = float(plan.phase_ends[APPROACH]) - left
        accepted = []
        for millimetres in MOVES:
            ok = 0
            for _ in range(count):
                heading, turn = rng.uniform(-np.pi, np.pi), np.deg2rad(millimetres / 4 * rng.uniform(-1.0, 1.0))
                offset = 1e-3 * millimetres * np.array([np.cos(heading), np.sin(heading), 0.0])
                T_new = pin.SE3(pin.utils.rotate("z", turn) @ T.rotation, T.translation + offset)
                estimate = PoseEstimate(T_new, 1e-6 * np.eye(6), t, t, np.zeros(6))
                ok += replanner.replan_to_pose(plan, cell.targets, estimate, t).ok
            accepted.append(ok)
        shares = {f"{millimetres}_mm": k / count for millimetres, k in zip(MOVES, accepted, strict=True)}
        rows.append({"solver": "replanner", "case": "late_moves", "left_s": left, "n": count, **shares})
    return rows


def _case_of(result: ReplanResult) -> str:
    free = result.path is Path.TRACKING and result.iterations == 0 and not result.message
    if "fresh" in result.timings_ms:
        # A budget of its own: the running plan bridges it.
        return "cycle_fresh"
    return "cycle_free" if free else "cycle_constrained"


def _sequence(
    cell: Cell, replanner: Replanner, kind: str, rng: np.random.Generator
) -> Iterator[tuple[ReplanResult, GraspPlan]]:
    """Replans from the start to the grasp, each from the plan of the one before; with the plan that ran before it."""
    plan, targets, T = cell.plan, cell.targets, cell.targets.T_world_object
    twist, heading = np.zeros(6), rng.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    if kind == "moving":
        twist[:3] = 0.03 * direction
        # Where it has to be now so that the running plan meets it.
        T = moved(T, twist, -float(plan.phase_ends[1]))
    end = float(plan.phase_ends[APPROACH])
    step_at = rng.uniform(0.1, 0.7) * end
    t, jumped = plan.start_time + rng.uniform(0.0, 1.0 / RATE), False
    while t < plan.phase_ends[APPROACH] - 0.2:
        if kind == "drift":
            T = pin.SE3(T.rotation, T.translation + 0.01 / (RATE * end) * direction)
        if kind.startswith("step") and not jumped and t >= step_at:
            jumped = True
            T = pin.SE3(T.rotation, T.translation + float(kind[5]) * 0.01 * direction)
        T_now = moved(T, twist, t) if kind == "moving" else T
        result = replanner.replan_to_pose(plan, targets, PoseEstimate(T_now, 1e-6 * np.eye(6), t, t, twist), t)
        yield result, plan
        plan, targets = result.plan, (result.targets if result.ok else targets)
        t += 1.0 / RATE


def _valid(result: ReplanResult, task: GraspTask) -> bool:
    """The audit once more; what a softened funnel allows is judged by the replanner's own report."""
    report = audit(result.plan, result.targets, task, result.splice)
    return all(entry.name == "funnel" and result.recovery < 1.0 for entry in report.failures) and (
        result.audit is not None and result.audit.ok
    )


def splice_jump(running: GraspPlan, result: ReplanResult) -> float:
    """Largest difference of old and new plan at the splice, of arm and hand (rad, rad/s, rad/s²)."""
    a, b = running.sample(result.splice), result.plan.sample(result.splice)
    return max(
        float(np.abs(getattr(getattr(a, part), name) - getattr(getattr(b, part), name)).max())
        for part in ("arm", "gripper")
        for name in ("position", "velocity", "acceleration")
    )
