"""Variance components against SciPy, closed forms and simulations with a known truth."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rl2grid.records.variance import crossed_spread, t_quantile, two_sided_p

EXACT = 1e-12


def table(runs: int, months: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(runs, months))


def test_one_run_has_the_variance_of_its_months():
    x = table(1, 30)
    spread = crossed_spread(x[0], [x])
    assert spread.variance == pytest.approx(stats.sem(x[0]) ** 2, rel=EXACT)
    assert spread.normal_freedom == 29
    assert two_sided_p(x.mean(), spread._replace(freedom=spread.normal_freedom)) == pytest.approx(
        stats.ttest_1samp(x[0], 0).pvalue, rel=1e-9
    )
    assert t_quantile(29, 0.95) == pytest.approx(stats.t.ppf(0.975, 29), rel=1e-9)


def test_variance_components_are_those_of_the_simulation():
    random = np.random.default_rng(1)
    shape = (4000, 4, 12)
    x = (
        0.7 * random.normal(size=(4000, 4, 1))
        + 0.5 * random.normal(size=(4000, 1, 12))
        + 0.9 * random.normal(size=shape)
    )
    spread = crossed_spread(x.mean(axis=1), [x])
    truth = 0.7**2 / 4 + 0.5**2 / 12 + 0.9**2 / 48
    assert spread.variance.mean() == pytest.approx(truth, rel=0.03)
    assert x.mean(axis=(1, 2)).var() == pytest.approx(truth, rel=0.08)
    assert ((spread.normal_freedom >= 3) & (spread.normal_freedom <= 14)).all()
    assert ((spread.freedom >= 1) & (spread.freedom <= spread.normal_freedom)).all()


def test_few_months_that_differ_leave_few_degrees_of_freedom():
    n = 20
    calm, rare = np.random.default_rng(2).uniform(size=n), np.ones(n)
    assert crossed_spread(calm, [calm[None]]).freedom == n - 1
    rare[0] = 0.7
    kurtosis = stats.kurtosis(rare, fisher=False, bias=False)
    spread = crossed_spread(rare, [rare[None]])
    assert spread.freedom == pytest.approx(2 * n / (kurtosis - (n - 3) / (n - 1)), rel=1e-9)
    assert spread.normal_freedom == n - 1


@pytest.mark.parametrize("runs", [3, 5, 10])
@pytest.mark.parametrize(("of_runs", "of_both"), [(0.0, 1.0), (0.3, 0.5), (1.0, 0.3)])
def test_nineteen_of_twenty_intervals_hold_the_truth(runs, of_runs, of_both):
    random = np.random.default_rng(runs)
    n, months = 1500, 20
    x = (
        of_runs * random.normal(size=(n, runs, 1))
        + random.normal(size=(n, 1, months))
        + of_both * random.normal(size=(n, runs, months))
    )
    spread = crossed_spread(x.mean(axis=1), [x])
    covered = np.abs(x.mean(axis=(1, 2))) <= t_quantile(spread.freedom, 0.95) * np.sqrt(spread.variance)
    assert 0.9 <= covered.mean() <= 0.97


def test_without_spread_nothing_is_divided_by_zero():
    spread = crossed_spread(np.ones(5), [np.ones((3, 5))])
    assert (spread.variance, spread.freedom) == (0, 4)
    assert two_sided_p(0.0, spread) == 1.0
    assert two_sided_p(0.1, spread) == 0.0
    assert np.isnan(crossed_spread(np.ones(1), []).variance)
