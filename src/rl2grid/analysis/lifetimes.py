"""Time to failure: how long grids stay alive, after Kaplan and Meier (1958).

A completed month says that the grid lived at least that long: its lifetime is censored. Bands are about other runs and
months, like all intervals: Greenwood's variance of independent lives is multiplied by what the lives of one run, and
those in one month, have in common (Kish's design effect).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rl2grid.arrays import F64
from rl2grid.records.episodes import Episode
from rl2grid.records.shares import score_interval
from rl2grid.records.summary import by_scenario
from rl2grid.records.variance import LEVEL, Spread, crossed_spread


@dataclass(frozen=True, eq=False)
class Lifetimes:
    """How long each episode lived."""

    steps: F64
    """float64 [run, month, seed] grid steps survived."""
    failed: np.ndarray[tuple[int, int, int], np.dtype[np.bool_]]
    """bool [run, month, seed] whether it was lost then; else it was completed, and would have lived longer."""


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


def lifetimes(runs: Sequence[Sequence[Episode]]) -> Lifetimes:
    """Lifetimes of the episodes of each run, which may start anywhere and be of any length."""

    def stacked(column: str) -> F64:
        return np.stack([by_scenario(episodes, column) for episodes in runs])

    return Lifetimes(np.round(stacked("survival") * stacked("episode_length")), stacked("completed") == 0)


def kaplan_meier(lived: Lifetimes, *, level: float = LEVEL) -> SurvivalCurve:
    """Share of grids alive over time, with pointwise Wilson intervals, which have a width where all are alive."""
    falls = np.unique(lived.steps[lived.failed])
    at_risk = np.array([(lived.steps >= step).sum() for step in falls], np.float64)
    lost = np.array([(lived.failed & (lived.steps == step)).sum() for step in falls], np.float64)
    alive = np.concatenate(([1.0], np.cumprod(1 - lost / at_risk)))
    with np.errstate(divide="ignore"):
        greenwood = np.concatenate(([0.0], np.cumsum(lost / (at_risk * (at_risk - lost)))))
    independent = np.where(alive > 0, alive**2 * np.where(alive > 0, greenwood, 0.0), 0.0)
    steps = np.concatenate(([0.0], falls))
    effect, spread = _design_effect(lived, steps)
    spread = spread._replace(variance=independent * effect)
    low, high = score_interval(alive, spread, lived.steps.shape[1], level=level)
    return SurvivalCurve(steps, alive, low, high, lived.steps[~lived.failed])


def _design_effect(lived: Lifetimes, steps: F64) -> tuple[F64, Spread]:
    """How many times the variance of independent lives there is after each step, and the spread that shows it."""
    lives = ((lived.steps > steps[:, None, None, None]) | ~lived.failed).astype(np.float64)
    table = lives.mean(axis=-1)
    by_month = table.mean(axis=-2)
    share, n = by_month.mean(axis=-1), lived.steps.size
    spread = crossed_spread(by_month, [table])
    independent = share * (1 - share) / n
    is_seen = independent > 0
    return np.where(is_seen, spread.variance / np.where(is_seen, independent, 1.0), 1.0), spread
