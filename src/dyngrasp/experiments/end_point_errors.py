"""What the paper's linearised update leaves of a move, and the exact one: where the hand would really arrive."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.errors import OutOfReach
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.replanning.lcqp import end_point_error
from dyngrasp.planning.replanning.phase_programs import APPROACH, TrackingSettings
from dyngrasp.planning.replanning.splice import track
from dyngrasp.planning.replanning.target_update import updated_targets
from dyngrasp.planning.replanning.tracking_qp import TrackingWeights
from dyngrasp.trajectory import GraspPlan


def end_point_rows(plan: GraspPlan, targets: GraspTargets, task: GraspTask, seed: int) -> list[dict[str, Any]]:
    """How far the hand would miss the pre-grasp if the accelerations of the updated plan were carried out.

    Args:
        plan: Updated when little of its approach is over.
        targets: What it was made for.
        task: Arm, gripper and part.
        seed: Of the walks of the part.

    Returns:
        A row for each update, weight of the duration and move: medians over eight headings (mm).
    """
    rows: list[dict[str, Any]] = []
    for stiffness in (1.0, 100.0):
        weights = TrackingWeights(0.01, 0.01, 1.0, stiffness)
        for solver in ("lcqp", "exact"):
            settings = TrackingSettings(weights=weights, paper_rows=solver == "lcqp")
            for centimetres in (1, 3, 5, 10):
                error = _miss(plan, targets, task, settings, [0.01 * centimetres], 0.3, seed)
                rows.append(_error_row(solver, stiffness, f"{centimetres} cm", error))
            error = _miss(plan, targets, task, settings, [0.01] * 20, 0.02, seed)
            rows.append(_error_row(solver, stiffness, "20 x 1 cm", error))
    return rows


def _error_row(solver: str, stiffness: float, move: str, error: float) -> dict[str, Any]:
    return {
        "solver": solver,
        "case": "end_point_error",
        "duration_weight": stiffness,
        "move": move,
        "error_mm": 1e3 * error,
    }


def _miss(
    first: GraspPlan,
    made_for: GraspTargets,
    task: GraspTask,
    settings: TrackingSettings,
    steps: list[float],
    share: float,
    seed: int,
) -> float:
    """Median over eight headings of the miss after a series of moves (m); a series walks at random."""
    misses = []
    for i in range(8):
        rng = np.random.default_rng([seed, i])
        plan, targets = first, made_for
        heading = 2 * np.pi * i / 8
        for step in steps:
            direction = np.array([np.cos(heading), np.sin(heading), 0.0])
            T = targets.T_world_object
            try:
                targets = updated_targets(targets, pin.SE3(T.rotation, T.translation + step * direction), task)
            except OutOfReach:
                break
            candidate = track(plan, targets, task, plan.start_time + share * first.durations[APPROACH], settings)
            if candidate.plan is None:
                break
            plan = candidate.plan
            heading += rng.uniform(-np.pi / 2, np.pi / 2)
        else:
            misses.append(end_point_error(plan.arm[APPROACH], task.robot))
    return float(np.median(misses)) if misses else float("nan")
