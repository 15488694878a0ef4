"""One clock for everything that runs in the loop: the control rate, and slower rates derived from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dyngrasp.errors import InvalidProblem


@dataclass(frozen=True)
class Tick:
    """One control period.

    Attributes:
        index: Counts from 0.
        t: Its time (s).
        replan: Whether the replanner starts now.
        record: Whether the record takes a sample now.
    """

    index: int
    t: float
    replan: bool
    record: bool


@dataclass(frozen=True)
class Clock:
    """Iterates over the ticks of an episode.

    A slower rate need not divide the control rate: its event falls on the first tick at or after its due time, so the
    mean rate is kept (30 Hz on a 1 kHz clock comes every 33 or 34 ticks).

    Attributes:
        period: Control period (s).
        start, end: First tick, and the time at which the ticks stop (s).
        replan_rate, record_rate: In Hz, at most 1/period; 0 for never.

    Raises:
        InvalidProblem: A period, span or rate that makes no clock.
    """

    period: float
    start: float
    end: float
    replan_rate: float = 10.0
    record_rate: float = 250.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.period) and self.period > 0):
            raise InvalidProblem(f"clock: period must be > 0, got {self.period} s")
        if not (np.isfinite(self.start) and np.isfinite(self.end) and self.end > self.start):
            raise InvalidProblem(f"clock: end must come after start, got {self.start} s and {self.end} s")
        for name in ("replan_rate", "record_rate"):
            rate = getattr(self, name)
            # Rates and periods are rounded decimals: 1000 Hz and 0.001 s must fit.
            if not 0 <= rate * self.period <= 1 + 1e-9:
                raise InvalidProblem(f"clock: {name} must be between 0 and the control rate, got {rate} Hz")

    def __len__(self) -> int:
        """Number of ticks."""
        return int(np.ceil((self.end - self.start) / self.period - 1e-9))

    def __iter__(self) -> Iterator[Tick]:
        """Ticks in order of time. Each time is computed afresh: adding periods up would drift."""
        for i in range(len(self)):
            yield Tick(i, self.start + i * self.period, self._due(self.replan_rate, i), self._due(self.record_rate, i))

    def _due(self, rate: float, i: int) -> bool:
        if rate == 0:
            return False
        cycles = rate * self.period
        return i == 0 or np.floor(i * cycles + 1e-9) > np.floor((i - 1) * cycles + 1e-9)
