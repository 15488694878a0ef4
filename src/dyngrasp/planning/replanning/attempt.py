"""One call of the replanner: the ways to a new plan in their order, the audit after each, the clock before the next."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property

import numpy as np

from dyngrasp.errors import GraspRefused, OutOfReach
from dyngrasp.motion_arrays import JOIN_TOLERANCE
from dyngrasp.planning.audit import audit, standstill
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask, grasp_targets, moved
from dyngrasp.planning.problem import AuditReport, PhaseProblem, Status
from dyngrasp.planning.replanning.full_problem import FullProblem, raised
from dyngrasp.planning.replanning.funnel_recovery import FunnelRecovery, funnel_recovery
from dyngrasp.planning.replanning.outcome import Path, ReplannerSettings, ReplanResult, about_the_approach, failures_of
from dyngrasp.planning.replanning.phase_programs import APPROACH, DELIVER, GRASP
from dyngrasp.planning.replanning.splice import Candidate, splice_time, track
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.planning.worst_values import WHOLE
from dyngrasp.signals import PoseEstimate
from dyngrasp.trajectory import PHASE_NAMES, GraspPlan, PlanSample


class Attempt:
    """One call: what is known, and the clock that runs."""

    def __init__(
        self,
        task: GraspTask,
        settings: ReplannerSettings,
        full: FullProblem | None,
        clock: Callable[[], float],
        plan: GraspPlan,
        t: float,
    ) -> None:
        self.task, self.settings, self.full = task, settings, full
        self.plan, self.t = plan, t
        self.clock = clock
        self.began, self.began_wall = self.clock(), time.perf_counter()
        self.timings: dict[str, float] = {}
        self.report: AuditReport | None = None
        self.recovery: FunnelRecovery | None = None
        self.reasons: list[str] = []
        self.iterations = 0
        self.audit_took = 0.0
        self.previous: GraspTargets | None = None
        self.splice = splice_time(plan, t + self.settings.budget)

    @cached_property
    def state(self) -> PlanSample:
        """Of the running plan at the splice."""
        return self.plan.sample(self.splice)

    def to_pose(self, previous: GraspTargets, estimate: PoseEstimate) -> ReplanResult:
        """See `Replanner.replan_to_pose`."""
        refusal = self._refusal()
        if refusal:
            return self._kept(Status.INFEASIBLE, previous, refusal)
        self.previous = previous
        try:
            targets, candidate = self._targets(previous, estimate)
        except OutOfReach as error:
            return self._fresh_or_kept(previous, estimate, f"inverse kinematics: {error}")
        return self._followed(targets, estimate, candidate)

    def _targets(
        self, previous: GraspTargets, estimate: PoseEstimate, way: int = 0
    ) -> tuple[GraspTargets, Candidate | None]:
        """Boundary states for an estimate; a moving part is met when one of the descents brings the hand there.

        Returns:
            The targets, and for a moving part the candidate that was tracked towards them.

        Raises:
            OutOfReach: The posture of the running plan cannot follow the part.
        """
        updater, twist, plan = target_updater(self.task), estimate.twist_world, self.plan
        moving = self._moves(estimate)
        grasp_time, targets, candidate = float(plan.phase_ends[GRASP]), previous, None
        for _ in range(8 if moving else 1):
            started = time.perf_counter()
            T = estimate.T_world_object
            if moving:
                T = moved(T, twist, grasp_time - estimate.t_capture)
            try:
                targets = updater.update(
                    previous, T, twist if moving else None, grasp_time, float(plan.durations[GRASP])
                )
            finally:
                self._count("targets", started)
            if not moving:
                break
            candidate = self._track(targets, way)
            if candidate.plan is None:
                break
            change = float(candidate.plan.phase_ends[GRASP]) - grasp_time
            grasp_time, plan = grasp_time + change, candidate.plan
            if abs(change) * float(np.abs(twist).max()) <= self.settings.settled:
                break
        return targets, candidate

    def towards(self, targets: GraspTargets, previous: GraspTargets | None = None) -> ReplanResult:
        """See `Replanner.replan`."""
        self.previous = previous
        refusal = self._refusal()
        if refusal:
            return self._kept(Status.INFEASIBLE, targets, refusal)
        return self._followed(targets, None, None)

    def _followed(
        self, targets: GraspTargets, estimate: PoseEstimate | None, candidate: Candidate | None
    ) -> ReplanResult:
        """All ways towards targets, the first of them tracked already if its candidate is given."""
        phase, previous = self.plan.phase_at(self.splice), self.previous
        if phase == APPROACH:
            self.recovery = self._recovery(self.splice, targets)
            if self.recovery is None:
                return self._fresh_or_kept(targets, estimate, "the hand is beside the part, below the new grasp frame")
        status, best = Status.INFEASIBLE, None
        # In the grasp, and where the paper's program has no way of its own, one way is all there is.
        ways = len(self.settings.tracking.descents) if phase == APPROACH and self.settings.gate else 1
        for way in range(ways):
            aimed = targets
            if way and estimate is not None and previous is not None and self._moves(estimate):
                # Another way takes another time, and then the part is elsewhere.
                try:
                    aimed, candidate = self._targets(previous, estimate, way)
                except OutOfReach:
                    break
            candidate = candidate or self._track(aimed, way)
            self.iterations += candidate.iterations
            status = candidate.status
            if candidate.plan is None:
                self.reasons.append(f"tracking: {candidate.message}")
                break
            best, targets, candidate = candidate.plan, aimed, None
            self.report = self._audited(best, targets)
            if self.report.ok or not self.settings.gate:
                return self._published(best, targets, Path.TRACKING, self.settings.budget)
            status = Status.AUDIT_FAILED
            self.reasons.append(f"tracking: {failures_of(self.report)}")
            if self._late(self.settings.budget):
                return self._kept(Status.DEADLINE_MISSED, targets, "no time for another attempt")
            if not about_the_approach(self.report, best):
                break
        if best is not None and self.full is not None and phase == APPROACH:
            found, path = self._reoptimised(best, targets)
            if found is not None:
                return self._published(found, targets, path, self.settings.budget)
        return self._fresh_or_kept(targets, estimate, "", status)

    def _refusal(self) -> str:
        """Why nothing may change any more; "" if it may."""
        plan, task = self.plan, self.task
        if self.splice < plan.start_time:
            return "the running plan has not taken over yet"
        phase = plan.phase_at(self.splice)
        if phase == DELIVER:
            return "the part is in the hand"
        left = float(plan.phase_ends[phase]) - self.splice
        if left < self.settings.least_horizon:
            return f"{left:.3f} s are left of the phase {PHASE_NAMES[phase]}"
        if phase == GRASP:
            closed = plan.gripper[GRASP].position[-1]
            gap = task.gripper.aperture(self.state.gripper.position) - task.gripper.aperture(closed)
            if gap < 2 * self.settings.finger_clearance:
                return "the fingers close on the part"
        return ""

    def _track(self, targets: GraspTargets, way: int = 0) -> Candidate:
        started = time.perf_counter()
        candidate = track(self.plan, targets, self.task, self.splice, self.settings.tracking, way, self.previous)
        self._count("tracking", started)
        return candidate

    def _recovery(self, splice: float, targets: GraspTargets) -> FunnelRecovery | None:
        settings = self.settings
        return funnel_recovery(self.plan, splice, targets, self.task, settings.recovery_shares, settings.reaction)

    @cached_property
    def _keeps_moving(self) -> bool:
        """Whether the running plan does: then the new one must, too."""
        return standstill(self.plan, self.task, self.splice).ok

    def _audited(self, plan: GraspPlan, targets: GraspTargets) -> AuditReport:
        started, started_clock = time.perf_counter(), self.clock()
        wall = WHOLE if self.recovery is None else self.recovery.wall(plan)
        report = audit(plan, targets, self.task, self.splice, wall)
        slowest = standstill(plan, self.task, self.splice)
        if slowest.ok or self._keeps_moving:
            report = AuditReport((*report.entries, slowest))
        self._count("audit", started)
        self.audit_took = self.clock() - started_clock
        return report

    def _reoptimised(self, candidate: GraspPlan, targets: GraspTargets) -> tuple[GraspPlan | None, Path]:
        """The way down the funnel anew, then under all constraints; None if neither helps."""
        assert self.full is not None
        assert self.report is not None
        assert self.recovery is not None
        state = self.state
        started = time.perf_counter()
        left = float(self.plan.phase_ends[APPROACH]) - self.splice
        problems, why = self.full.problems(state, left, targets, self.recovery)
        self._count("full", started)
        if problems is None:
            self.reasons.append(f"full problem: {why}")
            return None, Path.REOPTIMISED
        started = time.perf_counter()
        anew = self.full.descent(candidate, problems[APPROACH], state, targets)
        self._count("descent", started)
        if anew is not None:
            self.report = self._audited(anew, targets)
            if self.report.ok:
                return anew, Path.DESCENT
            self.reasons.append(f"descent: {failures_of(self.report)}")
            candidate = anew
        return self._refined(candidate, set(), problems, state, targets, self.settings.budget), Path.REOPTIMISED

    def _refined(
        self,
        plan: GraspPlan,
        solved: set[int],
        problems: tuple[PhaseProblem, ...],
        state: PlanSample,
        targets: GraspTargets,
        budget: float,
    ) -> GraspPlan | None:
        """Solve what the audit refuses, and audit again, until it refuses nothing or nothing is left to be done.

        Between its grid points a motion may pass the wall of the funnel; then that is moved by a little more.
        """
        assert self.full is not None
        assert self.report is not None
        why = ""
        for _ in range(self.settings.rounds):
            refused = {plan.phase_at(min(entry.time, plan.end_time)) for entry in self.report.failures}
            if self._late(budget):
                why = "no time left"
                break
            through_wall = [entry for entry in self.report.failures if entry.name == "funnel"]
            if APPROACH in solved and through_wall:
                problems = (raised(problems[APPROACH], 0.002 - 1.2 * through_wall[0].worst), *problems[1:])
            elif refused <= solved:
                break
            started = time.perf_counter()
            improved, why = self.full.improve(plan, refused, problems, state, targets, self._stop(budget))
            self._count("full", started)
            if improved is None:
                break
            plan, solved = improved, solved | refused
            self.report = self._audited(plan, targets)
            if self.report.ok:
                return plan
        self.reasons.append(f"full problem: {why or failures_of(self.report)}")
        return None

    def _fresh_or_kept(
        self, targets: GraspTargets, estimate: PoseEstimate | None, reason: str, status: Status = Status.INFEASIBLE
    ) -> ReplanResult:
        """Plan anew from where the arm will be after the longer budget; the old plan bridges that time."""
        if reason:
            self.reasons.append(reason)
        budget, plan = self.settings.fresh_budget, self.plan
        splice = self.t + budget
        left = float(plan.phase_ends[APPROACH]) - splice
        if self.full is None or left < self.settings.least_horizon or self._late(budget):
            return self._kept(status, targets, "")
        state = plan.sample(splice)
        waits = np.abs(state.gripper.position - targets.gripper_open).max() <= JOIN_TOLERANCE
        if not waits or state.gripper.velocity.any():
            return self._kept(status, targets, "fresh plan: the hand is not open and at rest")
        started = time.perf_counter()
        try:
            if estimate is not None:
                targets = self._fresh_targets(estimate, state, left)
            elif not targets.moving:
                targets = grasp_targets(targets.T_world_object, self.task, state.arm.position)
        except (OutOfReach, GraspRefused) as error:
            self._count("fresh", started)
            return self._kept(Status.INFEASIBLE, targets, f"fresh plan: {error}")
        recovery = self._recovery(splice, targets)
        fresh, problems, why = None, None, "the hand is beside the part, below the new grasp frame"
        if recovery is not None:
            problems, why = self.full.problems(state, left, targets, recovery)
            if problems is not None:
                fresh, why = self.full.fresh(plan, splice, problems, state, targets, self._stop(budget))
        self._count("fresh", started)
        if fresh is None:
            return self._kept(Status.INFEASIBLE, targets, f"fresh plan: {why}")
        self.splice, self.recovery = splice, recovery
        self.report = self._audited(fresh, targets)
        if not self.report.ok:
            assert problems is not None
            self.reasons.append(f"fresh plan: {failures_of(self.report)}")
            fresh = self._refined(fresh, {APPROACH, GRASP, DELIVER}, problems, state, targets, budget)
        if fresh is None:
            return self._kept(Status.AUDIT_FAILED, targets, "")
        return self._published(fresh, targets, Path.FRESH, budget)

    def _fresh_targets(self, estimate: PoseEstimate, state: PlanSample, left: float) -> GraspTargets:
        """Targets that owe nothing to the running plan; a moving part is met when a new approach can be there."""
        assert self.full is not None
        T, twist, q = estimate.T_world_object, estimate.twist_world, state.arm.position
        if not self._moves(estimate):
            return grasp_targets(T, self.task, q)
        age, grasp_duration = state.arm.t - estimate.t_capture, float(self.plan.durations[GRASP])
        standing = grasp_targets(moved(T, twist, age + left + grasp_duration), self.task, q)
        until_grasp = (self.full.approach_time(state, standing) or left) + grasp_duration
        return target_updater(self.task).update(
            standing, moved(T, twist, age + until_grasp), twist, state.arm.t + until_grasp, grasp_duration
        )

    def _moves(self, estimate: PoseEstimate) -> bool:
        # A slower part than this moves less than `settled` while the grasp time changes by a second.
        return any(abs(rate) > self.settings.settled for rate in estimate.twist_world.tolist())

    def _late(self, budget: float) -> bool:
        return self.clock() - self.began > budget

    def _stop(self, budget: float) -> Callable[[], bool]:
        """When a solver has to give up: what it finds still has to be audited, which takes as long as the last time."""
        return lambda: self._late(budget - self.audit_took)

    def _count(self, stage: str, started: float) -> None:
        self.timings[stage] = self.timings.get(stage, 0.0) + 1e3 * (time.perf_counter() - started)

    def _published(self, plan: GraspPlan, targets: GraspTargets, path: Path, budget: float) -> ReplanResult:
        """The last look at the clock comes after everything else: what is late is not published."""
        result = self._result(Status.CONVERGED, plan, path, targets)
        elapsed = self.clock() - self.began
        if elapsed > budget:
            return self._kept(Status.DEADLINE_MISSED, targets, f"{1e3 * elapsed:.1f} ms of {1e3 * budget:.0f} ms taken")
        return result

    def _kept(self, status: Status, targets: GraspTargets, reason: str) -> ReplanResult:
        if reason:
            self.reasons.append(reason)
        return self._result(status, self.plan, Path.KEPT, targets)

    def _result(self, status: Status, plan: GraspPlan, path: Path, targets: GraspTargets) -> ReplanResult:
        self.timings["total"] = 1e3 * (time.perf_counter() - self.began_wall)
        factor = self.recovery.factor if self.recovery is not None else 1.0
        splice, report, timings, message = self.splice, self.report, self.timings, "; ".join(self.reasons)
        return ReplanResult(status, plan, path, splice, targets, report, factor, timings, message, self.iterations)
