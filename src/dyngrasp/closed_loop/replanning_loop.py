"""Replanning while the arm moves: when it starts, when its answer is there, and when a new plan takes over.

An answer becomes available a latency after its question, measured or fixed; what is not there by its splice is late
and dropped. A new question waits until the answer to the former is there, so that every plan continues the one that
will really run before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from dyngrasp.closed_loop.pose_source import PoseSource
from dyngrasp.errors import InvalidProblem
from dyngrasp.models.grasp_object import Grasp
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.replanning.replanner import Path, Replanner, ReplanResult
from dyngrasp.signals import PoseEstimate
from dyngrasp.simulation.plant import Truth
from dyngrasp.trajectory import PHASE_NAMES, GraspPlan

_GRASP = PHASE_NAMES.index("grasp")


@dataclass(frozen=True)
class ReplanningSettings:
    """Settings of `ReplanningLoop`.

    Attributes:
        rate: How often a replan starts (Hz); the paper: 10.
        latency: From question to answer (s); None takes what the answer really took on this machine.
        largest_deviation: Standard deviation of the grasp point (m) above which an estimate is not taken: the running
            plan goes on. A part that nobody sees any more is known less and less.
    """

    rate: float = 10.0
    latency: float | None = 0.020
    largest_deviation: float = np.inf

    def __post_init__(self) -> None:
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise InvalidProblem(f"the replanning rate must be > 0, got {self.rate} Hz")
        if self.latency is not None and not (np.isfinite(self.latency) and self.latency >= 0):
            raise InvalidProblem(f"the latency must be ≥ 0, got {self.latency} s")
        if not self.largest_deviation > 0:
            raise InvalidProblem(f"largest_deviation must be > 0 m, got {self.largest_deviation}")


@dataclass(frozen=True)
class ReplanEvent:
    """One replan of an episode.

    Attributes:
        t: When it started (s).
        result: Its answer.
        ready: When that was there (s).
        late: Whether it came after its splice and was dropped.
    """

    t: float
    result: ReplanResult
    ready: float
    late: bool


class ReplanningLoop:
    """Holds the running plan of an episode and replaces it."""

    def __init__(
        self,
        replanner: Replanner,
        source: PoseSource,
        plan: GraspPlan,
        targets: GraspTargets,
        settings: ReplanningSettings | None = None,
    ) -> None:
        """Begin with a plan.

        Args:
            replanner: Makes new plans.
            source: Says where the part is.
            plan: The first plan.
            targets: What it was made for.
            settings: Rate and latency.
        """
        self.settings = settings or ReplanningSettings()
        self.events: list[ReplanEvent] = []
        self.not_taken: list[float] = []
        """Times before the part is in the hand at which a replan was due but the estimate too uncertain (s)."""
        self._replanner, self._source = replanner, source
        self._running, self._next, self._targets = plan, plan, targets
        self._asked: ReplanEvent | None = None

    @property
    def targets(self) -> GraspTargets:
        """What the newest plan was made for."""
        return self._targets

    @property
    def newest(self) -> GraspPlan:
        """The newest plan, also before it takes over."""
        return self._next

    def plan_at(self, t: float, ask: bool, truth: Truth) -> GraspPlan:
        """The plan that holds at time t (s).

        Args:
            t: Now.
            ask: Whether a replan is due.
            truth: For the pose source.
        """
        self._receive(t)
        if t >= self._next.start_time:
            self._running = self._next
        if ask and self._asked is None:
            estimate = self._source.estimate(truth, t)
            if t < self._next.phase_ends[_GRASP] and self._is_vague(estimate):
                self.not_taken.append(t)
                return self._running
            result = self._replanner.replan_to_pose(self._next, self._targets, estimate, t)
            took = 1e-3 * result.timings_ms["total"] if self.settings.latency is None else self.settings.latency
            if self.settings.latency is not None and result.path is Path.FRESH:
                # The fixed latency is that of a local replan; a fresh plan is granted all of its own budget.
                took = max(took, result.splice - t)
            # Splices and latencies are sums of rounded decimals.
            self._asked = ReplanEvent(t, result, t + took, t + took > result.splice + 1e-9)
            self._receive(t)
        return self._running

    def _is_vague(self, estimate: PoseEstimate) -> bool:
        return grasp_point_deviation(estimate, self._targets.grasp) > self.settings.largest_deviation

    def _receive(self, t: float) -> None:
        event = self._asked
        if event is None or t < event.ready:
            return
        self._asked = None
        self.events.append(event)
        # A control period may lie between the splice and this tick: the old plan was followed until then, and both
        # agree there.
        if event.result.ok and not event.late:
            self._next, self._targets = event.result.plan, event.result.targets


def grasp_point_deviation(estimate: PoseEstimate, grasp: Grasp) -> float:
    """Standard deviation (m) of where the grasp point is, along the direction in which it is known least."""
    # T·exp(δ) moves the point p of the object by ρ + θ × p, in the object's axes.
    lever = np.hstack([np.eye(3), -pin.skew(grasp.T_object_grasp.translation)])
    return float(np.sqrt(np.linalg.eigvalsh(lever @ estimate.covariance @ lever.T)[-1]))
