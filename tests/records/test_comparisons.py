"""Methods compared on the same months: against SciPy, by hand, and data whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rl2grid.records.comparisons import holm, paired_differences, probability_of_improvement
from rl2grid.records.shares import wilson_interval
from rl2grid.records.statistics import UNIT, Scores


def table(runs: int, months: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(runs, months))


def test_a_difference_of_two_runs_is_the_paired_t_test():
    x, y = (Scores(table(1, 25, seed)[:, :, None]) for seed in (1, 2))
    (difference,) = paired_differences([x, y], [(0, 1)])
    expected = stats.ttest_rel(x.values[0, :, 0], y.values[0, :, 0])
    assert difference.p == pytest.approx(expected.pvalue, rel=1e-9)
    assert difference.holm == difference.p
    interval = expected.confidence_interval()
    width = difference.estimate.high - difference.estimate.low
    assert width == pytest.approx(interval.high - interval.low, rel=0.05)
    assert difference.reversed.estimate.value == -difference.estimate.value
    assert difference.reversed.estimate.low == -difference.estimate.high


def test_what_months_are_worth_falls_out_of_a_difference():
    hard = 10 * np.random.default_rng(0).normal(size=(1, 40, 1))
    noise = 0.1 * np.random.default_rng(1).normal(size=(2, 3, 40, 1))
    x, y = Scores(hard + noise[0] + 0.2), Scores(hard + noise[1])
    (difference,) = paired_differences([x, y], [(0, 1)])
    assert 0 < difference.estimate.low < 0.2 < difference.estimate.high < 0.4
    assert difference.p < 1e-6
    with pytest.raises(ValueError, match="got 40, 3 of them"):
        paired_differences([x, Scores(table(1, 3)[:, :, None])], [(0, 1)])


def test_holms_correction_by_hand():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == pytest.approx([1.0, 1.0])
    corrected = holm([0.01, np.nan, 0.02])
    assert corrected[[0, 2]] == pytest.approx([0.02, 0.02])
    assert np.isnan(corrected[1])


@pytest.mark.parametrize("ties", [False, True])
def test_the_probability_of_improvement_is_the_statistic_of_mann_and_whitney(ties):
    random = np.random.default_rng(0)
    a, b = random.uniform(size=(3, 5, 2)), random.uniform(size=(2, 5, 4))
    x, y = (Scores(np.round(one, 1) if ties else one, UNIT) for one in (a, b))
    expected = np.mean(
        [
            stats.mannwhitneyu(x.values[:, m].ravel(), y.values[:, m].ravel(), alternative="greater").statistic / 48
            for m in range(5)
        ]
    )
    assert probability_of_improvement(x, y).value == pytest.approx(expected, rel=1e-12)
    assert probability_of_improvement(y, x).value == pytest.approx(1 - expected, rel=1e-12)
    with pytest.raises(ValueError, match="got 5 and 6 of them"):
        probability_of_improvement(x, Scores(np.ones((1, 6, 1))))


def test_an_improvement_in_every_month_is_no_certainty():
    worse = np.random.default_rng(0).uniform(size=(1, 8, 1))
    improvement = probability_of_improvement(Scores(worse + 0.01), Scores(worse))
    assert (improvement.value, improvement.high) == (1.0, 1.0)
    assert improvement.low == pytest.approx(wilson_interval(8, 8)[0])
