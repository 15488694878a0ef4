"""Rows of a `NodeConstraint`, their Jacobian and the Hessian of their weighted sum at all grid points, compiled.

The derivatives are taken symbolically of one grid point; the C code that CasADi makes of them is compiled once for
each arm and row and runs over the grid in a loop. Without a C compiler CasADi's virtual machine evaluates the same
expressions.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from functools import partial
from typing import Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from dyngrasp.planning.collocation import code_cache
from dyngrasp.planning.collocation.node_code import HEADER, kernel
from dyngrasp.planning.problem import NodeConstraint
from dyngrasp.signals import Array

_log = logging.getLogger(__name__)


Evaluation = Callable[[], object]


class NodeFunctions(Protocol):
    """Evaluation of one kind of row over a grid of K points; `columns` places m rows among those of other constraints.

    Attributes:
        rows: m.
        depends_on_acceleration: (m,) whether a row depends on v at all.
    """

    rows: int
    depends_on_acceleration: NDArray[np.bool_]

    def values(self, q: Array, v: Array, p: Array, g: Array, column: int) -> None:
        """Write g (K, total) in columns `column` to `column + m`.

        Args:
            q: (K, n) positions, contiguous.
            v: (K, n) accelerations, contiguous.
            p: (K, n_p) parameters.
            g: (K, total) rows of all constraints.
            column: Where the rows of this one begin.
        """
        ...

    def derivatives(
        self, q: Array, v: Array, p: Array, weights: Array, g: Array, jacobian: Array, hessian: Array, column: int
    ) -> None:
        """Write values and Jacobian, add the Hessian of Σ weights · g by (q, v).

        Args:
            q: As for `values`, and so are the next two.
            v: (K, n)
            p: (K, n_p)
            weights: (total, P), P being K padded to full vectors (`work_arrays`).
            g: (K, total), written in the same columns.
            jacobian: (total, 2n, P), written in the rows from `column` on.
            hessian: (2n, 2n, P), added to.
            column: As for `values`.
        """
        ...

    def bound(
        self, q: Array, v: Array, p: Array, weights: Array, g: Array, jacobian: Array, hessian: Array, column: int
    ) -> tuple[Evaluation, Evaluation]:
        """`values` and `derivatives` on arrays that outlive the answer: to call again and again at no further cost."""
        ...


def node_functions(constraint: NodeConstraint) -> NodeFunctions:
    """The fastest evaluation that this machine offers; made once for each function of a process."""
    function = constraint.function
    command = code_cache.compiler()
    key = (function.__hash__(), command)
    if key not in _made:
        made: NodeFunctions
        try:
            made = CompiledNodeFunctions(function, constraint.name)
        except code_cache.CompilationError as error:
            _log.warning("%s of the planner run in CasADi's virtual machine, slower: %s", constraint.name, error)
            made = InterpretedNodeFunctions(function)
        # A hash is only good as long as the function that it names is alive, hence the function beside it.
        _made[key] = (function, made)
    return _made[key][1]


_made: dict[tuple, tuple[ca.Function, NodeFunctions]] = {}


def _expressions(function: ca.Function) -> tuple[ca.Function, ca.Function, NDArray[np.bool_]]:
    """(q, v, p) → g and (q, v, p, weights) → g, Jacobian, Hessian, and which rows depend on v.

    CasADi stores columns; a matrix that shall lie in rows is handed out transposed.
    """
    n, m = function.size1_in(0), function.size1_out(0)
    q, v, p = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("p", function.size1_in(2))
    weights = ca.SX.sym("weights", m)
    u = ca.vertcat(q, v)
    g = ca.densify(function(q, v, p))
    jacobian = ca.jacobian(g, u)
    options = {"cse": True}
    values = ca.Function("values", [q, v, p], [g], options)
    # A triangle of the Hessian, column by column, or all columns at once: which is shorter depends on the rows.
    hessian, gradient = ca.hessian(ca.dot(weights, g), u)
    columns = [ca.vertcat(ca.SX(j, 1), ca.jacobian(gradient[j:], u[j])) for j in range(2 * n)]
    derivatives = min(
        (
            ca.Function("derivatives", [q, v, p, weights], [g, jacobian.T, second], options)
            for second in (hessian, ca.tril2symm(ca.horzcat(*columns)))
        ),
        key=ca.Function.n_instructions,
    )
    by_acceleration = np.array(ca.DM(function.jac_sparsity(0, 1), 1.0)).reshape(m, n)
    return values, derivatives, np.any(by_acceleration != 0, axis=1)


class InterpretedNodeFunctions:
    """CasADi's virtual machine, one call for the whole grid."""

    def __init__(self, function: ca.Function) -> None:
        self._values, self._derivatives, self.depends_on_acceleration = _expressions(function)
        self.rows = function.size1_out(0)
        self._maps: dict[int, tuple[ca.Function, ca.Function]] = {}

    def _over(self, points: int) -> tuple[ca.Function, ca.Function]:
        if points not in self._maps:
            self._maps[points] = self._values.map(points), self._derivatives.map(points)
        return self._maps[points]

    def values(self, q: Array, v: Array, p: Array, g: Array, column: int) -> None:
        """See `NodeFunctions`."""
        g[:, column : column + self.rows] = self._over(len(q))[0](q.T, v.T, p.T).full().T

    def derivatives(
        self, q: Array, v: Array, p: Array, weights: Array, g: Array, jacobian: Array, hessian: Array, column: int
    ) -> None:
        """See `NodeFunctions`."""
        K, n = q.shape
        here = slice(column, column + self.rows)
        values, rows, curvature = self._over(K)[1](q.T, v.T, p.T, weights[here, :K])
        g[:, here] = values.full().T
        # The map sets K matrices side by side; each column of one is a row of the transpose.
        jacobian[here, :, :K] = np.moveaxis(rows.full().T.reshape(K, self.rows, 2 * n), 0, -1)
        hessian[:, :, :K] += np.moveaxis(curvature.full().T.reshape(K, 2 * n, 2 * n), 0, -1)

    def bound(
        self, q: Array, v: Array, p: Array, weights: Array, g: Array, jacobian: Array, hessian: Array, column: int
    ) -> tuple[Evaluation, Evaluation]:
        """See `NodeFunctions`."""
        return (
            partial(self.values, q, v, p, g, column),
            partial(self.derivatives, q, v, p, weights, g, jacobian, hessian, column),
        )


class CompiledNodeFunctions:
    """Machine code from the cache.

    Raises:
        CompilationError: There is no compiler, or it failed.
    """

    def __init__(self, function: ca.Function, name: str) -> None:
        values, derivatives, self.depends_on_acceleration = _expressions(function)
        self.rows = function.size1_out(0)
        library = code_cache.load(
            _source(values, derivatives), f"node functions '{name}' of an arm of {function.size1_in(0)} joints"
        )
        pointer, number = ctypes.c_void_p, ctypes.c_longlong
        self._values, self._derivatives = library.values_over_grid, library.derivatives_over_grid
        self._values.argtypes = [number] + 4 * [pointer] + [number]
        self._derivatives.argtypes = [number] + 7 * [pointer] + [number]
        self._values.restype = self._derivatives.restype = None

    def values(self, q: Array, v: Array, p: Array, g: Array, column: int) -> None:
        """See `NodeFunctions`."""
        rows, total = g.ctypes.data + 8 * column, g.shape[1]
        self._values(len(q), q.ctypes.data, v.ctypes.data, p.ctypes.data, rows, total)

    def derivatives(
        self, q: Array, v: Array, p: Array, weights: Array, g: Array, jacobian: Array, hessian: Array, column: int
    ) -> None:
        """See `NodeFunctions`."""
        self.bound(q, v, p, weights, g, jacobian, hessian, column)[1]()

    def bound(
        self, q: Array, v: Array, p: Array, weights: Array, g: Array, jacobian: Array, hessian: Array, column: int
    ) -> tuple[Evaluation, Evaluation]:
        """See `NodeFunctions`."""
        points, total = len(q), g.shape[1]
        here, rows = (q.ctypes.data, v.ctypes.data, p.ctypes.data), g.ctypes.data + g.itemsize * column
        by_rows = (weights.ctypes.data + column * weights.strides[0], rows)
        by_rows += (jacobian.ctypes.data + column * jacobian.strides[0], hessian.ctypes.data)
        return partial(self._values, points, *here, rows, total), partial(
            self._derivatives, points, *here, *by_rows, total
        )


# A group of grid points is gathered into vectors and evaluated. The last group may be smaller, its idle lanes repeat
# the last grid point; arrays whose last axis are the grid points have room for them.
_LOOPS = """
#define GATHER(at, source, size) \\
  for (int i = 0; i < (size); ++i) \\
    for (int l = 0; l < LANES; ++l) in[(at) + i][l] = (source)[(k + (l < lanes ? l : lanes - 1)) * (size) + i];

void values_over_grid(count points, const double* q, const double* v, const double* p, double* g, count total) {{
  real in[{inputs}], out[{rows}];
  for (count k = 0; k < points; k += LANES) {{
    const count lanes = points - k < LANES ? points - k : LANES;
    GATHER(0, q, {n}) GATHER({n}, v, {n}) GATHER({twice}, p, {n_p})
    values(in, out);
    for (count l = 0; l < lanes; ++l)
      for (int i = 0; i < {rows}; ++i) g[(k + l) * total + i] = out[i][l];
  }}
}}

static const short jacobian_at[] = {{{jacobian_at}}}, curvature_at[] = {{{curvature_at}}};

void derivatives_over_grid(count points, const double* q, const double* v, const double* p, const double* weights,
                           double* g, double* jacobian, double* hessian, count total) {{
  const count room = (points + LANES - 1) / LANES * LANES;
  const run none = {{0}};
  real in[{inputs} + {rows}], out[{outputs}];
  for (count k = 0; k < points; k += LANES) {{
    const count lanes = points - k < LANES ? points - k : LANES;
    GATHER(0, q, {n}) GATHER({n}, v, {n}) GATHER({twice}, p, {n_p})
    for (int i = 0; i < {rows}; ++i) in[{inputs} + i] = *(const run*)(weights + i * room + k);
    derivatives(in, out);
    for (count l = 0; l < lanes; ++l)
      for (int i = 0; i < {rows}; ++i) g[(k + l) * total + i] = out[i][l];
    for (int i = 0; i < {rows} * {twice}; ++i) *(run*)(jacobian + i * room + k) = none;
    for (int i = 0; i < {in_jacobian}; ++i) *(run*)(jacobian + jacobian_at[i] * room + k) = out[{rows} + i];
    for (int i = 0; i < {in_curvature}; ++i)
      *(run*)(hessian + curvature_at[i] * room + k) += out[{rows} + {in_jacobian} + i];
  }}
}}
"""


def _source(values: ca.Function, derivatives: ca.Function) -> str:
    n, n_p, rows = values.size1_in(0), values.size1_in(2), values.size1_out(0)
    # Nonzeros by columns; the first output is written transposed, so both orders are that of rows in memory.
    places = []
    for output in (1, 2):
        row, column = derivatives.sparsity_out(output).get_triplet()
        places.append([c * 2 * n + r for r, c in zip(row, column, strict=True)])
    numbers = {
        "n": n,
        "twice": 2 * n,
        "n_p": n_p,
        "rows": rows,
        "inputs": 2 * n + n_p,
        "outputs": rows + len(places[0]) + len(places[1]),
        "in_jacobian": len(places[0]),
        "in_curvature": len(places[1]),
        # A list of none is no C; the entry is never read.
        "jacobian_at": ", ".join(map(str, places[0] or [0])),
        "curvature_at": ", ".join(map(str, places[1] or [0])),
    }
    kernels = kernel(values, "values") + kernel(derivatives, "derivatives")
    return HEADER + kernels + _LOOPS.format(**numbers)
