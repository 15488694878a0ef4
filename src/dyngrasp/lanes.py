"""Eight numbers side by side as one value of compiled code.

Seven joints do the same things. As rows of an array, whose length is known only when the program runs, they go through
memory from grid point to grid point, and a recurrence waits for what it has just written. As one value they stay in a
vector register, and a step of it takes as long as its chain of arithmetic. The same holds for eight samples of a
motion, of which each goes through a chain of links.

Rows of joints that are worked on have W numbers, the next multiple of eight, with zeros behind the joints: nothing here
looks where an array ends. Rows of n numbers are read with zeros behind them, and written without.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import reduce
from typing import Any

from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from dyngrasp.signals import Array

LANES = 8

_INDEX, _FLAGS = ir.IntType(64), ir.IntType(1)
_VECTOR, _MASK = ir.VectorType(ir.DoubleType(), LANES), ir.VectorType(_FLAGS, LANES)
_ALIGNMENT = ir.Constant(ir.IntType(32), 8)


def _compiled(define: Callable[..., Any]) -> Any:
    """`intrinsic`, for whose callers the first parameter does not exist."""
    return intrinsic(define)


class LanesType(types.Type):
    """Of eight float64."""

    def __init__(self) -> None:
        super().__init__("Lanes")


LANES_TYPE = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, _VECTOR)


def _splat(builder: Any, scalar: Any) -> Any:
    """Instructions for a vector of one number eight times."""
    nothing = ir.Constant(ir.VectorType(scalar.type, LANES), ir.Undefined)
    first = builder.insert_element(nothing, scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, nothing, ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES))


def _place(context: Any, builder: Any, array_type: Any, array: Any, at: Any, count: Any) -> tuple[Any, Any]:
    """Instructions for the address of some numbers of a flat array and the mask of the lanes that they fill."""
    data = context.make_array(array_type)(context, builder, array).data
    lanes = ir.Constant(ir.VectorType(_INDEX, LANES), list(range(LANES)))
    mask = builder.icmp_signed("<", lanes, _splat(builder, count))
    return builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer()), mask


@_compiled
def load(typing_context, numbers, at, count):
    """The numbers of a contiguous flat array from `at` on, `count` of them if that is less than eight."""
    signature = LANES_TYPE(numbers, types.int64, types.int64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        address, mask = _place(context, builder, signature.args[0], *arguments)
        kind = ir.FunctionType(_VECTOR, [address.type, _ALIGNMENT.type, _MASK, _VECTOR])
        read = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v8f64.p0")
        return builder.call(read, [address, _ALIGNMENT, mask, ir.Constant(_VECTOR, None)])

    return signature, generate


@_compiled
def store(typing_context, lanes, numbers, at, count):
    """Write into a contiguous flat array from `at` on, `count` numbers if that is less than eight."""
    signature = types.void(lanes, numbers, types.int64, types.int64)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        lanes, *where = arguments
        address, mask = _place(context, builder, signature.args[1], *where)
        kind = ir.FunctionType(ir.VoidType(), [_VECTOR, address.type, _ALIGNMENT.type, _MASK])
        write = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.store.v8f64.p0")
        builder.call(write, [lanes, address, _ALIGNMENT, mask])
        return context.get_dummy_value()

    return signature, generate


@_compiled
def lanes_of(typing_context, number):
    """One number eight times."""
    signature = LANES_TYPE(types.float64)
    return signature, lambda context, builder, signature, arguments: _splat(builder, arguments[0])


@_compiled
def sum_of(typing_context, lanes):
    """The sum of all lanes."""
    signature = types.float64(LANES_TYPE)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = [builder.extract_element(arguments[0], ir.Constant(_INDEX, lane)) for lane in range(LANES)]
        return reduce(builder.fadd, numbers)

    return signature, generate


@_compiled
def any_below(typing_context, lanes, bounds):
    """Whether any lane is below that of `bounds`."""
    signature = types.boolean(LANES_TYPE, LANES_TYPE)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flags = builder.bitcast(builder.fcmp_ordered("<", *arguments), ir.IntType(LANES))
        return builder.icmp_unsigned("!=", flags, ir.Constant(ir.IntType(LANES), 0))

    return signature, generate


@njit(cache=True)
def whole_lanes(n: int) -> int:
    """W: the next multiple of eight."""
    return (n + LANES - 1) // LANES * LANES


@njit(cache=True)
def widen(rows: Array, out: Array) -> None:
    """Copy rows (m, n) into rows (m, W) of whole lanes, with zeros after them."""
    count, n = rows.shape
    width, numbers, flat = out.shape[1], rows.ravel(), out.ravel()
    for i in range(count):
        for j in range(0, width, LANES):
            store(load(numbers, i * n + j, n - j), flat, i * width + j, LANES)


@njit(cache=True)
def narrow(factor: float, rows: Array, column: int, out: Array) -> None:
    """Write a multiple of rows (m, W) of whole lanes, from a column on, into rows (m, n)."""
    count, n = out.shape
    width, numbers, flat = rows.shape[1], rows.ravel(), out.ravel()
    for i in range(count):
        for j in range(0, n, LANES):
            store(factor * load(numbers, i * width + column + j, n - j), flat, i * n + j, n - j)


def _as_operator(symbol: Any, instruction: str) -> None:
    """Let an operator combine Lanes, or Lanes and a number. A product and a sum may become one instruction."""

    @_compiled
    def combine(typing_context, left, right):
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return getattr(builder, instruction)(*arguments, flags=("contract",))

        return LANES_TYPE(LANES_TYPE, LANES_TYPE), generate

    @overload(symbol)
    def typed(left, right):
        if left == LANES_TYPE and right == LANES_TYPE:
            return lambda left, right: combine(left, right)
        if left == LANES_TYPE and isinstance(right, types.Float):
            return lambda left, right: combine(left, lanes_of(right))
        if isinstance(left, types.Float) and right == LANES_TYPE:
            return lambda left, right: combine(lanes_of(left), right)
        return None


_as_operator(operator.add, "fadd")
_as_operator(operator.sub, "fsub")
_as_operator(operator.mul, "fmul")
_as_operator(operator.truediv, "fdiv")


# π/2 in three parts, the first two of 33 bits: multiples below 2^20 are subtracted without rounding (Cody and Waite).
_HALF_PI = (1.57079632673412561417e00, 6.07710050630396597660e-11, 2.02226624879595063154e-21)

# Minimax polynomials of (sin r − r) / r³ and (cos r − 1 + r²/2) / r⁴ in r² for |r| ≤ π/4, those of fdlibm.
_SINE = (
    -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04, 2.75573137070700676789e-06,
    -2.50507602534068634195e-08, 1.58969099521155010221e-10,
)  # fmt: skip
_COSINE = (
    4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05, -2.75573143513906633035e-07,
    2.08757232129817482790e-09, -1.13596475577881948265e-11,
)  # fmt: skip


# A sum with this is an integer: there is no room for more digits behind the largest one.
_ROUNDING = 1.5 * 2.0**52


@njit(cache=True, error_model="numpy")
def cosine_sine(angle):
    """Cosine and sine of `Lanes` below 10⁶ rad, to 2 ulp of 1; without branches, unlike libm's."""
    quarter = (angle * (2.0 / math.pi) + _ROUNDING) - _ROUNDING
    r = ((angle - quarter * _HALF_PI[0]) - quarter * _HALF_PI[1]) - quarter * _HALF_PI[2]
    z = r * r
    p = _SINE[4] + z * _SINE[5]
    p = _SINE[0] + z * (_SINE[1] + z * (_SINE[2] + z * (_SINE[3] + z * p)))
    g = _COSINE[4] + z * _COSINE[5]
    g = _COSINE[0] + z * (_COSINE[1] + z * (_COSINE[2] + z * (_COSINE[3] + z * g)))
    near_sine, near_cosine = r + r * z * p, (1.0 - 0.5 * z) + z * z * g
    # What is left of the quarter turns beside whole turns, −2 … 2, and beside half turns, −1 … 1: integers all.
    turn = quarter - 4.0 * ((0.25 * quarter + _ROUNDING) - _ROUNDING)
    odd = quarter - 2.0 * ((0.5 * quarter + _ROUNDING) - _ROUNDING)
    odd = odd * odd
    c, s = (1.0 - odd) * (1.0 - 0.5 * turn * turn), odd * turn
    return c * near_cosine - s * near_sine, c * near_sine + s * near_cosine
