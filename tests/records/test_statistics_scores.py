"""Aggregates, profiles and comparisons of scores against SciPy, rliable and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rl2grid.records.statistics import (
    Scores,
    Unit,
    episode_mean,
    estimate,
    iqm_score,
    mean_score,
    median_score,
    optimality_gap,
    probability_of_improvement,
    score_band,
    share_above,
    stratified_bootstrap,
)

EXACT = 1e-12
"""Of sums of fewer than a hundred numbers of order 1, in another order."""


def scores(runs: int = 4, scenarios: int = 6, seeds: int = 3, *, seed: int = 0, ties: bool = False) -> Scores:
    values = np.random.default_rng(seed).uniform(size=(runs, scenarios, seeds))
    return Scores(np.round(values, 1) if ties else values)


def test_aggregates_by_hand():
    # Two scenarios with means 0.25 and 1.25, of two repetitions each.
    values = np.array([[0.0, 0.5], [0.5, 2.0]])
    assert mean_score(values) == pytest.approx(0.75)
    assert median_score(np.array([[0.0, 0.2], [0.3, 0.5], [1.0, 1.0]])) == pytest.approx(0.4)
    assert iqm_score(values) == pytest.approx(0.5)
    assert optimality_gap(values) == pytest.approx(1 - (0.0 + 0.5 + 0.5 + 1.0) / 4)
    assert optimality_gap(values, 0.5) == pytest.approx(0.5 - 1.5 / 4)
    np.testing.assert_allclose(share_above([0.0, 0.4, 0.5, 2.0])(values), [0.75, 0.75, 0.25, 0.0])


def test_resampled_aggregates_are_those_of_each_resample():
    samples = scores().resampled(Unit.RUN, 7)
    for aggregate in (mean_score, iqm_score, median_score, optimality_gap, share_above([0.2, 0.7])):
        one_by_one = np.stack([aggregate(sample) for sample in samples])
        np.testing.assert_allclose(aggregate(samples), one_by_one, rtol=EXACT)


@pytest.mark.parametrize("ties", [False, True])
def test_probability_of_improvement_is_the_statistic_of_mann_and_whitney(ties):
    x, y = scores(3, 5, 2, ties=ties), scores(2, 5, 4, seed=1, ties=ties)
    expected = np.mean(
        [
            stats.mannwhitneyu(a, b, alternative="greater").statistic / (a.size * b.size)
            for a, b in zip(x.by_scenario, y.by_scenario, strict=True)
        ]
    )
    assert probability_of_improvement(x, y).value == pytest.approx(expected, rel=EXACT)
    assert probability_of_improvement(y, x).value == pytest.approx(1 - expected, rel=EXACT)


def test_the_interval_of_an_improvement_is_that_of_comparing_anew_in_each_resample():
    x, y = scores(1, 4, 6), scores(1, 4, 5, seed=1)
    a, b = x.resampled(Unit.SEED, 400, 0), y.resampled(Unit.SEED, 400, 1)
    compared = (a[..., :, None] > b[..., None, :]).mean(axis=(1, 2, 3))
    interval = probability_of_improvement(x, y, resamples=400)
    assert (interval.low, interval.high) == pytest.approx(np.quantile(compared, [0.025, 0.975]), rel=EXACT)


@pytest.mark.parametrize("shape", [(5, 4, 1), (1, 30, 1)])
def test_an_improvement_over_oneself_is_even(shape):
    one = scores(*shape)
    interval = probability_of_improvement(one, one)
    assert interval.value == pytest.approx(0.5)
    assert interval.low <= 0.5 <= interval.high


def test_an_improvement_in_every_month_is_certain():
    worse = scores(1, 8, 1)
    better = Scores(worse.values + 0.01)
    assert probability_of_improvement(better, worse) == probability_of_improvement(better, worse, seed=3)
    assert probability_of_improvement(better, worse).low == 1.0


def test_scores_of_other_scenarios_are_refused():
    with pytest.raises(ValueError, match="got 6 and 5"):
        probability_of_improvement(scores(), scores(scenarios=5))
    with pytest.raises(ValueError, match="non-empty"):
        Scores(np.zeros((1, 0, 1)))
    with pytest.raises(ValueError, match="finite"):
        Scores(np.full((1, 1, 1), np.nan))


def test_what_is_resampled_depends_on_what_was_repeated():
    assert scores(2, 6, 1).unit is Unit.RUN
    assert scores(1, 6, 2).unit is Unit.SEED
    assert scores(1, 6, 1).unit is Unit.SCENARIO


def test_seeds_stay_within_their_scenario():
    values = np.broadcast_to(np.arange(5.0)[:, None], (1, 5, 3)).copy()
    interval = estimate(Scores(values))
    assert (interval.low, interval.high) == (2.0, 2.0)


def test_seeds_are_resampled_as_by_the_stratified_bootstrap():
    one = scores(1, 6, 5)
    strata = np.repeat(np.arange(6), 5).tolist()
    assert estimate(one) == stratified_bootstrap(one.by_scenario.reshape(-1), strata=strata)


def test_runs_are_resampled_whole():
    # Runs differ, scenarios and seeds do not: the interval is that of the runs' means.
    means = np.array([0.1, 0.4, 0.5, 0.9])
    one = Scores(np.broadcast_to(means[:, None, None], (4, 10, 3)).copy())
    interval, expected = estimate(one), stratified_bootstrap(means)
    assert (interval.value, interval.low, interval.high) == pytest.approx(
        (expected.value, expected.low, expected.high), rel=EXACT
    )


def test_intervals_over_runs_cover_the_truth_where_those_within_scenarios_do_not():
    random = np.random.default_rng(5)
    by_run = within = 0
    for _ in range(100):
        # Whole runs are good or bad: episodes of one run are no independent repetitions.
        one = Scores(random.normal(size=(8, 1, 1)) + 0.1 * random.normal(size=(8, 20, 1)))
        interval = estimate(one, resamples=300)
        by_run += interval.low <= 0 <= interval.high
        samples = mean_score(one.resampled(Unit.SEED, 300))
        low, high = np.quantile(samples, [0.025, 0.975])
        within += low <= 0 <= high
    assert by_run >= 80  # percentile intervals of eight runs are a little narrow
    assert within <= 60


def test_a_profile_falls_and_its_band_holds_it():
    value, low, high = score_band(scores(), share_above(np.linspace(0, 1, 21)))
    assert (np.diff(value) <= 0).all()
    assert (low <= value).all()
    assert (value <= high).all()
    assert value[-1] == 0.0


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
    x, y = scores(1, 6, 7, ties=True), scores(1, 6, 4, seed=1, ties=True)
    theirs = x.by_scenario.T  # [run, task]
    assert mean_score(x.by_scenario) == pytest.approx(metrics.aggregate_mean(theirs), rel=EXACT)
    assert median_score(x.by_scenario) == pytest.approx(metrics.aggregate_median(theirs), rel=EXACT)
    assert iqm_score(x.by_scenario) == pytest.approx(metrics.aggregate_iqm(theirs), rel=EXACT)
    assert optimality_gap(x.by_scenario, 0.6) == pytest.approx(metrics.aggregate_optimality_gap(theirs, 0.6), rel=EXACT)
    expected = metrics.probability_of_improvement(theirs, y.by_scenario.T)
    assert probability_of_improvement(x, y).value == pytest.approx(expected, rel=EXACT)


def test_profiles_and_intervals_are_those_of_rliable():
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    one = scores(1, 6, 8)
    theirs = {"one": one.by_scenario.T}
    levels = np.linspace(0, 1, 11)
    profiles, bands = library.create_performance_profile(theirs, levels, reps=4000)
    value, low, high = score_band(one, share_above(levels), resamples=4000)
    np.testing.assert_allclose(value, profiles["one"], atol=EXACT)
    # Percentiles of 4000 resamples of shares of 48 scores: two scores apart at most.
    np.testing.assert_allclose([low, high], bands["one"], atol=2 / 48 + EXACT)
    _, intervals = library.get_interval_estimates(theirs, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=4000)
    ours = estimate(one, iqm_score, resamples=4000)
    # A tenth of the interval's width.
    assert [ours.low, ours.high] == pytest.approx(intervals["one"][:, 0], abs=0.1 * (ours.high - ours.low))
