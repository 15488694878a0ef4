"""One trial from draw to verdict: targets, plan, audit, physics, criteria."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import pinocchio as pin

from dyngrasp.closed_loop.episode import EpisodeSettings, grasp_controller, run_episode
from dyngrasp.closed_loop.pose_source import PoseSource
from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.closed_loop.replanning_loop import ReplanEvent
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import OutOfReach
from dyngrasp.experiments.draws import Trial
from dyngrasp.experiments.metrics import Outcome, judge
from dyngrasp.experiments.provenance import versions
from dyngrasp.experiments.replanning import replanning_loop, replanning_summary
from dyngrasp.experiments.vision import camera_poses, films, vision_summary
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.grasp_targets import GraspTargets, grasp_targets, moved, ranked_grasp_targets
from dyngrasp.planning.problem import PlanResult, Status
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.simulation.mujoco_plant import MujocoPlant
from dyngrasp.simulation.plant import TruthfulPlant
from dyngrasp.simulation.scene import Scene, SceneSettings, build_scene
from dyngrasp.trajectory import GraspPlan

# Arm postures that are tried, best first, before a pose counts as not plannable.
CANDIDATES = 4

# When a moving part is met, over the time of the grasp of one that stands where it will be met; tried in turn.
LATER = (1.0, 1.1, 1.25)

# When a moving part may be in reach (s).
FIRST_GUESSES = (0.0, 2.0, 4.0, 6.0)


@dataclass(frozen=True, eq=False)
class PlannedTrial:
    """How planning ended: the targets it was made for, the result, and the wall time of all attempts (ms)."""

    targets: GraspTargets
    result: PlanResult
    planning_ms: float
    attempts: int


@dataclass(frozen=True, eq=False)
class ExecutedTrial:
    """What happened in the plant, the verdict, the plan carried out in the end, every replan, and what the camera saw.

    `not_taken` are the times at which a pose was too uncertain for a replan.
    """

    record: EpisodeRecord
    outcome: Outcome
    scene: Scene
    plan: GraspPlan
    targets: GraspTargets
    replans: tuple[ReplanEvent, ...] = ()
    not_taken: tuple[float, ...] = ()
    vision: VisionRecord | None = None


def planner_for(workcell: Workcell) -> CollocationPlanner:
    """The planner that a scenario asks for; it keeps its compiled functions, so make one a process."""
    section = workcell.scenario.planner
    settings = CollocationSettings(
        effort_weight=section.effort_weight, intervals=section.intervals, backend=section.backend
    )
    return CollocationPlanner(workcell.task, settings)


def plan_trial(workcell: Workcell, trial: Trial, planner: CollocationPlanner) -> PlannedTrial:
    """Plan for the pose that the trial believes in; the next-best arm posture is tried where one fails.

    Raises:
        OutOfReach: No posture reaches the part.
        GraspRefused: The gripper cannot take or hold it.
    """
    began = time.perf_counter()
    first: tuple[GraspTargets, PlanResult] | None = None
    attempts = 0
    T, twist = trial.T_world_object_believed, trial.twist_believed
    if twist.any():
        T = moved(T, twist, _first_grasp_time(workcell, trial, planner))
    for targets in islice(ranked_grasp_targets(T, workcell.task, workcell.q_start), CANDIDATES):
        attempts += 1
        result = planner.plan(workcell.q_start, targets)
        if result.plan is not None and twist.any():
            targets, result = _met(workcell, trial, planner, targets, result.plan)
        if result.ok:
            return PlannedTrial(targets, result, 1e3 * (time.perf_counter() - began), attempts)
        # Of several failures the best posture's says most.
        first = first or (targets, result)
    assert first is not None  # ranked_grasp_targets yields at least once or raises
    return PlannedTrial(*first, 1e3 * (time.perf_counter() - began), attempts)


def _first_grasp_time(workcell: Workcell, trial: Trial, planner: CollocationPlanner) -> float:
    """When a moving part is met depends on where, and where on when: how long it takes to where it soon will be (s)."""
    failure: OutOfReach | None = None
    for guess in FIRST_GUESSES:
        T = moved(trial.T_world_object_believed, trial.twist_believed, guess)
        try:
            targets = grasp_targets(T, workcell.task, workcell.q_start)
        except OutOfReach as error:
            failure = error
            continue
        plan = planner.plan(workcell.q_start, targets).plan
        if plan is not None:
            return max(guess, float(plan.phase_ends[1]))
    if failure is not None:
        raise failure
    return FIRST_GUESSES[0]


def _met(
    workcell: Workcell, trial: Trial, planner: CollocationPlanner, standing: GraspTargets, plan: GraspPlan
) -> tuple[GraspTargets, PlanResult]:
    """Targets and plan that meet a moving part, from a plan for one that stands about where it will be met."""
    updater, duration = target_updater(workcell.task), float(plan.durations[1])
    targets, result = standing, PlanResult(Status.INFEASIBLE, None, (), None, {}, "the part rides out of reach")
    for later in LATER:
        grasp_time = later * float(plan.phase_ends[1])
        T = moved(trial.T_world_object_believed, trial.twist_believed, grasp_time)
        try:
            targets = updater.update(standing, T, trial.twist_believed, grasp_time, duration)
        except OutOfReach:
            break
        result = planner.plan(workcell.q_start, targets)
        if result.ok:
            break
    return targets, result


def execute_trial(
    workcell: Workcell,
    trial: Trial,
    planned: PlannedTrial,
    progress: Callable[[float, str], None] | None = None,
    planner: CollocationPlanner | None = None,
    source: PoseSource | None = None,
) -> ExecutedTrial:
    """Carry out a valid plan in the plant that the trial drew, and judge what happened.

    Args:
        workcell: Scenario and models.
        trial: Where the part really is and how the plant deviates.
        planned: A plan that passed its audit.
        progress: Called with time (s) and phase as the episode runs.
        planner: States the problems that the replanner falls back on; one is made if it is needed and left out.
        source: Tells the replanner where the part is, in place of what the scenario's `[pose]` says.
    """
    task, plan = workcell.task, planned.result.require()
    period = 1.0 / workcell.scenario.plant.control_rate_hz
    settings = SceneSettings(timestep=min(SceneSettings().timestep, period))
    filmed = films(workcell) and source is None
    scene = build_scene(
        task.robot,
        task.gripper,
        task.grasp_object,
        trial.variation,
        settings,
        markers=filmed,
        conveyor=trial.conveyor,
    )
    plant: TruthfulPlant = MujocoPlant(
        scene, plan.arm[0].position[0], plan.gripper[0].position[0], trial.T_world_object, t=plan.start_time
    )
    controller = grasp_controller(task, planned.targets.grasp, period)
    meta = {"scenario": workcell.scenario.model_dump(mode="json"), "seed": trial.seed, "versions": versions()}
    with ExitStack() as stack:
        camera = stack.enter_context(camera_poses(workcell, trial, plan, scene)) if filmed else None
        if camera is not None:
            plant = camera.filmed(plant)
        planner = planner or planner_for(workcell)
        loop = replanning_loop(workcell, trial, plan, planned.targets, planner, source or camera)
        record = run_episode(
            plan,
            plant,
            controller,
            EpisodeSettings(control_period=period),
            replanning=loop,
            progress=progress,
            meta=meta,
        )
    vision = None if camera is None else camera.finish(meta)
    targets, events, not_taken = planned.targets, (), ()
    if loop is not None:
        plan, targets, events, not_taken = loop.newest, loop.targets, tuple(loop.events), tuple(loop.not_taken)
    outcome = judge(plan, record, task, targets.grasp)
    return ExecutedTrial(record, outcome, scene, plan, targets, events, not_taken, vision)


def summary(trial: Trial, planned: PlannedTrial, executed: ExecutedTrial | None) -> dict[str, Any]:
    """The content of `summary.json`; without an execution the criteria are empty and `cause` says why."""
    result = planned.result
    document: dict[str, Any] = {
        "success": executed is not None and executed.outcome.success,
        "cause": executed.outcome.cause if executed else f"planning: {result.status}: {result.message}",
        "criteria": executed.outcome.summary() if executed else {},
        "replanning": replanning_summary(executed.replans, executed.not_taken) if executed else {},
        "vision": vision_summary(executed.vision) if executed else {},
        "phases": result.plan.durations.tolist() if result.plan else [],
        "planning_ms": planned.planning_ms,
        "planning_attempts": planned.attempts,
        "timings_ms": result.timings_ms,
        "plan_status": str(result.status),
        "grasp": planned.targets.grasp.name,
        "worst": worst_ratios(planned, executed),
        "tracking": executed.outcome.details if executed else {},
        "seed": trial.seed,
        "versions": versions(),
    }
    return document


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
    row = _drawn(trial, workcell)
    planned = plan_trial(workcell, trial, planner)
    executed = execute_trial(workcell, trial, planned, planner=planner) if planned.result.ok else None
    document = summary(trial, planned, executed)
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
    row["trial_ms"] = 1e3 * (time.perf_counter() - began)
    return row


def _drawn(trial: Trial, workcell: Workcell) -> dict[str, Any]:
    """What chance decided: pose of the part, error of the believed pose in the grasp frame, friction and mass."""
    T, T_object_grasp = trial.T_world_object, workcell.task.grasp_object.grasps[0].T_object_grasp
    error = (T * T_object_grasp).actInv(trial.T_world_object_believed * T_object_grasp)
    return {
        "seed": trial.seed,
        "x_m": float(T.translation[0]),
        "y_m": float(T.translation[1]),
        "yaw_deg": float(np.rad2deg(pin.rpy.matrixToRpy(T.rotation)[2])),
        "error_along_mm": 1e3 * float(error.translation[0]),
        "error_across_mm": 1e3 * float(error.translation[1]),
        "error_up_mm": 1e3 * float(error.translation[2]),
        "error_deg": float(np.rad2deg(np.linalg.norm(pin.log3(error.rotation)))),
        "friction": trial.variation.friction,
        "mass_factor": trial.variation.mass_factor,
    }
