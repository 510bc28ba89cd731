"""Time to failure: how long grids stay alive, after Kaplan and Meier (1958).

A completed month says that the grid lived at least that long: its lifetime is censored. Curves and tests are
SciPy's; here is what they are asked, and what is made of the points at which their formulas are not defined.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rl2grid.arrays import F64
from rl2grid.records.episodes import Episode
from rl2grid.records.statistics import LEVEL


@dataclass(frozen=True, eq=False)
class Lifetimes:
    """How long each episode lived."""

    steps: F64
    """float64 [episode] grid steps survived."""
    failed: np.ndarray[tuple[int], np.dtype[np.bool_]]
    """bool [episode] whether it was lost then; else it was completed, and would have lived longer."""


@dataclass(frozen=True, eq=False)
class SurvivalCurve:
    """The Kaplan-Meier estimate: a staircase that falls at ``steps``."""

    steps: F64
    """float64 [fall], 0 first."""
    alive: F64
    """Share of grids alive after each of them."""
    low: F64
    high: F64
    censored: F64
    """float64 [episode] steps at which completed episodes leave."""

    @property
    def median(self) -> float:
        """Steps after which half of the grids are lost; NaN while more than half are alive."""
        lost = np.flatnonzero(self.alive <= 0.5)
        return float(self.steps[lost[0]]) if lost.size else float("nan")


def lifetimes(episodes: Sequence[Episode]) -> Lifetimes:
    """Lifetimes of episodes that may start anywhere and be of any length."""
    steps = [round(episode.survival * episode.episode_length) for episode in episodes]
    return Lifetimes(np.array(steps, np.float64), np.array([not episode.completed for episode in episodes], np.bool_))


def kaplan_meier(lived: Lifetimes, *, level: float = LEVEL) -> SurvivalCurve:
    """Share of grids alive over time, with pointwise intervals of Greenwood's variance on the log(-log) scale.

    That scale keeps intervals within 0 and 1. Where it is not defined, all grids being alive or none, the interval
    is that of the last step at which it was; before the first loss it is [1, 1].
    """
    function = stats.ecdf(_censored(lived)).sf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        interval = function.confidence_interval(level, method="log-log")
    falls = np.flatnonzero(np.diff(function.probabilities, prepend=1.0) < 0)
    steps = np.concatenate(([0.0], function.quantiles[falls]))
    alive, low, high = (
        _carried(np.concatenate(([1.0], bound.probabilities[falls])))
        for bound in (function, interval.low, interval.high)
    )
    return SurvivalCurve(steps, alive, np.where(alive > 0, low, 0.0), high, lived.steps[~lived.failed])


def log_rank(x: Lifetimes, y: Lifetimes) -> float:
    """Two-sided p-value of the log-rank test that both live equally long (Mantel, 1966); 1 where nobody failed."""
    if not (x.failed.any() or y.failed.any()):
        return 1.0
    return float(stats.logrank(_censored(x), _censored(y)).pvalue)


def _censored(lived: Lifetimes) -> stats.CensoredData:
    return stats.CensoredData(uncensored=lived.steps[lived.failed], right=lived.steps[~lived.failed])


def _carried(values: F64) -> F64:
    """Values with the last known one in the place of those that are not defined."""
    known = np.maximum.accumulate(np.where(np.isnan(values), 0, np.arange(len(values))))
    return np.asarray(values[known])
