"""A phase as a nonlinear program whose functions depend on its structure alone, so that they are built once.

Variables are q_k, w_k = T q̇_k, a_k = T² v_k at every grid point, and T. In these the trapezoidal rule is linear,
constant and free of T; T couples the grid points as one dense column. First and second derivatives are
taken of one grid point and mapped over the grid: the Hessian of the Lagrangian is exact and block diagonal but for T.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from dyngrasp.planning.collocation.closed_form import SHORTEST_DURATION
from dyngrasp.planning.problem import PhaseProblem
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory


@dataclass(frozen=True)
class NonlinearProgram:
    """Functions of one problem structure: f, g and their exact derivatives.

    Attributes:
        problem: {"x", "p", "f", "g"} as CasADi wants it.
        grad_f, jac_g, hess_lag: Derivatives in the signatures of CasADi's IPOPT interface.
        functions: The constraint functions, kept alive because look-ups go by their identity.
    """

    problem: dict[str, ca.MX]
    grad_f: ca.Function
    jac_g: ca.Function
    hess_lag: ca.Function
    functions: tuple[ca.Function, ...]


def structure_key(problem: PhaseProblem) -> tuple:
    """Problems of equal key share their functions: all that a pose, a part or a limit changes is data."""
    functions = tuple(constraint.function.__hash__() for constraint in problem.constraints)
    return problem.intervals, problem.joints, bool(np.isfinite(problem.acceleration_limit).any()), functions


def _grid_point(problem: PhaseProblem) -> tuple[ca.Function, ca.Function, ca.Function, ca.Function]:
    """Cost and rows of one grid point: values, gradient of the cost, Jacobian and Hessian, as columns of nonzeros."""
    n = problem.joints
    z, T = ca.SX.sym("z", 3 * n), ca.SX.sym("T")
    q, w, a = ca.vertsplit(z, n)
    limits = ca.SX.sym("limits", 2 * n + 2)
    velocity_limit, acceleration_limit, weight, share = ca.vertsplit(limits, [0, n, 2 * n, 2 * n + 1, 2 * n + 2])
    cost = weight * ca.sumsqr(a) / T**3 + share * T
    rows = [T + w / velocity_limit, T - w / velocity_limit]
    if np.isfinite(problem.acceleration_limit).any():
        rows += [T**2 + a / acceleration_limit, T**2 - a / acceleration_limit]
    parameters = []
    for constraint in problem.constraints:
        p = ca.SX.sym(constraint.name, constraint.function.size1_in(2))
        scale = ca.SX.sym(constraint.name + "_scale", constraint.function.size1_out(0))
        rows.append(constraint.function(q, a / T**2, p) / scale)
        parameters += [p, scale]
    g = ca.vertcat(*rows)
    p = ca.vertcat(limits, *parameters)

    variables = ca.vertcat(z, T)
    sigma, multiplier = ca.SX.sym("sigma"), ca.SX.sym("lambda", g.numel())
    lagrangian = sigma * cost + ca.dot(multiplier, g)
    hessian = ca.triu(ca.hessian(lagrangian, variables)[0])
    jacobian = ca.jacobian(g, variables)
    return (
        ca.Function("grid_point", [z, T, p], [cost, g]),
        ca.Function("grid_point_gradient", [z, T, p], [ca.densify(ca.gradient(cost, variables))]),
        ca.Function("grid_point_jacobian", [z, T, p], [jacobian], {"cse": True}),
        ca.Function("grid_point_hessian", [z, T, p, sigma, multiplier], [hessian], {"cse": True}),
    )


def _gathered(sparsity_rows: list, sparsity_cols: list, values: ca.MX, shape: tuple[int, int]) -> ca.MX:
    """A sparse matrix from triplets without duplicates, its nonzeros an expression."""
    rows, cols = np.concatenate(sparsity_rows), np.concatenate(sparsity_cols)
    order = np.lexsort((rows, cols))
    sparsity = ca.Sparsity.triplet(*shape, rows[order].tolist(), cols[order].tolist())
    return ca.MX(sparsity, values[order.tolist()])


def _dynamics(intervals: int, n: int) -> ca.DM:
    """Constant matrix of the trapezoidal rule, (2 n N, 3 n (N+1))."""
    half, eye, zero = 0.5 / intervals, np.eye(n), np.zeros((n, n))
    here = np.block([[-eye, -half * eye, zero], [zero, -eye, -half * eye]])
    there = np.block([[eye, -half * eye, zero], [zero, eye, -half * eye]])
    shift_here = ca.DM.eye(intervals + 1)[:-1, :]
    shift_there = ca.DM.eye(intervals + 1)[1:, :]
    return ca.sparsify(ca.kron(shift_here, ca.sparsify(here)) + ca.kron(shift_there, ca.sparsify(there)))


def build(problem: PhaseProblem) -> NonlinearProgram:
    """Build the functions that every problem of the same `structure_key` shares."""
    N, n = problem.intervals, problem.joints
    point, point_gradient, point_jacobian, point_hessian = _grid_point(problem)
    rows = point.size1_out(1)
    n_p = point.size1_in(2)
    points = N + 1
    last = 3 * n * points

    x = ca.MX.sym("x", last + 1)
    p = ca.MX.sym("p", n_p * points + 2 * n)
    Z, T = ca.reshape(x[:last], 3 * n, points), x[last]
    P = ca.reshape(p[: n_p * points], n_p, points)
    start_velocity, end_velocity = p[n_p * points : n_p * points + n], p[n_p * points + n :]
    repeated_T = ca.repmat(T, 1, points)

    dynamics = _dynamics(N, n)
    cost, grid = point.map(points)(Z, repeated_T, P)
    w_ends = ca.vertcat(Z[n : 2 * n, 0] - T * start_velocity, Z[n : 2 * n, N] - T * end_velocity)
    f = ca.sum2(cost)
    g = ca.vertcat(dynamics @ x[:last], w_ends, ca.vec(grid))

    gradients = point_gradient.map(points)(Z, repeated_T, P)
    grad_f = ca.vertcat(ca.vec(gradients[: 3 * n, :]), ca.sum2(gradients[3 * n, :]))

    # Each block is laid out as its nonzeros one grid point after another; T is the last column.
    dyn_rows, dyn_cols = (np.array(i) for i in dynamics.sparsity().get_triplet())
    first = dynamics.shape[0]
    ends = np.arange(n)
    jac_rows = [dyn_rows, first + np.arange(2 * n), first + np.arange(2 * n)]
    jac_cols = [dyn_cols, np.concatenate([n + ends, 3 * n * N + n + ends]), np.full(2 * n, last)]
    point_rows, point_cols = (np.array(i) for i in point_jacobian.sparsity_out(0).get_triplet())
    offset = np.arange(points)[:, None]
    jac_rows.append((first + 2 * n + rows * offset + point_rows).ravel())
    jac_cols.append(np.where(point_cols == 3 * n, last, 3 * n * offset + point_cols).ravel())
    jac_values = ca.vertcat(
        ca.MX(ca.DM(dynamics.nonzeros())),
        ca.MX.ones(2 * n),
        -start_velocity,
        -end_velocity,
        _nonzeros(point_jacobian, points, Z, repeated_T, P),
    )
    jac_g = _gathered(jac_rows, jac_cols, jac_values, (g.numel(), last + 1))

    sigma, multiplier = ca.MX.sym("sigma"), ca.MX.sym("lambda", g.numel())
    grid_multiplier = ca.reshape(multiplier[first + 2 * n :], rows, points)
    blocks = _nonzeros(point_hessian, points, Z, repeated_T, P, ca.repmat(sigma, 1, points), grid_multiplier)
    hess_rows, hess_cols = (np.array(i) for i in point_hessian.sparsity_out(0).get_triplet())
    blocks = ca.reshape(blocks, hess_rows.size, points)
    local = np.flatnonzero(~((hess_rows == 3 * n) & (hess_cols == 3 * n)))
    corner = np.flatnonzero((hess_rows == 3 * n) & (hess_cols == 3 * n))
    hess_lag = _gathered(
        [(3 * n * offset + hess_rows[local]).ravel(), np.array([last])],
        [np.where(hess_cols[local] == 3 * n, last, 3 * n * offset + hess_cols[local]).ravel(), np.array([last])],
        ca.vertcat(ca.vec(blocks[local.tolist(), :]), ca.sum2(blocks[corner.tolist(), :])),
        (last + 1, last + 1),
    )
    return NonlinearProgram(
        {"x": x, "p": p, "f": f, "g": g},
        ca.Function("nlp_grad_f", [x, p], [f, grad_f], ["x", "p"], ["f", "grad:f:x"]),
        ca.Function("nlp_jac_g", [x, p], [g, jac_g], ["x", "p"], ["g", "jac:g:x"]),
        ca.Function(
            "nlp_hess_l", [x, p, sigma, multiplier], [hess_lag], ["x", "p", "lam:f", "lam:g"], ["triu:hess:gamma:x:x"]
        ),
        tuple(constraint.function for constraint in problem.constraints),
    )


def _nonzeros(function: ca.Function, points: int, *arguments: ca.MX) -> ca.MX:
    """Nonzeros of the one sparse output of `function`, one grid point after another, as a column."""
    inputs = [ca.SX.sym(f"i{i}", function.size1_in(i)) for i in range(function.n_in())]
    (output,) = function.call(inputs)
    flat = ca.Function(function.name() + "_nonzeros", inputs, [output.nz[:]])
    return ca.vec(flat.map(points)(*arguments))


def numbers(problem: PhaseProblem) -> dict[str, Array]:
    """Parameters and bounds of one problem: p, lbx, ubx, lbg, ubg."""
    N, n = problem.intervals, problem.joints
    acceleration_limit = np.where(np.isfinite(problem.acceleration_limit), problem.acceleration_limit, 1e12)
    limits = np.concatenate([problem.velocity_limit, acceleration_limit, [problem.effort_weight / N, 1.0 / (N + 1)]])
    columns = [np.tile(limits, (N + 1, 1))]
    for constraint in problem.constraints:
        columns += [constraint.parameters, np.tile(constraint.scale, (N + 1, 1))]
    box_rows = 4 * n if np.isfinite(problem.acceleration_limit).any() else 2 * n
    lower = np.concatenate([np.zeros(box_rows)] + [c.lower / c.scale for c in problem.constraints])
    upper = np.concatenate([np.full(box_rows, np.inf)] + [c.upper / c.scale for c in problem.constraints])

    free = np.full((N + 1, 3 * n), np.inf)
    lbx, ubx = -free, free.copy()
    lbx[:, :n], ubx[:, :n] = problem.position_lower, problem.position_upper
    lbx[0, :n] = ubx[0, :n] = problem.start_position
    lbx[-1, :n] = ubx[-1, :n] = problem.end_position
    shortest = max(problem.min_duration, min(SHORTEST_DURATION, problem.max_duration))
    equalities = np.zeros(2 * n * N + 2 * n)
    return {
        "p": np.concatenate([np.hstack(columns).ravel(), problem.start_velocity, problem.end_velocity]),
        "lbx": np.append(lbx.ravel(), shortest),
        "ubx": np.append(ubx.ravel(), problem.max_duration),
        "lbg": np.concatenate([equalities, np.tile(lower, N + 1)]),
        "ubg": np.concatenate([equalities, np.tile(upper, N + 1)]),
    }


def pack(trajectory: Trajectory) -> Array:
    """The variables x of a trajectory."""
    T = trajectory.duration
    z = np.hstack([trajectory.position, T * trajectory.velocity, T**2 * trajectory.acceleration])
    return np.append(z.ravel(), T)


def unpack(x: Array, intervals: int) -> tuple[Array, float]:
    """Accelerations in normalised time, (N+1, n), and T."""
    z = x[:-1].reshape(intervals + 1, -1)
    return z[:, 2 * z.shape[1] // 3 :], float(x[-1])
