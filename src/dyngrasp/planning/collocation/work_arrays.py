"""Memory of one problem structure as one argument: what the compiled functions of an iteration read and write."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from dyngrasp.signals import Array

LANES = 8
"""Numbers in the widest vectors of today's processors; runs of memory that are worked on at once are multiples."""


def padded(size: int) -> int:
    """The least multiple of `LANES` that is not below size."""
    return -(-size // LANES) * LANES


class WorkArrays(NamedTuple):
    """Arrays of one problem structure, used again by every problem that shares it.

    K = N + 1 grid points, n joints, m rows c of the constraints at a grid point; P and W are K and n padded. Where P is
    the last axis one operation serves all grid points; what stands there past the last grid point means nothing.

    Attributes:
        z: (3, K, n) q, w, a at the present point.
        v: (K, n) a / T².
        c: (K, m) rows of the constraints there.
        weights: (m, P) factors of c in Σ λ g.
        jacobian: (m, 2n, P) derivatives of c by (q, v).
        hessian: (2n, 2n, P) second derivatives of Σ weights · c by (q, v).
        blocks: (3, n, n, P) what the Newton matrix is of q, a in the space of every grid point; see `newton_matrix`.
        band: (K, n, 3W) of the Newton matrix or of its Cholesky factor; layout as in `banded`.
        border: (K, W) column of T of the same, or last row of the factor.
        x: (K, W) a right-hand side, or its solution.
        dz: (3, K, n) step of q, w, a.
    """

    z: Array
    v: Array
    c: Array
    weights: Array
    jacobian: Array
    hessian: Array
    blocks: Array
    band: Array
    border: Array
    x: Array
    dz: Array

    @classmethod
    def of(cls, points: int, joints: int, constraint_rows: int) -> WorkArrays:
        """Zeros of the shapes that K, n and m ask for."""
        K, n, m = points, joints, constraint_rows
        P, W = padded(K), padded(n)
        return cls(
            z=np.zeros((3, K, n)),
            v=np.zeros((K, n)),
            c=np.zeros((K, m)),
            weights=np.zeros((m, P)),
            jacobian=np.zeros((m, 2 * n, P)),
            hessian=np.zeros((2 * n, 2 * n, P)),
            blocks=np.zeros((3, n, n, P)),
            band=np.zeros((K, n, 3 * W)),
            border=np.zeros((K, W)),
            x=np.zeros((K, W)),
            dz=np.zeros((3, K, n)),
        )
