"""The reference backend with its functions compiled: what IPOPT can do at its best, for comparisons."""

from __future__ import annotations

import casadi as ca

from dyngrasp.planning.collocation import code_cache, transcription
from dyngrasp.planning.collocation.ipopt import IpoptSolver
from dyngrasp.planning.problem import PhaseProblem


class CompiledIpoptSolver(IpoptSolver):
    """`IpoptSolver` whose objective, rows and derivatives are C code compiled by the machine's compiler.

    Building takes up to a minute for each problem structure the first time on a machine; the code is kept in the cache
    of `code_cache`.

    Raises:
        CompilationError: At the first solve, without a C compiler.
    """

    def _solver(self, problem: PhaseProblem) -> ca.Function:
        key = transcription.structure_key(problem)
        if key not in self._solvers:
            program = transcription.build(problem)
            x, p = program.problem["x"], program.problem["p"]
            functions = {
                "nlp_f": ca.Function("nlp_f", [x, p], [program.problem["f"]], ["x", "p"], ["f"]),
                "nlp_g": ca.Function("nlp_g", [x, p], [program.problem["g"]], ["x", "p"], ["g"]),
                "grad_f": program.grad_f,
                "jac_g": program.jac_g,
                "hess_lag": program.hess_lag,
            }
            generator = ca.CodeGenerator("nlp", {"with_header": False})
            for function in functions.values():
                generator.add(function)
            library = code_cache.load(generator.dump(), f"IPOPT's functions of phase {problem.name!r}")
            loaded = {name: ca.external(f.name(), library._name) for name, f in functions.items()}
            nlp = {"x": x, "p": p, "f": loaded["nlp_f"](x, p), "g": loaded["nlp_g"](x, p)}
            derivatives = {name: loaded[name] for name in ("grad_f", "jac_g", "hess_lag")}
            # Compiled functions have no derivatives but those given; sensitivities by p are not asked for.
            options = self.options() | derivatives | {"no_nlp_grad": True, "calc_lam_p": False}
            self._solvers[key] = program, ca.nlpsol("phase", "ipopt", nlp, options)
        return self._solvers[key][1]
