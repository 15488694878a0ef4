"""Where to start an approach: a motion of least effort through way points down the axis of the funnel."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.planning.collocation.closed_form import optimum_through
from dyngrasp.planning.grasp_targets import GraspTargets
from dyngrasp.planning.grasp_task import GraspTask
from dyngrasp.planning.problem import PhaseProblem
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory

# Heights of the way points between the pre-grasp (0) and z_th (1), and so when they are passed before the end.
HEIGHTS = (1.0, 0.62, 0.25)

# Parts of the approach that the descent through the funnel may take; the cheapest of them is the start.
SHARES = np.linspace(0.06, 0.5, 12)

# Newton steps from one way point to the next: centimetres apart, they are then met to a fraction of the funnel's width.
NEWTON_STEPS = 2
DAMPING = 1e-6  # of the squares of the Jacobian


def descent(problem: PhaseProblem, targets: GraspTargets, task: GraspTask) -> Trajectory | None:
    """The cheapest motion that comes down the axis of the funnel, of several times for the descent.

    Limits and rows are not looked at: it is where a solver may start.

    Args:
        problem: The approach.
        targets: What it was made for.
        task: Arm, gripper and part.

    Returns:
        None if the funnel ends below the pre-grasp, or the grid is too coarse for the way points.
    """
    lowest, top = task.settings.pregrasp_distance, task.grasp_object.funnel.z_threshold
    timetables = _timetables(problem.intervals)
    if top <= lowest or not timetables:
        return None
    heights = lowest + (top - lowest) * np.array(HEIGHTS)
    T_object_grasp, T_grasp_flange = targets.grasp.T_object_grasp, task.T_flange_open.inverse()
    above = [T_object_grasp * pin.SE3(np.eye(3), np.array([0.0, 0.0, h])) * T_grasp_flange for h in heights]
    end = targets.grasp_time - targets.grasp_duration

    def waypoints(before: Array) -> Array:
        """(W, n) postures above the part, where it is so long before the pre-grasp (s)."""
        found, q = np.empty((len(above), problem.joints)), problem.end_position
        for i in reversed(range(len(above))):
            T_world_flange = targets.T_world_object_at(end - before[i]) * above[i]
            found[i] = q = task.robot.flange_chain.moved_to(T_world_flange, q, NEWTON_STEPS, DAMPING)
        return found

    if not targets.moving:
        return optimum_through(problem, timetables, waypoints(np.zeros(len(HEIGHTS))))[0]
    motions = [
        optimum_through(problem, [nodes], waypoints((1 - np.array(nodes) / problem.intervals) * problem.max_duration))
        for nodes in timetables
    ]
    return min(motions, key=lambda motion: motion[1])[0]


@lru_cache(maxsize=64)
def _timetables(intervals: int) -> tuple[tuple[int, ...], ...]:
    """Grid points of the way points for each of `SHARES` that the grid can tell apart."""
    # Square roots: the descent brakes towards the pre-grasp.
    nodes = np.round(intervals * (1 - SHARES[:, None] * np.sqrt(HEIGHTS))).astype(int)
    possible = (np.diff(nodes, axis=1) > 0).all(axis=1) & (nodes[:, 0] >= 1) & (nodes[:, -1] < intervals)
    return tuple(tuple(row) for row in nodes[possible].tolist())
