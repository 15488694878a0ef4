"""What becomes of the funnel when a new pose leaves the present state outside of it.

Rule: over the rest of the approach, s from 0 at the splice to 1 at the pre-grasp, the height of the funnel's wall is
multiplied by

    φ(s) = min(1, φ_0 + (1 − φ_0) s / σ),

where φ_0 ≤ 1 is the largest factor that leaves the hand inside at the splice, and σ < 1 a given share. A state inside
the funnel has φ_0 = 1, and nothing is softened. Below the grasp frame no factor helps: such a state is refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import AuditReport, NodeConstraint
from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan, PlanSample

# Of the constraint's parameters: three of G, twelve of the grasp frame, then z_th.
_HEIGHT_PARAMETER = 15

# The state at the splice lies this share inside the softened wall, so that an interior point remains.
_INSIDE = 0.98

# Asked of the solver at the grid points (m), for the hand cuts corners between them.
_MARGIN = 0.001

_SUBSTEPS = 4  # as the audit


@dataclass(frozen=True)
class FunnelRecovery:
    """Softening of one replan.

    Attributes:
        factor: φ_0; 1 where the state at the splice is inside the funnel.
        share: σ.
    """

    factor: float
    share: float

    def at(self, s: Array) -> Array:
        """φ at shares s (M,) of the rest of the approach."""
        return np.minimum(1.0, self.factor + (1.0 - self.factor) * s / self.share)

    def soften(self, constraint: NodeConstraint) -> NodeConstraint:
        """The constraint "funnel" of an approach that starts at the splice."""
        if self.factor >= 1.0:
            return constraint
        parameters = constraint.parameters.copy()
        parameters[:, _HEIGHT_PARAMETER] *= self.at(np.linspace(0.0, 1.0, len(parameters)))
        return replace(constraint, parameters=parameters, lower=np.array([_MARGIN]))

    def judge(self, report: AuditReport, plan: GraspPlan, targets: GraspTargets, task: GraspTask) -> AuditReport:
        """The report with its entry "funnel" replaced by the softened one, where the state at the splice is outside."""
        if self.factor >= 1.0:
            return report
        approach, hand = plan.arm[0], plan.gripper[0]
        local = np.linspace(0.0, approach.duration, _SUBSTEPS * approach.intervals + 1)
        q, q_h = approach.sample_many(local)[0], hand.sample_many(local)[0]
        times, s = plan.start_time + local, local / approach.duration
        height, wall = np.array(
            [_height_and_wall(a, b, t, targets, task) for a, b, t in zip(q, q_h, times, strict=True)]
        ).T
        h = height - self.at(s) * wall
        worst = int(h.argmin())
        detail = f"softened: wall from {self.factor:.2f} of its height"
        entries = tuple(
            replace(entry, worst=float(h[worst]), time=float(times[worst]), detail=detail)
            if entry.name == "funnel"
            else entry
            for entry in report.entries
        )
        return AuditReport(entries)


def funnel_recovery(
    state: PlanSample, targets: GraspTargets, task: GraspTask, splice: float, share: float
) -> FunnelRecovery | None:
    """The softening that a replan needs; None if the hand is below the grasp frame and no softening helps.

    Args:
        state: Of the running plan at the splice.
        targets: The new targets.
        task: Arm, gripper, part.
        splice: When the new trajectory takes over (s).
        share: σ.
    """
    height, wall = _height_and_wall(state.arm.position, state.gripper.position, splice, targets, task)
    if height - wall >= _MARGIN:
        return FunnelRecovery(1.0, share)
    inside = min(_INSIDE * height, height - 1.2 * _MARGIN)
    if inside <= 0:
        return None
    return FunnelRecovery(inside / wall, share)


def _height_and_wall(q: Array, q_h: Array, t: float, targets: GraspTargets, task: GraspTask) -> tuple[float, float]:
    """Height of G in the grasp frame and that of the wall below or above it, eq. (5) (m)."""
    gripper, funnel = task.gripper, task.grasp_object.funnel
    T_hand = task.robot.forward_kinematics(q) * gripper.T_flange_hand
    G = T_hand.act(gripper.grasp_point(q_h))
    x, y, z = (targets.T_world_object_at(t) * targets.grasp.T_object_grasp).actInv(G)
    bell = np.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2))
    return float(z), float(funnel.z_threshold * (1.0 - bell))
