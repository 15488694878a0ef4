"""Where the quadratic program does not do: whole phases under all constraints, torque and funnel included.

Planner and solver are given from outside; this module asks for the problems from the moving start, softens the funnel
by the stated rule, solves, and joins the answers to the running plan with the acceleration that it has at the splice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from dyngrasp.errors import DyngraspError
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import PhaseProblem, PhaseSolver, Solution
from dyngrasp.planning.replanning.funnel_recovery import FunnelRecovery, lifted
from dyngrasp.planning.replanning.phase_programs import APPROACH, TrackingSettings, hold_start
from dyngrasp.planning.replanning.splice import stretched
from dyngrasp.signals import Array, JointState
from dyngrasp.trajectory import GraspPlan, PlanSample, Trajectory

# The funnel is lifted in full after this share of the approach, and until as much before its end; at the end itself by
# this much (m): the pre-grasp stands 20 mm above its tip.
_RAMP, _LIFT_AT_END = 0.15, 0.012


class PhasePlanner(Protocol):
    """What states the problems of whole phases; the offline planner does."""

    def phase_problems(
        self,
        q_start: JointState,
        targets: GraspTargets,
        gripper_start: Array | None = None,
        start_time: float = 0.0,
    ) -> tuple[PhaseProblem, PhaseProblem, PhaseProblem]:
        """The problems of the three phases from a moving start."""
        ...

    def guess(self, problem: PhaseProblem, targets: GraspTargets) -> Trajectory | None:
        """Where to start a phase if there is no better idea."""
        ...


@dataclass(frozen=True)
class FullProblem:
    """The three phases from a splice in the approach on.

    Attributes:
        task: Arm, gripper, part.
        planner: States the problems.
        solver: Solves one.
        settings: For the acceleration at the splice.
        detour: How much longer than what was left of it the approach may become (s). On a grid stretched over a long
            detour the steps would be coarse enough to pass through the funnel's wall unseen.
    """

    task: GraspTask
    planner: PhasePlanner
    solver: PhaseSolver
    settings: TrackingSettings
    detour: float = 1.5

    def problems(
        self, state: PlanSample, left: float, targets: GraspTargets, recovery: FunnelRecovery
    ) -> tuple[tuple[PhaseProblem, ...] | None, str]:
        """The problems from a state with `left` (s) of the approach ahead, or None and why there are none."""
        try:
            problems = self.planner.phase_problems(state.arm, targets, state.gripper.position, state.arm.t)
        except DyngraspError as error:
            return None, str(error)
        rows = tuple(recovery.soften(row) if row.name == "funnel" else row for row in problems[APPROACH].constraints)
        shortest = problems[APPROACH].min_duration
        longest = max(min(problems[APPROACH].max_duration, left + self.detour), shortest)
        return (replace(problems[APPROACH], constraints=rows, max_duration=longest), *problems[1:]), ""

    def approach_time(self, state: PlanSample, targets: GraspTargets) -> float | None:
        """How long about an approach takes that comes down the funnel (s); None where that cannot be told."""
        try:
            problem = self.planner.phase_problems(state.arm, targets, state.gripper.position, state.arm.t)[APPROACH]
        except DyngraspError:
            return None
        guess = self.planner.guess(problem, targets)
        return None if guess is None else guess.duration

    def descent(
        self, plan: GraspPlan, problem: PhaseProblem, state: PlanSample, targets: GraspTargets
    ) -> GraspPlan | None:
        """The plan with an approach that comes down the funnel anew, in closed form; None if there is none.

        Limits and rows are not looked at: that is for the audit.
        """
        guess = self.planner.guess(problem, targets)
        motion = None if guess is None else hold_start(guess, state.arm, targets.pregrasp, self.task, self.settings)
        if motion is None:
            return None
        arm, hand = list(plan.arm), list(plan.gripper)
        arm[APPROACH], hand[APPROACH] = motion, stretched(hand[APPROACH], motion.duration)
        return replace(plan, arm=tuple(arm), gripper=tuple(hand))  # type: ignore[arg-type]

    def improve(
        self,
        plan: GraspPlan,
        phases: set[int],
        problems: tuple[PhaseProblem, ...],
        state: PlanSample,
        targets: GraspTargets,
        stop: Callable[[], bool],
    ) -> tuple[GraspPlan | None, str]:
        """The plan with some phases solved anew, from what they are in it; None and why if one of them fails.

        The solver gives up once `stop` says so.
        """
        for phase in sorted(phases):
            solution = self.solver.solve(problems[phase], plan.arm[phase], stop)
            motion, why = self._joined(solution, phase, state, targets)
            if motion is None:
                return None, why
            arm, hand = list(plan.arm), list(plan.gripper)
            arm[phase], hand[phase] = motion, stretched(hand[phase], motion.duration)
            plan = replace(plan, arm=tuple(arm), gripper=tuple(hand))
        return plan, ""

    def fresh(
        self,
        running: GraspPlan,
        splice: float,
        problems: tuple[PhaseProblem, ...],
        state: PlanSample,
        targets: GraspTargets,
        stop: Callable[[], bool],
    ) -> tuple[GraspPlan | None, str]:
        """A plan from the splice on that owes nothing to the running one but its state and the paths of its hand."""
        motions: list[Trajectory] = []
        for phase, problem in enumerate(problems):
            solution = self.solver.solve(problem, self.planner.guess(problem, targets), stop)
            motion, why = self._joined(solution, phase, state, targets)
            if motion is None:
                return None, why
            motions.append(motion)
        still = np.zeros((motions[APPROACH].intervals + 1, len(running.gripper_joints)))
        waiting = Trajectory(motions[APPROACH].duration, still + state.gripper.position, still, still)
        closing = (stretched(path, arm.duration) for path, arm in zip(running.gripper[1:], motions[1:], strict=True))
        return replace(running, arm=tuple(motions), gripper=(waiting, *closing), start_time=splice), ""

    def _joined(
        self, solution: Solution, phase: int, state: PlanSample, targets: GraspTargets
    ) -> tuple[Trajectory | None, str]:
        if not solution.ok or solution.trajectory is None:
            return None, solution.message
        if phase != APPROACH:
            return solution.trajectory, ""
        motion = hold_start(solution.trajectory, state.arm, targets.pregrasp, self.task, self.settings)
        return motion, "" if motion is not None else "the acceleration at the splice cannot be met"


def raised(problem: PhaseProblem, by: float) -> PhaseProblem:
    """The approach with its funnel lifted by a height (m), but as far as both ends, which are given, allow."""
    s = np.linspace(0.0, 1.0, problem.intervals + 1)
    lift = np.minimum(by * np.clip(s / _RAMP, 0.0, 1.0), _LIFT_AT_END + by * np.clip((1.0 - s) / _RAMP, 0.0, 1.0))
    rows = tuple(lifted(row, lift) if row.name == "funnel" else row for row in problem.constraints)
    return replace(problem, constraints=rows)
