"""The online replanner: a new plan for new targets, audited and in time, or the old one and the reason why."""

from __future__ import annotations

import time
from collections.abc import Callable

from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import PhaseSolver
from dyngrasp.planning.replanning.attempt import Attempt
from dyngrasp.planning.replanning.full_problem import FullProblem, PhasePlanner
from dyngrasp.planning.replanning.outcome import Path, ReplannerSettings, ReplanResult
from dyngrasp.signals import PoseEstimate
from dyngrasp.trajectory import GraspPlan

__all__ = ["Path", "PhasePlanner", "ReplanResult", "Replanner", "ReplannerSettings"]


class Replanner:
    """Replaces running plans; keeps no state between calls but what it has computed of the task.

    The first call loads compiled code and takes long. Later on, a pass of Python's garbage collector over all that a
    process has made can take 0.1 s: call `gc.freeze()` once everything is set up and warm.
    """

    def __init__(
        self,
        task: GraspTask,
        settings: ReplannerSettings | None = None,
        solver: PhaseSolver | None = None,
        planner: PhasePlanner | None = None,
        clock: Callable[[], float] = time.perf_counter,
    ) -> None:
        """Prepare a replanner.

        Args:
            task: Arm, gripper, part and target.
            settings: Budget and weights.
            solver: Solves a phase under all constraints where the audit refuses the quadratic program's answer.
            planner: Makes the problems for it, and fresh plans where the part moved too far.
            clock: Seconds; what the deadline is measured with. A constant makes results independent of the machine.
        """
        self.task = task
        self.settings = settings or ReplannerSettings()
        self.full: FullProblem | None = None
        if solver is not None and planner is not None:
            self.full = FullProblem(task, planner, solver, self.settings.tracking)
        self._clock = clock

    def replan(
        self, plan: GraspPlan, targets: GraspTargets, t: float, previous: GraspTargets | None = None
    ) -> ReplanResult:
        """Continue `plan` to new targets.

        Args:
            plan: The running plan, whoever made it.
            targets: New boundary states, best from `updated_targets`: those continue the plan's posture.
            t: Now (s), on the plan's clock.
            previous: What the running plan was made for, which matters only if the part moved in it.

        Returns:
            A new plan that takes over at t + budget, with q, q̇ and q̈ of the old one there; or the old plan with a
            status.
        """
        return self._attempt(plan, t).towards(targets, previous=previous)

    def replan_to_pose(self, plan: GraspPlan, previous: GraspTargets, estimate: PoseEstimate, t: float) -> ReplanResult:
        """The whole cycle: from an estimate of the part's pose through the inverse kinematics to an audited plan.

        A moving part is predicted to the time of the grasp. That time changes with the plan, so both are iterated
        until the predicted part no longer moves.

        Args:
            plan: The running plan.
            previous: What it was made for.
            estimate: Newest estimate; its capture time is what prediction starts from.
            t: Now (s).
        """
        return self._attempt(plan, t).to_pose(previous, estimate)

    def _attempt(self, plan: GraspPlan, t: float) -> Attempt:
        return Attempt(self.task, self.settings, self.full, self._clock, plan, t)
