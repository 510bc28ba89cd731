"""Point estimates of a method's results and their intervals: runs and months crossed.

Aggregates are those of Agarwal et al. (2021), "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
with months of one grid in the place of tasks. Their intervals are about other runs *and* other months: the bootstrap
draws both anew, each on its own (Owen, 2007: the pigeonhole bootstrap), so that a run plays all months that are drawn.
Where there is one run, months alone are drawn: the same interval, which then says nothing of other runs.

Percentiles of such resamples are too narrow with few runs, and too wide for what runs and months do together. They are
corrected by what the bootstrap gets wrong of the mean, whose variance :mod:`rl2grid.records.variance` knows: the
distance of both ends from the estimate is multiplied so that the interval of a mean is as wide as Student's t. Figures
between 0 and 1 have Wilson's interval with the same corrected variance, :mod:`rl2grid.records.shares`: percentiles
know nothing of the bounds, and have no width where all months end alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from rl2grid.arrays import F64
from rl2grid.records.resampling import MONTHS, RESAMPLES, drawn
from rl2grid.records.shares import score_interval, share_intervals
from rl2grid.records.variance import LEVEL, Spread, crossed_spread, t_quantile

UNIT = (0.0, 1.0)
"""Bounds of shares, of survival, and of probabilities."""
_CELLS_AT_ONCE = 250_000
"""Of resampled tables: what is in memory at a time."""


@dataclass(frozen=True)
class Estimate:
    """A statistic of some results and its interval."""

    value: float
    low: float
    """NaN, like :attr:`high`, where results of one month alone tell nothing of others."""
    high: float


@dataclass(frozen=True, eq=False)
class Scores:
    """A figure of every episode of one method, such as its survival."""

    values: F64
    """float64 [run, month, seed]; one run where nothing was trained."""
    bounds: tuple[float, float] = (-np.inf, np.inf)
    """What the figure cannot leave, and no interval either."""

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or self.values.size == 0:
            raise ValueError(f"Scores must be a non-empty array [run, month, seed], got {self.values.shape}.")
        if not np.isfinite(self.values).all():
            raise ValueError("Scores must be finite numbers.")

    @property
    def runs(self) -> int:
        """How many trainings; 1 where nothing was trained."""
        return len(self.values)

    @property
    def months(self) -> int:
        return int(self.values.shape[1])

    @property
    def table(self) -> F64:
        """Means over seeds, float64 [run, month]."""
        return np.asarray(self.values.mean(axis=-1))

    @property
    def by_month(self) -> F64:
        """Means over runs and seeds, float64 [month]."""
        return np.asarray(self.values.mean(axis=(0, 2)))

    @property
    def spread(self) -> Spread:
        """Of the mean."""
        return crossed_spread(self.by_month, [self.table])


Aggregate = Callable[[F64, F64, F64], F64]
"""Maps values [run, month, seed] and how often runs [resample, run] and months [resample, month] were drawn to a figure
of each resample, float64 [resample]."""


def mean_score(values: F64, runs: F64, months: F64) -> F64:
    """Mean over runs, months and seeds."""
    table = values.mean(axis=-1)
    return np.asarray((runs @ table * months).sum(axis=-1) / table.size)


def iqm_score(values: F64, runs: F64, months: F64) -> F64:
    """Interquartile mean over all episodes: without the lowest and the highest quarter (rounded down)."""
    order = np.argsort(values, axis=None)
    run, month, _ = np.unravel_index(order, values.shape)
    cut = values.size // 4
    counted = np.cumsum(runs[:, run] * months[:, month], axis=-1)
    kept = np.diff(np.clip(counted, cut, values.size - cut), axis=-1, prepend=cut)
    return np.asarray(kept @ values.reshape(-1)[order] / (values.size - 2 * cut))


def median_score(values: F64, runs: F64, months: F64) -> F64:
    """Median over months of the mean over runs and seeds."""
    means = runs @ values.mean(axis=-1) / values.shape[0]
    order = np.argsort(means, axis=-1)
    ranked, counted = np.take_along_axis(means, order, -1), np.cumsum(np.take_along_axis(months, order, -1), axis=-1)
    n = values.shape[1]
    middle = [np.argmax(counted >= rank, axis=-1)[:, None] for rank in ((n + 1) // 2, n // 2 + 1)]
    return np.asarray(sum(np.take_along_axis(ranked, place, -1)[:, 0] for place in middle) / 2)


def optimality_gap(values: F64, runs: F64, months: F64, target: float = 1.0) -> F64:
    """What is missing to ``target`` on average; what exceeds it does not make up for what is missing elsewhere."""
    return target - mean_score(np.minimum(values, target), runs, months)


def aggregated(scores: Scores, aggregate: Aggregate = mean_score) -> float:
    """An aggregate of the scores as they are."""
    return float(aggregate(scores.values, np.ones((1, scores.runs)), np.ones((1, scores.months)))[0])


def estimate(
    scores: Scores, aggregate: Aggregate = mean_score, *, resamples: int = RESAMPLES, level: float = LEVEL
) -> Estimate:
    """An aggregate of scores with its interval over runs and months."""
    value, spread = aggregated(scores, aggregate), scores.spread
    is_mean = aggregate is mean_score
    if is_mean and scores.bounds == UNIT:
        return bounded(value, spread, scores.months, level)
    means = resampled(scores, mean_score, resamples)
    samples = means if is_mean else resampled(scores, aggregate, resamples)
    if scores.bounds == UNIT:
        share = samples.var() / means.var() if means.var() > 0 else 1.0
        return bounded(value, spread._replace(variance=spread.variance * share), scores.months, level)
    return stretched(value, samples, means, spread, scores.bounds, level)


def bounded(value: float, spread: Spread, months: int, level: float = LEVEL) -> Estimate:
    """A figure between 0 and 1 with Wilson's interval."""
    low, high = score_interval(value, spread, months, level=level)
    return Estimate(value, float(low), float(high))


def resampled(scores: Scores, aggregate: Aggregate, resamples: int = RESAMPLES, stream: int = MONTHS + 1) -> F64:
    """An aggregate in each resample, float64 [resample].

    Args:
        scores: of one method.
        aggregate: of them.
        resamples: number of bootstrap samples.
        stream: of the draws of runs; those of months are the same for all methods.
    """
    runs, months = drawn(scores.runs, resamples, stream), drawn(scores.months, resamples, MONTHS)
    block = max(1, _CELLS_AT_ONCE // scores.values.size)
    parts = [
        aggregate(scores.values, runs[first : first + block], months[first : first + block])
        for first in range(0, resamples, block)
    ]
    return np.concatenate(parts)


def stretched(
    value: float, samples: F64, means: F64, spread: Spread, bounds: tuple[float, float], level: float = LEVEL
) -> Estimate:
    """The percentile interval of resamples, stretched about the estimate as that of the mean has to be.

    Args:
        value: the estimate.
        samples: of it, float64 [resample].
        means: of the mean that ``spread`` is about, in the same resamples.
        spread: variance of that mean, and its degrees of freedom.
        bounds: what the ends of the interval do not leave.
        level: coverage of the interval.
    """
    if np.isnan(spread.variance):
        return Estimate(value, float("nan"), float("nan"))
    error, needed = means.std(), np.sqrt(spread.variance) * t_quantile(spread.freedom, level)
    stretch = float(needed / (NormalDist().inv_cdf((1 + level) / 2) * error)) if error > 0 else 1.0
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2])
    ends = np.clip([value + stretch * (low - value), value + stretch * (high - value)], *bounds)
    return Estimate(value, float(ends[0]), float(ends[1]))


def profile_band(scores: Scores, thresholds: ArrayLike, *, level: float = LEVEL) -> tuple[F64, F64, F64]:
    """The performance profile: share of all scores above each of the thresholds, with Wilson's intervals.

    Returns:
        Share, low and high, float64 [threshold] each.
    """
    above = (scores.values > np.asarray(thresholds, np.float64)[:, None, None, None]).astype(np.float64)
    low, high = share_intervals(above, level=level)
    return above.mean(axis=(1, 2, 3)), low, high


def curve_band(curves: ArrayLike, *, level: float = LEVEL) -> tuple[F64, F64, F64]:
    """Mean of several runs' curves, with the pointwise interval of Student's t over runs.

    Args:
        curves: [run, point], at least two runs.
        level: coverage of the interval.

    Returns:
        Mean, low and high, float64 [point] each.
    """
    results = np.asarray(curves, np.float64)
    n = len(results)
    average = results.mean(axis=0)
    half = t_quantile(n - 1, level) * results.std(axis=0, ddof=1) / np.sqrt(n)
    return average, average - half, average + half


def episode_mean(values: ArrayLike, episodes: ArrayLike, window: int) -> F64:
    """Mean over the last ``window`` episodes at each point of a curve whose points are means over several.

    Args:
        values: [point] mean over the episodes of the point.
        episodes: [point] number of its episodes, above 0.
        window: number of episodes; the first points use those there are.

    Returns:
        float64 [point].
    """
    if window < 1:
        raise ValueError(f"The window must hold at least one episode, got {window}.")
    counts = np.asarray(episodes, np.float64)
    ended = np.concatenate(([0.0], np.cumsum(counts)))
    total = np.concatenate(([0.0], np.cumsum(np.asarray(values, np.float64) * counts)))
    # Episodes of one point are told apart by nothing: the window cuts through them in proportion.
    first = np.maximum(ended[1:] - window, 0.0)
    return np.asarray((total[1:] - np.interp(first, ended, total)) / (ended[1:] - first))
