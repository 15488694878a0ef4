"""The interior point method for the joints that it is about.

Joints meet in T alone. Without rows a joint is at its minimum for whatever T there is: it follows T along a line that
the free optimum has told already, and what that costs belongs to the curvature of T. With some twenty active rows two
joints of seven are left to be iterated on.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from dyngrasp.planning.replanning.interior_point import interior_point
from dyngrasp.planning.replanning.joint_splines import Indices, product
from dyngrasp.signals import Array


@njit(cache=True, error_model="numpy")
def solve_joints_with_rows(
    codes: Indices,
    rows: int,
    a_ends: tuple[bool, bool],
    first: Indices,
    taps: Array,
    base: Array,
    base_column: Array,
    along_T: Array,
    corner: float,
    g_T: float,
    slope: Array,
    along_T_z: Array,
    x: Array,
    T: float,
    T_lin: float,
    z: Array,
    boxes: Array,
    rates: Array,
    duration: tuple[float, float],
    free_T: bool,
    unit: float,
    violation: float,
    max_iterations: int,
    multipliers: Array,
) -> tuple[int, float, int, int]:
    """`interior_point` on the joints that the codes name, from a point that minimises the cost without rows.

    Args:
        codes: See `interior_point`.
        rows: See there.
        a_ends: See there.
        first: See there.
        taps: See there.
        base: (N−1, 3) bands of the Hessian of the cost, the same for all joints.
        base_column: See there.
        along_T: (N−1, n) change of the unknowns with T that keeps the gradient zero.
        corner: See there.
        g_T: See there.
        slope: See there.
        along_T_z: (3, K, n) what q, w, a do then.
        x: (N−1, n) unknowns, overwritten.
        T: See `interior_point`.
        T_lin: See there.
        z: See there.
        boxes: See there.
        rates: See there.
        duration: See there.
        free_T: See there.
        unit: See there.
        violation: See there.
        max_iterations: See there.
        multipliers: See there.

    Returns:
        Outcome, T, iterations, number of rows in the end.
    """
    _, K, n = z.shape
    place = np.full(n, -1)
    for i in range(rows):
        place[codes[i] % n] = 0
    joints = np.flatnonzero(place == 0)
    place[joints] = np.arange(joints.size)
    bands = np.empty((K - 2, 3, joints.size))
    for i in range(K - 2):
        for d in range(3):
            bands[i, d] = base[i, d]
    for j in range(n):
        if free_T and place[j] < 0:
            corner += product(base_column[:, j], along_T[:, j])
    for i in range(rows):
        codes[i] = codes[i] // n * joints.size + place[codes[i] % n]
    some_x, some_z = x[:, joints], z[:, :, joints]
    outcome, T_new, iterations, rows = interior_point(
        codes, rows, a_ends, first, taps, bands, base_column[:, joints], corner, g_T, slope[:, :, joints], some_x, T,
        T_lin, some_z, boxes[:, joints], rates[:, :, joints], duration, free_T, unit, violation, max_iterations,
        multipliers,
    )  # fmt: skip
    for i in range(rows):
        codes[i] = codes[i] // joints.size * n + joints[codes[i] % joints.size]
    if free_T:
        x += (T_new - T) * along_T
        z += (T_new - T) * along_T_z
    x[:, joints], z[:, :, joints] = some_x, some_z
    return outcome, T_new, iterations, rows
