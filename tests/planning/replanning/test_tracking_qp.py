"""The structured program against its optimality conditions, a dense solver and the paper's sparse form."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dyngrasp.errors import InvalidProblem
from dyngrasp.planning.problem import Status
from dyngrasp.planning.replanning.lcqp import end_point_error, linearize_dynamics, sparse_program
from dyngrasp.planning.replanning.tracking_qp import (
    TrackingProblem,
    TrackingWeights,
    paper_step,
    paper_update,
    solve_tracking,
)
from dyngrasp.trajectory import Trajectory


def motion(N=20, n=3, T=1.3, seed=0):
    """A random motion that obeys the trapezoidal rule."""
    rng = np.random.default_rng(seed)
    v = np.cumsum(rng.normal(size=(N + 1, n)), axis=0) * 0.3
    half = T / N / 2
    w = rng.normal(size=n) * 0.1 + half * np.vstack([np.zeros(n), np.cumsum(v[1:] + v[:-1], axis=0)])
    q = rng.normal(size=n) + half * np.vstack([np.zeros(n), np.cumsum(w[1:] + w[:-1], axis=0)])
    return Trajectory(T, q, w, v)


def problem(reference, move=0.05, speed=np.inf, effort=np.inf, held=(True, False), paper=False, weights=None, seed=1):
    rng = np.random.default_rng(seed)
    n = reference.position.shape[1]

    def state(k, by):
        return np.stack([reference.position[k], reference.velocity[k], reference.acceleration[k]]) + by

    return TrackingProblem(
        reference,
        state(0, 0.0),
        state(-1, np.stack([move * rng.normal(size=n), 0.1 * move * rng.normal(size=n), np.zeros(n)])),
        held[0],
        held[1],
        np.full(n, -10.0),
        np.full(n, 10.0),
        np.full(n, speed),
        np.full(n, effort),
        0.3 * reference.duration,
        3 * reference.duration,
        weights or TrackingWeights(1.0, 0.5, 0.1, 10.0),
        paper,
    )


def dense_solution(program):
    """The same program by a sparse active-set solver."""
    H, A = ca.DM(program.P), ca.DM(program.E)
    quiet = {"print_iter": False, "print_header": False, "print_info": False}
    solver = ca.conic("reference", "qrqp", {"h": H.sparsity(), "a": A.sparsity()}, quiet)
    answer = solver(h=H, g=ca.DM.zeros(H.shape[0]), a=A, lba=program.lower, uba=program.upper)
    return np.array(answer["x"]).ravel()


def test_eq12_stage_matrices_are_the_derivatives_of_the_trapezoidal_rule():
    reference = motion(N=6, n=2)
    stages = linearize_dynamics(reference)
    N, n = 6, 2
    rng = np.random.default_rng(3)
    s = rng.normal(size=(N + 1, 3 * n + 1))
    s[:, -1] = s[0, -1]

    def defect(scale):
        T = reference.duration + scale * s[0, -1]
        q, w, v = (
            x + scale * s[:, i * n : (i + 1) * n]
            for i, x in enumerate((reference.position, reference.velocity, reference.acceleration))
        )
        half = T / N / 2
        return np.hstack([np.diff(q, axis=0) - half * (w[1:] + w[:-1]), np.diff(w, axis=0) - half * (v[1:] + v[:-1])])

    step = 1e-6
    numeric = (defect(step) - defect(-step)) / (2 * step)
    symbolic = np.array([stages.C[k] @ s[k + 1] - stages.A[k] @ s[k] for k in range(N)])
    # central differences of a polynomial of degree two: rounding over the step is what is left
    assert np.abs(symbolic[:, : 2 * n] - numeric).max() < 1e-9
    assert np.abs(symbolic[:, 2 * n]).max() < 1e-15


@pytest.mark.parametrize("seed", range(4))
def test_without_active_boxes_it_is_the_papers_program(seed):
    p = problem(motion(seed=seed), paper=True, held=(True, True), speed=50.0, effort=1e4, seed=seed)
    solution = solve_tracking(p)
    assert solution.status is Status.CONVERGED
    assert solution.iterations == 0
    assert np.abs(paper_step(p, solution).ravel() - dense_solution(sparse_program(p))).max() < 1e-8


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("limited", ["speed", "acceleration"])
def test_with_active_boxes_it_is_the_papers_program(seed, limited):
    reference = motion(seed=seed)
    values = reference.velocity if limited == "speed" else reference.acceleration
    bound = max(0.9 * np.abs(values[1:-1]).max(), 1.05 * np.abs(values[[0, -1]]).max())
    p = problem(
        reference,
        move=0.01,
        paper=True,
        held=(True, True),
        speed=bound if limited == "speed" else 50.0,
        effort=bound if limited == "acceleration" else 1e4,
    )
    solution = solve_tracking(p)
    assert solution.status is Status.CONVERGED
    program = sparse_program(p)
    x, expected = paper_step(p, solution).ravel(), dense_solution(program)
    rows = program.E @ x
    assert max((program.lower - rows).max(), (rows - program.upper).max()) < 1e-8
    assert 0.5 * x @ (program.P @ x) <= 0.5 * expected @ (program.P @ expected) * (1 + 1e-9)
    assert np.abs(x - expected).max() < 1e-6


def kkt_residuals(p, solution):
    """Stationarity, feasibility and complementarity of the exact program, from dense matrices of finite differences.

    The program is quadratic in the free values r and T, so that differences over a step of one are exact but for
    rounding.
    """
    from dyngrasp.planning.replanning.joint_splines import boundary, filtered, sequence

    reference, T_ref = p.reference, p.reference.duration
    N, n = reference.intervals, reference.position.shape[1]
    ends = np.stack([p.start, p.end])
    held = (p.hold_start_acceleration, p.hold_end_acceleration)
    motion = np.stack([reference.position, reference.velocity, reference.acceleration])

    def scaled(x, T):
        values, slopes = np.empty((2, 3, n)), np.empty((2, 3, n))
        boundary(T, T_ref, ends, motion, False, values, slopes)
        r, z = np.empty((N + 3, n)), np.empty((3, N + 1, n))
        sequence(x, values, held, r)
        filtered(r, z)
        return z

    def cost(x, T):
        q, w, a = scaled(x, T)
        dT = T - T_ref
        dw = (w - T_ref * reference.velocity - reference.velocity * dT) / T_ref
        dv = (a - (T_ref**2 + 2 * T_ref * dT) * reference.acceleration) / T_ref**2
        weights = p.weights
        return 0.5 * (
            weights.position * ((q - reference.position) ** 2).sum()
            + weights.velocity * (dw**2).sum()
            + weights.acceleration * (dv**2).sum()
            + (N + 1) * weights.duration * dT**2
        )

    def limits(x, T):
        w = scaled(x, T)[1, 1:N]
        return np.concatenate([(T * p.velocity_limit - sign * w).ravel() for sign in (1, -1)])

    # Values of r at the solution from its positions and accelerations.
    T = solution.duration
    r = solution.scaled[0] - solution.scaled[2] / (4 * N**2)
    x0 = np.vstack([r[:1], r[2:-2], r[-1:]])

    def unpack(y):
        return y[:-1].reshape(N - 1, n), y[-1]

    y0 = np.append(x0.ravel(), T)
    free = np.ones(y0.size, bool)
    if held[0]:
        free[:n] = False
    if held[1]:
        free[-1 - n : -1] = False
    step = 1e-4

    def derivative(f):
        columns = []
        for i in np.flatnonzero(free):
            e = np.zeros(y0.size)
            e[i] = step
            columns.append((f(*unpack(y0 + e)) - f(*unpack(y0 - e))) / (2 * step))
        return np.array(columns)

    gradient, g = derivative(cost), limits(*unpack(y0))
    jacobian = derivative(limits)
    scale = max(cost(x0, T), 1e-6)
    active = g < 1e-6 * np.abs(g).max()
    if not active.any():
        return np.abs(gradient).max() / scale, float(-g.min()), 0.0
    lam, *_ = np.linalg.lstsq(jacobian[:, active], gradient, rcond=None)
    residual = gradient - jacobian[:, active] @ lam
    # Where the reference is the answer and touches a bound, gradient and multipliers are only rounding; gradients
    # of this size belong to moves of 1e-10 rad.
    nothing = 1e-6
    stationarity = np.abs(residual).max() / max(np.abs(gradient).max(), nothing)
    return stationarity, float(-g.min()), float(-lam.min() / max(np.abs(lam).max(), nothing))


@example(seed=838, move=0.0, speed_share=1.0, held_start=False)
@example(seed=129, move=0.1, speed_share=1.0, held_start=False)
@settings(max_examples=60)
@given(
    seed=st.integers(0, 10**6),
    move=st.floats(0.0, 0.3),
    speed_share=st.floats(0.5, 1.1),
    held_start=st.booleans(),
)
def test_kkt_conditions_of_the_exact_program(seed, move, speed_share, held_start):
    reference = motion(N=10, n=2, seed=seed)
    moving = reference.velocity
    bound = max(speed_share * np.abs(moving).max(), 1.02 * np.abs(moving[[0, -1]]).max() + 0.2 * move)
    # Starting at rest in acceleration keeps the program quadratic: T² q̈ at the splice is treated by two linear passes.
    p = problem(reference, move=move, speed=bound, held=(held_start, False), seed=seed)
    p.start[2] = 0.0
    solution = solve_tracking(p)
    if solution.status is not Status.CONVERGED:
        # Infeasible programs exist here; what may not happen is an answer that claims to be one.
        assert solution.status in (Status.INFEASIBLE, Status.ITERATION_LIMIT)
        return
    stationarity, violation, sign = kkt_residuals(p, solution)
    # differences over steps of 1e-4 of a cost with curvatures up to N⁴
    assert stationarity < 1e-5
    assert violation < 1e-8
    assert sign < 1e-4


@pytest.mark.parametrize("move", [0.0, 0.01, 0.2])
def test_answer_meets_both_ends_and_the_dynamics_to_rounding(move):
    p = problem(motion(N=100, n=7), move=move, speed=3.0)
    trajectory = solve_tracking(p).trajectory
    assert trajectory.dynamics_defect() < 1e-12
    assert np.array_equal(trajectory.position[0], p.start[0])
    assert np.array_equal(trajectory.velocity[0], p.start[1])
    assert np.array_equal(trajectory.acceleration[0], p.start[2])
    assert np.array_equal(trajectory.position[-1], p.end[0])
    assert np.array_equal(trajectory.velocity[-1], p.end[1])


def test_first_acceleration_is_exact_also_between_the_nodes_around_it():
    p = problem(motion(N=50, n=3), move=0.2, weights=TrackingWeights(0.0, 0.0, 1.0, 1e-3))
    solution = solve_tracking(p)
    assert abs(solution.duration - p.reference.duration) > 0.01
    raw = solution.scaled / solution.duration ** np.arange(3)[:, None, None]
    # a = N² (second difference of numbers near one): rounding times N²
    assert np.abs(raw[:, 0] - p.start).max() < 1e-11


def test_no_move_changes_nothing():
    reference = motion(N=40, n=4)
    p = problem(reference, move=0.0)
    solution = solve_tracking(p)
    assert abs(solution.duration - reference.duration) < 1e-12
    assert np.abs(solution.trajectory.position - reference.position).max() < 1e-12


def test_given_duration_is_kept():
    p = problem(motion(), move=0.1)
    fixed = replace(p, min_duration=p.reference.duration, max_duration=p.reference.duration)
    solution = solve_tracking(fixed)
    assert solution.status is Status.CONVERGED
    assert solution.duration == p.reference.duration


def test_bounds_of_the_duration_are_kept():
    p = problem(motion(), move=0.5, weights=TrackingWeights(0.0, 0.0, 1.0, 1e-6))
    free = solve_tracking(p)
    bounded = replace(p, max_duration=0.5 * (free.duration + p.reference.duration))
    if free.duration < p.reference.duration:
        bounded = replace(p, min_duration=0.5 * (free.duration + p.reference.duration))
    solution = solve_tracking(bounded)
    assert solution.status is Status.CONVERGED
    assert bounded.min_duration - 1e-8 <= solution.duration <= bounded.max_duration + 1e-8
    assert abs(solution.duration - free.duration) > 1e-3


def test_node_weights_pull_the_motion_to_the_reference_where_they_are():
    p = problem(motion(N=60, n=2), move=0.1, weights=TrackingWeights(0.0, 0.0, 1.0, 100.0))
    pulled = replace(p, node_weights=np.where(np.arange(61) < 30, 1e6, 0.0))
    free, held = (solve_tracking(x).scaled[0][5:25] - p.reference.position[5:25] for x in (p, pulled))
    assert np.abs(held).max() < 0.02 * np.abs(free).max()


def test_impossible_boxes_are_a_status():
    p = problem(motion(), move=1.0, speed=0.5)
    slow = replace(p, velocity_limit=np.full(3, 0.02), max_duration=p.reference.duration)
    assert solve_tracking(slow).status in (Status.INFEASIBLE, Status.ITERATION_LIMIT)


def test_numbers_that_are_not_finite_are_a_status():
    p = problem(motion())
    broken = p.end.copy()
    broken[0, 0] = np.nan
    assert solve_tracking(replace(p, end=broken)).status is Status.NONFINITE


def test_eq15_leaves_a_defect_of_second_order_and_the_exact_step_none(task):
    """Twice the move, four times the defect; and none at all in scaled time."""
    reference = motion(N=100, n=7, T=1.0)
    errors = []
    for move in (0.02, 0.04):
        p = problem(reference, move=move, paper=True, held=(True, True), speed=50.0, effort=1e4)
        p = replace(p, weights=TrackingWeights(0.0, 0.0, 1.0, 1.0))
        solution = solve_tracking(p)
        update = paper_update(reference, paper_step(p, solution))
        for name in ("position", "velocity", "acceleration"):
            # The same in compiled code: products of numbers up to 1e4 in another order.
            assert np.abs(getattr(solution.trajectory, name) - getattr(update, name)).max() < 1e-10
        errors.append(end_point_error(update, task.robot))
        exact = replace(p, paper_rows=False)
        assert end_point_error(solve_tracking(exact).trajectory, task.robot) < 1e-12
    assert errors[0] > 1e-6
    assert 3.0 < errors[1] / errors[0] < 5.0


@pytest.mark.parametrize(
    "change",
    [
        {"min_duration": 0.0},
        {"min_duration": 2.0, "max_duration": 1.0},
        {"max_duration": np.inf},
        {"start": np.zeros((3, 2))},
    ],
)
def test_bad_problems_are_refused(change):
    with pytest.raises(InvalidProblem):
        replace(problem(motion()), **change)


@pytest.mark.parametrize("bad", [{"acceleration": 0.0}, {"duration": 0.0}, {"position": -1.0}, {"velocity": np.nan}])
def test_bad_weights_are_refused(bad):
    with pytest.raises(InvalidProblem):
        TrackingWeights(**bad)
