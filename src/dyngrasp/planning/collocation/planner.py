"""The offline planner: three phases of arm and hand on one clock, from boundary states to an audited plan."""

from __future__ import annotations

import time

import numpy as np

from dyngrasp.planning.audit import audit
from dyngrasp.planning.collocation.descent import descent
from dyngrasp.planning.collocation.phase_problems import PHASE_OF_RESERVE, HandMotion, PhaseProblems, Reserves
from dyngrasp.planning.collocation.settings import BACKENDS, CollocationSettings
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.problem import AuditReport, PhaseProblem, PhaseSolver, PlanResult, Solution, Status
from dyngrasp.signals import Array, JointState
from dyngrasp.trajectory import PHASE_NAMES, GraspPlan, Trajectory

__all__ = ["CollocationPlanner", "CollocationSettings"]

# Plans after which raising the reserves is given up.
MOST_PLANS = 8


class CollocationPlanner:
    """Plans a grasp by trapezoidal collocation with free phase durations, eq. (3)."""

    def __init__(
        self, task: GraspTask, settings: CollocationSettings | None = None, solver: PhaseSolver | None = None
    ) -> None:
        """Prepare a planner; functions are built at the first plan and kept.

        Args:
            task: Arm, gripper, part and target.
            settings: How to plan.
            solver: Used in place of the backend that the settings name.
        """
        self.task = task
        self.settings = settings or CollocationSettings()
        self.solver = solver or BACKENDS[self.settings.backend]()
        self._problems = PhaseProblems(task, self.settings)

    def plan(
        self,
        q_start: Array | JointState,
        targets: GraspTargets,
        gripper_start: Array | None = None,
        start_time: float = 0.0,
    ) -> PlanResult:
        """Plan the three phases one after the other, and audit the whole.

        A moving part is met when and where the targets say: then the durations of approach and grasp are given.

        Args:
            q_start: (n,) configuration at rest (rad), or a state with its velocity.
            targets: Boundary states of the phases.
            gripper_start: (m,) present posture of the gripper (rad), at rest; open if left out.
            start_time: Time of the first grid point on the common clock (s).

        Returns:
            The plan if every phase converged and the audit passed; else what went wrong, as a status.

        Raises:
            InvalidProblem: The hand cannot close in time, or a moving part cannot be met when the targets say.
        """
        began = time.perf_counter()
        start, hand = _state(q_start), self._problems.hand(targets, gripper_start)
        reserves = Reserves.of(self.settings)
        problems = self._problems.state(start, targets, hand, reserves, start_time)
        timings = {"problems": 1e3 * (time.perf_counter() - began)}
        solutions: list[Solution] = []
        for name, problem in zip(PHASE_NAMES, problems, strict=True):
            solution = self.solver.solve(problem, self.guess(problem, targets))
            solutions.append(solution)
            timings[name] = solution.timings_ms.get("total", 0.0)
            if not solution.ok:
                timings["total"] = 1e3 * (time.perf_counter() - began)
                return PlanResult(solution.status, None, tuple(solutions), None, timings, solution.message)
        plan, report = self._audited(solutions, hand, targets, start_time, timings)
        for _ in range(1, MOST_PLANS):
            raised = reserves.raised(report, solutions[-1].require())
            if raised is None:
                break
            reserves, problems = raised, self._problems.state(start, targets, hand, raised, start_time)
            again = {}
            for phase in (PHASE_OF_RESERVE[entry.name] for entry in report.failures):
                again[phase] = self.solver.solve(problems[phase], solutions[phase].trajectory)
                timings[PHASE_NAMES[phase]] += again[phase].timings_ms.get("total", 0.0)
            if not all(solution.ok for solution in again.values()):
                break
            solutions = [again.get(phase, solution) for phase, solution in enumerate(solutions)]
            plan, report = self._audited(solutions, hand, targets, start_time, timings)
        timings["total"] = 1e3 * (time.perf_counter() - began)
        if report.ok:
            return PlanResult(Status.CONVERGED, plan, tuple(solutions), report, timings)
        failed = "; ".join(str(entry) for entry in report.failures)
        return PlanResult(Status.AUDIT_FAILED, plan, tuple(solutions), report, timings, f"audit: {failed}")

    def _audited(
        self,
        solutions: list[Solution],
        hand: tuple[HandMotion, ...],
        targets: GraspTargets,
        start_time: float,
        timings: dict[str, float],
    ) -> tuple[GraspPlan, AuditReport]:
        """The solved phases on one timeline with the gripper, and what the audit says of them."""
        began = time.perf_counter()
        arm = tuple(solution.require() for solution in solutions)
        plan = GraspPlan(
            arm=arm,  # type: ignore[arg-type]
            gripper=tuple(motion.path.over(phase.duration) for motion, phase in zip(hand, arm, strict=True)),  # type: ignore[arg-type]
            start_time=start_time,
            arm_joints=self.task.robot.joint_names,
            gripper_joints=self.task.gripper.joint_names,
        )
        report = audit(plan, targets, self.task)
        timings["audit"] = timings.get("audit", 0.0) + 1e3 * (time.perf_counter() - began)
        return plan, report

    def phase_problems(
        self,
        q_start: Array | JointState,
        targets: GraspTargets,
        gripper_start: Array | None = None,
        start_time: float = 0.0,
    ) -> tuple[PhaseProblem, PhaseProblem, PhaseProblem]:
        """The three problems that `plan` solves, in the order of `PHASE_NAMES`; arguments as there."""
        hand = self._problems.hand(targets, gripper_start)
        return self._problems.state(_state(q_start), targets, hand, Reserves.of(self.settings), start_time)

    def guess(self, problem: PhaseProblem, targets: GraspTargets) -> Trajectory | None:
        """A start for the approach that comes down the funnel; None where the solver's own start is as good."""
        if all(constraint.name != "funnel" for constraint in problem.constraints):
            return None
        return descent(problem, targets, self.task)


def _state(q_start: Array | JointState) -> BoundaryState:
    if isinstance(q_start, JointState):
        return BoundaryState(q_start.position, q_start.velocity)
    return BoundaryState(q_start, np.zeros(np.size(q_start)))
