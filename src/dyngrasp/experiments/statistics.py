"""Intervals and summaries that studies report."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

# Two-sided 95 %: the 97.5 % quantile of the standard normal distribution.
Z_95 = 1.959963984540054


@dataclass(frozen=True)
class Proportion:
    """A share of successes with its 95 % confidence interval.

    Attributes:
        successes: How many trials succeeded.
        trials: How many there were.
        low: Lower end of the interval, in [0, 1].
        high: Upper end of the interval, in [0, 1].
    """

    successes: int
    trials: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """Successes over trials; NaN without a trial."""
        return self.successes / self.trials if self.trials else math.nan

    def __str__(self) -> str:
        if not self.trials:
            return "0 of 0"
        return f"{self.successes} of {self.trials} ({100 * self.low:.1f} to {100 * self.high:.1f} %)"


def wilson(successes: int, trials: int, z: float = Z_95) -> Proportion:
    """Score interval of a binomial proportion (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927).

    Unlike the normal approximation it stays inside [0, 1] and has a width at 0 and at all successes, where the studies
    of this package usually end up.

    Args:
        successes: Number of successes, 0 ≤ successes ≤ trials.
        trials: Number of trials; without any the interval is [0, 1].
        z: Quantile of the standard normal distribution.

    Raises:
        ValueError: Counts that no study can have.
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"0 ≤ successes ≤ trials expected, got {successes} of {trials}")
    if trials == 0:
        return Proportion(0, 0, 0.0, 1.0)
    share, weight = successes / trials, z * z / trials
    centre = (share + weight / 2) / (1 + weight)
    half_width = z / (1 + weight) * math.sqrt(share * (1 - share) / trials + weight / (4 * trials))
    # At the two ends the interval closes exactly; rounding must not push it past them.
    low = 0.0 if successes == 0 else max(0.0, centre - half_width)
    high = 1.0 if successes == trials else min(1.0, centre + half_width)
    return Proportion(successes, trials, low, high)


def timing_summary(times_ms: ArrayLike) -> dict[str, float | int]:
    """The four keys under which every command reports times.

    Args:
        times_ms: Any number of times (ms); what is not finite was not measured and does not count.

    Returns:
        `median_ms`, `p99_ms`, `max_ms` (NaN without a time) and `n`.
    """
    times = np.asarray(times_ms, dtype=float).ravel()
    times = times[np.isfinite(times)]
    if times.size == 0:
        return {"median_ms": math.nan, "p99_ms": math.nan, "max_ms": math.nan, "n": 0}
    return {
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.percentile(times, 99)),
        "max_ms": float(times.max()),
        "n": int(times.size),
    }
