"""The end of the interior point method: once it shows which rows are active, the rest is a system of equations.

A guess of the active rows turns the program into equations. What they say corrects the guess: a row whose multiplier is
negative leaves, one that is violated comes in. When neither happens the equations are the optimality conditions, met to
rounding. Hintermüller, Ito, Kunisch, "The primal-dual active set strategy as a semismooth Newton method", SIAM J.
Optim. 13 (2002). Nothing says that this must end where the guess is poor; then the interior point method goes on.

The equations are solved by the method of multipliers with so high a penalty that few rounds leave nothing: the matrix
keeps the bands of the cost.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from dyngrasp.planning.replanning.joint_splines import (
    TAPS,
    Indices,
    factorise,
    product,
    spread_band,
    substitute,
    substitute_both,
    subtract,
    write,
)
from dyngrasp.signals import Array

Flags = NDArray[np.bool_]

# Active rows are meant to vanish to within the first of their half-width, and no row may be below minus the second.
_EXACT, _VIOLATION = 1e-12, 1e-11

# Rounds of the method of multipliers.
_POLISHES = 4


@njit(cache=True, error_model="numpy")
def newton_matrix(
    omega: Array,
    used: int,
    at: Indices,
    along: Array,
    cs: Array,
    base: Array,
    base_column: Array,
    corner: float,
    band: Array,
    column: Array,
) -> float:
    """Write the bands (N−1, 3, W) and the column of T (N−1, W) of ∇²f + Gᵀ Ω G; return the corner of T.

    Rows and the derivatives of the cost are those of `interior_point`.
    """
    _, width = column.shape
    spread_band(base, band)
    write(1.0, base_column, column)
    flat_band, flat_column = band.ravel(), column.ravel()
    for i in range(used):
        if omega[i] > 0.0:
            corner += omega[i] * cs[i] * cs[i]
            # The same place in an array of three numbers an unknown: (f, 0, j) instead of (f, j).
            in_band = 3 * at[i] - 2 * (at[i] % width)
            for b in range(TAPS):
                weight = omega[i] * along[i, b]
                flat_column[at[i] + b * width] += cs[i] * weight
                for d in range(TAPS - b):
                    flat_band[in_band + (3 * b + d) * width] += weight * along[i, b + d]
    return corner


@njit(cache=True, error_model="numpy")
def bordered_step(
    first: bool,
    free_T: bool,
    band: Array,
    column: Array,
    complement: float,
    solved: Array,
    step: Array,
    step_T: float,
) -> tuple[float, float]:
    """Solve a Newton matrix, its band factorised, for a right-hand side: (N−1, W) in `step`, overwritten, and `step_T`.

    Args:
        first: Whether it is the first one of this matrix.
        free_T: Whether T is a variable.
        band: Its factors.
        column: (N−1, W) by the unknowns and T.
        complement: The last diagonal element; once the first is solved, what this returned then.
        solved: (N−1, W) the column times the inverse of the band, written by the first.
        step: The right-hand side.
        step_T: That of T.

    Returns:
        The Schur complement of the band, and the step of T.
    """
    if not free_T:
        substitute(band, step)
        return complement, 0.0
    if first:
        write(1.0, column, solved)
        substitute_both(band, solved, step)
        complement -= product(column, solved)
    else:
        substitute(band, step)
    step_T = (step_T - product(column, step)) / complement
    subtract(step_T, solved, step)
    return complement, step_T


@njit(cache=True, error_model="numpy")
def finish(
    rounds: int,
    penalty: float,
    used: int,
    at: Indices,
    along: Array,
    cs: Array,
    g: Array,
    lam: Array,
    active: Flags,
    residual: Array,
    residual_T: float,
    base: Array,
    base_column: Array,
    corner: float,
    free_T: bool,
    band: Array,
    column: Array,
    solved: Array,
    step: Array,
    omega: Array,
) -> tuple[bool, float]:
    """The step to the optimum over the rows of a point that is near it.

    Args:
        rounds: Guesses at most.
        penalty: Of a row that is active.
        used: How many rows there are; what they are made of is told in `interior_point`.
        at: See there.
        along: See there.
        cs: See there.
        g: Values of the rows.
        lam: Their multipliers, overwritten by those of the optimum if it is found.
        active: Which rows are thought to be active, overwritten.
        residual: (N−1, W) ∇f − Gᵀ λ.
        residual_T: The same by T.
        base: See `interior_point`.
        base_column: See there.
        corner: See there.
        free_T: Whether T is a variable.
        band: (N−1, 3, W), overwritten.
        column: (N−1, W), overwritten.
        solved: (N−1, W), overwritten.
        step: (N−1, W), overwritten by the step of the unknowns.
        omega: As many as rows, overwritten.

    Returns:
        Whether the optimum was found, and the step of T.
    """
    width = step.shape[1]
    flat_step = step.ravel()
    new = lam[:used].copy()
    for _ in range(rounds):
        for i in range(used):
            omega[i] = penalty if active[i] else 0.0
            new[i] = new[i] if active[i] else 0.0
        complement = newton_matrix(omega, used, at, along, cs, base, base_column, corner, band, column)
        factorise(band)
        worst, changed = 0.0, False
        for polish in range(_POLISHES):
            write(-1.0, residual, step)
            step_T = -residual_T
            for i in range(used):
                y = new[i] - lam[i] - omega[i] * g[i]
                step_T += y * cs[i]
                for b in range(TAPS):
                    flat_step[at[i] + b * width] += y * along[i, b]
            complement, step_T = bordered_step(polish == 0, free_T, band, column, complement, solved, step, step_T)
            worst = 0.0
            for i in range(used):
                value = g[i] + cs[i] * step_T
                for b in range(TAPS):
                    value += along[i, b] * flat_step[at[i] + b * width]
                if active[i]:
                    new[i] -= penalty * value
                    worst = max(worst, abs(value))
                    if polish == 0 and new[i] < 0.0:
                        active[i], changed = False, True
                elif polish == 0 and value < -_VIOLATION:
                    active[i], changed = True, True
            if changed or worst < _EXACT:
                break
        if not changed:
            if worst < _VIOLATION:
                lam[:used] = new
            return worst < _VIOLATION, step_T
    return False, 0.0
