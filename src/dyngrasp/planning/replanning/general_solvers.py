"""General solvers on the online program, each set up once and its numbers updated for every call."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from dyngrasp.errors import UnknownName
from dyngrasp.planning.replanning.lcqp import SparseProgram
from dyngrasp.signals import Array

Solve = Callable[[SparseProgram], tuple[Array, float]]
"""A program in, its minimiser and the wall time of update and solution (ms) out."""


def solver_of(name: str) -> Solve | None:
    """A solver by name; None if its package is not installed.

    Raises:
        UnknownName: There is none of that name.
    """
    if name not in SOLVERS:
        raise UnknownName("solver", name, list(SOLVERS))
    package, make = SOLVERS[name]
    try:
        version(package)
    except PackageNotFoundError:
        return None
    return make()


def _split(program: SparseProgram) -> tuple[Any, Array, Any, Array, Array]:
    """Equalities and the box: for solvers that treat both apart."""
    rows = program.rows - program.variables
    lower, upper = program.lower[rows:], program.upper[rows:]
    return sp.csc_matrix(program.E[:rows]), program.lower[:rows], sp.csc_matrix(program.P), lower, upper


class _Piqp:
    """PIQP with exploitation of the stages left to its sparse factorisation."""

    def __init__(self, kkt_solver: str) -> None:
        self._piqp = importlib.import_module("piqp")
        self._kkt_solver = kkt_solver
        self._solver: Any = None

    def __call__(self, program: SparseProgram) -> tuple[Array, float]:
        A, b, P, lower, upper = _split(program)
        c = np.zeros(program.variables)
        none = sp.csc_matrix((0, program.variables))
        if self._solver is None:
            self._solver = self._piqp.SparseSolver()
            settings = self._solver.settings
            settings.eps_abs, settings.eps_rel = 1e-9, 1e-9
            settings.kkt_solver = getattr(self._piqp.KKTSolver, self._kkt_solver)
            self._solver.setup(P, c, A, b, none, None, None, lower, upper)
            self._solver.solve()
        began = time.perf_counter()
        self._solver.update(A=A, b=b, x_l=lower, x_u=upper)
        self._solver.solve()
        elapsed = 1e3 * (time.perf_counter() - began)
        if self._solver.result.info.status != self._piqp.PIQP_SOLVED:
            return np.full(c.size, np.nan), elapsed
        return np.array(self._solver.result.x), elapsed


class _Osqp:
    def __init__(self) -> None:
        self._osqp = importlib.import_module("osqp")
        self._solver: Any = None

    def __call__(self, program: SparseProgram) -> tuple[Array, float]:
        E = sp.csc_matrix(program.E)
        E.sort_indices()
        if self._solver is None:
            self._solver = self._osqp.OSQP()
            self._solver.setup(
                P=sp.triu(sp.csc_matrix(program.P), format="csc"),
                q=np.zeros(program.variables),
                A=E,
                l=program.lower,
                u=program.upper,
                verbose=False,
                eps_abs=1e-9,
                eps_rel=1e-9,
                max_iter=100_000,
                polishing=True,
            )
            self._solver.solve(raise_error=False)
        began = time.perf_counter()
        self._solver.update(Ax=E.data, l=program.lower, u=program.upper)
        result = self._solver.solve(raise_error=False)
        return np.array(result.x, dtype=float), 1e3 * (time.perf_counter() - began)


class _Clarabel:
    """Clarabel takes one-sided rows in cones; infinite bounds are left out."""

    def __init__(self) -> None:
        self._clarabel = importlib.import_module("clarabel")

    def __call__(self, program: SparseProgram) -> tuple[Array, float]:
        clarabel = self._clarabel
        E, lower, upper = sp.csr_matrix(program.E), program.lower, program.upper
        equal = lower == upper
        above, below = ~equal & np.isfinite(upper), ~equal & np.isfinite(lower)
        A = sp.vstack([E[equal], E[above], -E[below]]).tocsc()
        b = np.concatenate([upper[equal], upper[above], -lower[below]])
        cones = [clarabel.ZeroConeT(int(equal.sum())), clarabel.NonnegativeConeT(int(above.sum() + below.sum()))]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-9
        began = time.perf_counter()
        solver = clarabel.DefaultSolver(sp.csc_matrix(program.P), np.zeros(program.variables), A, b, cones, settings)
        x = np.array(solver.solve().x)
        return x, 1e3 * (time.perf_counter() - began)


class _Ipopt:
    """IPOPT, what the paper uses, through CasADi."""

    def __init__(self) -> None:
        self._solver: Any = None

    def __call__(self, program: SparseProgram) -> tuple[Array, float]:
        H, A = ca.DM(sp.csc_matrix(program.P)), ca.DM(sp.csc_matrix(program.E))
        if self._solver is None:
            options = {
                "nlpsol": "ipopt",
                "nlpsol_options": {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9}},
            }
            self._solver = ca.conic("program", "nlpsol", {"h": H.sparsity(), "a": A.sparsity()}, options)
        began = time.perf_counter()
        answer = self._solver(h=H, g=ca.DM.zeros(H.shape[0]), a=A, lba=program.lower, uba=program.upper)
        return np.array(answer["x"]).ravel(), 1e3 * (time.perf_counter() - began)


SOLVERS: dict[str, tuple[str, Callable[[], Solve]]] = {
    "ipopt": ("casadi", _Ipopt),
    "osqp": ("osqp", _Osqp),
    "piqp": ("piqp", lambda: _Piqp("sparse_ldlt")),
    "piqp_multistage": ("piqp", lambda: _Piqp("sparse_multistage")),
    "clarabel": ("clarabel", _Clarabel),
}
"""Package and maker of each solver to compare with."""
