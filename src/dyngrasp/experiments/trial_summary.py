"""What is told of a trial: the content of `summary.json`, and the row of a study."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.closed_loop.first_look import FirstLook
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.experiments.draws import Trial
from dyngrasp.experiments.provenance import versions
from dyngrasp.experiments.replanning import replanning_summary
from dyngrasp.experiments.trial import ExecutedTrial, PlannedTrial, execute_trial, plan_trial
from dyngrasp.experiments.trial_world import first_look, trial_world
from dyngrasp.experiments.vision import vision_summary
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.planning.collocation.planner import CollocationPlanner


def summary(
    workcell: Workcell,
    trial: Trial,
    look: FirstLook | None,
    planned: PlannedTrial | None,
    executed: ExecutedTrial | None,
    vision: VisionRecord | None = None,
) -> dict[str, Any]:
    """The content of `summary.json`; of what a trial did not get to, the values are empty, and `cause` says why.

    Args:
        workcell: Scenario and models.
        trial: What chance decided.
        look: The first look, if there was one.
        planned: None if the look found nothing to plan for.
        executed: None without a valid plan.
        vision: What the camera saw, if it saw anything.
    """
    result = planned.result if planned else None
    return {
        "success": executed is not None and executed.outcome.success,
        "cause": _cause(workcell, planned, executed),
        "criteria": executed.outcome.summary() if executed else {},
        "replanning": replanning_summary(executed.replans, executed.not_taken) if executed else {},
        "first_look": _look_summary(workcell, look, vision),
        "vision": vision_summary(vision),
        "phases": result.plan.durations.tolist() if result and result.plan else [],
        "planning_ms": planned.planning_ms if planned else None,
        "planning_attempts": planned.attempts if planned else 0,
        "timings_ms": result.timings_ms if result else {},
        "plan_status": str(result.status) if result else None,
        "grasp": planned.targets.grasp.name if planned else None,
        "worst": worst_ratios(planned, executed) if planned else {},
        "tracking": executed.outcome.details if executed else {},
        "seed": trial.seed,
        "versions": versions(),
    }


def worst_ratios(planned: PlannedTrial, executed: ExecutedTrial | None) -> dict[str, float | None]:
    """Largest ratio to each limit; `position` and `velocity` in the plant where there was one, else as planned.

    `acceleration` is None for an arm whose file states no such limit.
    """
    audit = planned.result.audit
    if audit is None:
        return {}
    ratios: dict[str, float | None] = {name: audit[name].worst for name in ("position", "velocity")}
    ratios["torque_planned"] = audit["torque"].worst
    if executed is not None:
        ratios.update(executed.outcome.worst)
    ratios["acceleration"] = audit["acceleration"].worst or None
    return ratios


def study_row(workcell: Workcell, trial: Trial, planner: CollocationPlanner) -> dict[str, Any]:
    """Run a trial to the end and flatten it into one row of a study; a trial that cannot be planned is a row too."""
    began = time.perf_counter()
    with trial_world(workcell, trial) as world:
        look = first_look(workcell, world)
        planned = executed = None
        if look is None or look.estimate is not None:
            planned = plan_trial(workcell, trial, planner, look)
            if planned.result.ok:
                executed = execute_trial(workcell, trial, planned, planner=planner, world=world)
        vision = world.vision()
    document = summary(workcell, trial, look, planned, executed, vision)
    row = _drawn(workcell, trial, look)
    row |= {
        key: document[key] for key in ("success", "cause", "planning_ms", "planning_attempts", "plan_status", "grasp")
    }
    row |= dict(zip(("approach_s", "grasp_s", "deliver_s"), document["phases"], strict=False))
    criteria = dict(document["criteria"])
    passed = criteria.pop("passed", {})
    row |= criteria
    row |= {f"passed_{name}": verdict for name, verdict in passed.items()}
    row |= {f"worst_{name}": ratio for name, ratio in document["worst"].items()}
    row |= document["tracking"]
    row |= {key: document["replanning"].get(key) for key in ("replans", "published", "too_uncertain")}
    row |= {f"look_{key}": document["first_look"].get(key) for key in ("s", "frames", "deviation_mm")}
    row["trial_ms"] = 1e3 * (time.perf_counter() - began)
    return row


def _cause(workcell: Workcell, planned: PlannedTrial | None, executed: ExecutedTrial | None) -> str:
    if executed is not None:
        return executed.outcome.cause
    if planned is not None:
        return f"planning: {planned.result.status}: {planned.result.message}"
    seconds = workcell.scenario.camera.look_s
    return f"first look: the part was not found within {seconds:g} s of pictures from task.start_deg"


def _look_summary(workcell: Workcell, look: FirstLook | None, vision: VisionRecord | None) -> dict[str, Any]:
    """How long the look took, what was known then, and, as evidence, what that was wrong by at the grasp point."""
    if look is None:
        return {}
    frames = [r for r in vision.reports if r.frame.t_receipt <= look.ended] if vision else []
    document: dict[str, Any] = {
        "s": look.ended - look.began,
        "frames": len(frames),
        "with_markers": sum(bool(report.frame.seen) for report in frames),
    }
    if look.estimate is None:
        return document
    error = _error(workcell, look.truth.T_world_part, look.estimate.T_world_object)
    return document | {
        "deviation_mm": 1e3 * look.deviation,
        "error_mm": 1e3 * float(np.linalg.norm(error.translation)),
        "error_deg": float(np.rad2deg(np.linalg.norm(pin.log3(error.rotation)))),
    }


def _drawn(workcell: Workcell, trial: Trial, look: FirstLook | None) -> dict[str, Any]:
    """What chance decided: pose of the part, error of the believed pose in the grasp frame, friction and mass."""
    T = trial.T_world_object
    row: dict[str, Any] = {
        "seed": trial.seed,
        "x_m": float(T.translation[0]),
        "y_m": float(T.translation[1]),
        "yaw_deg": float(np.rad2deg(pin.rpy.matrixToRpy(T.rotation)[2])),
        "friction": trial.variation.friction,
        "mass_factor": trial.variation.mass_factor,
    }
    believed = trial.T_world_object_believed
    if look is not None and look.estimate is not None:
        T, believed = look.truth.T_world_part, look.estimate.T_world_object
    if believed is not None:
        error = _error(workcell, T, believed)
        offsets = 1e3 * error.translation
        row |= dict(zip(("error_along_mm", "error_across_mm", "error_up_mm"), offsets.tolist(), strict=True))
        row["error_deg"] = float(np.rad2deg(np.linalg.norm(pin.log3(error.rotation))))
    return row


def _error(workcell: Workcell, T_world_object: pin.SE3, T_believed: pin.SE3) -> pin.SE3:
    """What a believed pose is wrong by, in the grasp frame: what the fingers feel."""
    T_object_grasp = workcell.task.grasp_object.grasps[0].T_object_grasp
    return (T_world_object * T_object_grasp).actInv(T_believed * T_object_grasp)
