"""One trial from what is believed of the part to the verdict: targets, plan, audit, physics, criteria."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from typing import Any

import pinocchio as pin

from dyngrasp.closed_loop.episode import grasp_controller, run_episode
from dyngrasp.closed_loop.first_look import FirstLook
from dyngrasp.closed_loop.pose_source import PoseSource
from dyngrasp.closed_loop.record import EpisodeRecord
from dyngrasp.closed_loop.replanning_loop import ReplanEvent
from dyngrasp.closed_loop.vision_record import VisionRecord
from dyngrasp.errors import InvalidProblem, OutOfReach
from dyngrasp.experiments.draws import Trial
from dyngrasp.experiments.metrics import Outcome, judge
from dyngrasp.experiments.provenance import versions
from dyngrasp.experiments.replanning import replanning_loop
from dyngrasp.experiments.trial_world import TrialWorld, trial_world
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.planning.collocation.planner import CollocationPlanner, CollocationSettings
from dyngrasp.planning.grasp_targets import GraspTargets, grasp_targets, moved, ranked_grasp_targets
from dyngrasp.planning.problem import PlanResult, Status
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.signals import Array
from dyngrasp.simulation.scene import Scene
from dyngrasp.trajectory import GraspPlan

# Arm postures that are tried, best first, before a pose counts as not plannable.
CANDIDATES = 4

# When a moving part is met, over the time of the grasp of one that stands where it will be met; tried in turn.
LATER = (1.0, 1.1, 1.25)

# When a moving part may be in reach (s).
FIRST_GUESSES = (0.0, 2.0, 4.0, 6.0)

# After the planned grasp by so much (s) no more pictures are taken: a replanned grasp may come a little later, and once
# the fingers hold the part nobody asks where it is.
AFTER_GRASP = 0.5


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


def plan_trial(
    workcell: Workcell, trial: Trial, planner: CollocationPlanner, look: FirstLook | None = None
) -> PlannedTrial:
    """Plan for what is believed of the part; the next-best arm posture is tried where one fails.

    Args:
        workcell: Scenario and models.
        trial: What the planner is told, if nobody looks.
        planner: Plans.
        look: What the first look found; the plan begins when the arm has waited for it.

    Raises:
        OutOfReach: No posture reaches the part.
        GraspRefused: The gripper cannot take or hold it.
        InvalidProblem: Nothing is known of the part: the scenario wants it seen, and no look found it.
    """
    began = time.perf_counter()
    first: tuple[GraspTargets, PlanResult] | None = None
    attempts, belief = 0, _belief(trial, look)
    T, twist = belief.T_world_object, belief.twist_world
    if twist.any():
        T = moved(T, twist, _first_grasp_time(workcell, belief, planner))
    for targets in islice(ranked_grasp_targets(T, workcell.task, workcell.q_start), CANDIDATES):
        attempts += 1
        result = planner.plan(workcell.q_start, targets, start_time=belief.t)
        if result.plan is not None and twist.any():
            targets, result = _met(workcell, belief, planner, targets, result.plan)
        if result.ok:
            return PlannedTrial(targets, result, 1e3 * (time.perf_counter() - began), attempts)
        # Of several failures the best posture's says most.
        first = first or (targets, result)
    assert first is not None  # ranked_grasp_targets yields at least once or raises
    return PlannedTrial(*first, 1e3 * (time.perf_counter() - began), attempts)


@dataclass(frozen=True)
class _Belief:
    """Where the part is at time t (s), when the motion begins, and how it moves (m/s, rad/s)."""

    T_world_object: pin.SE3
    twist_world: Array
    t: float = 0.0


def _belief(trial: Trial, look: FirstLook | None) -> _Belief:
    if look is not None and look.estimate is not None:
        seen = look.estimate
        T = moved(seen.T_world_object, seen.twist_world, look.start_time - seen.t_capture)
        return _Belief(T, seen.twist_world, look.start_time)
    if trial.T_world_object_believed is None:
        raise InvalidProblem('with pose.source = "camera" a plan needs a first look that found the part')
    return _Belief(trial.T_world_object_believed, trial.twist_believed)


def _first_grasp_time(workcell: Workcell, belief: _Belief, planner: CollocationPlanner) -> float:
    """When a moving part is met depends on where, and where on when: how long it takes to where it soon will be (s)."""
    failure: OutOfReach | None = None
    for guess in FIRST_GUESSES:
        T = moved(belief.T_world_object, belief.twist_world, guess)
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
    workcell: Workcell, belief: _Belief, planner: CollocationPlanner, standing: GraspTargets, plan: GraspPlan
) -> tuple[GraspTargets, PlanResult]:
    """Targets and plan that meet a moving part, from a plan for one that stands about where it will be met."""
    updater, duration = target_updater(workcell.task), float(plan.durations[1])
    targets, result = standing, PlanResult(Status.INFEASIBLE, None, (), None, {}, "the part rides out of reach")
    for later in LATER:
        after = later * (float(plan.phase_ends[1]) - belief.t)
        T = moved(belief.T_world_object, belief.twist_world, after)
        try:
            targets = updater.update(standing, T, belief.twist_world, belief.t + after, duration)
        except OutOfReach:
            break
        result = planner.plan(workcell.q_start, targets, start_time=belief.t)
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
    world: TrialWorld | None = None,
) -> ExecutedTrial:
    """Carry out a valid plan in the plant that the trial drew, and judge what happened.

    Args:
        workcell: Scenario and models.
        trial: Where the part really is and how the plant deviates.
        planned: A plan that passed its audit.
        progress: Called with time (s) and phase as the episode runs.
        planner: States the problems that the replanner falls back on; one is made if it is needed and left out.
        source: Tells the replanner where the part is, in place of what the scenario's `[pose]` says.
        world: In which the first look was taken; a new one is made if there was none.

    Raises:
        PlanningFailed: The plan is not valid after all.
    """
    task, plan = workcell.task, planned.result.require()
    start_time = plan.start_time
    meta = episode_meta(workcell, trial)
    with ExitStack() as stack:
        world = world or stack.enter_context(trial_world(workcell, trial, filmed=False))
        camera = world.camera
        planner = planner or planner_for(workcell)
        loop = replanning_loop(workcell, trial, plan, planned.targets, planner, source or camera)
        if camera is not None:
            # Without replanning nobody looks any more.
            camera.until = plan.start_time if loop is None else float(plan.phase_ends[1]) + AFTER_GRASP
        record = run_episode(
            plan,
            world.plant,
            grasp_controller(task, planned.targets.grasp, world.rates.control_period),
            world.rates,
            replanning=loop,
            recorder=world.recorder,
            progress=progress,
            meta=meta,
        )
        vision = world.vision(meta)
    targets, events, not_taken = planned.targets, (), ()
    if loop is not None:
        plan, targets, events, not_taken = loop.newest, loop.targets, tuple(loop.events), tuple(loop.not_taken)
    outcome = judge(plan, record, task, targets.grasp, start_time)
    return ExecutedTrial(record, outcome, world.scene, plan, targets, events, not_taken, vision)


def episode_meta(workcell: Workcell, trial: Trial) -> dict[str, Any]:
    """What is kept with the records of a trial."""
    return {"scenario": workcell.scenario.model_dump(mode="json"), "seed": trial.seed, "versions": versions()}
