"""Methods compared on the same months: paired differences with Holm's correction, and the probability of improvement.

What one month is worth, easy or hard, is the same for all who play it, and falls out of a difference. The runs of
different methods are independent; months are drawn for both at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rl2grid.arrays import F64
from rl2grid.records.resampling import MONTHS, RESAMPLES
from rl2grid.records.statistics import Estimate, Scores, bounded, mean_score, resampled, stretched
from rl2grid.records.variance import LEVEL, crossed_spread, two_sided_p


@dataclass(frozen=True)
class Difference:
    """How much more one method scores than another on the same months."""

    estimate: Estimate
    """Mean over months, with its interval over runs and months."""
    p: float
    """Two-sided, that there is no difference."""
    holm: float
    """The same, corrected for all comparisons that were made together (Holm, 1979)."""

    @property
    def reversed(self) -> Difference:
        """How much more the other scores."""
        one = self.estimate
        return Difference(Estimate(-one.value, -one.high, -one.low), self.p, self.holm)


def paired_differences(
    scores: Sequence[Scores], pairs: Sequence[tuple[int, int]], *, resamples: int = RESAMPLES, level: float = LEVEL
) -> list[Difference]:
    """Differences of the means of some pairs of methods, one family of comparisons.

    Args:
        scores: of each method, on the same months in the same order.
        pairs: places of two methods in ``scores``; the second is subtracted from the first.
        resamples: number of bootstrap samples.
        level: coverage of the intervals.

    Raises:
        ValueError: the methods were not scored on equally many months.
    """
    if len({one.months for one in scores}) > 1:
        counts = ", ".join(str(one.months) for one in scores)
        raise ValueError(f"Methods must be scored on the same months, got {counts} of them.")
    means = [resampled(one, mean_score, resamples, stream) for stream, one in enumerate(scores, start=MONTHS + 1)]
    found = []
    for x, y in pairs:
        by_month = scores[x].by_month - scores[y].by_month
        spread = crossed_spread(by_month, [scores[x].table, scores[y].table])
        value, samples = float(by_month.mean()), means[x] - means[y]
        (low, high), (least, most) = scores[x].bounds, scores[y].bounds
        interval = stretched(value, samples, samples, spread, (low - most, high - least), level)
        found.append((interval, float(two_sided_p(value, spread))))
    corrected = holm([p for _, p in found])
    return [Difference(interval, p, float(q)) for (interval, p), q in zip(found, corrected, strict=True)]


def holm(p_values: ArrayLike) -> F64:
    """P-values corrected for having looked at all of them, after Holm (1979); those that are NaN do not count.

    The smallest is multiplied by their number, the next by one less, and so on; none becomes smaller than the one
    before it, or larger than 1.
    """
    p = np.asarray(p_values, np.float64)
    known = np.flatnonzero(~np.isnan(p))
    order = known[np.argsort(p[known], kind="stable")]
    corrected = np.full(p.shape, np.nan)
    corrected[order] = np.minimum(np.maximum.accumulate(p[order] * np.arange(len(order), 0, -1)), 1.0)
    return corrected


def probability_of_improvement(x: Scores, y: Scores, *, level: float = LEVEL) -> Estimate:
    """P(X > Y): how probably an episode of X scores more than one of Y in the same month, ties counted half.

    It is the mean over months of the Mann-Whitney statistic, divided by the number of pairs.

    Raises:
        ValueError: the methods were not scored on equally many months.
    """
    if x.months != y.months:
        raise ValueError(f"Methods must be scored on the same months, got {x.months} and {y.months} of them.")
    a, b = x.values[:, None, :, :, None], y.values[None, :, :, None, :]
    # float64 [run of X, run of Y, month]: means over pairs of seeds.
    wins = ((a > b) + 0.5 * (a == b)).mean(axis=(-2, -1))
    by_month = wins.mean(axis=(0, 1))
    spread = crossed_spread(by_month, [wins.mean(axis=1), wins.mean(axis=0)])
    return bounded(float(by_month.mean()), spread, x.months, level)
