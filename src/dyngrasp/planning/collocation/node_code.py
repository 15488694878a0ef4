"""C code that evaluates one expression at eight grid points at once.

CasADi's own generator writes scalar code. Here the operations of a function are written over vectors of eight numbers,
an extension of C that GCC and Clang share: one instruction then serves as many grid points as the processor is wide.
Where it is narrower, the compiler splits the vectors.

Sine and cosine are vectors too: every row of an arm begins with those of its joints, and the mathematical library knows
one number at a time. x = k π/2 + r with |r| ≤ π/4; there Taylor's series are exact to rounding by the ninth term, and
k mod 4 says which of ± sin r and ± cos r is meant.
"""

from __future__ import annotations

import math
from fractions import Fraction

import casadi as ca

from dyngrasp.planning.collocation.code_cache import CompilationError
from dyngrasp.planning.collocation.work_arrays import LANES

# Operations that vectors have themselves.
_ARITHMETIC = {
    ca.OP_ASSIGN: "{0}",
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "2.0 * {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_SIN: "sine({0}, 0)",
    ca.OP_COS: "sine({0}, 1)",
}

# Operations that are taken lane by lane: x and y are numbers.
_LANE_BY_LANE = {
    ca.OP_SQRT: "sqrt(x)",
    ca.OP_EXP: "exp(x)",
    ca.OP_EXPM1: "expm1(x)",
    ca.OP_LOG: "log(x)",
    ca.OP_LOG1P: "log1p(x)",
    ca.OP_TAN: "tan(x)",
    ca.OP_ASIN: "asin(x)",
    ca.OP_ACOS: "acos(x)",
    ca.OP_ATAN: "atan(x)",
    ca.OP_SINH: "sinh(x)",
    ca.OP_COSH: "cosh(x)",
    ca.OP_TANH: "tanh(x)",
    ca.OP_FABS: "fabs(x)",
    ca.OP_FLOOR: "floor(x)",
    ca.OP_CEIL: "ceil(x)",
    ca.OP_SIGN: "x > 0 ? 1.0 : x < 0 ? -1.0 : x",
    ca.OP_ATAN2: "atan2(x, y)",
    ca.OP_POW: "pow(x, y)",
    ca.OP_CONSTPOW: "pow(x, y)",
    ca.OP_HYPOT: "hypot(x, y)",
    ca.OP_FMIN: "fmin(x, y)",
    ca.OP_FMAX: "fmax(x, y)",
    ca.OP_FMOD: "fmod(x, y)",
    ca.OP_COPYSIGN: "copysign(x, y)",
    ca.OP_LT: "x < y",
    ca.OP_LE: "x <= y",
    ca.OP_EQ: "x == y",
    ca.OP_NE: "x != y",
    ca.OP_NOT: "!x",
    ca.OP_AND: "x && y",
    ca.OP_OR: "x || y",
    ca.OP_IF_ELSE_ZERO: "x != 0 ? y : 0.0",
}

# π/2 in three numbers: the product of k, of up to 20 bits, with each of the first two is exact in 53 bits.
_HALF_PI = Fraction("3.14159265358979323846264338327950288419716939937510582097494459") / 2
_FIRST = Fraction(round(_HALF_PI * 2**31), 2**31)
_SECOND = Fraction(round((_HALF_PI - _FIRST) * 2**63), 2**63)
_PARTS = [float(part).hex() for part in (_FIRST, _SECOND, _HALF_PI - _FIRST - _SECOND)]


def _series(powers: range) -> str:
    """Σ (−1)^i r^(2 i) / n! over every second power n, by Horner's rule in s = r²."""
    terms = [f"{(-1) ** i / math.factorial(n):.17g}" for i, n in enumerate(powers)]
    text = terms.pop()
    while terms:
        text = f"({text}) * s + {terms.pop()}"
    return text


HEADER = f"""#include <math.h>
enum {{ LANES = {LANES} }};
typedef double real __attribute__((vector_size(LANES * sizeof(double))));
/* The same in an array of numbers, which may begin anywhere. */
typedef double run __attribute__((vector_size(LANES * sizeof(double)), aligned(sizeof(double)), may_alias));
typedef long long whole __attribute__((vector_size(LANES * sizeof(double))));
typedef long long count;

/* sin(x + turns pi/2) */
static inline real sine(real x, int turns) {{
  const whole far = (x > 0x1p20) | (x < -0x1p20);
  count any = 0;
  for (int l = 0; l < LANES; ++l) any |= far[l];
  if (any) {{
    for (int l = 0; l < LANES; ++l) x[l] = turns ? cos(x[l]) : sin(x[l]);
    return x;
  }}
  /* Of a number as large as this the last bit is one: adding it rounds, and leaves k in the lowest bits. */
  const double rounding = 0x1.8p52;
  const real shifted = x * {float(1 / _HALF_PI).hex()} + rounding, k = shifted - rounding;
  const real r = ((x - k * {_PARTS[0]}) - k * {_PARTS[1]}) - k * {_PARTS[2]}, s = r * r;
  const real odd = r * ({_series(range(1, 19, 2))});
  const real even = {_series(range(0, 19, 2))};
  const whole quadrant = (whole)shifted + turns, other = -(quadrant & 1), sign = (quadrant & 2) << 62;
  return (real)((((whole)even & other) | ((whole)odd & ~other)) ^ sign);
}}
"""


def kernel(function: ca.Function, name: str) -> str:
    """A C function `static void name(const real* in, real* out)`.

    `in` holds the elements of all (dense) inputs one after another, `out` the nonzeros of all outputs.

    Args:
        function: A function of scalar expressions.
        name: Of the C function.

    Raises:
        CompilationError: An operation that has no counterpart here.
    """
    first_in, first_out = [0], [0]
    for i in range(function.n_in()):
        first_in.append(first_in[-1] + function.nnz_in(i))
    for i in range(function.n_out()):
        first_out.append(first_out[-1] + function.nnz_out(i))
    used: set[int] = set()
    lines = [f"static void {name}(const real* in, real* out) {{", "  const real zero = {0};"]
    lines.append(f"  real {', '.join(f'w{i}' for i in range(max(function.sz_w(), 1)))};")
    for i in range(function.n_instructions()):
        operation = function.instruction_id(i)
        source, target = function.instruction_input(i), function.instruction_output(i)
        if operation == ca.OP_INPUT:
            lines.append(f"  w{target[0]} = in[{first_in[source[0]] + source[1]}];")
        elif operation == ca.OP_OUTPUT:
            lines.append(f"  out[{first_out[target[0]] + target[1]}] = w{source[0]};")
        elif operation == ca.OP_CONST:
            lines.append(f"  w{target[0]} = zero + {float(function.instruction_constant(i)).hex()};")
        elif operation in _ARITHMETIC:
            lines.append(f"  w{target[0]} = {_ARITHMETIC[operation].format(*(f'w{j}' for j in source))};")
        elif operation in _LANE_BY_LANE:
            used.add(operation)
            lines.append(f"  w{target[0]} = lanes_{operation}(w{source[0]}, w{source[-1]});")
        else:
            raise CompilationError(f"operation {operation} of CasADi is not known here")
    lines.append("}\n")
    return "".join(_lane_function(operation) for operation in sorted(used)) + "\n".join(lines)


def _lane_function(operation: int) -> str:
    guard = f"LANES_{operation}"
    return (
        f"#ifndef {guard}\n#define {guard}\n"
        f"static inline double lane_{operation}(double x, double y) {{ (void)y; return {_LANE_BY_LANE[operation]}; }}\n"
        f"static inline real lanes_{operation}(real x, real y) {{\n"
        f"  real z;\n  for (int l = 0; l < LANES; ++l) z[l] = lane_{operation}(x[l], y[l]);\n  return z;\n}}\n#endif\n"
    )
