"""The running loop: the one place where plan, controllers and plant meet."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dyngrasp.closed_loop.clock import Clock
from dyngrasp.closed_loop.record import EpisodeRecord, Recorder
from dyngrasp.closed_loop.replanning_loop import ReplanningLoop
from dyngrasp.control.computed_torque import ComputedTorque, ComputedTorqueSettings
from dyngrasp.control.grasp_controller import Controller, GraspController
from dyngrasp.control.gripper_control import GripperController, GripperControlSettings
from dyngrasp.errors import InvalidProblem
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.simulation.plant import Truth, TruthfulPlant
from dyngrasp.trajectory import GraspPlan, PlanSample


@dataclass(frozen=True)
class EpisodeSettings:
    """Rates of the loop.

    Attributes:
        control_period: Of controllers and plant (s). 1 ms; the paper's 125 µs works as well.
        hold_time: How long the arm holds the part at the target before the episode ends (s): slow slip shows there.
        record_rate: Samples a second in the record (Hz); contacts between samples are not lost.
        longest_delay: How much later than the first plan the last one may end (s).
    """

    control_period: float = 1e-3
    hold_time: float = 0.5
    record_rate: float = 250.0
    longest_delay: float = 30.0


def grasp_controller(
    task: GraspTask,
    grasp: Grasp,
    control_period: float,
    arm: ComputedTorqueSettings | None = None,
    hand: GripperControlSettings | None = None,
) -> GraspController:
    """Controllers of arm and hand for a task, from the nominal models.

    Args:
        task: Arm, gripper, part.
        grasp: Which grasp is taken; it says how the part hangs in the hand.
        control_period: Of the loop (s).
        arm: Gains of the arm.
        hand: Gains and forces of the hand; by default it presses with the share of its force that the task states.
    """
    hand = hand or GripperControlSettings(force_fraction=task.settings.grip_share)
    return GraspController(
        task.robot,
        task.gripper,
        ComputedTorque(task.robot_empty, task.robot_loaded(grasp), control_period, arm),
        GripperController(task.gripper, control_period, task.grasp_object.mass, hand),
    )


def run_episode(
    plan: GraspPlan,
    plant: TruthfulPlant,
    controller: Controller,
    settings: EpisodeSettings | None = None,
    *,
    replanning: ReplanningLoop | None = None,
    recorder: Recorder | None = None,
    progress: Callable[[float, str], None] | None = None,
    meta: dict[str, Any] | None = None,
) -> EpisodeRecord:
    """Carry out a plan, or the plans that follow from it.

    The controllers see observations and the plan; the truth goes into the record and nowhere else.

    Args:
        plan: What to do.
        plant: Where it happens; its time must be the plan's start, its period the control period.
        controller: Turns both into torques.
        settings: Rates.
        replanning: Replaces the plan as the pose of the part becomes known; begins with the same plan.
        recorder: Goes on with a record that has begun already, with a first look.
        progress: Called at every recorded sample with the time (s) and the name of the phase.
        meta: Kept with the record.

    Raises:
        InvalidProblem: Plant and clock disagree about the time.
    """
    settings = settings or EpisodeSettings()
    rate = 0.0 if replanning is None else replanning.settings.rate
    # Replans change the end of the motion; the longest time bounds an episode whose plans never end.
    longest = settings.hold_time + (0.0 if replanning is None else settings.longest_delay)
    clock = Clock(
        settings.control_period,
        plan.start_time,
        plan.end_time + longest,
        replan_rate=rate,
        record_rate=settings.record_rate,
    )
    recorder = recorder or Recorder(plan.arm_joints, plan.gripper_joints, settings.control_period)
    for tick in clock:
        if abs(plant.t - tick.t) > settings.control_period / 2:
            raise InvalidProblem(
                f"episode: the plant is at {plant.t:.6f} s, the clock at {tick.t:.6f} s; the plant's step must be "
                f"the control period of {settings.control_period:g} s and its start that of the plan"
            )
        truth = plant.truth()
        if replanning is not None:
            plan = replanning.plan_at(tick.t, tick.replan, truth)
            if tick.t >= replanning.newest.end_time + settings.hold_time:
                break
        sample = plan.sample(tick.t)
        run_period(plant, controller, recorder, sample, truth, tick.record)
        if tick.record and progress is not None:
            progress(tick.t, sample.phase)
    return recorder.finish(meta)


def run_period(
    plant: TruthfulPlant, controller: Controller, recorder: Recorder, sample: PlanSample, truth: Truth, record: bool
) -> None:
    """Follow a sample of a plan for one control period and watch what happens.

    Args:
        plant: Steps by a control period.
        controller: Sees what the plant's sensors read, and the sample.
        recorder: Watches, and keeps this instant if `record`.
        sample: What is asked for now.
        truth: State of the plant now, for the record.
        record: Whether a sample of the record is due.
    """
    observed, state = plant.observe(), plant.state
    command = controller.command(observed, sample)
    recorder.watch(observed, truth)
    plant.step(command)
    if record:
        recorder.sample(observed, truth, sample, command, plant.applied, state)
