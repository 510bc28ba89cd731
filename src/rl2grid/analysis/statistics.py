"""Point estimates and intervals of few, skewed results, after Agarwal et al. (2021).

"Deep Reinforcement Learning at the Edge of the Statistical Precipice" recommends the interquartile
mean and percentile intervals of a bootstrap stratified by task. The random numbers of the bootstrap
come from a counter-based generator, so that an interval is a function of the results alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Statistic = Callable[[Floats], Floats]
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


def mean(values: Floats) -> Floats:
    """Mean over the last axis."""
    return np.asarray(values.mean(axis=-1))


def interquartile_mean(values: Floats) -> Floats:
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
) -> tuple[Floats, Floats, Floats]:
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


def trailing_mean(values: ArrayLike, window: int, *, level: float = LEVEL) -> tuple[Floats, Floats, Floats]:
    """Mean of the last ``window`` values at each point, with the normal interval of that mean.

    The first points use what there is; a point with one value has an interval without width.

    Args:
        values: [point], in order.
        window: number of values averaged, at least 1.
        level: coverage of the interval.

    Returns:
        Mean, low and high, float64 [point] each.
    """
    if window < 1:
        raise ValueError(f"The window must hold at least one value, got {window}.")
    results = np.asarray(values, dtype=np.float64)
    count = np.minimum(np.arange(1, len(results) + 1), window)
    # Centred first: sums of squares of large, nearly equal numbers would cancel.
    centre = results.mean() if len(results) else 0.0
    average = _window_sum(results - centre, window) / count
    square = _window_sum((results - centre) ** 2, window) / count
    variance = np.maximum(square - average**2, 0.0) * count / np.maximum(count - 1, 1)
    half = NormalDist().inv_cdf((1 + level) / 2) * np.sqrt(variance / count)
    average = average + centre
    return average, average - half, average + half


def _window_sum(values: Floats, window: int) -> Floats:
    total = np.concatenate(([0.0], np.cumsum(values)))
    end = np.arange(1, len(values) + 1)
    return np.asarray(total[end] - total[np.maximum(end - window, 0)])


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
