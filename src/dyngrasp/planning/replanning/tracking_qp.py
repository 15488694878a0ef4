"""The online quadratic program (13) in the variables of scaled time, where its step is exact.

The paper's step (δq, δq̇, δv, δT) and the step (δq, δw, δa, δT) of w = T q̇, a = T² v are related by

    δw = T* δq̇ + q̇* δT,      δa = T*² δv + 2 T* v* δT,

which turns the linearised dynamics (12) into the exact ones: they are linear in (q, w, a) and free of T. So both are
one program, with the same weights and the same minimiser; but a step taken in (q, w, a) obeys the trapezoidal rule to
rounding, while the paper's update (15) drops the products of deviations. For given δT the program falls apart into
one pentadiagonal system a joint.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numba import njit

from dyngrasp.errors import InvalidProblem
from dyngrasp.lanes import narrow, whole_lanes, widen
from dyngrasp.planning.problem import MIN_INTERVALS, Status
from dyngrasp.planning.replanning.interior_point import INFEASIBLE, ITERATION_LIMIT, NONFINITE, OPTIMAL
from dyngrasp.planning.replanning.joint_splines import Filters, Indices, Motion, filters
from dyngrasp.planning.replanning.tracking_kernel import Weights, solve, write_motion
from dyngrasp.signals import Array, frozen
from dyngrasp.trajectory import Trajectory


@dataclass(frozen=True)
class TrackingWeights:
    """Weights of eq. (14), the same for all grid points.

    With position and rate weights of zero the step is the smoothest one: the correction spreads over the whole horizon
    and has almost arrived when the hand comes down the funnel. Weight on the position delays it to the end, where the
    funnel is narrow.

    Attributes:
        position: Q_q (1/rad²).
        velocity: Q_q̇ (s²/rad²).
        acceleration: Q_v (s⁴/rad²), > 0: it makes the program strictly convex.
        duration: Q_ΔT (1/s²), > 0.
    """

    position: float = 0.0
    velocity: float = 0.0
    acceleration: float = 1.0
    duration: float = 100.0

    def __post_init__(self) -> None:
        valid = self.position >= 0 and self.velocity >= 0 and self.acceleration > 0 and self.duration > 0
        if not (valid and np.isfinite([self.position, self.velocity, self.acceleration, self.duration]).all()):
            raise InvalidProblem(f"weights must be ≥ 0, those of acceleration and duration > 0; got {self}")

    @cached_property
    def numbers(self) -> Weights:
        """What compiled code takes for them."""
        return float(self.position), float(self.velocity), float(self.acceleration), float(self.duration)


@dataclass(frozen=True, eq=False)
class TrackingProblem:
    """What is asked of one phase.

    Attributes:
        reference: ξ*, on the grid of the answer; it need not meet the boundary states nor obey the dynamics exactly.
        start, end: (3, n) position (rad), velocity (rad/s) and acceleration (rad/s²) there.
        hold_start_acceleration, hold_end_acceleration: Whether the accelerations are given; if not, they are ignored.
        position_lower, position_upper: (n,) limits (rad).
        velocity_limit, acceleration_limit: (n,) limits, +inf where there is none.
        min_duration, max_duration: Bounds of ΔT (s), 0 < min ≤ max < ∞; equal ones fix it.
        weights: Of the deviations.
        paper_rows: Boxes linear in (δq̇, δv) as in eq. (13c), and sums over k = 1 … N−1; the motion then is that of
            the paper's update (15), with its defect.
        node_weights: (N+1,) added to Q_q at each grid point, where the motion has to stay with the reference; none if
            left out.
    """

    reference: Trajectory
    start: Array
    end: Array
    hold_start_acceleration: bool
    hold_end_acceleration: bool
    position_lower: Array
    position_upper: Array
    velocity_limit: Array
    acceleration_limit: Array
    min_duration: float
    max_duration: float
    weights: TrackingWeights = field(default_factory=TrackingWeights)
    paper_rows: bool = False
    node_weights: Array | None = None

    def __post_init__(self) -> None:
        n = self.reference.position.shape[1]
        if self.reference.intervals < MIN_INTERVALS:
            raise InvalidProblem(f"at least {MIN_INTERVALS} grid intervals, got {self.reference.intervals}")
        if self.start.shape != (3, n) or self.end.shape != (3, n):
            raise InvalidProblem(f"states of shape (3, {n}) expected, got {self.start.shape}, {self.end.shape}")
        if not 0 < self.min_duration <= self.max_duration < np.inf:
            raise InvalidProblem(f"durations 0 < min ≤ max < ∞ expected: {self.min_duration}, {self.max_duration} s")


@dataclass(frozen=True, eq=False)
class TrackingSolution:
    """Answer to a `TrackingProblem`.

    Attributes:
        status: `converged`, or why not.
        duration: ΔT (s).
        motion: (3, N+1, n) q (rad), q̇ (rad/s), q̈ (rad/s²), its boundary states those of the problem to the last digit;
            with `paper_rows` the paper's update (15) of the reference.
        scaled: (3, N+1, n) q (rad), w = T q̇ and a = T² q̈ (rad); with `paper_rows` their linear model.
        iterations: Of the interior point method; 0 where no box is active.
        rows: Codes of the rows that were imposed, see `box_rows`.
        multipliers: Their multipliers and those of the two bounds of ΔT.
        elapsed_ms: Wall time of the solution (ms).
    """

    status: Status
    duration: float
    motion: Array
    scaled: Array
    iterations: int
    rows: Indices
    multipliers: Array
    elapsed_ms: float

    @property
    def trajectory(self) -> Trajectory:
        """The motion."""
        return Trajectory.of(self.duration, self.motion)


STATUS = {
    OPTIMAL: Status.CONVERGED,
    INFEASIBLE: Status.INFEASIBLE,
    ITERATION_LIMIT: Status.ITERATION_LIMIT,
    NONFINITE: Status.NONFINITE,
}


def solve_tracking(problem: TrackingProblem) -> TrackingSolution:
    """Solve the program; never raises for numerical reasons."""
    began = time.perf_counter()
    reference = problem.reference
    N, n = reference.intervals, reference.position.shape[1]
    ends = np.empty((2, 3, n))
    ends[0], ends[1] = problem.start, problem.end
    held = (problem.hold_start_acceleration, problem.hold_end_acceleration)
    boxes = np.empty((4, n))
    boxes[0], boxes[1] = problem.position_lower, problem.position_upper
    boxes[2], boxes[3] = problem.velocity_limit, problem.acceleration_limit
    scaled, motion = np.empty((3, N + 1, n)), np.empty((3, N + 1, n))
    outcome, duration, iterations, rows, multipliers = _solve(
        (reference.position, reference.velocity, reference.acceleration),
        reference.duration,
        ends,
        held,
        problem.weights.numbers,
        np.zeros(N + 1) if problem.node_weights is None else problem.node_weights,
        boxes,
        problem.paper_rows,
        (problem.min_duration, problem.max_duration),
        filters(N, *held, not problem.paper_rows),
        scaled,
        motion,
    )
    elapsed = 1e3 * (time.perf_counter() - began)
    return TrackingSolution(
        STATUS[outcome], duration, frozen(motion), frozen(scaled), iterations, rows, multipliers, elapsed
    )


@njit(cache=True, error_model="numpy")
def _solve(
    reference: Motion,
    T_ref: float,
    ends: Array,
    held: tuple[bool, bool],
    weights: Weights,
    node_weights: Array,
    boxes: Array,
    paper_rows: bool,
    duration: tuple[float, float],
    filters: Filters,
    scaled: Array,
    motion: Array,
) -> tuple[int, float, int, Indices, Array]:
    """`solve` and `write_motion` about q*, q̇*, v*, each (K, n); q, w, a go into `scaled` (3, K, n)."""
    K, n = reference[0].shape
    width = whole_lanes(n)
    wanted, z = np.empty((3, K, width)), np.empty((3, K, width))
    for kind in range(3):
        widen(reference[kind], wanted[kind])
    answer = solve(wanted, T_ref, ends, held, weights, node_weights, boxes, paper_rows, duration, filters, z)
    for kind in range(3):
        narrow(1.0, z[kind], 0, scaled[kind])
    write_motion(z, wanted, answer[1], T_ref, ends, held, paper_rows, 0, motion)
    return answer


def paper_step(problem: TrackingProblem, solution: TrackingSolution) -> Array:
    """(N+1, 3n+1) stages s_k = [δq, δq̇, δv, δT] of a solution: the same minimiser in the paper's variables."""
    reference, T = problem.reference, problem.reference.duration
    dT = solution.duration - T
    q, w, a = solution.scaled
    dq = q - reference.position
    dw = (w - (T + dT) * reference.velocity) / T
    dv = (a - (T * T + 2 * T * dT) * reference.acceleration) / T**2
    return np.hstack([dq, dw, dv, np.full((len(q), 1), dT)])


def paper_update(reference: Trajectory, step: Array) -> Trajectory:
    """ξ* + δξ*, eq. (15). The products of deviations that it drops leave a defect in the dynamics."""
    n = reference.position.shape[1]
    return Trajectory(
        reference.duration + float(step[0, -1]),
        reference.position + step[:, :n],
        reference.velocity + step[:, n : 2 * n],
        reference.acceleration + step[:, 2 * n : 3 * n],
    )
