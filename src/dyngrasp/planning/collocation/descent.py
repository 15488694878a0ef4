"""Where to start an approach: a motion of least effort through way points down the axis of the funnel."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pinocchio as pin

from dyngrasp.models.robot import RobotModel
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
DAMPING = 1e-6  # of the Jacobian's squares, so that a singular posture gives a finite step


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

    def waypoints(before: Array) -> Array:
        """(W, n) postures above the part, where it is so long before the pre-grasp (s)."""
        found, q, end = [], problem.end_position, targets.grasp_time - targets.grasp_duration
        for height, dt in zip(heights[::-1], before[::-1], strict=True):
            T_world_grasp = targets.T_world_object_at(end - dt) * targets.grasp.T_object_grasp
            above = T_world_grasp * pin.SE3(np.eye(3), np.array([0.0, 0.0, height]))
            q = _moved_to(task.robot, above * task.T_flange_open.inverse(), q)
            found.insert(0, q)
        return np.array(found)

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


def _moved_to(robot: RobotModel, T_world_flange: pin.SE3, q: Array) -> Array:
    """The configuration that a few Newton steps of least length lead to from q."""
    for _ in range(NEWTON_STEPS):
        now = robot.forward_kinematics(q)
        twist = np.concatenate(
            [T_world_flange.translation - now.translation, pin.log3(T_world_flange.rotation @ now.rotation.T)]
        )
        J = robot.jacobian(q)
        q = q + J.T @ np.linalg.solve(J @ J.T + DAMPING * np.eye(6), twist)
    return q
