"""Intervals of shares against textbooks and SciPy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rl2grid.records.shares import score_interval, share_intervals, wilson_interval
from rl2grid.records.variance import Spread


def test_wilsons_interval_is_the_textbooks():
    # Brown, Cai and DasGupta (2001): bounds p with |k/n - p| = z sqrt(p (1 - p) / n); first two worked by hand.
    low, high = wilson_interval([8, 0, 10, 0], [10, 10, 10, 0])
    np.testing.assert_allclose(low, [0.4902, 0.0, 0.7225, 0.0], atol=5e-5)
    np.testing.assert_allclose(high, [0.9433, 0.2775, 1.0, 1.0], atol=5e-5)
    k, n = np.array([3, 77, 950]), np.array([11, 100, 1000])
    for bound in wilson_interval(k, n):
        np.testing.assert_allclose(np.abs(k / n - bound), 1.959964 * np.sqrt(bound * (1 - bound) / n), rtol=1e-6)


def test_a_share_of_one_run_has_wilsons_interval():
    for k in (0, 1, 7, 20):
        months = (np.arange(20) < k).astype(float)
        low, high = share_intervals(months[None, :, None])
        expected = stats.binomtest(k, 20).proportion_ci(method="wilson")
        assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-9)


def test_runs_that_play_alike_are_no_further_attempts():
    months = (np.arange(20) < 7).astype(float)[None, :, None]
    alike = share_intervals(np.repeat(months, 3, axis=0))
    np.testing.assert_allclose(alike, share_intervals(months), atol=1e-9)
    assert share_intervals(np.zeros((3, 20, 2)))[1] == pytest.approx(wilson_interval(0, 20)[1])
    # Runs of which one completes everything and the others nothing say little of the next one.
    runs = np.zeros((3, 20, 1))
    runs[0] = 1.0
    low, high = share_intervals(runs)
    assert low < 0.05
    assert high > 0.9


@pytest.mark.parametrize("runs", [1, 5])
def test_months_that_are_seldom_lost_are_in_the_interval(runs):
    """19 of 20 months are completed: few or none of those that are not was seen."""
    random = np.random.default_rng(runs)
    shape = (1500, 1, 20)
    months = 1.6 + 0.3 * random.normal(size=shape)
    table = np.clip(months + 0.2 * random.normal(size=(1500, runs, 20)), 0, 1)
    values = stats.norm.ppf((np.arange(100_000) + 0.5) / 100_000, 1.6, np.hypot(0.3, 0.2))
    low, high = share_intervals(table[..., None])
    held = (low <= np.clip(values, 0, 1).mean()) & (np.clip(values, 0, 1).mean() <= high)
    assert 0.9 <= held.mean() <= 0.98


def test_few_runs_leave_doubt_of_a_figure_at_its_end():
    three = Spread(np.array(0.01), np.array(2.0), np.array(2.0))
    low, high = score_interval(1.0, three, 200)
    assert high == 1.0
    assert low < wilson_interval(50, 50)[0], "three runs that differ tell less than two hundred months"
