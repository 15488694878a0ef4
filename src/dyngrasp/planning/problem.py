"""What a planner is asked and what it answers: `PhaseProblem` → `Solution`, a whole grasp → `PlanResult`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple, Protocol

import casadi
import numpy as np
from numba import njit

from dyngrasp.errors import InvalidProblem, PlanningFailed
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import GraspPlan, Trajectory

MIN_INTERVALS = 4  # two boundary states of two derivatives each leave no freedom on a coarser grid
ROUNDING = 1e-9  # beyond its limits (rad, rad/s) that a boundary state may be


class Status(StrEnum):
    """How an attempt ended. All but `converged` are expected outcomes, not exceptions."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "iteration_limit"
    INFEASIBLE = "infeasible"
    DEADLINE_MISSED = "deadline_missed"
    NONFINITE = "nonfinite"
    AUDIT_FAILED = "audit_failed"


@dataclass(frozen=True)
class NodeConstraint:
    """lower ≤ g(q_k, v_k, p_k) ≤ upper at every grid point k.

    Attributes:
        name: What it is: "torque", "funnel", …; the audit reports under the same name.
        function: CasADi function (q (n), v (n), p (n_p)) → g (m). One function serves every pose and every part:
            whatever changes from problem to problem is a parameter, so that it is compiled once.
        parameters: (N+1, n_p), p_k at each grid point.
        lower: (m,), −inf where there is none.
        upper: (m,), +inf where there is none.
        scale: (m,), typical magnitude of a row in its own unit, > 0; solvers divide by it.
    """

    name: str
    function: casadi.Function
    parameters: Array
    lower: Array
    upper: Array
    scale: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", read_only(self.parameters, (-1, -1)))
        for bound in ("lower", "upper", "scale"):
            object.__setattr__(self, bound, read_only(getattr(self, bound), (-1,)))
        rows, n_p = self.function.size1_out(0), self.function.size1_in(2)
        if not self.lower.size == self.upper.size == self.scale.size == rows:
            raise InvalidProblem(f"{self.name}: bounds and scale need one entry for each of the {rows} rows")
        if self.parameters.shape[1] != n_p:
            raise InvalidProblem(f"{self.name}: {n_p} parameters a node expected, got {self.parameters.shape[1]}")
        if (self.lower > self.upper).any():
            raise InvalidProblem(f"{self.name}: a lower bound above its upper bound")


@njit(cache=True)
def _first_outside(position: Array, velocity: Array, lower: Array, upper: Array, speed: Array) -> int:
    """The first joint whose state (n,) is not a finite one within its limits (n,), up to rounding; −1 if none is."""
    for i in range(position.size):
        inside = lower[i] - ROUNDING <= position[i] <= upper[i] + ROUNDING and abs(velocity[i]) <= speed[i] + ROUNDING
        if not (inside and np.isfinite(position[i]) and np.isfinite(velocity[i])):
            return i
    return -1


@dataclass(frozen=True)
class PhaseProblem:
    """One phase of the offline problem, eq. (3): minimise ΔT + ρ Δt Σ vᵀv between two states, under limits.

    Attributes:
        name: Phase name, for messages.
        start_position, start_velocity, end_position, end_velocity: (n,) boundary states x_S and x_T (rad, rad/s).
        position_lower, position_upper: (n,) limits on q (rad).
        velocity_limit: (n,) limits on |q̇| (rad/s).
        acceleration_limit: (n,) limits on |v| (rad/s²), +inf where there is none.
        constraints: Rows imposed at the grid points.
        intervals: N ≥ 4.
        effort_weight: ρ ≥ 0 in s⁴/rad² (the paper: 1).
        min_duration, max_duration: Bounds on ΔT (s); a gripper that needs time to close sets the lower one.

    Raises:
        InvalidProblem: Shapes differ, numbers are not finite, N < 4, or a boundary state violates its own limits.
    """

    name: str
    start_position: Array
    start_velocity: Array
    end_position: Array
    end_velocity: Array
    position_lower: Array
    position_upper: Array
    velocity_limit: Array
    acceleration_limit: Array
    constraints: tuple[NodeConstraint, ...] = ()
    intervals: int = 100
    effort_weight: float = 1.0
    min_duration: float = 0.0
    max_duration: float = 60.0

    def __post_init__(self) -> None:
        n = np.size(self.start_position)
        for name in (
            "start_position",
            "start_velocity",
            "end_position",
            "end_velocity",
            "position_lower",
            "position_upper",
            "velocity_limit",
            "acceleration_limit",
        ):
            try:
                object.__setattr__(self, name, read_only(getattr(self, name), (n,)))
            except ValueError as error:
                raise InvalidProblem(f"{self.name}: {name}: {error}") from error
        object.__setattr__(self, "constraints", tuple(self.constraints))
        self._check(n)

    def _check(self, n: int) -> None:
        if self.intervals < MIN_INTERVALS:
            raise InvalidProblem(f"{self.name}: at least {MIN_INTERVALS} grid intervals, got {self.intervals}")
        if not (np.isfinite(self.effort_weight) and self.effort_weight >= 0):
            raise InvalidProblem(f"{self.name}: effort weight must be ≥ 0, got {self.effort_weight}")
        if not 0 <= self.min_duration <= self.max_duration or self.max_duration <= 0:
            raise InvalidProblem(
                f"{self.name}: durations must satisfy 0 ≤ min ≤ max, got {self.min_duration} and {self.max_duration} s"
            )
        for constraint in self.constraints:
            if constraint.parameters.shape[0] != self.intervals + 1:
                raise InvalidProblem(
                    f"{self.name}: {constraint.name} has parameters for {constraint.parameters.shape[0]} grid points, "
                    f"the grid has {self.intervals + 1}"
                )
            if constraint.function.size1_in(0) != n:
                raise InvalidProblem(f"{self.name}: {constraint.name} is a function of another number of joints")
        for end in ("start", "end"):
            q, w = getattr(self, f"{end}_position"), getattr(self, f"{end}_velocity")
            i = _first_outside(q, w, self.position_lower, self.position_upper, self.velocity_limit)
            if i >= 0:
                raise InvalidProblem(
                    f"{self.name}: joint {i + 1} of the {end} state is at {q[i]:.4f} rad with {w[i]:.4f} rad/s, "
                    f"possible are {self.position_lower[i]:.4f} to {self.position_upper[i]:.4f} rad with up to "
                    f"{self.velocity_limit[i]:.4f} rad/s"
                )

    @property
    def joints(self) -> int:
        """Number of joints n."""
        return self.start_position.size


@dataclass(frozen=True)
class Solution:
    """Answer to one `PhaseProblem`.

    Attributes:
        status: How it ended.
        trajectory: The best trajectory found; None unless it satisfies the dynamics and the boundary states.
        objective: ΔT + ρ Δt Σ vᵀv of the trajectory (s), NaN without one.
        iterations: Iterations of the solver.
        worst_violation: Largest violation of any limit or row at the grid points, in units of `NodeConstraint.scale`
            (boxes: of their own half-width), 0 if all hold.
        timings_ms: Wall time of each stage (ms).
        message: What the solver said, for people.
    """

    status: Status
    trajectory: Trajectory | None
    objective: float
    iterations: int
    worst_violation: float
    timings_ms: dict[str, float] = field(default_factory=dict)
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether the trajectory may be used."""
        return self.status is Status.CONVERGED

    def require(self) -> Trajectory:
        """The trajectory, or `PlanningFailed` with this solution attached."""
        if not self.ok or self.trajectory is None:
            raise PlanningFailed(f"{self.status}: {self.message}", self)
        return self.trajectory


class AuditEntry(NamedTuple):
    """The worst value of one constraint over a whole plan.

    Attributes:
        name: What was evaluated: "torque", "funnel", …
        worst: The worst value found, in `unit`.
        bound: What it must not exceed, or not fall below.
        at_least: Whether `bound` is a lower bound.
        tolerance: Rounding allowed beyond the bound, in `unit`.
        unit: "m", "rad", "" for a ratio to a limit, …
        time: When it occurs on the plan's clock (s).
        detail: Which joint or which pair of bodies.
    """

    name: str
    worst: float
    bound: float
    at_least: bool
    tolerance: float
    unit: str
    time: float
    detail: str = ""

    @property
    def ok(self) -> bool:
        """Whether the constraint holds everywhere; a NaN does not."""
        excess = self.bound - self.worst if self.at_least else self.worst - self.bound
        return bool(excess <= self.tolerance)

    def __str__(self) -> str:
        relation = "≥" if self.at_least else "≤"
        where = f" ({self.detail})" if self.detail else ""
        return (
            f"{self.name} {self.worst:.4g} {self.unit} at {self.time:.3f} s{where}, must be {relation} {self.bound:.4g}"
        )


@dataclass(frozen=True)
class AuditReport:
    """Every constraint of a plan, evaluated independently of the solver that made it."""

    entries: tuple[AuditEntry, ...]

    @property
    def ok(self) -> bool:
        """Whether the plan may be executed."""
        return not self.failures

    @cached_property
    def failures(self) -> tuple[AuditEntry, ...]:
        """The entries that do not hold."""
        return tuple(entry for entry in self.entries if not entry.ok)

    def __getitem__(self, name: str) -> AuditEntry:
        for entry in self.entries:
            if entry.name == name:
                return entry
        raise KeyError(f"no audit entry {name!r}; there are {', '.join(e.name for e in self.entries)}")


@dataclass(frozen=True)
class PlanResult:
    """Answer to a whole grasp: the plan, how each phase went, and the audit that decides whether it may be executed.

    Attributes:
        status: `converged` if all phases converged and the audit passed.
        plan: The plan, also when only the audit failed (for inspection); None if a phase has no trajectory.
        phases: Solutions of the phases attempted.
        audit: The audit of the plan, None if there is no plan.
        timings_ms: Wall time of each stage (ms): "targets", "approach", "grasp", "deliver", "audit", "total".
        message: The first thing that went wrong, "" if nothing.
    """

    status: Status
    plan: GraspPlan | None
    phases: tuple[Solution, ...]
    audit: AuditReport | None
    timings_ms: dict[str, float]
    message: str = ""

    @property
    def ok(self) -> bool:
        """Whether the plan may be executed."""
        return self.status is Status.CONVERGED

    def require(self) -> GraspPlan:
        """The plan, or `PlanningFailed` with this result attached."""
        if not self.ok or self.plan is None:
            raise PlanningFailed(f"{self.status}: {self.message}", self)
        return self.plan


class PhaseSolver(Protocol):
    """A backend: solves one phase. Expected failures are statuses, never exceptions."""

    def solve(
        self, problem: PhaseProblem, guess: Trajectory | None = None, stop: Callable[[], bool] | None = None
    ) -> Solution:
        """Solve `problem`, from `guess` if given (any number of grid points, any duration), until `stop` says so."""
        ...
