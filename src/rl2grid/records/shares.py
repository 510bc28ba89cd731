"""Intervals of figures between 0 and 1, after Wilson (1927): they stay there, and have a width where all agree."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from rl2grid.arrays import F64
from rl2grid.records.variance import LEVEL, Spread, crossed_spread, t_quantile


def wilson_interval(successes: ArrayLike, attempts: ArrayLike, *, level: float = LEVEL) -> tuple[F64, F64]:
    """Wilson's score interval of a probability, float64 low and high.

    Unlike the normal interval it never leaves [0, 1] and has a width where all attempts went the same way.
    Without any attempt it is [0, 1].
    """
    n = np.asarray(attempts, np.float64)
    k = np.asarray(successes, np.float64)
    z = NormalDist().inv_cdf((1 + level) / 2)
    centre = (k + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * np.sqrt(np.where(n > 0, k * (n - k) / np.maximum(n, 1), 0.0) + z**2 / 4)
    # At the ends the exact bound is 0 or 1; rounding would miss it by an ulp.
    return np.where(k == 0, 0.0, centre - half), np.where(k == n, 1.0, centre + half)


def score_interval(value: ArrayLike, spread: Spread, months: int, *, level: float = LEVEL) -> tuple[F64, F64]:
    """Wilson's interval of a figure between 0 and 1, with the number of attempts that has its spread.

    So many independent attempts would tell as much of a share (Korn and Graubard, 1998). For the share that one run
    reached it is the number of months, and so it is where no spread was seen: 0 of 20 months are 0 of 20 attempts.

    Args:
        value: of the figure, [...].
        spread: of it, [...].
        months: that were played; of one alone, the figure is as uncertain as a single attempt.
        level: coverage of the interval.

    Returns:
        Low and high, float64 [...].
    """
    share = np.asarray(value, np.float64)
    if months < 2:
        return wilson_interval(share, 1.0, level=level)
    is_seen = (spread.variance > 0) & (share > 0) & (share < 1)
    n = np.where(is_seen, 1 + share * (1 - share) / np.where(is_seen, spread.variance, 1.0), float(months))
    seen, normal = (
        n * (t_quantile(months - 1, level) / t_quantile(freedom, level)) ** 2
        for freedom in (spread.freedom, spread.normal_freedom)
    )
    # Nothing between 0 and 1 varies more than a share, whose variance is known with the share itself.
    n = np.maximum(seen, np.minimum(normal, months))
    low, high = wilson_interval(share * n, n, level=level)
    return np.where(share == 0, 0.0, low), np.where(share == 1, 1.0, high)


def share_intervals(values: F64, *, level: float = LEVEL) -> tuple[F64, F64]:
    """Intervals of the means of several figures between 0 and 1 over runs and months.

    Args:
        values: float64 [..., run, month, seed].
        level: coverage of the intervals.

    Returns:
        Low and high, float64 [...].
    """
    table = values.mean(axis=-1)
    by_month = table.mean(axis=-2)
    return score_interval(by_month.mean(axis=-1), crossed_spread(by_month, [table]), table.shape[-1], level=level)
