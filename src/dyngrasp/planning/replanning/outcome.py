"""What a replan may take, and what it answers."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from dyngrasp.errors import InvalidProblem, PlanningFailed
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.problem import AuditReport, Status
from dyngrasp.planning.replanning.phase_programs import TrackingSettings
from dyngrasp.trajectory import GraspPlan


class Path(StrEnum):
    """Which way led to the answer."""

    TRACKING = "tracking"
    DESCENT = "descent"
    REOPTIMISED = "reoptimised"
    FRESH = "fresh"
    KEPT = "kept"


@dataclass(frozen=True)
class ReplannerSettings:
    """Settings of `Replanner`.

    Attributes:
        budget: Time from the call to the splice (s). What takes longer is discarded.
        fresh_budget: The same for a fresh plan (s), which the old plan bridges.
        tracking: Of the quadratic program.
        least_horizon: Shorter rests of a phase are not touched (s): nothing could be corrected in them but violently.
        finger_clearance: Grasp updates end when the closing gap is within twice this of the part's width (m): from
            then on the fingers meet the part, which moves with them and not with its estimate.
        recovery_shares: σ_0 and σ_1 of `funnel_recovery`.
        reaction: τ of `funnel_recovery` (s).
        rounds: How often the full problem is solved and audited at most.
        settled: A moving part's grasp time is iterated until the predicted part moves less than this (m).
        gate: Whether the audit decides on publication. It does, but where the paper's own method is to be shown as it
            is.
    """

    budget: float = 0.020
    fresh_budget: float = 0.100
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    least_horizon: float = 0.10
    finger_clearance: float = 0.004
    recovery_shares: tuple[float, float] = (0.4, 0.8)
    reaction: float = 0.1
    rounds: int = 3
    settled: float = 1e-7
    gate: bool = True

    def __post_init__(self) -> None:
        if not (0 < self.budget <= self.fresh_budget and self.least_horizon > 0):
            raise InvalidProblem(f"0 < budget ≤ fresh_budget and least_horizon > 0 expected, got {self}")


@dataclass(frozen=True)
class ReplanResult:
    """Answer to one call.

    Attributes:
        status: `converged` if there is a new plan; why not otherwise.
        plan: The plan to follow: the new one, or the old one that goes on.
        path: Which way led to it.
        splice: When a new plan takes over (s).
        targets: What the new plan was made for.
        audit: Of the new plan, or of the candidate that failed; None if none was audited.
        recovery: φ_0 of the funnel, 1 where nothing was softened.
        timings_ms: Wall time of each stage (ms): "targets", "tracking", "audit", "descent", "full", "fresh",
            "total".
        message: Why the old plan was kept, or why the first ways failed.
        iterations: Of the tracking program's interior point method; 0 where no box was active.
    """

    status: Status
    plan: GraspPlan
    path: Path
    splice: float
    targets: GraspTargets
    audit: AuditReport | None
    recovery: float
    timings_ms: dict[str, float]
    message: str = ""
    iterations: int = 0

    @property
    def ok(self) -> bool:
        """Whether there is a new plan."""
        return self.status is Status.CONVERGED

    def require(self) -> GraspPlan:
        """The new plan, or `PlanningFailed` with this result attached."""
        if not self.ok:
            raise PlanningFailed(f"{self.status}: {self.message}", self)
        return self.plan


def about_the_approach(report: AuditReport, plan: GraspPlan) -> bool:
    """Whether all that fails happens before the pre-grasp, where another descent may help."""
    return all(entry.time <= plan.phase_ends[0] for entry in report.failures)


def failures_of(report: AuditReport) -> str:
    """What an audit found wrong, in words."""
    return "audit: " + "; ".join(str(entry) for entry in report.failures)
