"""How far a mean over runs and months is off: variance components of a table of runs by months.

Runs and months are crossed: every run plays every month. A value is

    x[r, m] = mean + run[r] + month[m] + (run x month)[r, m],

so that the mean over R runs and M months has the variance var(run) / R + var(month) / M + var(run x month) / (R M). The
two last terms together are what the means of the months vary, divided by M; the first is estimated by the mean squares
of an analysis of variance, and 0 where that would be negative. The degrees of freedom are Satterthwaite's (1946): few
runs that vary leave few. So do few months that differ from all others: their variance has O'Neill's (2014, Some useful
moment results in sampling problems). ``benchmarks/intervals.py`` shows what intervals with these quantiles cover.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rl2grid.arrays import F64

LEVEL = 0.95
"""Coverage that intervals aim at."""


class Spread(NamedTuple):
    """Variance of a mean and its degrees of freedom, float64 [...] each; NaN for fewer than two months."""

    variance: F64
    freedom: F64
    """What Student's t takes."""
    normal_freedom: F64
    """What it would take if the means of months were normal, at least as much."""


def crossed_spread(by_month: F64, tables: Sequence[F64]) -> Spread:
    """Spread of the mean over months of what was played by independent groups of runs.

    Args:
        by_month: float64 [..., month] what is averaged: means over runs, or differences of two such.
        tables: float64 [..., run, month] of each group of runs that takes part; one run says nothing of others.
    """
    months = by_month.shape[-1]
    if months < 2:
        unknown = np.full(by_month.shape[:-1], np.nan)
        return Spread(unknown, unknown, unknown)
    of_months = by_month.var(axis=-1, ddof=1) / months
    variance, of_runs = of_months, np.zeros(of_months.shape)
    for table in tables:
        if table.shape[-2] > 1:
            part, whole = _run_part(table)
            variance = variance + part
            of_runs = of_runs + np.where(part > 0, whole, 0.0) ** 2 / (table.shape[-2] - 1)
    seen, normal = (
        _satterthwaite(variance, of_months**2 / freedom + of_runs, months - 1.0)
        for freedom in (_freedom_of_months(by_month), months - 1.0)
    )
    # The fewest runs have theirs.
    normal = np.maximum(normal, min([months, *(table.shape[-2] for table in tables if table.shape[-2] > 1)]) - 1)
    return Spread(np.asarray(variance), np.clip(seen, 1.0, normal), normal)


def _satterthwaite(variance: F64, squares: F64, most: float) -> F64:
    """Degrees of freedom of a sum; ``most`` where there is no spread whose freedom could be missing."""
    return np.asarray(np.where(squares > 0, variance**2 / np.where(squares > 0, squares, 1.0), most))


def _freedom_of_months(by_month: F64) -> F64:
    """Degrees of freedom of the variance of some months, from their kurtosis, unbiased as SciPy's; float64 [...]."""
    n = by_month.shape[-1]
    if n < 4:
        return np.full(by_month.shape[:-1], n - 1.0)
    deviations = by_month - by_month.mean(axis=-1, keepdims=True)
    square = (deviations**2).mean(axis=-1)
    excess = (deviations**4).mean(axis=-1) / np.where(square > 0, square, 1.0) ** 2 - 3.0
    kurtosis = 3.0 + (n - 1) / ((n - 2) * (n - 3)) * ((n + 1) * excess + 6.0)
    above = kurtosis - (n - 3) / (n - 1)
    # Lighter tails than a normal distribution's are not taken for knowledge.
    freedom = np.minimum(2 * n / np.where(above > 0, above, 1.0), n - 1)
    return np.asarray(np.where((square > 0) & (above > 0), freedom, n - 1.0), np.float64)


def t_quantile(freedom: ArrayLike, level: float) -> F64:
    """How many standard errors an interval of Student's t reaches to each side, float64 [...]."""
    # Imported here: SciPy's special functions take longer to load than all of the records.
    from scipy import special

    return np.asarray(special.stdtrit(freedom, (1 + level) / 2), np.float64)


def two_sided_p(value: ArrayLike, spread: Spread) -> F64:
    """How probably Student's t is as far from 0, float64 [...]; 1 for no difference, 0 for one without spread."""
    from scipy import special

    distance, error = np.abs(np.asarray(value, np.float64)), np.sqrt(spread.variance)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(distance == 0, 0.0, distance / error)
    return np.asarray(2 * special.stdtr(spread.freedom, -t), np.float64)


def _run_part(table: F64) -> tuple[F64, F64]:
    """What runs contribute to the variance of the mean over runs and months, and what it was found in, float64 [...].

    The part is as uncertain as the whole mean square of the runs, from which what chance explains was subtracted.
    """
    runs, months = table.shape[-2:]
    by_run, by_month = table.mean(axis=-1), table.mean(axis=-2)
    residuals = table - by_run[..., :, None] - by_month[..., None, :] + by_run.mean(axis=-1)[..., None, None]
    of_runs = months * by_run.var(axis=-1, ddof=1)
    of_both = (residuals**2).sum(axis=(-2, -1)) / ((runs - 1) * (months - 1))
    return np.maximum(of_runs - of_both, 0.0) / (runs * months), of_runs / (runs * months)
