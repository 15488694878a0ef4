"""The paper's linearly constrained quadratic program (13) and its update (15), to the letter, for comparison.

With x = (q, q̇), f = (q̇, v) the matrices of eq. (12) are

    C_{k+1} = [ I − h/2 Γx   −h/2 Γv   0 ]      A_k = [ I + h/2 Γx   h/2 Γv   (x*_{k+1} − x*_k) / ΔT* ]
              [ 0             0         1 ],           [ 0            0        1                         ],

Γx = [0 I; 0 0], Γv = [0; I], h = ΔT*/N, for s_k = (δx_k, δv_k, δT). The sums of the cost run over k = 1 … N−1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from dyngrasp.models.robot import RobotModel
from dyngrasp.planning.replanning.tracking_qp import TrackingProblem
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import Trajectory


@dataclass(frozen=True)
class StageDynamics:
    """C_{k+1} s_{k+1} = A_k s_k for k = 0 … N−1, both (N, 2n+1, 3n+1), s = [δq, δq̇, δv, δT] in rad, s."""

    C: Array
    A: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "C", read_only(self.C, (-1, -1, -1)))
        object.__setattr__(self, "A", read_only(self.A, (-1, -1, -1)))


def linearize_dynamics(trajectory: Trajectory) -> StageDynamics:
    """Linearise the trapezoidal dynamics about a trajectory, eqs. (10)–(12).

    The traversal time is a variable of every stage, which keeps the program banded.

    Args:
        trajectory: Reference ξ*, on N+1 grid points.
    """
    N, n = trajectory.intervals, trajectory.position.shape[1]
    half = trajectory.duration / N / 2
    eye = np.eye(n)
    C, A = np.zeros((N, 2 * n + 1, 3 * n + 1)), np.zeros((N, 2 * n + 1, 3 * n + 1))
    for matrices, sign in ((C, -1.0), (A, 1.0)):
        matrices[:, : 2 * n, : 2 * n] = np.eye(2 * n)
        matrices[:, :n, n : 2 * n] = sign * half * eye
        matrices[:, n : 2 * n, 2 * n : 3 * n] = sign * half * eye
        matrices[:, 2 * n, 3 * n] = 1.0
    states = np.hstack([trajectory.position, trajectory.velocity])
    A[:, : 2 * n, 3 * n] = np.diff(states, axis=0) / trajectory.duration
    return StageDynamics(C, A)


@dataclass(frozen=True)
class SparseProgram:
    """min ½ sᵀ P s subject to lower ≤ E s ≤ upper, s the stages one after the other.

    Attributes:
        P: (N+1)(3n+1) square, diagonal.
        E: Dynamics above the identity of the boxes.
        lower, upper: Bounds of the rows of E.
    """

    P: sp.csc_array
    E: sp.csc_array
    lower: Array
    upper: Array

    @property
    def rows(self) -> int:
        """Number of rows of E."""
        return self.lower.size

    @property
    def variables(self) -> int:
        """Number of variables."""
        return int(self.P.indptr.size) - 1


def sparse_program(problem: TrackingProblem) -> SparseProgram:
    """Eq. (13) of a problem as general solvers take it.

    Args:
        problem: With `paper_rows`: boxes, sums and fixed boundary accelerations are then those of the paper.
    """
    reference = problem.reference
    N, n = reference.intervals, reference.position.shape[1]
    width = 3 * n + 1
    stages = linearize_dynamics(reference)
    dynamics = sp.lil_matrix((N * (2 * n + 1), (N + 1) * width))
    for k in range(N):
        rows = slice(k * (2 * n + 1), (k + 1) * (2 * n + 1))
        dynamics[rows, k * width : (k + 1) * width] = -stages.A[k]
        dynamics[rows, (k + 1) * width : (k + 2) * width] = stages.C[k]

    w = problem.weights
    cost = np.zeros((N + 1, width))
    cost[1:N] = np.concatenate(
        [np.full(n, w.position), np.full(n, w.velocity), np.full(n, w.acceleration), [w.duration]]
    )
    star = np.hstack([reference.position, reference.velocity, reference.acceleration])
    lower, upper = np.empty((N + 1, width)), np.empty((N + 1, width))
    lower[:, : 3 * n] = (
        np.concatenate([problem.position_lower, -problem.velocity_limit, -problem.acceleration_limit]) - star
    )
    upper[:, : 3 * n] = (
        np.concatenate([problem.position_upper, problem.velocity_limit, problem.acceleration_limit]) - star
    )
    lower[:, -1] = problem.min_duration - reference.duration
    upper[:, -1] = problem.max_duration - reference.duration
    for k, state, held in (
        (0, problem.start, problem.hold_start_acceleration),
        (N, problem.end, problem.hold_end_acceleration),
    ):
        fixed = 3 * n if held else 2 * n
        lower[k, :fixed] = upper[k, :fixed] = state.ravel()[:fixed] - star[k, :fixed]
    zeros = np.zeros(N * (2 * n + 1))
    return SparseProgram(
        sp.csc_array(sp.diags_array(cost.ravel())),
        sp.csc_array(sp.vstack([sp.csc_array(dynamics), sp.eye_array((N + 1) * width)])),
        np.concatenate([zeros, lower.ravel()]),
        np.concatenate([zeros, upper.ravel()]),
    )


def end_point_error(trajectory: Trajectory, robot: RobotModel) -> float:
    """How far from the planned end the flange is if the accelerations of a trajectory are carried out (m)."""
    N, T = trajectory.intervals, trajectory.duration
    half = T / N / 2
    v = trajectory.acceleration
    velocity = trajectory.velocity[0] + half * np.vstack([np.zeros(v.shape[1]), np.cumsum(v[1:] + v[:-1], axis=0)])
    end = trajectory.position[0] + half * np.sum(velocity[1:] + velocity[:-1], axis=0)
    planned = robot.forward_kinematics(trajectory.position[-1]).translation
    return float(np.linalg.norm(robot.forward_kinematics(end).translation - planned))
