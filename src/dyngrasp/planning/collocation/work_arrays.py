"""Memory of one problem structure as one argument: what the compiled functions of an iteration read and write."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dyngrasp.signals import Array


class WorkArrays(NamedTuple):
    """Arrays of one problem structure, used again by every problem that shares it.

    K = N + 1 grid points, n joints, m rows c of the constraints at a grid point.

    Attributes:
        z: (3, K, n) q, w, a at the present point.
        v: (K, n) a / T².
        c: (K, m) rows of the constraints there.
        weights: (K, m) factors of c in Σ λ g.
        jacobian: (K, m, 2n) derivatives of c by (q, v).
        hessian: (K, 2n, 2n) second derivatives of Σ weights · c by (q, v).
        band: ((K−2) n, 3n) of the Newton matrix or of its Cholesky factor; layout as in `banded`.
        solved_column: ((K−2) n,) the band's inverse times the column of T.
        dz: (3, K, n) step of q, w, a.
    """

    z: Array
    v: Array
    c: Array
    weights: Array
    jacobian: Array
    hessian: Array
    band: Array
    solved_column: Array
    dz: Array

    @classmethod
    def of(cls, points: int, joints: int, constraint_rows: int) -> WorkArrays:
        """Zeros of the shapes that K, n and m ask for."""
        K, n, m = points, joints, constraint_rows
        unknowns = (K - 2) * n
        return cls(
            z=np.zeros((3, K, n)),
            v=np.zeros((K, n)),
            c=np.zeros((K, m)),
            weights=np.zeros((K, m)),
            jacobian=np.zeros((K, m, 2 * n)),
            hessian=np.zeros((K, 2 * n, 2 * n)),
            band=np.zeros((unknowns, 3 * n)),
            solved_column=np.zeros(unknowns),
            dz=np.zeros((3, K, n)),
        )
