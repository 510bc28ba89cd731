"""Statistics against hand-computed values, SciPy, and synthetic data whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from rl2grid.records.statistics import (
    bootstrap_band,
    interquartile_mean,
    mean,
    stratified_bootstrap,
)


def test_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -50.0])) == pytest.approx(3.5)
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == pytest.approx(3.0)  # nothing to cut from three
    assert interquartile_mean(np.array([0.0, 1.0, 2.0, 50.0, 9.0])) == pytest.approx(4.0)  # one cut at each end


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 8, 50, 101])
def test_interquartile_mean_is_the_trimmed_mean_of_scipy(n):
    values = np.random.default_rng(n).normal(size=(3, n))
    np.testing.assert_allclose(interquartile_mean(values), stats.trim_mean(values, 0.25, axis=1), rtol=1e-12)


def test_an_interval_holds_its_value_and_repeats_itself():
    values = np.random.default_rng(0).uniform(size=40)
    first, again = stratified_bootstrap(values), stratified_bootstrap(values)
    assert first == again
    assert first.value == pytest.approx(values.mean())
    assert first.low < first.value < first.high
    assert stratified_bootstrap(values, seed=1) != first


def test_the_bootstrap_of_a_mean_has_the_closed_form_width():
    values = np.random.default_rng(1).normal(size=400)
    interval = stratified_bootstrap(values, resamples=20_000)
    standard_error = values.std() / np.sqrt(len(values))
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * standard_error, rel=0.03)


def test_strata_keep_their_share_of_a_resample():
    values = np.array([0.0] * 5 + [1.0] * 5)
    assert stratified_bootstrap(values, strata=["a"] * 5 + ["b"] * 5).low == pytest.approx(0.5)
    assert stratified_bootstrap(values, strata=["a"] * 5 + ["b"] * 5).high == pytest.approx(0.5)
    assert stratified_bootstrap(values).low < 0.35


def test_strata_may_be_interleaved_and_of_different_sizes():
    values = np.array([0.0, 10.0, 0.0, 20.0, 30.0])
    interval = stratified_bootstrap(values, strata=["zero", "some", "zero", "some", "some"])
    assert interval.value == pytest.approx(12.0)
    assert interval.low >= 30 / 5  # at least thrice the smallest of the second stratum
    assert interval.high <= 90 / 5


@pytest.mark.parametrize("statistic", [mean, interquartile_mean])
def test_intervals_cover_the_truth_about_as_often_as_they_claim(statistic):
    random = np.random.default_rng(2)
    covered = 0
    for _ in range(300):
        scenarios = np.repeat([0.0, 2.0], 15)
        interval = stratified_bootstrap(
            random.normal(scenarios, 1.0), statistic, strata=scenarios.tolist(), resamples=400
        )
        covered += interval.low <= 1.0 <= interval.high
    assert 0.88 <= covered / 300 <= 0.98


@pytest.mark.parametrize("values", [[], [0.1, np.nan], [np.inf], [[0.0, 1.0]]])
def test_values_that_mean_nothing_are_refused(values):
    with pytest.raises(ValueError, match="Results must be"):
        stratified_bootstrap(values)


def test_strata_of_another_length_are_refused():
    with pytest.raises(ValueError, match="2 results but 1"):
        stratified_bootstrap([0.0, 1.0], strata=["a"])


def test_a_band_is_the_bootstrap_at_every_point():
    curves = np.random.default_rng(3).normal(size=(6, 4))
    average, low, high = bootstrap_band(curves)
    for point in range(4):
        expected = stratified_bootstrap(curves[:, point])
        assert (average[point], low[point], high[point]) == pytest.approx((expected.value, expected.low, expected.high))
