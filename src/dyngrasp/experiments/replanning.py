"""From the `[replanner]` and `[pose]` tables of a scenario to a replanning loop, and from its events to figures."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from dyngrasp.closed_loop.pose_source import NoisyPoses, PoseSource, TruePoses
from dyngrasp.closed_loop.replanning_loop import ReplanEvent, ReplanningLoop, ReplanningSettings
from dyngrasp.experiments.draws import Trial
from dyngrasp.experiments.scenario import PoseSection, ReplannerSection
from dyngrasp.experiments.workcell import Workcell
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.perception.pose_noise import PoseNoise, PoseNoiseSettings
from dyngrasp.planning.collocation.planner import CollocationPlanner
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.replanning.phase_programs import TrackingSettings
from dyngrasp.planning.replanning.replanner import Replanner, ReplannerSettings
from dyngrasp.trajectory import GraspPlan

# Of all random streams of a trial this one belongs to the camera: the others stay what they are without it.
_POSE_STREAM = 7


def replanner_for(task: GraspTask, section: ReplannerSection, planner: CollocationPlanner) -> Replanner:
    """The replanner that a scenario asks for.

    With a fixed latency its deadline is not measured, so that an episode does not depend on the machine.
    """
    paper = section.mode == "lcqp"
    settings = ReplannerSettings(
        budget=1e-3 * section.budget_ms, tracking=TrackingSettings(paper_rows=paper), gate=not paper
    )
    measured = section.latency_ms == "measured"
    clock = time.perf_counter if measured else _standing_clock
    return Replanner(task, settings, StructuredSolver(), planner, clock)


def replanning_loop(
    workcell: Workcell,
    trial: Trial,
    plan: GraspPlan,
    targets: GraspTargets,
    planner: CollocationPlanner,
    source: PoseSource | None = None,
) -> ReplanningLoop | None:
    """The loop of a trial; None if the scenario keeps the first plan.

    `source` is a camera or the user's own; truth and noise model are made here.
    """
    section = workcell.scenario.replanner
    if not section.enabled:
        return None
    # What the noise model says of itself rests on knowing its own error: no sensor does, so it is not judged by it.
    bound = np.inf if source is None else 1e-3 * section.largest_deviation_mm
    source = source or pose_source(workcell.scenario.pose, trial, targets.grasp)
    latency = None if section.latency_ms == "measured" else 1e-3 * float(section.latency_ms)
    replanner = replanner_for(workcell.task, section, planner)
    if latency is None:
        # What is compiled or loaded at the first call would count as latency of the first replan.
        replanner.replan(plan, targets, plan.start_time)
    return ReplanningLoop(
        replanner, source, plan, targets, ReplanningSettings(section.rate_hz, latency, largest_deviation=bound)
    )


def pose_source(section: PoseSection, trial: Trial, grasp: Grasp) -> PoseSource:
    """What the loop is told of the part's pose."""
    moving = section.motion != "still"
    if section.source == "truth":
        return TruePoses(moving)
    assert trial.T_world_object_believed is not None  # a camera is a source of its own
    T_object_grasp = grasp.T_object_grasp
    error = (trial.T_world_object * T_object_grasp).actInv(trial.T_world_object_believed * T_object_grasp)
    settings = PoseNoiseSettings(
        reveal_from=section.reveal_from_m,
        reveal_to=section.reveal_to_m,
        residual_position=1e-3 * section.residual_mm,
        residual_angle=np.deg2rad(section.residual_deg),
        frame_position=1e-3 * section.frame_mm,
        frame_position_growth=1e-3 * section.frame_mm_per_m2,
        frame_angle=np.deg2rad(section.frame_deg),
        frame_angle_growth=np.deg2rad(section.frame_deg_per_m2),
        correlation_time=section.correlation_s,
        frame_velocity=1e-3 * section.frame_mm_s,
        frame_spin=np.deg2rad(section.frame_deg_s),
    )
    seed = int(np.random.SeedSequence(trial.seed, spawn_key=(_POSE_STREAM,)).generate_state(1, np.uint64)[0])
    twist_error = trial.twist_believed - trial.twist_world
    return NoisyPoses(PoseNoise(error, T_object_grasp, settings, seed, twist_error), moving)


def replanning_summary(events: Sequence[ReplanEvent], not_taken: Sequence[float] = ()) -> dict[str, Any]:
    """How the replans of an episode ended: counts by way and status, reasons, and times.

    Times are those of the replans that replaced the plan (ms). `too_uncertain` counts the updates that were not taken
    because of the estimate's covariance; see `not_taken` of `ReplanningLoop`.
    """
    if not events and not not_taken:
        return {}
    # A refusal, as while the part is carried, takes next to nothing.
    replaced = [event for event in events if event.result.ok and not event.late]
    times = [event.result.timings_ms["total"] for event in replaced]
    return {
        "replans": len(events),
        "published": len(replaced),
        "late": sum(event.late for event in events),
        "too_uncertain": len(not_taken),
        "paths": dict(Counter(str(event.result.path) for event in events)),
        "kept_because": dict(Counter(event.result.message for event in events if not event.result.ok)),
        "median_ms": float(np.median(times)) if times else None,
        "max_ms": max(times, default=None),
    }


def _standing_clock() -> float:
    return 0.0
