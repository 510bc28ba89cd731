"""Aggregates and their intervals against hand-computed values, SciPy, rliable and data whose truth is known."""

from __future__ import annotations

import time

import numpy as np
import pytest
from scipy import stats

from rl2grid.records.resampling import drawn
from rl2grid.records.statistics import (
    UNIT,
    Aggregate,
    Scores,
    aggregated,
    curve_band,
    episode_mean,
    estimate,
    iqm_score,
    mean_score,
    median_score,
    optimality_gap,
    profile_band,
    resampled,
)

EXACT = 1e-12
"""Of sums of fewer than a hundred numbers of order 1, in another order."""
AGGREGATES: tuple[Aggregate, ...] = (mean_score, iqm_score, median_score, optimality_gap)


def scores(runs: int = 4, months: int = 6, seeds: int = 3, *, seed: int = 0, ties: bool = False) -> Scores:
    values = np.random.default_rng(seed).uniform(size=(runs, months, seeds))
    return Scores(np.round(values, 1) if ties else values, UNIT)


def test_aggregates_by_hand():
    # Two months with means 0.25 and 1.25, of two seeds each.
    one = Scores(np.array([[[0.0, 0.5], [0.5, 2.0]]]))
    assert aggregated(one) == pytest.approx(0.75)
    assert aggregated(Scores(np.array([[[0.0, 0.2], [0.3, 0.5], [1.0, 1.0]]])), median_score) == pytest.approx(0.4)
    assert aggregated(one, median_score) == pytest.approx(0.75)
    assert aggregated(one, iqm_score) == pytest.approx(0.5)
    assert aggregated(one, optimality_gap) == pytest.approx(1 - (0.0 + 0.5 + 0.5 + 1.0) / 4)
    share, low, high = profile_band(Scores(one.values / 2, UNIT), [0.0, 0.2, 0.25, 1.0])
    np.testing.assert_allclose(share, [0.75, 0.75, 0.25, 0.0])
    assert (low <= share).all()
    assert (share <= high).all()


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 8, 50, 101])
def test_the_interquartile_mean_is_the_trimmed_mean_of_scipy(n):
    values = np.random.default_rng(n).normal(size=(1, n, 1))
    assert aggregated(Scores(values), iqm_score) == pytest.approx(stats.trim_mean(values.ravel(), 0.25), rel=EXACT)


@pytest.mark.parametrize("ties", [False, True])
@pytest.mark.parametrize("aggregate", AGGREGATES)
def test_resampled_aggregates_are_those_of_the_tables_that_were_drawn(aggregate, ties):
    one = scores(3, 5, 2, ties=ties)
    runs, months = drawn(3, 7, 1), drawn(5, 7, 0)
    samples = resampled(one, aggregate, 7)
    for sample, run, month in zip(samples, runs.astype(int), months.astype(int), strict=True):
        table = one.values[np.repeat(np.arange(3), run)][:, np.repeat(np.arange(5), month)]
        assert sample == pytest.approx(aggregated(Scores(table), aggregate), rel=EXACT)


def test_draws_repeat_themselves_and_differ_between_streams():
    assert drawn(9, 50, 1).sum(axis=1).tolist() == [9.0] * 50
    np.testing.assert_array_equal(drawn(9, 50, 1), drawn.__wrapped__(9, 50, 1))
    assert (drawn(9, 50, 1) != drawn(9, 50, 2)).any()
    np.testing.assert_array_equal(drawn(1, 3, 5), np.ones((3, 1)))


def test_the_interval_of_one_run_is_students_over_months():
    values = np.random.default_rng(1).normal(size=(1, 40, 2))
    interval = estimate(Scores(values))
    low, high = stats.t.interval(0.95, 39, values.mean(), stats.sem(values.mean(axis=-1).ravel()))
    # Percentiles of 2000 resamples keep some skewness: the width is Student's to a few percent.
    assert interval.high - interval.low == pytest.approx(high - low, rel=0.05)
    assert interval.low < interval.value < interval.high


def test_runs_that_differ_make_the_interval_as_wide_as_their_number_is_small():
    # Runs differ, months and seeds do not: Student's t of the runs' means.
    means = np.array([0.1, 0.4, 0.5, 0.9])
    one = Scores(np.broadcast_to(means[:, None, None], (4, 10, 3)).copy())
    interval = estimate(one)
    low, high = stats.t.interval(0.95, 3, means.mean(), stats.sem(means))
    assert interval.high - interval.low == pytest.approx(high - low, rel=0.05)


def test_no_interval_leaves_what_is_possible():
    assert estimate(Scores(np.array([[[0.0], [0.0], [9.0]]]), (0.0, np.inf))).low == 0.0
    one = scores(3, 5, 1)
    for aggregate in AGGREGATES:
        interval = estimate(one, aggregate)
        assert 0 <= interval.low <= interval.value <= interval.high <= 1


def test_agreement_in_every_month_still_leaves_doubt():
    interval = estimate(Scores(np.ones((1, 20, 1)), UNIT))
    assert (interval.value, interval.high) == (1.0, 1.0)
    assert interval.low == pytest.approx(0.8389, abs=1e-4)  # Wilson, 20 of 20
    assert estimate(Scores(np.ones((3, 20, 2)), UNIT), iqm_score).low == pytest.approx(0.8389, abs=1e-4)


def test_one_month_tells_nothing_of_others():
    interval = estimate(Scores(np.array([[[3.0, 4.0]]])))
    assert interval.value == 3.5
    assert np.isnan([interval.low, interval.high]).all()
    share = estimate(Scores(np.array([[[0.5]]]), UNIT))
    assert share.low < 0.1 < 0.9 < share.high


def test_what_means_nothing_is_refused():
    with pytest.raises(ValueError, match="non-empty"):
        Scores(np.zeros((1, 0, 1)))
    with pytest.raises(ValueError, match="finite"):
        Scores(np.full((1, 1, 1), np.nan))


def test_a_profile_falls_and_its_band_holds_it():
    value, low, high = profile_band(scores(), np.linspace(0, 1, 21))
    assert (np.diff(value) <= 0).all()
    assert (low <= value).all()
    assert (value <= high).all()
    assert value[-1] == 0.0 < high[-1]


def test_a_band_of_curves_is_students_at_every_point():
    curves = np.random.default_rng(3).normal(size=(6, 4))
    average, low, high = curve_band(curves)
    expected = stats.t.interval(0.95, 5, curves.mean(axis=0), stats.sem(curves, axis=0))
    np.testing.assert_allclose(average, curves.mean(axis=0), rtol=EXACT)
    np.testing.assert_allclose([low, high], expected, rtol=1e-9)


def test_ten_runs_on_five_hundred_months_are_fast():
    one = Scores(np.random.default_rng(0).uniform(size=(10, 500, 1)), UNIT)
    began = time.process_time()
    for aggregate in AGGREGATES:
        estimate(one, aggregate)
    assert time.process_time() - began < 3.0  # a sixth of a second on one core


def test_a_mean_over_episodes_is_that_of_the_episodes_themselves():
    random = np.random.default_rng(0)
    counts = random.integers(1, 9, 40)
    values = random.uniform(size=40)
    episodes = np.repeat(values, counts)
    smoothed = episode_mean(values, counts, 25)
    for point, end in enumerate(np.cumsum(counts)):
        assert smoothed[point] == pytest.approx(episodes[max(0, end - 25) : end].mean(), rel=1e-10)
    with pytest.raises(ValueError, match="at least one"):
        episode_mean([1.0], [1], 0)


def test_aggregates_are_those_of_rliable():
    metrics = pytest.importorskip("rliable.metrics")
    one = scores(1, 6, 7, ties=True)
    theirs = one.values[0].T  # [run, task]
    assert aggregated(one) == pytest.approx(metrics.aggregate_mean(theirs), rel=EXACT)
    assert aggregated(one, median_score) == pytest.approx(metrics.aggregate_median(theirs), rel=EXACT)
    assert aggregated(one, iqm_score) == pytest.approx(metrics.aggregate_iqm(theirs), rel=EXACT)
    assert aggregated(one, optimality_gap) == pytest.approx(metrics.aggregate_optimality_gap(theirs, 1.0), rel=EXACT)
