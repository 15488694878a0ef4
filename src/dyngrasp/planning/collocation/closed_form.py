"""Minimum effort between two states in closed form, and the motion nearest to given accelerations that meets both ends.

With s = t/T, w = T q̇, a = T² v and h = 1/N the trapezoidal rule, eq. (3b), is linear and free of T, and the two end
values of a joint are linear in its accelerations: w_N − w_0 = Σ c_k a_k, q_N − q_0 − w_0 = Σ d_k a_k with

    c = h (½, 1, …, 1, ½),    d = h² (N/2 − ¼, N−1, N−2, …, 1, ¼).

Minimum Σ a² under two linear equations is a combination of c and d: two numbers a joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numba import njit

from dyngrasp.planning.problem import PhaseProblem
from dyngrasp.signals import Array, read_only
from dyngrasp.trajectory import Trajectory

# A motion from a state at rest to itself costs least with no duration at all; a trajectory needs one (s).
SHORTEST_DURATION = 1e-3


@lru_cache(maxsize=64)
def _end_map(intervals: int) -> tuple[Array, Array, Array]:
    """(2, N+1) rows c and d, their (2, 2) Gram matrix and its inverse."""
    h = 1.0 / intervals
    c = np.full(intervals + 1, h)
    c[[0, -1]] = h / 2
    rows = np.vstack([c, _reach_row(intervals, intervals)])
    gram = rows @ rows.T
    return rows, gram, np.linalg.inv(gram)


def _end_change(problem: PhaseProblem, duration: float) -> Array:
    """(2, n) what the accelerations must change: of w, and of q beyond coasting."""
    coasting = duration * problem.start_velocity
    return np.vstack(
        [duration * problem.end_velocity - coasting, problem.end_position - problem.start_position - coasting]
    )


def integrate(start_position: Array, start_rate: Array, curvature: Array) -> tuple[Array, Array]:
    """Positions and rates in normalised time from accelerations in normalised time, by the trapezoidal rule.

    Args:
        start_position: (n,) q_0.
        start_rate: (n,) w_0 = T q̇_0.
        curvature: (N+1, n) a = T² v.

    Returns:
        q and w, each (N+1, n).
    """
    position, rate = np.empty_like(curvature), np.empty_like(curvature)
    _integrate(start_position, start_rate, curvature, position, rate)
    return position, rate


@njit(cache=True)
def _integrate(start_position: Array, start_rate: Array, curvature: Array, position: Array, rate: Array) -> None:
    points, joints = curvature.shape
    half = 0.5 / (points - 1)
    for j in range(joints):
        position[0, j], rate[0, j] = start_position[j], start_rate[j]
    for k in range(1, points):
        for j in range(joints):
            rate[k, j] = rate[k - 1, j] + half * (curvature[k, j] + curvature[k - 1, j])
            position[k, j] = position[k - 1, j] + half * (rate[k, j] + rate[k - 1, j])


def nearest_trajectory(problem: PhaseProblem, curvature: Array, duration: float) -> Trajectory:
    """The motion that meets both boundary states with accelerations as near to the given ones as possible.

    The least Σ|δa|² that closes the gap at the end is added; the dynamics and the boundary states then hold to
    rounding, whatever solver the accelerations come from.

    Args:
        problem: Gives the boundary states and N.
        curvature: (N+1, n) accelerations in normalised time, a = T² v.
        duration: T (s).
    """
    rows, _, gram_inverse = _end_map(problem.intervals)
    start_rate = duration * problem.start_velocity
    change = _end_change(problem, duration)
    curvature = curvature + rows.T @ (gram_inverse @ (change - rows @ curvature))
    position, rate = integrate(problem.start_position, start_rate, curvature)
    velocity = rate / duration
    # The last grid point is the boundary state itself; the sums above differ from it by rounding only.
    position[-1], velocity[0], velocity[-1] = problem.end_position, problem.start_velocity, problem.end_velocity
    return Trajectory(duration, position, velocity, curvature / duration**2)


def least_effort(problem: PhaseProblem, duration: float) -> Trajectory:
    """The minimiser of Σ|v_k|² for a given duration under the boundary states alone."""
    return nearest_trajectory(problem, np.zeros((problem.intervals + 1, problem.joints)), duration)


def effort_coefficients(problem: PhaseProblem) -> Array:
    """(3,) c0, c1, c2 of the least Σ|a_k|² = c0 + c1 T + c2 T² over all motions of duration T."""
    fixed = _end_change(problem, 0.0)
    return _coefficients(_end_map(problem.intervals)[2], fixed, _end_change(problem, 1.0) - fixed)


def _coefficients(gram_inverse: Array, fixed: Array, linear: Array) -> Array:
    """(..., 3) of the least Σ|a_k|² with which the rows of a map give fixed + T linear, each (..., rows, n)."""
    by_fixed, by_linear = gram_inverse @ fixed, gram_inverse @ linear
    products = (fixed * by_fixed, 2.0 * linear * by_fixed, linear * by_linear)
    return np.stack([product.sum(axis=(-2, -1)) for product in products], axis=-1)


def least_cost(problem: PhaseProblem, duration: float) -> float:
    """J(T) = T + (ρ/N)(c0 T⁻³ + c1 T⁻² + c2 T⁻¹), the objective of `least_effort` (s)."""
    weight = problem.effort_weight / problem.intervals
    c0, c1, c2 = effort_coefficients(problem)
    return float(_cost(c0, c1, c2, weight, duration))


def best_duration(problem: PhaseProblem) -> float:
    """The duration within its bounds that minimises J(T).

    An end of the interval or a root of the quartic T⁴ − (ρ/N)(c2 T² + 2 c1 T + 3 c0) = 0.
    """
    return float(_best_root(effort_coefficients(problem)[None], problem)[0][0])


@njit(cache=True)
def _cost(c0: float, c1: float, c2: float, weight: float, duration: float) -> float:
    """J at a duration."""
    return duration + weight * ((c0 / duration + c1) / duration + c2) / duration


def _best_root(coefficients: Array, problem: PhaseProblem) -> tuple[Array, Array]:
    """Duration within its bounds that minimises J(T), and J there, for each row of coefficients (S, 3)."""
    shortest = max(problem.min_duration, min(SHORTEST_DURATION, problem.max_duration))
    weight = problem.effort_weight / problem.intervals
    durations, costs = np.empty(len(coefficients)), np.empty(len(coefficients))
    _minimise(coefficients, weight, shortest, problem.max_duration, durations, costs)
    return durations, costs


@njit(cache=True)
def _minimise(
    coefficients: Array, weight: float, shortest: float, longest: float, durations: Array, costs: Array
) -> None:
    """Of the ends of the interval and the roots of the quartic between them the one where J is least.

    The quartic p(T) = T⁴ − ρ/N (c2 T² + 2 c1 T + 3 c0) is monotone between neighbouring roots of its derivative, a
    cubic without quadratic term: each such stretch has one root of p at most, found by bisection to the last digit.
    """
    corners = np.empty(5)
    for i in range(len(coefficients)):
        c0, c1, c2 = coefficients[i]
        best, least = shortest, _cost(c0, c1, c2, weight, shortest)
        at_end = _cost(c0, c1, c2, weight, longest)
        if at_end < least:
            best, least = longest, at_end
        corners[:] = shortest
        corners[4] = longest
        # T³ − m T − k = 0 by Cardano, or by Vieta where there are three roots.
        m, k = weight * c2 / 2, weight * c1 / 2
        discriminant = k * k / 4 - m * m * m / 27
        if discriminant > 0:
            root = np.sqrt(discriminant)
            corners[1] = np.cbrt(k / 2 + root) + np.cbrt(k / 2 - root)
        elif m > 0:
            radius = np.sqrt(m / 3)
            angle = np.arccos(min(max(k / 2 / radius**3, -1.0), 1.0)) / 3
            for j in range(3):
                corners[1 + j] = 2 * radius * np.cos(angle - 2 * np.pi * j / 3)
        for j in range(1, 4):
            corners[j] = min(max(corners[j], shortest), longest)
        corners.sort()
        for j in range(4):
            lower, upper = corners[j], corners[j + 1]
            rising = _slope(c0, c1, c2, weight, upper) > 0
            if rising == (_slope(c0, c1, c2, weight, lower) > 0):
                continue
            middle = (lower + upper) / 2
            while lower < middle < upper:
                if (_slope(c0, c1, c2, weight, middle) > 0) == rising:
                    upper = middle
                else:
                    lower = middle
                middle = (lower + upper) / 2
            cost = _cost(c0, c1, c2, weight, middle)
            if cost < least:
                best, least = middle, cost
        durations[i], costs[i] = best, least


@njit(cache=True)
def _slope(c0: float, c1: float, c2: float, weight: float, T: float) -> float:
    """The quartic: T⁴ dJ/dT."""
    return T**4 - weight * ((c2 * T + 2 * c1) * T + 3 * c0)


def unconstrained_optimum(problem: PhaseProblem) -> Trajectory:
    """The optimum of the phase without its inequalities; optimal for the phase if it satisfies them."""
    return least_effort(problem, best_duration(problem))


def within_speed_limits(problem: PhaseProblem, duration: float) -> Trajectory:
    """The motion of least effort, slow enough to keep the speed limits at the grid points if it may be."""
    for _ in range(3):
        motion = least_effort(problem, duration)
        ratio = float((np.abs(motion.velocity) / problem.velocity_limit).max())
        if ratio <= 1.001:
            return motion
        # Exact from rest to rest; with moving ends the ratio falls more slowly than 1/T, hence the repetition.
        duration = min(duration * ratio, problem.max_duration)
    return least_effort(problem, duration)


def optimum_through(
    problem: PhaseProblem, timetables: Sequence[Sequence[int]], waypoints: Array
) -> tuple[Trajectory, float]:
    """The cheapest motion that passes given positions in turn, without the inequalities.

    Args:
        problem: Gives the boundary states, ρ and the bounds on the duration.
        timetables: Grid points at which to pass the positions, inner ones, ascending; of several timetables the
            cheapest is taken.
        waypoints: (W, n) positions (rad).

    Returns:
        The motion and its objective (s).
    """
    rows, gram_inverse = _way_map(problem.intervals, tuple(tuple(nodes) for nodes in timetables))
    at_ends, at_waypoints = _end_change(problem, 0.0), waypoints - problem.start_position
    fixed = np.vstack([at_ends, at_waypoints])
    shares = np.asarray(timetables, dtype=float) / problem.intervals
    linear = np.empty((len(shares), *fixed.shape))
    linear[:, :2] = _end_change(problem, 1.0) - at_ends
    linear[:, 2:] = -shares[..., None] * problem.start_velocity
    durations, costs = _best_root(_coefficients(gram_inverse, fixed, linear), problem)
    best = int(costs.argmin())
    duration = float(durations[best])
    curvature = rows[best].T @ (gram_inverse[best] @ (fixed + duration * linear[best]))
    return nearest_trajectory(problem, curvature, duration), float(costs[best])


@lru_cache(maxsize=64)
def _way_map(intervals: int, timetables: tuple[tuple[int, ...], ...]) -> tuple[Array, Array]:
    """(S, W+2, N+1) rows of both end values and of the positions at W grid points, and their inverse Gram matrices."""
    ends = _end_map(intervals)[0]
    rows = np.stack([np.vstack([ends, *(_reach_row(intervals, node) for node in nodes)]) for nodes in timetables])
    return rows, np.asarray(np.linalg.inv(rows @ rows.swapaxes(-1, -2)), dtype=float)


def _reach_row(intervals: int, node: int) -> Array:
    """(N+1,) what each acceleration adds to the position at a grid point, in normalised time."""
    h = 1.0 / intervals
    row = np.zeros(intervals + 1)
    row[: node + 1] = h**2 * np.arange(node, -1.0, -1.0)
    row[0] = h**2 * (node / 2 - 0.25)
    row[node] = h**2 / 4
    return row


@lru_cache(maxsize=64)
def rest_to_rest(intervals: int) -> tuple[Array, Array, Array]:
    """Position, rate and curvature, each (N+1,), of the least-effort motion from 0 to 1 at rest, in normalised time."""
    rows, _, gram_inverse = _end_map(intervals)
    curvature = rows.T @ (gram_inverse @ np.array([0.0, 1.0]))
    position, rate = integrate(read_only(np.zeros(1)), np.zeros(1), curvature[:, None])
    # The motion is odd about its middle; averaging with its mirror image takes the summed rounding out of both ends.
    symmetric_rate = (rate[:, 0] + rate[::-1, 0]) / 2
    symmetric_position = (position[:, 0] + 1.0 - position[::-1, 0]) / 2
    symmetric_rate[[0, -1]] = 0.0
    symmetric_position[[0, -1]] = 0.0, 1.0
    odd_curvature = (curvature - curvature[::-1]) / 2
    return read_only(symmetric_position), read_only(symmetric_rate), read_only(odd_curvature)
