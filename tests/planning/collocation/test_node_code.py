"""Generated C code over vectors against CasADi's own evaluation, operation by operation."""

import casadi as ca
import numpy as np
import pytest

from dyngrasp.planning.collocation import code_cache, node_code
from dyngrasp.planning.collocation.code_cache import CompilationError
from dyngrasp.planning.collocation.node_functions import CompiledNodeFunctions, InterpretedNodeFunctions
from dyngrasp.planning.collocation.work_arrays import padded

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
    room = padded(points)
    weights = random.normal(size=(rows, room))
    found = []
    for functions in (CompiledNodeFunctions(function, "all"), InterpretedNodeFunctions(function)):
        values, g = np.empty((points, rows)), np.empty((points, rows))
        jacobian, hessian = np.full((rows, 4, room), 3.0), np.zeros((4, 4, room))
        functions.values(q, v, p, values, 0)
        functions.derivatives(q, v, p, weights, g, jacobian, hessian, 0)
        found.append((values, g, jacobian[:, :, :points], hessian[:, :, :points]))
    for fast, slow in zip(*found, strict=True):
        np.testing.assert_allclose(fast, slow, rtol=1e-12, atol=1e-12)


def test_rows_that_depend_on_nothing():
    symbols = [ca.SX.sym(name, n) for name, n in (("q", 2), ("v", 2), ("p", 0))]
    function = ca.Function("constant", symbols, [ca.SX(1.5)])
    functions = CompiledNodeFunctions(function, "constant")
    g, jacobian, hessian = np.empty((3, 1)), np.ones((1, 4, padded(3))), np.zeros((4, 4, padded(3)))
    weights = np.ones((1, padded(3)))
    functions.derivatives(np.ones((3, 2)), np.ones((3, 2)), np.empty((3, 0)), weights, g, jacobian, hessian, 0)
    assert (g == 1.5).all()
    assert (jacobian == 0.0).all()
    assert (hessian == 0.0).all()


def test_an_operation_without_counterpart_is_refused():
    x = ca.SX.sym("x")
    with pytest.raises(CompilationError, match="not known"):
        node_code.kernel(ca.Function("f", [x], [ca.erf(x)]), "f")


def test_sine_and_cosine_are_exact_to_the_last_digits():
    random = np.random.default_rng(0)
    ordinary = random.uniform(-10, 10, 4000)
    # Where a sine is nearly zero, and where 20 bits of quarter turns end.
    close = np.arange(-2000, 2000) * (np.pi / 2) + random.choice([0.0, 1e-15, 1e-9, -1e-5], 4000)
    long = np.power(10.0, random.uniform(-12, 9, 4000)) * random.choice([-1.0, 1.0], 4000)
    edges = np.array([0.0, 2.0**20, np.nextafter(2.0**20, np.inf), -(2.0**20), np.pi / 4, np.nan, np.inf, -np.inf])
    x = np.concatenate([ordinary, close, long, edges]).astype(float)
    symbols = [ca.SX.sym("q", 1), ca.SX.sym("v", 1), ca.SX.sym("p", 0)]
    function = ca.Function("turn", symbols, [ca.vertcat(ca.sin(symbols[0]), ca.cos(symbols[0]))])
    g = np.empty((x.size, 2))
    CompiledNodeFunctions(function, "turn").values(x[:, None], np.zeros((x.size, 1)), np.empty((x.size, 0)), g, 0)
    with np.errstate(invalid="ignore"):
        expected = np.stack([np.sin(x), np.cos(x)], axis=1)
    # One unit in the last place from the series, half a unit from rounding, half a unit from the library.
    np.testing.assert_allclose(g, expected, rtol=2 * float(np.finfo(float).eps), atol=0.0)
