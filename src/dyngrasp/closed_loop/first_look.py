"""The first look: the arm stands, held by its controller, until a pose source knows the part well enough to plan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dyngrasp.closed_loop.clock import Clock
from dyngrasp.closed_loop.episode import EpisodeSettings, run_period
from dyngrasp.closed_loop.pose_source import PoseSource
from dyngrasp.closed_loop.record import Recorder
from dyngrasp.closed_loop.replanning_loop import grasp_point_deviation
from dyngrasp.control.grasp_controller import Controller
from dyngrasp.errors import InvalidProblem
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.perception.pose_filter import PoseUnknown
from dyngrasp.signals import JointState, PoseEstimate
from dyngrasp.simulation.plant import Truth, TruthfulPlant
from dyngrasp.trajectory import PHASE_NAMES, PlanSample


@dataclass(frozen=True)
class FirstLookSettings:
    """When a first look ends.

    Attributes:
        deviation: Standard deviation of the grasp point that is good enough to plan for (m).
        shortest: It does not end before (s): velocities become known only with time.
        longest: After so long (s) it ends with whatever is known by then.
        planning: How long the arm then waits (s) for its plan, which is made meanwhile: that of a part at rest takes
            0.03 s, that of a moving one up to 0.2 s.
    """

    deviation: float = 2e-3
    shortest: float = 0.0
    longest: float = 2.0
    planning: float = 0.2

    def __post_init__(self) -> None:
        if not self.deviation > 0:
            raise InvalidProblem(f"deviation > 0 m expected, got {self.deviation}")
        if not (0 <= self.shortest <= self.longest and 0 < self.longest < np.inf):
            raise InvalidProblem(
                f"0 ≤ shortest ≤ longest and longest > 0 s expected, got {self.shortest}, {self.longest}"
            )
        if not (np.isfinite(self.planning) and self.planning >= 0):
            raise InvalidProblem(f"planning ≥ 0 s expected, got {self.planning}")


@dataclass(frozen=True)
class FirstLook:
    """How a first look ended.

    Attributes:
        began, ended: Times (s).
        start_time: When the motion begins (s).
        estimate: What was known of the part when the look ended; None if it was not found.
        deviation: Standard deviation of the grasp point then (m), infinite if it was not found.
        truth: The state of the plant then: evidence, for nothing that plans.
    """

    began: float
    ended: float
    start_time: float
    estimate: PoseEstimate | None
    deviation: float
    truth: Truth


def take_first_look(
    arm_position: ArrayLike,
    gripper_position: ArrayLike,
    grasps: Sequence[Grasp],
    plant: TruthfulPlant,
    controller: Controller,
    source: PoseSource,
    recorder: Recorder,
    settings: FirstLookSettings | None = None,
    rates: EpisodeSettings | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> FirstLook:
    """Hold a posture until the part is known.

    Args:
        arm_position: (n,) posture in which the arm stands (rad).
        gripper_position: (m,) posture of the planned gripper joints (rad).
        grasps: Of the part: each grasp point must be known.
        plant: Where it happens.
        controller: Holds the posture.
        source: Says where the part is, or that it does not know by raising `PoseUnknown`.
        recorder: Keeps what happens, as the beginning of an episode.
        settings: When the look ends.
        rates: Control period and record rate.
        progress: Called at every recorded sample with the time (s) and "first look".

    Returns:
        What was found; the plant stands at its `start_time`, ready for an episode that begins then.
    """
    settings, rates = settings or FirstLookSettings(), rates or EpisodeSettings()
    arm, hand = np.asarray(arm_position, dtype=float), np.asarray(gripper_position, dtype=float)
    began, half = plant.t, rates.control_period / 2
    # One period more than it may take: the motion begins with a period of its own.
    last = began + settings.longest + settings.planning + 3 * half
    estimate, deviation, ended, t, evidence = None, np.inf, np.inf, began, plant.truth()
    for tick in Clock(rates.control_period, began, last, record_rate=rates.record_rate):
        t, truth = tick.t, plant.truth()
        if ended == np.inf:
            estimate, deviation = _known(source, truth, t, grasps)
            evidence = truth
            enough = deviation <= settings.deviation and t >= began + settings.shortest - half
            if enough or t >= began + settings.longest - half:
                ended = t
        if t >= ended + settings.planning - half:
            break
        sample = PlanSample(PHASE_NAMES[0], _at_rest(t, arm), _at_rest(t, hand))
        run_period(plant, controller, recorder, sample, truth, tick.record)
        if progress is not None and tick.record:
            progress(t, "first look")
    return FirstLook(began, ended, t, estimate, deviation, evidence)


def _known(source: PoseSource, truth: Truth, t: float, grasps: Sequence[Grasp]) -> tuple[PoseEstimate | None, float]:
    try:
        estimate = source.estimate(truth, t)
    except PoseUnknown:
        return None, np.inf
    return estimate, max(grasp_point_deviation(estimate, grasp) for grasp in grasps)


def _at_rest(t: float, position: np.ndarray) -> JointState:
    return JointState(t, position, np.zeros_like(position), np.zeros_like(position))
