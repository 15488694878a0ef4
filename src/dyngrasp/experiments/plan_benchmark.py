"""What a benchmark of planning has measured, attempt by attempt, and the tables that condense it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from dyngrasp.experiments.statistics import timing_summary
from dyngrasp.planning.collocation.ipopt import IpoptSettings
from dyngrasp.planning.collocation.ipopt_compiled import CompiledIpoptSolver
from dyngrasp.planning.problem import PhaseSolver
from dyngrasp.trajectory import PHASE_NAMES

PEERS: dict[str, tuple[str, Callable[[], PhaseSolver]]] = {
    "ipopt": (
        "IPOPT with MUMPS, exact compiled derivatives, the planner's start, mu_init = 1e-4, at most 300 iterations",
        lambda: CompiledIpoptSolver(IpoptSettings(max_iterations=300)),
    )
}
"""Solvers to compare with: what each is given, and how to make it."""

CASES = {
    "paper": "the paper's start configuration and box of poses",
    "stress": "random start postures, half of the torque limits",
}

WARM = "warm"
"""The default solver after the part has moved by `MOVE` (m), from the solution before; the arm keeps grasp, branch and
arm angle, as it does when it follows a part."""
MOVE = 0.01

REFERENCE = "ipopt"

# Objectives that differ by less are those of one optimum (relative).
SAME = 1e-5


@dataclass(frozen=True)
class Attempt:
    """One phase of one trial by one solver."""

    case: str
    weight: float
    trial: int
    phase: str
    solver: str
    time_ms: float
    iterations: int
    objective: float
    violation: float
    ok: bool


@dataclass(frozen=True)
class Stage:
    """Wall time of a part of planning, or of all of it ("plan"), in one trial by the default solver."""

    case: str
    weight: float
    trial: int
    stage: str
    time_ms: float
    ok: bool


@dataclass(frozen=True)
class PlanBenchmark:
    """Everything measured, on grids of so many intervals for so many joints; its methods condense it."""

    attempts: tuple[Attempt, ...]
    stages: tuple[Stage, ...]
    growth: tuple[dict[str, Any], ...]
    peers: tuple[str, ...]
    intervals: int
    joints: int

    def report(self) -> dict[str, Any]:
        """For JSON: what was measured, one row a backend, part and weight, and the comparisons with peers.

        The keys are those of every `bench`: `backend`, `part` (phase1 to phase3, whole, and what else a whole plan
        takes), `start` (cold or warm), `rho`, `grid` (N), `joints`, `solved`, times, `objective_rel_diff` to the
        reference IPOPT (the median over what both solved; None without it), `worst_violation`.
        """
        return {
            "cases": CASES,
            "peers": {name: PEERS[name][0] for name in self.peers},
            "rows": self._part_rows(),
            "comparisons": self.comparison_rows(),
        }

    def _part_rows(self) -> list[dict[str, Any]]:
        size = {"grid": self.intervals, "joints": self.joints}
        rows: list[dict[str, Any]] = []
        for row in self.stage_rows():
            if row["stage"] not in PHASE_NAMES:
                part = "whole" if row["stage"] == "plan" else row["stage"]
                rows.append(
                    {"case": row["case"], "backend": "structured", "start": "cold", "part": part}
                    | {"rho": row["weight"], **size, "solved": row["ok"]}
                    | _without(row, "case", "weight", "stage", "ok")
                )
        for row in self.phase_rows():
            warm = row["solver"] == WARM
            rows.append(
                {"case": row["case"], "backend": "structured" if warm else row["solver"]}
                | {"start": "warm" if warm else "cold", "part": f"phase{PHASE_NAMES.index(row['phase']) + 1}"}
                | {"rho": row["weight"], **size, "solved": row["ok"]}
                | _without(row, "case", "weight", "phase", "solver", "ok")
                | {
                    "objective_rel_diff": self._objective_difference(
                        row["case"], row["weight"], row["phase"], row["solver"]
                    )
                }
            )
        rows += [
            {"case": "growth", "backend": "structured", "start": "cold", "part": "phase1", "rho": row["weight"]}
            | {"grid": row["intervals"], "joints": row["joints"], "solved": row["ok"]}
            | _without(row, "weight", "intervals", "joints", "ok")
            for row in self.growth
        ]
        return rows

    def _objective_difference(self, case: str, weight: float, phase: str, solver: str) -> float | None:
        objectives: dict[str, dict[int, float]] = {solver: {}, REFERENCE: {}}
        for a in self.attempts:
            if (a.case, a.weight, a.phase) == (case, weight, phase) and a.solver in objectives and a.ok:
                objectives[a.solver][a.trial] = a.objective
        both = objectives[solver].keys() & objectives[REFERENCE].keys()
        # After a move the problem is another one than the reference's.
        if solver == WARM or not both:
            return None
        return float(np.median([objectives[solver][k] / objectives[REFERENCE][k] - 1 for k in both]))

    def stage_rows(self) -> list[dict[str, Any]]:
        """Times of each stage of a whole plan."""
        groups: dict[tuple, list[Stage]] = {}
        for stage in self.stages:
            groups.setdefault((stage.case, stage.weight, stage.stage), []).append(stage)
        return [
            {"case": case, "weight": weight, "stage": name, "ok": sum(s.ok for s in group)}
            | timing_summary([s.time_ms for s in group])
            for (case, weight, name), group in groups.items()
        ]

    def phase_rows(self) -> list[dict[str, Any]]:
        """Times, iterations, objectives and violations of each phase by each solver."""
        groups: dict[tuple, list[Attempt]] = {}
        for attempt in self.attempts:
            groups.setdefault((attempt.case, attempt.weight, attempt.phase, attempt.solver), []).append(attempt)
        rows = []
        for (case, weight, phase, solver), group in groups.items():
            solved = [a for a in group if a.ok]
            rows.append(
                {"case": case, "weight": weight, "phase": phase, "solver": solver, "ok": len(solved)}
                | timing_summary([a.time_ms for a in group])
                | {
                    "iterations": float(np.median([a.iterations for a in group])),
                    "objective": float(np.mean([a.objective for a in solved])) if solved else np.nan,
                    "worst_violation": max((a.violation for a in solved), default=np.nan),
                }
            )
        return rows

    def comparison_rows(self) -> list[dict[str, Any]]:
        """The default solver against each peer on the problems that both solved."""
        by_problem: dict[tuple, dict[str, Attempt]] = {}
        for a in self.attempts:
            by_problem.setdefault((a.case, a.weight, a.phase, a.trial), {})[a.solver] = a
        rows = []
        for peer in self.peers:
            groups: dict[tuple, list[tuple[Attempt, Attempt]]] = {}
            for (case, weight, phase, _), solvers in by_problem.items():
                if peer in solvers:
                    groups.setdefault((case, weight, phase), []).append((solvers["structured"], solvers[peer]))
            for (case, weight, phase), pairs in groups.items():
                both = [(ours, theirs) for ours, theirs in pairs if ours.ok and theirs.ok]
                change = np.array([ours.objective / theirs.objective - 1 for ours, theirs in both])
                rows.append(
                    {
                        "case": case,
                        "weight": weight,
                        "phase": phase,
                        "peer": peer,
                        "problems": len(pairs),
                        "both": len(both),
                        "only_ours": sum(ours.ok and not theirs.ok for ours, theirs in pairs),
                        "only_theirs": sum(theirs.ok and not ours.ok for ours, theirs in pairs),
                        "same": int((np.abs(change) <= SAME).sum()),
                        "better": int((change < -SAME).sum()),
                        "worse": int((change > SAME).sum()),
                        "speedup": float(np.median([theirs.time_ms / ours.time_ms for ours, theirs in pairs])),
                    }
                )
        return rows


def _without(row: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key not in keys}
