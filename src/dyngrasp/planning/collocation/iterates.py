"""What goes into and what comes out of an interior point iteration: settings, how it ended, the best point seen."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from dyngrasp.signals import Array


@dataclass(frozen=True)
class InteriorPointSettings:
    """Settings of `InteriorPoint`.

    Attributes:
        tolerance: E at the solution, relative to the objective.
        violation_tolerance: Largest violation of a row at the solution, in its scaled unit.
        max_iterations: Newton systems.
        least_slack: Slack that a violated row begins with.
        price: ν at the start, relative to the objective.
        adaptive: Whether to use free mode at all.
    """

    tolerance: float = 1e-8
    violation_tolerance: float = 1e-9
    max_iterations: int = 500
    least_slack: float = 1e-2
    price: float = 1.0
    adaptive: bool = True


class Outcome(Enum):
    """How an attempt ended."""

    OPTIMAL = auto()
    INFEASIBLE = auto()
    ITERATION_LIMIT = auto()
    STALLED = auto()
    DEADLINE = auto()
    NONFINITE = auto()


@dataclass
class Best:
    """The best iterate so far: the cheapest that violates nothing, else the one that violates least."""

    x: Array
    T: float
    objective: float = np.inf
    violation: float = np.inf

    def offer(self, x: Array, T: float, objective: float, violation: float, tolerance: float) -> None:
        """Keep an iterate if it is better than the one kept."""
        if not np.isfinite(objective + violation):
            return
        if violation <= tolerance:
            better = self.violation > tolerance or objective < self.objective
        else:
            better = violation < self.violation
        if better:
            self.x[:], self.T, self.objective, self.violation = x, T, objective, violation
