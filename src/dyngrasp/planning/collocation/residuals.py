"""What a trajectory costs and by how much it violates its problem, measured apart from any solver."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np

from dyngrasp.planning.problem import NodeConstraint, PhaseProblem
from dyngrasp.signals import Array
from dyngrasp.trajectory import Trajectory

_mapped: dict[tuple[int, int], tuple[ca.Function, ca.Function]] = {}


def objective(problem: PhaseProblem, trajectory: Trajectory) -> float:
    """ΔT + ρ Δt Σ vᵀv over all grid points, eq. (3a) (s)."""
    effort = float(np.sum(trajectory.acceleration**2))
    return trajectory.duration * (1.0 + problem.effort_weight / problem.intervals * effort)


def rows(constraint: NodeConstraint, position: Array, acceleration: Array) -> Array:
    """(K, m) values of a constraint at K grid points.

    Args:
        constraint: With parameters for the same K points.
        position: (K, n) in rad.
        acceleration: (K, n) in rad/s².
    """
    key = (constraint.function.__hash__(), len(position))
    # The function is kept beside its map: a hash is only good as long as what it names is alive.
    if key not in _mapped:
        _mapped[key] = (constraint.function, constraint.function.map(len(position)))
    return _mapped[key][1](position.T, acceleration.T, constraint.parameters.T).full().T


def excess(constraint: NodeConstraint, values: Array) -> Array:
    """(K, m) how far values lie outside the bounds, in units of the scale; ≤ 0 inside."""
    return np.maximum(constraint.lower - values, values - constraint.upper) / constraint.scale


def worst_violation(problem: PhaseProblem, trajectory: Trajectory) -> tuple[float, str]:
    """The largest violation of any limit at the grid points, and the name of the limit ("" if all hold).

    Boxes are measured in their own half-width, rows in their scale, the duration in its upper bound.
    """
    q, w, v = trajectory.position, trajectory.velocity, trajectory.acceleration
    half_width = (problem.position_upper - problem.position_lower) / 2
    outside = np.maximum(problem.position_lower - q, q - problem.position_upper) / half_width
    late = max(problem.min_duration - trajectory.duration, trajectory.duration - problem.max_duration)
    found = {
        "position": outside.max(),
        "velocity": (np.abs(w) / problem.velocity_limit - 1.0).max(),
        "acceleration": (np.abs(v) / problem.acceleration_limit - 1.0).max(),
        "duration": late / problem.max_duration,
    }
    for constraint in problem.constraints:
        found[constraint.name] = excess(constraint, rows(constraint, q, v)).max()
    if not all(np.isfinite(value) for value in found.values()):
        return np.inf, "not finite: " + ", ".join(name for name, value in found.items() if not np.isfinite(value))
    name = max(found, key=lambda key: found[key])
    return (float(found[name]), name) if found[name] > 0 else (0.0, "")


def infeasible_at_once(problem: PhaseProblem, tolerance: float) -> str:
    """Why no motion can solve the problem, as far as that shows without a search; "" if it does not show.

    A joint at top speed must cover its way in the longest duration, and rows that no acceleration enters must hold
    at the boundary positions, where nothing is left to choose.
    """
    travel = np.abs(problem.end_position - problem.start_position) / problem.velocity_limit
    joint = int(travel.argmax())
    if travel[joint] > problem.max_duration * (1 + tolerance):
        return (
            f"joint {joint + 1} needs {travel[joint]:.3f} s at its top speed, "
            f"the longest duration is {problem.max_duration:.3f} s"
        )
    ends = np.vstack([problem.start_position, problem.end_position])
    for constraint in problem.constraints:
        if constraint.function.jac_sparsity(0, 1).nnz() > 0:
            continue
        at_ends = replace(constraint, parameters=constraint.parameters[[0, -1]])
        outside = excess(constraint, rows(at_ends, ends, np.zeros_like(ends))).max(axis=1)
        for end, by in zip(("start", "end"), outside, strict=True):
            if by > tolerance:
                return f"{constraint.name} is violated at the {end} by {by:.1e} of its scale"
    return ""
