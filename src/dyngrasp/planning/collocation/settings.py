"""How to plan: what a user may choose of the offline planner."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dyngrasp.errors import InvalidProblem
from dyngrasp.planning.collocation.ipopt import IpoptSolver
from dyngrasp.planning.collocation.structured import StructuredSolver
from dyngrasp.planning.problem import MIN_INTERVALS, PhaseSolver

BACKENDS: dict[str, Callable[[], PhaseSolver]] = {"structured": StructuredSolver, "ipopt": IpoptSolver}
"""Solvers of one phase by name."""


@dataclass(frozen=True)
class CollocationSettings:
    """Settings of `CollocationPlanner`.

    Attributes:
        effort_weight: ρ of eq. (3a) (s⁴/rad²): 1 is the paper's, 1e-3 close to time-optimal.
        intervals: N of each phase.
        backend: Name of the solver of one phase; see `BACKENDS`.
        velocity_fraction, torque_fraction: Parts of the limits that a plan may use; the rest serves the controller,
            which has to track the plan with a model that is not exact.
        position_margin: Distance kept from the position limits (rad), less where a boundary state is closer.
        funnel_margin: h ≥ this at the grid points of the approach (m) at N = 100, because between them the hand cuts
            corners, by the square of the step on other grids; raised where the audit finds that it cuts deeper.
        hold_safety: Factor by which the pinch exceeds what the part asks of it while it is carried, at the velocities
            of the motion of least effort; where the audit finds that the real ones ask too much, at those.
        max_duration: Longest approach and longest delivery (s).
    """

    effort_weight: float = 1.0
    intervals: int = 100
    backend: str = "structured"
    velocity_fraction: float = 0.95
    torque_fraction: float = 0.9
    position_margin: float = 0.01
    funnel_margin: float = 0.002
    hold_safety: float = 1.4
    max_duration: float = 30.0

    def __post_init__(self) -> None:
        for name in ("velocity_fraction", "torque_fraction"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidProblem(f"{name} must be in (0, 1], got {getattr(self, name)}")
        if self.intervals < MIN_INTERVALS:
            raise InvalidProblem(f"intervals must be at least {MIN_INTERVALS}, got {self.intervals}")
        for name, least in (
            ("effort_weight", 0.0),
            ("position_margin", 0.0),
            ("funnel_margin", 0.0),
            ("hold_safety", 1.0),
        ):
            if not least <= getattr(self, name) < np.inf:
                raise InvalidProblem(f"{name} must be a number ≥ {least:g}, got {getattr(self, name)}")
        if not 0 < self.max_duration < np.inf:
            raise InvalidProblem(f"max_duration must be a number of seconds > 0, got {self.max_duration}")
        if self.backend not in BACKENDS:
            raise InvalidProblem(f"no backend called {self.backend!r}; valid: {', '.join(sorted(BACKENDS))}")
