"""Generated C code over vectors against CasADi's own evaluation, operation by operation."""

import casadi as ca
import numpy as np
import pytest

from dyngrasp.planning.collocation import code_cache, node_code
from dyngrasp.planning.collocation.code_cache import CompilationError
from dyngrasp.planning.collocation.node_functions import CompiledNodeFunctions, InterpretedNodeFunctions

pytestmark = pytest.mark.skipif(code_cache.compiler() is None, reason="no C compiler")


def every_operation(q, v, p):
    x, y, z = q[0], v[0], p[0]
    return ca.vertcat(
        x + y * z - x / (2 + y**2),
        -x + ca.sqrt(1 + x**2) + ca.exp(y) + ca.log(3 + x) + 1 / (3 + x),
        ca.sin(x) * ca.cos(y) + ca.tan(x / 2),
        ca.asin(x / 3) + ca.acos(y / 3) + ca.atan(z),
        ca.sinh(x) + ca.cosh(y) + ca.tanh(z),
        ca.fabs(x) + ca.sign(y) * z,
        ca.atan2(x, 2 + y) + ca.hypot(x, 1 + y**2),
        (3 + x) ** 1.7 + (3 + x) ** y,
        ca.fmin(x, y) + ca.fmax(y, z),
        ca.if_else(x < y, x * z, y**3),
        ca.if_else(ca.logic_and(x <= y, z > 0), 1.0, x),
        ca.log1p(x**2) + ca.expm1(y) + 2 * x,
        ca.SX(4.25),
    )


@pytest.mark.parametrize("points", [1, 7, 8, 9, 40])
def test_every_operation_on_full_and_partial_groups(points):
    symbols = [ca.SX.sym(name, 2) for name in "qvp"]
    function = ca.Function("all", symbols, [every_operation(*symbols)])
    random = np.random.default_rng(points)
    q, v, p = (random.uniform(-1.5, 1.5, (points, 2)) for _ in range(3))
    rows = function.size1_out(0)
    weights = random.normal(size=(points, rows))
    found = []
    for functions in (CompiledNodeFunctions(function, "all"), InterpretedNodeFunctions(function)):
        values, g = np.empty((points, rows)), np.empty((points, rows))
        jacobian, hessian = np.full((points, rows, 4), 3.0), np.zeros((points, 4, 4))
        functions.values(q, v, p, values, 0)
        functions.derivatives(q, v, p, weights, g, jacobian, hessian, 0)
        found.append((values, g, jacobian, hessian))
    for fast, slow in zip(*found, strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-12, atol=1e-12)


def test_rows_that_depend_on_nothing():
    symbols = [ca.SX.sym(name, n) for name, n in (("q", 2), ("v", 2), ("p", 0))]
    function = ca.Function("constant", symbols, [ca.SX(1.5)])
    functions = CompiledNodeFunctions(function, "constant")
    g, jacobian, hessian = np.empty((3, 1)), np.ones((3, 1, 4)), np.zeros((3, 4, 4))
    functions.derivatives(np.ones((3, 2)), np.ones((3, 2)), np.empty((3, 0)), np.ones((3, 1)), g, jacobian, hessian, 0)
    assert (g == 1.5).all()
    assert (jacobian == 0.0).all()
    assert (hessian == 0.0).all()


def test_an_operation_without_counterpart_is_refused():
    x = ca.SX.sym("x")
    with pytest.raises(CompilationError, match="not known"):
        node_code.kernel(ca.Function("f", [x], [ca.erf(x)]), "f")
