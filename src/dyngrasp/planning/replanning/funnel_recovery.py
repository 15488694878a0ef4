"""What becomes of the funnel when a new pose leaves the present state outside of it.

Rule: over the rest of the approach, s from 0 at the splice to 1 at the pre-grasp, the height of the funnel's wall is
multiplied by

    φ(s) = φ_0 up to s = σ_0,    then linear up to 1 at s = σ_1,

where σ_0 < σ_1 < 1 are given shares, and φ_0 ≤ 1 is the largest factor that leaves the hand inside at the splice and,
went it on as before, a time τ after it: it can neither stop nor turn at once. So the hand first has time to come
back above the part, then the wall rises. A hand that stays inside the funnel has φ_0 = 1, and nothing is softened.
Below the grasp frame no factor helps: such a state is refused. That the fingers do not touch the part meanwhile is for
the audit's clearances to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from dyngrasp.models.flange_chain import place_frames
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.problem import NodeConstraint
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan, PlanSample

# Of the constraint's parameters: three of G, nine of the grasp frame's axes by rows, three of its origin, then z_th.
_AXES, _ORIGIN, _HEIGHT_PARAMETER = slice(3, 12), slice(12, 15), 15

# The state at the splice lies this share inside the softened wall, so that an interior point remains.
_INSIDE = 0.98

# Asked of the solver at the grid points (m), for the hand cuts corners between them.
_MARGIN = 0.001


@dataclass(frozen=True)
class FunnelRecovery:
    """Softening of one replan.

    Attributes:
        factor: φ_0; 1 where the state at the splice is inside the funnel.
        shares: σ_0 and σ_1.
    """

    factor: float
    shares: tuple[float, float]

    def at(self, s: Array) -> Array:
        """φ at shares s (M,) of the rest of the approach."""
        low, high = self.shares
        return self.factor + (1.0 - self.factor) * np.clip((s - low) / (high - low), 0.0, 1.0)

    def soften(self, constraint: NodeConstraint) -> NodeConstraint:
        """The constraint "funnel" of an approach that starts at the splice."""
        if self.factor >= 1.0:
            return constraint
        parameters = constraint.parameters.copy()
        parameters[:, _HEIGHT_PARAMETER] *= self.at(np.linspace(0.0, 1.0, len(parameters)))
        return replace(constraint, parameters=parameters, lower=np.array([_MARGIN]))

    def wall(self, plan: GraspPlan) -> Callable[[Array], Array]:
        """φ at times (s) of the approach of a plan that begins at the splice."""
        return lambda times: self.at((times - plan.start_time) / plan.arm[0].duration)


def funnel_recovery(
    plan: GraspPlan,
    state: PlanSample,
    targets: GraspTargets,
    task: GraspTask,
    shares: tuple[float, float],
    reaction: float,
) -> FunnelRecovery | None:
    """The softening that a replan needs; None if the hand is below the grasp frame and no softening helps.

    Args:
        plan: The running plan, in its approach.
        state: Of the plan where the new trajectory takes over.
        targets: The new targets.
        task: Arm, gripper, part.
        shares: σ_0 and σ_1.
        reaction: τ (s).
    """
    later = min(state.arm.t + reaction, math.nextafter(float(plan.phase_ends[0]), 0.0))
    local = later - plan.start_time
    (q_later, *_), (hand_later, *_) = (motion.sample_many((local,)) for motion in (plan.arm[0], plan.gripper[0]))
    factor = 1.0
    for t, q, hand in (
        (state.arm.t, state.arm.position, state.gripper.position),
        (later, q_later[0], hand_later[0]),
    ):
        height, wall = _height_and_wall(t, q, hand, targets, task)
        if height - wall >= _MARGIN:
            continue
        inside = min(_INSIDE * height, height - 1.2 * _MARGIN)
        if inside <= 0:
            return None
        factor = min(factor, inside / wall)
    return FunnelRecovery(factor, shares)


def lifted(constraint: NodeConstraint, by: Array) -> NodeConstraint:
    """The constraint "funnel" with the grasp frame lifted along its axis by heights (N+1,) (m)."""
    parameters = constraint.parameters.copy()
    outward = parameters[:, _AXES].reshape(-1, 3, 3)[:, :, 2]
    parameters[:, _ORIGIN] += by[:, None] * outward
    return replace(constraint, parameters=parameters)


def _height_and_wall(t: float, q: Array, hand: Array, targets: GraspTargets, task: GraspTask) -> tuple[float, float]:
    """Height of G in the grasp frame and that of the wall below or above it, eq. (5) (m), at a time and postures."""
    funnel, chain = task.grasp_object.funnel, task.robot.flange_chain
    T_world_grasp = targets.T_world_object_at(t) * targets.grasp.T_object_grasp
    x, y, z = _seen_from_grasp(
        chain.rotations,
        chain.offsets,
        q,
        target_updater(task).T_flange_grasp(hand).translation,
        T_world_grasp.rotation,
        T_world_grasp.translation,
    )
    bell = math.exp(-0.5 * ((x / funnel.sigma_x) ** 2 + (y / funnel.sigma_y) ** 2))
    return z, funnel.z_threshold * (1.0 - bell)


@njit(cache=True, error_model="numpy")
def _seen_from_grasp(rotations, offsets, q, p_flange_G, R_world_grasp, p_world_grasp):
    """Coordinates of G in the grasp frame (m), the arm at q (n,)."""
    frames = np.empty((q.size + 1, 3, 4))
    place_frames(rotations, offsets, q, frames)
    x, y, z = 0.0, 0.0, 0.0
    for a in range(3):
        lever = frames[-1, a, 3] - p_world_grasp[a]
        for b in range(3):
            lever += frames[-1, a, b] * p_flange_G[b]
        x += R_world_grasp[a, 0] * lever
        y += R_world_grasp[a, 1] * lever
        z += R_world_grasp[a, 2] * lever
    return x, y, z
