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
from dyngrasp.signals import Array, frozen, read_only
from dyngrasp.trajectory import Trajectory

# A motion from a state at rest to itself costs least with no duration at all; a trajectory needs one (s).
SHORTEST_DURATION = 1e-3

Ends = tuple[Array, Array, Array, Array]  # positions and velocities (n,) at the start, then at the end
Timetables = tuple[tuple[int, ...], ...]
_STRAIGHT: Timetables = ((),)  # the only timetable of a motion that passes nothing on its way
_NOWHERE = frozen(np.empty((0, 0)))  # its way points


@lru_cache(maxsize=64)
def _map(intervals: int, timetables: Timetables) -> tuple[Array, Array, Array]:
    """Rows of S timetables, their inverse Gram matrices (S, W+2, W+2), and when the W grid points of each are passed.

    Returns:
        c, d and the same as d for each of the W grid points, (S, W+2, N+1); inverse Gram matrices; s (S, W).
    """
    h = 1.0 / intervals
    c = np.full(intervals + 1, h)
    c[[0, -1]] = h / 2
    rows = np.array([[c, *(_reach_row(intervals, node) for node in (intervals, *nodes))] for nodes in timetables])
    inverse = np.asarray(np.linalg.inv(rows @ rows.swapaxes(-1, -2)), dtype=float)
    return frozen(rows), frozen(inverse), frozen(np.array(timetables, dtype=float) / intervals)


def _ends(problem: PhaseProblem) -> Ends:
    return problem.start_position, problem.start_velocity, problem.end_position, problem.end_velocity


def nearest_trajectory(problem: PhaseProblem, curvature: Array, duration: float) -> Trajectory:
    """The motion that meets both boundary states with accelerations as near to the given ones as possible.

    The least Σ|δa|² that closes the gap at the end is added; the dynamics and the boundary states then hold to
    rounding, whatever solver the accelerations come from.

    Args:
        problem: Gives the boundary states and N.
        curvature: (N+1, n) accelerations in normalised time, a = T² v.
        duration: T (s).
    """
    motion = np.empty((3, *curvature.shape))
    motion[2] = curvature
    return _meeting_ends(problem, duration, motion)


def _meeting_ends(problem: PhaseProblem, duration: float, motion: Array) -> Trajectory:
    """`nearest_trajectory` in place of its accelerations in normalised time, the last part of (3, N+1, n)."""
    _meet_ends(*_straight(problem.intervals), _ends(problem), duration, motion)
    return Trajectory.of(duration, motion)


@lru_cache(maxsize=64)
def _straight(intervals: int) -> tuple[Array, Array, Array, Array]:
    """Rows (2, N+1), inverse Gram matrix (2, 2), no shares and no way points of a motion that passes nothing."""
    rows, gram_inverse, shares = _map(intervals, _STRAIGHT)
    return rows[0], gram_inverse[0], shares[0], _NOWHERE


@njit(cache=True)
def _close(
    rows: Array, gram_inverse: Array, shares: Array, waypoints: Array, ends: Ends, duration: float, curvature: Array
) -> None:
    """Add the least Σ|δa|² to a (N+1, n) with which a motion meets its end and passes its way points."""
    fixed, linear = np.empty(len(rows)), np.empty(len(rows))
    for j in range(curvature.shape[1]):
        _changes(shares, waypoints, ends, j, fixed, linear)
        for row in range(len(rows)):
            fixed[row] += duration * linear[row]
            for k in range(len(curvature)):
                fixed[row] -= rows[row, k] * curvature[k, j]
        for row in range(len(rows)):
            weight = 0.0
            for other in range(len(rows)):
                weight += gram_inverse[row, other] * fixed[other]
            for k in range(len(curvature)):
                curvature[k, j] += weight * rows[row, k]


@njit(cache=True)
def _changes(shares: Array, waypoints: Array, ends: Ends, joint: int, fixed: Array, linear: Array) -> None:
    """Write fixed + T linear, (W+2,) each: what accelerations change of w, and of q beyond coasting at end and way."""
    start_position, start_velocity, end_position, end_velocity = ends
    fixed[0], linear[0] = 0.0, end_velocity[joint] - start_velocity[joint]
    fixed[1], linear[1] = end_position[joint] - start_position[joint], -start_velocity[joint]
    for i in range(len(shares)):
        fixed[2 + i] = waypoints[i, joint] - start_position[joint]
        linear[2 + i] = -shares[i] * start_velocity[joint]


@njit(cache=True)
def _meet_ends(
    rows: Array, gram_inverse: Array, shares: Array, waypoints: Array, ends: Ends, duration: float, motion: Array
) -> None:
    """Close the gaps of accelerations in normalised time, the last part of (3, N+1, n), and write the motion there."""
    # Way points may follow closely on one another: the second time closes what rounding of the inverse leaves open.
    for _ in range(2 if shares.size else 1):
        _close(rows, gram_inverse, shares, waypoints, ends, duration, motion[2])
    start_position, start_velocity, end_position, end_velocity = ends
    position, velocity, acceleration = motion
    half = 0.5 / (len(position) - 1)
    for j in range(position.shape[1]):
        position[0, j], velocity[0, j] = start_position[j], duration * start_velocity[j]
    for k in range(1, len(position)):
        for j in range(position.shape[1]):
            velocity[k, j] = velocity[k - 1, j] + half * (acceleration[k, j] + acceleration[k - 1, j])
            position[k, j] = position[k - 1, j] + half * (velocity[k, j] + velocity[k - 1, j])
    velocity /= duration
    acceleration /= duration**2
    # The last grid point is the boundary state itself; the sums above differ from it by rounding only.
    velocity[0], position[-1], velocity[-1] = start_velocity, end_position, end_velocity


def least_effort(problem: PhaseProblem, duration: float) -> Trajectory:
    """The minimiser of Σ|v_k|² for a given duration under the boundary states alone."""
    return _meeting_ends(problem, duration, np.zeros((3, problem.intervals + 1, problem.joints)))


def least_cost(problem: PhaseProblem, duration: float) -> float:
    """J(T) = T + (ρ/N)(c0 T⁻³ + c1 T⁻² + c2 T⁻¹), the objective of `least_effort` (s)."""
    c0, c1, c2 = _effort(*_straight(problem.intervals)[1:], _ends(problem))
    return _cost(c0, c1, c2, problem.effort_weight / problem.intervals, duration)


@njit(cache=True)
def _effort(gram_inverse: Array, shares: Array, waypoints: Array, ends: Ends) -> tuple[float, float, float]:
    """c0, c1, c2 of the least Σ|a_k|² = c0 + c1 T + c2 T² over all motions of duration T that pass the way points."""
    fixed, linear = np.empty(len(gram_inverse)), np.empty(len(gram_inverse))
    c0 = c1 = c2 = 0.0
    for j in range(ends[0].size):
        _changes(shares, waypoints, ends, j, fixed, linear)
        for row in range(fixed.size):
            by_fixed = by_linear = 0.0
            for other in range(fixed.size):
                by_fixed += gram_inverse[row, other] * fixed[other]
                by_linear += gram_inverse[row, other] * linear[other]
            c0 += fixed[row] * by_fixed
            c1 += 2.0 * linear[row] * by_fixed
            c2 += linear[row] * by_linear
    return c0, c1, c2


@njit(cache=True)
def _cost(c0: float, c1: float, c2: float, weight: float, duration: float) -> float:
    """J at a duration."""
    return duration + weight * ((c0 / duration + c1) / duration + c2) / duration


def best_duration(problem: PhaseProblem) -> float:
    """The duration within its bounds that minimises J(T).

    An end of the interval or a root of the quartic T⁴ − (ρ/N)(c2 T² + 2 c1 T + 3 c0) = 0.
    """
    return _best(problem, _STRAIGHT, _NOWHERE)[1]


def _best(problem: PhaseProblem, timetables: Timetables, waypoints: Array) -> tuple[int, float, float]:
    """The cheapest of some timetables, the duration within its bounds that minimises J(T), and J there."""
    _, gram_inverse, shares = _map(problem.intervals, timetables)
    shortest = max(problem.min_duration, min(SHORTEST_DURATION, problem.max_duration))
    weight = problem.effort_weight / problem.intervals
    return _cheapest(gram_inverse, shares, waypoints, _ends(problem), weight, shortest, problem.max_duration)


@njit(cache=True)
def _cheapest(
    gram_inverse: Array, shares: Array, waypoints: Array, ends: Ends, weight: float, shortest: float, longest: float
) -> tuple[int, float, float]:
    best, duration, least = 0, shortest, np.inf
    for s in range(len(shares)):
        c0, c1, c2 = _effort(gram_inverse[s], shares[s], waypoints, ends)
        T, cost = _minimise(c0, c1, c2, weight, shortest, longest)
        if cost < least:
            best, duration, least = s, T, cost
    return best, duration, least


@njit(cache=True)
def _minimise(c0: float, c1: float, c2: float, weight: float, shortest: float, longest: float) -> tuple[float, float]:
    """Of the ends of the interval and the roots of the quartic between them the one where J is least, and J there.

    The quartic p(T) = T⁴ − ρ/N (c2 T² + 2 c1 T + 3 c0) is monotone between neighbouring roots of its derivative, a
    cubic without quadratic term: each such stretch has one root of p at most, found by bisection to the last digit.
    """
    best, least = shortest, _cost(c0, c1, c2, weight, shortest)
    at_end = _cost(c0, c1, c2, weight, longest)
    if at_end < least:
        best, least = longest, at_end
    corners = np.full(5, shortest)
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
    return best, least


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
    nodes, waypoints = tuple(tuple(row) for row in timetables), read_only(waypoints)
    best, duration, cost = _best(problem, nodes, waypoints)
    rows, gram_inverse, shares = _map(problem.intervals, nodes)
    motion = np.zeros((3, problem.intervals + 1, problem.joints))
    _meet_ends(rows[best], gram_inverse[best], shares[best], waypoints, _ends(problem), duration, motion)
    return Trajectory.of(duration, motion), cost


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
    zero, one, motion = frozen(np.zeros(1)), frozen(np.ones(1)), np.zeros((3, intervals + 1, 1))
    _meet_ends(*_straight(intervals), (zero, zero, one, zero), 1.0, motion)
    position, rate, curvature = motion[..., 0]
    # The motion is odd about its middle; averaging with its mirror image takes the summed rounding out of both ends.
    symmetric_rate = (rate + rate[::-1]) / 2
    symmetric_position = (position + 1.0 - position[::-1]) / 2
    symmetric_rate[[0, -1]] = 0.0
    symmetric_position[[0, -1]] = 0.0, 1.0
    odd_curvature = (curvature - curvature[::-1]) / 2
    return frozen(symmetric_position), frozen(symmetric_rate), frozen(odd_curvature)
