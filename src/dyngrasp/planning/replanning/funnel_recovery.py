"""What becomes of the funnel when a new pose leaves the present state outside of it.

Rule: the height of the funnel's wall is multiplied at time t by

    φ(t) = min(1, φ_0 + (1 − φ_0) (t − t_splice) / τ),

where φ_0 ≤ 1 is the largest factor that leaves the hand inside at the splice, and τ a given time, at most the given share of what is left
of the approach. A state inside the funnel has φ_0 = 1, and nothing is softened. Below the grasp frame no factor helps: such a state
is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import AuditEntry, AuditReport, NodeConstraint
from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan

# Of the constraint's parameters: three of G, twelve of the grasp frame, then z_th.
_HEIGHT_PARAMETER = 15

# The state at the splice lies this share inside the softened wall, so that an interior point remains.
_INSIDE = 0.98

_SUBSTEPS = 4  # as the audit


@dataclass(frozen=True)
class FunnelRecovery:
    """Softening of one replan.

    Attributes:
        factor: φ_0; 1 where the state at the splice is inside the funnel.
        start: t_splice (s).
        duration: τ (s).
    """

    factor: float
    start: float
    duration: float

    def at(self, times: Array) -> Array:
        """φ at times (M,) of the common clock (s)."""
        return np.minimum(1.0, self.factor + (1.0 - self.factor) * (times - self.start) / self.duration)

    def soften(self, constraint: NodeConstraint, duration: float) -> NodeConstraint:
        """The constraint "funnel" of an approach that starts at the splice and takes `duration` (s)."""
        parameters = constraint.parameters.copy()
        nodes = self.start + np.linspace(0.0, duration, len(parameters))
        parameters[:, _HEIGHT_PARAMETER] *= self.at(nodes)
        return replace(constraint, parameters=parameters, lower=np.zeros(1))

    def judge(self, report: AuditReport, plan: GraspPlan, targets: GraspTargets, task: GraspTask) -> AuditReport:
        """The report with its entry "funnel" replaced by the softened one, where the state at the splice is outside."""
        if self.factor >= 1.0:
            return report
        approach, hand = plan.arm[0], plan.gripper[0]
        local = np.linspace(0.0, approach.duration, _SUBSTEPS * approach.intervals + 1)
        q, q_h = approach.sample_many(local)[0], hand.sample_many(local)[0]
        times = plan.start_time + local
        height, wall = np.array(
            [_height_and_wall(a, b, t, targets, task) for a, b, t in zip(q, q_h, times, strict=True)]
        ).T
        h = height - self.at(times) * wall
        worst = int(h.argmin())
        detail = f"softened: wall from {self.factor:.2f} of its height, whole after {self.duration:.2f} s"
        entries = tuple(
            replace(entry, worst=float(h[worst]), time=float(times[worst]), detail=detail)
            if entry.name == "funnel"
            else entry
            for entry in report.entries
        )
        return AuditReport(entries)


def funnel_recovery(
    plan: GraspPlan, targets: GraspTargets, task: GraspTask, splice: float, longest: float, share: float
) -> FunnelRecovery | None:
    """The softening that a replan needs; None if the hand is below the grasp frame and no softening helps.

    Args:
        plan: The running plan.
        targets: The new targets.
        task: Arm, gripper, part.
        splice: When the new trajectory takes over (s).
        longest: Largest τ (s).
        share: Largest part of the rest of the approach that τ may take.
    """
    state = plan.sample(splice)
    height, wall = _height_and_wall(state.arm.position, state.gripper.position, splice, targets, task)
    duration = max(min(longest, share * (plan.phase_ends[0] - splice)), 1e-3)
    if height >= wall:
        return FunnelRecovery(1.0, splice, duration)
    if height <= 0:
        return None
    return FunnelRecovery(_INSIDE * height / wall, splice, duration)


def _height_and_wall(q: Array, q_h: Array, t: float, targets: GraspTargets, task: GraspTask) -> tuple[float, float]:
    """z of G in the grasp frame and the height of the wall there, eq. (6) (m)."""
    gripper, funnel = task.gripper, task.grasp_object.funnel
    T_hand = task.robot.forward_kinematics(q) * gripper.T_flange_hand
    G = T_hand.act(gripper.grasp_point(q_h))
    x, y, z = (targets.T_world_object_at(t) * targets.grasp.T_object_grasp).actInv(G)
    bell = np.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2))
    return float(z), float(funnel.z_threshold * (1.0 - bell))
