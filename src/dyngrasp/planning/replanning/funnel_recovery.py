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
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from dyngrasp.models.flange_chain import place_frames
from dyngrasp.motion_arrays import interpolate
from dyngrasp.planning.grasp_targets import GraspTargets, GraspTask
from dyngrasp.planning.part_motion import part_poses
from dyngrasp.planning.problem import NodeConstraint
from dyngrasp.planning.replanning.target_update import target_updater
from dyngrasp.planning.worst_values import Wall
from dyngrasp.signals import Array
from dyngrasp.trajectory import GraspPlan

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

    def wall(self, plan: GraspPlan) -> Wall:
        """φ over the approach of a plan that begins at the splice."""
        return Wall(self.factor, *self.shares, plan.start_time, plan.arm[0].duration)


def funnel_recovery(
    plan: GraspPlan, t: float, targets: GraspTargets, task: GraspTask, shares: tuple[float, float], reaction: float
) -> FunnelRecovery | None:
    """The softening that a replan needs; None if the hand is below the grasp frame and no softening helps.

    Args:
        plan: The running plan, in its approach.
        t: When the new trajectory takes over (s).
        targets: The new targets.
        task: Arm, gripper, part.
        shares: σ_0 and σ_1.
        reaction: τ (s).
    """
    times = t, min(t + reaction, math.nextafter(float(plan.phase_ends[0]), 0.0))
    (arm, *_), (gripper, *_), _ = plan.arrays
    hands = np.empty((2, len(plan.gripper_joints)))
    _write_positions(gripper, plan.start_time, times, hands)
    updater, chain, funnel = target_updater(task), task.robot.flange_chain, task.grasp_object.funnel
    factor = _largest_factor(
        arm,
        plan.start_time,
        times,
        (updater.T_flange_grasp(hands[0]).translation, updater.T_flange_grasp(hands[1]).translation),
        (chain.rotations, chain.offsets),
        (targets.T_world_object.homogeneous, targets.twist_world, float(targets.grasp_time)),
        targets.grasp.T_object_grasp.homogeneous,
        (funnel.z_threshold, funnel.sigma_x, funnel.sigma_y),
    )
    return FunnelRecovery(factor, shares) if factor > 0.0 else None


def lifted(constraint: NodeConstraint, by: Array) -> NodeConstraint:
    """The constraint "funnel" with the grasp frame lifted along its axis by heights (N+1,) (m)."""
    parameters = constraint.parameters.copy()
    outward = parameters[:, _AXES].reshape(-1, 3, 3)[:, :, 2]
    parameters[:, _ORIGIN] += by[:, None] * outward
    return replace(constraint, parameters=parameters)


@njit(cache=True, error_model="numpy")
def _write_positions(trajectory, start, times, q):
    """Write positions (M, n) at M times (s) of a motion that begins at `start` (s)."""
    states = np.empty((3, *q.shape))
    interpolate(trajectory, np.array(times) - start, states)
    q[:] = states[0]


@njit(cache=True, error_model="numpy")
def _largest_factor(arm, start, times, points, chain, part, T_object_grasp, funnel):
    """φ_0 of a motion of the arm that begins at `start` (s); 0 where none helps.

    Args:
        arm: `Trajectory.arrays`.
        start: See above.
        times: M of them (s) at which G has to be inside the wall.
        points: G at each of them, (3,) in the flange frame (m).
        chain: `FlangeChain.rotations` and `.offsets`.
        part: Pose (4, 4) of the part when it is taken, its twist (6,) until then, and that time (s).
        T_object_grasp: (4, 4) grasp frame in the object frame.
        funnel: z_th and the standard deviations along x and y (m).
    """
    (T, twist, arrival), (z_threshold, sigma_x, sigma_y), M = part, funnel, len(times)
    R, p, q = np.empty((3, 3, M)), np.empty((3, M)), np.empty((M, chain[1].shape[0] - 1))
    part_poses((T[:3, :3], T[:3, 3], twist, arrival), np.array(times), R, p)
    _write_positions(arm, start, times, q)
    factor = 1.0
    for m in range(M):
        x, y, height = _seen_from_grasp(chain, q[m], points[m], R[:, :, m], p[:, m], T_object_grasp)
        wall = z_threshold * (1.0 - np.exp(-0.5 * ((x / sigma_x) ** 2 + (y / sigma_y) ** 2)))
        if height - wall < _MARGIN:
            inside = min(_INSIDE * height, height - 1.2 * _MARGIN)
            if inside <= 0.0:
                return 0.0
            factor = min(factor, inside / wall)
    return factor


@njit(cache=True, error_model="numpy")
def _seen_from_grasp(chain, q, p_flange_G, R_world_object, p_world_object, T_object_grasp):
    """Coordinates of G in the grasp frame (m), the arm at q (n,)."""
    frames, in_world, in_object, in_grasp = np.empty((q.size + 1, 3, 4)), np.empty(3), np.empty(3), np.zeros(3)
    place_frames(chain[0], chain[1], q, frames)
    for a in range(3):
        in_world[a] = frames[-1, a, 3] - p_world_object[a]
        for b in range(3):
            in_world[a] += frames[-1, a, b] * p_flange_G[b]
    for a in range(3):
        in_object[a] = -T_object_grasp[a, 3]
        for b in range(3):
            in_object[a] += R_world_object[b, a] * in_world[b]
    for a in range(3):
        for b in range(3):
            in_grasp[a] += T_object_grasp[b, a] * in_object[b]
    return in_grasp[0], in_grasp[1], in_grasp[2]
