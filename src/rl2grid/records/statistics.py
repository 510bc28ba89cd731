"""Point estimates and intervals of few, skewed results, after Agarwal et al. (2021).

"Deep Reinforcement Learning at the Edge of the Statistical Precipice" recommends the interquartile
mean and percentile intervals of a bootstrap stratified by task, performance profiles, and the
probability of improvement. What are tasks there are scenarios here: months of one grid. The random
numbers of the bootstrap come from a counter-based generator, so that an interval is a function of the
results alone.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rl2grid.arrays import F64

Statistic = Callable[[F64], F64]
"""Maps float64 [..., result] to float64 [...]."""

RESAMPLES = 2000
"""Bootstrap samples of an interval."""
LEVEL = 0.95
"""Coverage that intervals aim at."""


@dataclass(frozen=True)
class Estimate:
    """A statistic of some results and its interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3f} [{self.low:.3f}, {self.high:.3f}]"


class Unit(enum.Enum):
    """What a bootstrap draws anew, and hence what an interval is about."""

    RUN = "training runs"
    """Whole runs: all scenarios of a run stay together, because one policy played them."""
    SEED = "seeds within scenarios"
    """Episodes within every scenario, as rliable draws runs within every task."""
    SCENARIO = "scenarios"


@dataclass(frozen=True, eq=False)
class Scores:
    """A figure of every episode of one method, such as its survival."""

    values: F64
    """float64 [run, scenario, seed]; one run where nothing was trained."""

    def __post_init__(self) -> None:
        if self.values.ndim != 3 or self.values.size == 0:
            raise ValueError(f"Scores must be a non-empty array [run, scenario, seed], got {self.values.shape}.")
        if not np.isfinite(self.values).all():
            raise ValueError("Scores must be finite numbers.")

    @property
    def unit(self) -> Unit:
        """The coarsest repetition there is; scenarios where nothing was repeated."""
        runs, _, seeds = self.values.shape
        return Unit.RUN if runs > 1 else Unit.SEED if seeds > 1 else Unit.SCENARIO

    @property
    def by_scenario(self) -> F64:
        """float64 [scenario, repetition], run by run."""
        return np.asarray(np.moveaxis(self.values, 0, 1).reshape(self.values.shape[1], -1))

    def resampled(self, unit: Unit, resamples: int = RESAMPLES, seed: int = 0) -> F64:
        """float64 [resample, scenario, repetition], ``unit`` drawn with replacement."""
        runs, scenarios, seeds = self.values.shape
        if unit is Unit.RUN:
            drawn = self.values[_draw([np.arange(runs)], resamples, seed)]
            return np.asarray(np.moveaxis(drawn, 1, 2).reshape(resamples, scenarios, runs * seeds))
        if unit is Unit.SCENARIO:
            return np.asarray(self.by_scenario[_draw([np.arange(scenarios)], resamples, seed)])
        flat = self.by_scenario.reshape(-1)
        members = list(np.arange(flat.size).reshape(scenarios, -1))
        return np.asarray(flat[_draw(members, resamples, seed)].reshape(resamples, scenarios, -1))


Aggregate = Callable[[F64], F64]
"""Maps float64 [..., scenario, repetition] to float64 [...], or [..., threshold]."""


def mean_score(scores: F64) -> F64:
    """Mean over scenarios and repetitions."""
    return np.asarray(scores.mean(axis=(-2, -1)))


def iqm_score(scores: F64) -> F64:
    """Interquartile mean over scenarios and repetitions together."""
    return interquartile_mean(scores.reshape(*scores.shape[:-2], -1))


def median_score(scores: F64) -> F64:
    """Median over scenarios of the mean over repetitions."""
    return np.asarray(np.median(scores.mean(axis=-1), axis=-1))


def optimality_gap(scores: F64, target: float = 1.0) -> F64:
    """What is missing to ``target`` on average; what exceeds it does not make up for what is missing elsewhere."""
    return np.asarray(target - np.minimum(scores, target).mean(axis=(-2, -1)))


def share_above(thresholds: ArrayLike) -> Aggregate:
    """The performance profile: share of all scores above each of the thresholds [threshold]."""
    levels = np.asarray(thresholds, np.float64)

    def share(scores: F64) -> F64:
        flat = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
        rows = flat.reshape(-1, flat.shape[-1])
        above = np.stack([row.size - np.searchsorted(row, levels, side="right") for row in rows])
        return np.asarray(above.reshape(*flat.shape[:-1], len(levels)) / flat.shape[-1])

    return share


def estimate(
    scores: Scores,
    aggregate: Aggregate = mean_score,
    *,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
    seed: int = 0,
) -> Estimate:
    """An aggregate of scores, with the percentile interval of a bootstrap over :attr:`Scores.unit`."""
    value, low, high = score_band(scores, aggregate, resamples=resamples, level=level, seed=seed)
    return Estimate(float(value), float(low), float(high))


def score_band(
    scores: Scores, aggregate: Aggregate, *, resamples: int = RESAMPLES, level: float = LEVEL, seed: int = 0
) -> tuple[F64, F64, F64]:
    """:func:`estimate` of an aggregate with several values, such as :func:`share_above`: value, low and high."""
    samples = aggregate(scores.resampled(scores.unit, resamples, seed))
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return aggregate(scores.by_scenario), low, high


def probability_of_improvement(
    x: Scores, y: Scores, *, resamples: int = RESAMPLES, level: float = LEVEL, seed: int = 0
) -> Estimate:
    """P(X > Y): how probably an episode of X scores more than one of Y in the same scenario, ties counted half.

    It is the mean over scenarios of the Mann-Whitney statistic, divided by the number of pairs. The
    interval resamples both methods on their own; where neither has repetitions, it resamples scenarios.

    Raises:
        ValueError: the methods were not scored on equally many scenarios.
    """
    a, b = x.by_scenario, y.by_scenario
    if len(a) != len(b):
        raise ValueError(f"Methods must be scored on the same scenarios, got {len(a)} and {len(b)} of them.")
    wins = (a[:, :, None] > b[:, None, :]) + 0.5 * (a[:, :, None] == b[:, None, :])
    if x.unit is y.unit is Unit.SCENARIO:
        samples = wins.mean(axis=(1, 2))[_draw([np.arange(len(a))], resamples, seed)].mean(axis=1)
    else:
        # How often each repetition is drawn decides everything: no need to compare again in each resample.
        left, right = _weights(x, resamples, 2 * seed), _weights(y, resamples, 2 * seed + 1)
        samples = np.einsum("bsj,bsj->b", np.einsum("bsi,sij->bsj", left, wins, optimize=True), right) / len(a)
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(wins.mean()), float(low), float(high))


def _weights(scores: Scores, resamples: int, seed: int) -> F64:
    """Share of each repetition in each resample, float64 [resample, scenario, repetition]; equal if there is one."""
    runs, scenarios, seeds = scores.values.shape
    repetitions = runs * seeds
    if scores.unit is Unit.SCENARIO:
        return np.ones((resamples, scenarios, 1))
    number = np.arange(repetitions, dtype=np.float64)
    labels = Scores(np.broadcast_to(number.reshape(runs, 1, seeds), scores.values.shape).copy())
    drawn = labels.resampled(scores.unit, resamples, seed)
    return np.stack([(drawn == k).mean(axis=-1) for k in range(repetitions)], axis=-1)


def mean(values: F64) -> F64:
    """Mean over the last axis."""
    return np.asarray(values.mean(axis=-1))


def interquartile_mean(values: F64) -> F64:
    """Mean over the last axis of what is left without the lowest and the highest quarter (rounded down)."""
    n = values.shape[-1]
    cut = n // 4
    return np.asarray(np.sort(values, axis=-1)[..., cut : n - cut].mean(axis=-1))


def stratified_bootstrap(
    values: ArrayLike,
    statistic: Statistic = mean,
    *,
    strata: Sequence[object] | None = None,
    resamples: int = RESAMPLES,
    level: float = LEVEL,
    seed: int = 0,
) -> Estimate:
    """A statistic of all results, with the percentile interval of a stratified bootstrap.

    Each resample draws, with replacement and within every stratum, as many results as the stratum has,
    and computes the statistic over all of them. The strata decide what the interval is about: with one
    per scenario it tells how the figure would vary with other seeds on the same scenarios; with results
    of different scenarios in one stratum, how it would vary with other scenarios.

    Args:
        values: [result].
        statistic: :func:`mean`, :func:`interquartile_mean` or alike.
        strata: [result] the stratum of each result; None: all are in one.
        resamples: number of bootstrap samples.
        level: coverage of the interval.
        seed: of the bootstrap's random numbers.

    Raises:
        ValueError: no values, values that are not finite, or ``strata`` of another length.
    """
    results = np.asarray(values, dtype=np.float64)
    if results.ndim != 1 or results.size == 0:
        raise ValueError(f"Results must be a non-empty array [result], got shape {results.shape}.")
    if not np.isfinite(results).all():
        raise ValueError("Results must be finite numbers.")
    samples = statistic(results[_draw(_members(strata, len(results)), resamples, seed)])
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2])
    return Estimate(float(statistic(results)), float(low), float(high))


def bootstrap_band(
    curves: ArrayLike, *, resamples: int = RESAMPLES, level: float = LEVEL, seed: int = 0
) -> tuple[F64, F64, F64]:
    """Mean of several runs' curves, with the pointwise percentile interval over runs.

    Args:
        curves: [run, point].
        resamples: number of bootstrap samples.
        level: coverage of the interval.
        seed: of the bootstrap's random numbers.

    Returns:
        Mean, low and high, float64 [point] each.
    """
    results = np.asarray(curves, dtype=np.float64)
    drawn = _draw(_members(None, len(results)), resamples, seed)
    # How often each run is drawn, as a matrix: resampled means of all points are one product.
    counts = np.stack([np.count_nonzero(drawn == run, axis=1) for run in range(len(results))], axis=1)
    samples = counts @ results / len(results)
    low, high = np.quantile(samples, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return results.mean(axis=0), low, high


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


def _members(strata: Sequence[object] | None, n: int) -> list[NDArray[np.int64]]:
    """The results of each stratum, strata in order of appearance."""
    if strata is None:
        return [np.arange(n)]
    if len(strata) != n:
        raise ValueError(f"There are {n} results but {len(strata)} labels of strata.")
    members: dict[object, list[int]] = {}
    for result, stratum in enumerate(strata):
        members.setdefault(stratum, []).append(result)
    return [np.array(results) for results in members.values()]


def _draw(members: list[NDArray[np.int64]], resamples: int, seed: int) -> NDArray[np.int64]:
    """Results of each resample, int64 [resample, result]: Philox's raw output, as in ``rl2grid.streams``."""
    generator = np.random.Philox(key=seed)
    drawn = []
    for results in members:
        raw = generator.random_raw(resamples * len(results)).reshape(resamples, len(results))
        uniform = (raw >> np.uint64(11)).astype(np.float64) * 2.0**-53
        drawn.append(results[(uniform * len(results)).astype(np.int64)])
    return np.concatenate(drawn, axis=1)
