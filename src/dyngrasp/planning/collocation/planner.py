"""The offline planner: three phases of arm and hand on one clock, from boundary states to an audited plan."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from dyngrasp.errors import InvalidProblem
from dyngrasp.planning import constraints
from dyngrasp.planning.audit import audit
from dyngrasp.planning.collocation.closed_form import best_duration, within_speed_limits
from dyngrasp.planning.collocation.descent import descent
from dyngrasp.planning.collocation.gripper_path import GripperPath, gripper_path
from dyngrasp.planning.collocation.ipopt import IpoptSettings, IpoptSolver
from dyngrasp.planning.collocation.node_functions import node_functions
from dyngrasp.planning.collocation.structured import StructuredSettings, StructuredSolver
from dyngrasp.planning.grasp_targets import BoundaryState, GraspTargets, GraspTask
from dyngrasp.planning.problem import (
    AuditReport,
    NodeConstraint,
    PhaseProblem,
    PhaseSolver,
    PlanResult,
    Solution,
    Status,
)
from dyngrasp.signals import Array, JointState
from dyngrasp.trajectory import PHASE_NAMES, GraspPlan, Trajectory


@dataclass(frozen=True)
class CollocationSettings:
    """Settings of `CollocationPlanner`.

    Attributes:
        effort_weight: ρ of eq. (3a) (s⁴/rad²): 1 is the paper's, 1e-3 close to time-optimal.
        intervals: N of each phase.
        backend: Name of the solver of one phase; see `BACKENDS`.
        velocity_fraction, torque_fraction: Parts of the limits that a plan may use; the rest serves the controller,
            which has to track the plan with a model that is not exact.
        position_margin: Distance kept from the position limits (rad), less where a boundary state is closer.
        funnel_margin: h ≥ this at the grid points of the approach (m) at N = 100, because between them the hand cuts
            corners, by the square of the step on other grids; raised where the audit finds that it cuts deeper.
        hold_safety: Factor by which the pinch exceeds what the part asks of it while it is carried, at the velocities
            of the motion of least effort; where the audit finds that the real ones ask too much, at those.
        max_duration: Longest approach and longest delivery (s).
    """

    effort_weight: float = 1.0
    intervals: int = 100
    backend: str = "structured"
    velocity_fraction: float = 0.95
    torque_fraction: float = 0.9
    position_margin: float = 0.01
    funnel_margin: float = 0.002
    hold_safety: float = 1.4
    max_duration: float = 30.0

    def __post_init__(self) -> None:
        for name in ("velocity_fraction", "torque_fraction"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidProblem(f"{name} must be in (0, 1], got {getattr(self, name)}")
        if self.backend not in BACKENDS:
            raise InvalidProblem(f"no backend called {self.backend!r}; valid: {', '.join(sorted(BACKENDS))}")


BACKENDS = {"structured": lambda: StructuredSolver(StructuredSettings()), "ipopt": lambda: IpoptSolver(IpoptSettings())}
"""Solvers of one phase by name."""


@dataclass(frozen=True)
class _Reserves:
    """What rows keep in hand for what they leave out, and the velocities that they are told.

    Attributes:
        funnel: Margin of h for the chords between the grid points (m).
        hold: Factor on the pinch.
        carried: Motion whose velocities load the pinch; None for that of least effort.
    """

    funnel: float
    hold: float
    carried: Trajectory | None = None

    def raised(self, report: AuditReport, carried: Trajectory) -> _Reserves | None:
        """Larger by what the audit found missing; None if that is nothing, or more than reserves can help.

        Args:
            report: What the audit says of a plan.
            carried: Its delivery.
        """
        missing = {entry.name: entry.worst for entry in report.failures}
        if not missing or not missing.keys() <= _PHASE_OF_RESERVE.keys() or self.funnel >= LARGEST_FUNNEL_MARGIN:
            return None
        # A little more than was missing: the new motion differs from the one that was looked at.
        raised = replace(self, funnel=self.funnel - 1.3 * missing.get("funnel", 0.0))
        return replace(raised, hold=1.02 * self.hold, carried=carried) if "hold" in missing else raised


_PHASE_OF_RESERVE = {"funnel": 0, "hold": 2}

# Plans after which raising the reserves is given up.
MOST_PLANS = 8

# The pre-grasp itself stands 20 mm above the tip of the funnel (m).
LARGEST_FUNNEL_MARGIN = 0.015


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

    def plan(
        self,
        q_start: Array | JointState,
        targets: GraspTargets,
        gripper_start: Array | None = None,
        start_time: float = 0.0,
    ) -> PlanResult:
        """Plan the three phases one after the other, and audit the whole.

        Args:
            q_start: (n,) configuration at rest (rad), or a state with its velocity.
            targets: Boundary states of the phases.
            gripper_start: (m,) present posture of the gripper (rad), at rest; open if left out.
            start_time: Time of the first grid point on the common clock (s).

        A moving part is met when and where the targets say: then the durations of approach and grasp are given.

        Returns:
            The plan if every phase converged and the audit passed; else what went wrong, as a status.
        """
        began = time.perf_counter()
        start, paths, reserves = _state(q_start), self._gripper_paths(targets, gripper_start), self._reserves
        problems = self._problems(start, targets, paths, reserves, start_time)
        timings = {"problems": 1e3 * (time.perf_counter() - began)}
        solutions: list[Solution] = []
        for name, problem in zip(PHASE_NAMES, problems, strict=True):
            solution = self.solver.solve(problem, self.guess(problem, targets))
            solutions.append(solution)
            timings[name] = solution.timings_ms.get("total", 0.0)
            if not solution.ok:
                timings["total"] = 1e3 * (time.perf_counter() - began)
                return PlanResult(solution.status, None, tuple(solutions), None, timings, solution.message)
        plan, report = self._audited(solutions, paths, targets, start_time, timings)
        for _ in range(1, MOST_PLANS):
            raised = reserves.raised(report, solutions[-1].require())
            if raised is None:
                break
            reserves, problems = raised, self._problems(start, targets, paths, raised, start_time)
            again = {}
            for phase in (_PHASE_OF_RESERVE[entry.name] for entry in report.failures):
                again[phase] = self.solver.solve(problems[phase], solutions[phase].trajectory)
                timings[PHASE_NAMES[phase]] += again[phase].timings_ms.get("total", 0.0)
            if not all(solution.ok for solution in again.values()):
                break
            solutions = [again.get(phase, solution) for phase, solution in enumerate(solutions)]
            plan, report = self._audited(solutions, paths, targets, start_time, timings)
        timings["total"] = 1e3 * (time.perf_counter() - began)
        if report.ok:
            return PlanResult(Status.CONVERGED, plan, tuple(solutions), report, timings)
        failed = "; ".join(str(entry) for entry in report.failures)
        return PlanResult(Status.AUDIT_FAILED, plan, tuple(solutions), report, timings, f"audit: {failed}")

    def _audited(
        self,
        solutions: list[Solution],
        paths: tuple[GripperPath, ...],
        targets: GraspTargets,
        start_time: float,
        timings: dict[str, float],
    ) -> tuple[GraspPlan, AuditReport]:
        """The solved phases on one timeline with the gripper, and what the audit says of them."""
        began = time.perf_counter()
        arm = tuple(solution.require() for solution in solutions)
        plan = GraspPlan(
            arm=arm,  # type: ignore[arg-type]
            gripper=tuple(path.over(phase.duration) for path, phase in zip(paths, arm, strict=True)),  # type: ignore[arg-type]
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
        paths = self._gripper_paths(targets, gripper_start)
        return self._problems(_state(q_start), targets, paths, self._reserves, start_time)

    @property
    def _reserves(self) -> _Reserves:
        settings = self.settings
        return _Reserves(settings.funnel_margin * (100 / settings.intervals) ** 2, settings.hold_safety)

    def _problems(
        self,
        start: BoundaryState,
        targets: GraspTargets,
        paths: tuple[GripperPath, ...],
        reserves: _Reserves,
        start_time: float,
    ) -> tuple[PhaseProblem, PhaseProblem, PhaseProblem]:
        task, settings = self.task, self.settings
        bounds = [path.shortest_duration(task.gripper.velocity, task.gripper.acceleration) for path in paths]
        empty, loaded = task.robot_empty, task.robot_loaded(targets.grasp)
        torque = constraints.torque_rows(empty, settings.intervals, settings.torque_fraction)
        shortest, longest = max(bounds[1], task.settings.grasp_duration_min), task.settings.grasp_duration_max
        if bounds[1] > longest:
            raise InvalidProblem(
                f"grasp: {task.gripper.name} needs {bounds[1]:.3f} s to close, grasp_duration_max is {longest:g} s"
            )
        spans = [(bounds[0], settings.max_duration), (shortest, longest)]
        if targets.moving:
            # The part waits for nobody: it is where the targets say at their time alone.
            until_pregrasp = targets.grasp_time - targets.grasp_duration - start_time
            spans = [_only(until_pregrasp, *spans[0], "approach"), _only(targets.grasp_duration, *spans[1], "grasp")]
        approach = self._phase("approach", start, targets.pregrasp, (torque,), *spans[0])
        funnel = self._funnel(approach, targets, paths[0], reserves.funnel, start_time)
        approach = replace(approach, constraints=(torque, funnel))
        tube = self._tube(targets, paths[1])
        grasp = self._phase("grasp", targets.pregrasp, targets.grasped, (torque, tube), *spans[1])
        torque = constraints.torque_rows(loaded, settings.intervals, settings.torque_fraction)
        deliver = self._phase("deliver", targets.grasped, targets.place, (torque,), 0.0, settings.max_duration)
        carried = reserves.carried or within_speed_limits(deliver, best_duration(deliver))
        hold = self._hold(targets, carried.velocity, reserves.hold)
        return approach, grasp, replace(deliver, constraints=(torque, hold, self._above_ground(targets)))

    def guess(self, problem: PhaseProblem, targets: GraspTargets) -> Trajectory | None:
        """A start for the approach that comes down the funnel; None where the solver's own start is as good."""
        if all(constraint.name != "funnel" for constraint in problem.constraints):
            return None
        return descent(problem, targets, self.task)

    def _phase(
        self,
        name: str,
        start: BoundaryState,
        end: BoundaryState,
        rows: tuple[NodeConstraint, ...],
        shortest: float,
        longest: float,
    ) -> PhaseProblem:
        settings, limits = self.settings, self.task.robot.limits
        inner_lower = limits.position_lower + settings.position_margin
        inner_upper = limits.position_upper - settings.position_margin
        lowest, highest = np.minimum(start.position, end.position), np.maximum(start.position, end.position)
        # A moving start may be a little faster than the fraction: speed peaks between the grid points too.
        fastest = np.maximum(np.abs(start.velocity), np.abs(end.velocity))
        return PhaseProblem(
            name=name,
            start_position=start.position,
            start_velocity=start.velocity,
            end_position=end.position,
            end_velocity=end.velocity,
            position_lower=np.maximum(np.minimum(inner_lower, lowest), limits.position_lower),
            position_upper=np.minimum(np.maximum(inner_upper, highest), limits.position_upper),
            velocity_limit=np.minimum(
                np.maximum(settings.velocity_fraction * limits.velocity, fastest), limits.velocity
            ),
            acceleration_limit=limits.acceleration,
            constraints=rows,
            intervals=settings.intervals,
            effort_weight=settings.effort_weight,
            min_duration=shortest,
            max_duration=longest,
        )

    def _gripper_paths(self, targets: GraspTargets, gripper_start: Array | None) -> tuple[GripperPath, ...]:
        start = targets.gripper_open if gripper_start is None else np.asarray(gripper_start, dtype=float)
        postures = (start, targets.gripper_open, targets.gripper_closed, targets.gripper_closed)
        return tuple(gripper_path(postures[i], postures[i + 1], self.settings.intervals) for i in range(3))

    def _grasp_points(self, path: GripperPath) -> Array:
        """(N+1, 3) G in the flange frame along the hand's motion (m)."""
        gripper = self.task.gripper
        T = gripper.T_flange_hand
        return gripper.grasp_point_many(path.position) @ T.rotation.T + T.translation

    def _grasp_frames(self, targets: GraspTargets, start: float, end: float) -> pin.SE3 | list[pin.SE3]:
        """The grasp frame at the grid points between two times (s); the only one of a part at rest."""
        if not targets.moving:
            return targets.T_world_grasp
        times = np.linspace(start, end, self.settings.intervals + 1)
        return [targets.T_world_object_at(t) * targets.grasp.T_object_grasp for t in times]

    def _funnel(
        self, problem: PhaseProblem, targets: GraspTargets, path: GripperPath, margin: float, start_time: float
    ) -> NodeConstraint:
        """The funnel with its margin, or with what the boundary states leave of it."""
        funnel = constraints.funnel(
            self.task.robot,
            self._grasp_points(path),
            self._grasp_frames(targets, start_time, targets.grasp_time - targets.grasp_duration),
            self.task.grasp_object.funnel,
        )
        ends = np.vstack([problem.start_position, problem.end_position])
        at_ends = np.empty((2, 1))
        node_functions(funnel).values(ends, np.zeros_like(ends), funnel.parameters[[0, -1]], at_ends, 0)
        # A little less than the ends have, so that an interior point remains.
        margin = min(margin, 0.9 * float(at_ends.min()))
        return replace(funnel, lower=np.array([max(margin, 0.0)]))

    def _tube(self, targets: GraspTargets, path: GripperPath) -> NodeConstraint:
        settings = self.task.settings
        return constraints.grasp_tube(
            self.task.robot,
            self._grasp_points(path),
            self.task.T_flange_closed(targets.grasp).rotation,
            self._grasp_frames(targets, targets.grasp_time - targets.grasp_duration, targets.grasp_time),
            settings.lateral_tolerance,
            settings.dip_tolerance,
            settings.tilt_tolerance,
        )

    def _hold(self, targets: GraspTargets, velocity: Array, safety: float) -> NodeConstraint:
        task = self.task
        return constraints.hold(
            task.robot,
            self._T_flange_object(targets).act(task.grasp_object.spatial_inertia),
            task.T_flange_closed(targets.grasp),
            task.pinch(targets.grasp),
            velocity,
            safety,
        )

    def _above_ground(self, targets: GraspTargets) -> NodeConstraint:
        T, corners = self._T_flange_object(targets), self.task.grasp_object.underside
        place = self.task.robot.forward_kinematics(targets.place.position) * T
        start, end = (pose.translation[2] + corners @ pose.rotation[2] for pose in (targets.T_world_object, place))
        floor = constraints.lift_floor(start, end, self.settings.intervals)
        return constraints.above_ground(self.task.robot, corners @ T.rotation.T + T.translation, floor)

    def _T_flange_object(self, targets: GraspTargets) -> pin.SE3:
        """The part in the flange frame as the closed hand holds it."""
        return self.task.T_flange_closed(targets.grasp) * targets.grasp.T_object_grasp.inverse()


def _only(duration: float, shortest: float, longest: float, phase: str) -> tuple[float, float]:
    """Bounds that leave one duration (s), which must be within the others."""
    if not shortest - 1e-9 <= duration <= longest + 1e-9:
        raise InvalidProblem(
            f"{phase}: the part is met after {duration:.3f} s, possible are {shortest:.3f} to {longest:g} s"
        )
    return duration, duration


def _state(q_start: Array | JointState) -> BoundaryState:
    if isinstance(q_start, JointState):
        return BoundaryState(q_start.position, q_start.velocity)
    return BoundaryState(q_start, np.zeros(np.size(q_start)))
