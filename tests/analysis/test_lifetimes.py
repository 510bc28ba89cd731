"""Time to failure against published values and by hand.

The data are remission times of leukaemia patients in weeks (Freireich et al., 1963; Gehan, 1965), which textbooks
compute by hand: 21 under 6-mercaptopurine, 21 under placebo.
"""

from __future__ import annotations

import numpy as np
import pytest
from sample_results import episode
from scipy import stats

from rl2grid.analysis.lifetimes import Lifetimes, kaplan_meier, lifetimes, log_rank

FAILED = [6, 6, 6, 7, 10, 13, 16, 22, 23]
CENSORED = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
TREATED = Lifetimes(
    np.array(FAILED + CENSORED, np.float64), np.array([True] * len(FAILED) + [False] * len(CENSORED), np.bool_)
)
PLACEBO = Lifetimes(
    np.array([1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23], np.float64), np.ones(21, np.bool_)
)


def test_the_published_curve():
    curve = kaplan_meier(TREATED)
    assert curve.steps.tolist() == [0, 6, 7, 10, 13, 16, 22, 23]
    published = [1, 0.857, 0.807, 0.753, 0.690, 0.627, 0.538, 0.448]
    np.testing.assert_allclose(curve.alive, published, atol=5e-4)  # three digits are published
    assert curve.median == 23
    assert sorted(curve.censored) == CENSORED


def test_the_band_is_greenwoods():
    curve = kaplan_meier(TREATED)
    at_risk, lost = np.array([21, 17, 15, 12, 11, 7, 6]), np.array([3, 1, 1, 1, 1, 1, 1])
    deviation = np.sqrt(np.cumsum(lost / (at_risk * (at_risk - lost))))
    published = [0.0764, 0.0869, 0.0963, 0.1068, 0.1141, 0.1282, 0.1346]
    np.testing.assert_allclose(curve.alive[1:] * deviation, published, atol=5e-5)  # four digits are published
    shift = 1.959964 * deviation / np.log(curve.alive[1:])
    np.testing.assert_allclose(curve.low[1:], curve.alive[1:] ** np.exp(-shift), rtol=1e-5)
    np.testing.assert_allclose(curve.high[1:], curve.alive[1:] ** np.exp(shift), rtol=1e-5)
    assert (curve.low[0], curve.high[0]) == (1, 1)


def test_the_published_log_rank_test():
    # Chi squared 16.79 with one degree of freedom.
    assert stats.chi2.isf(log_rank(TREATED, PLACEBO), 1) == pytest.approx(16.79, abs=0.005)


def test_where_all_are_lost_the_band_is_the_last_one():
    curve = kaplan_meier(PLACEBO)
    assert curve.alive[-1] == 0
    assert curve.low[-1] == 0
    assert curve.high[-1] == curve.high[-2]
    assert np.isfinite(curve.high).all()


def test_completed_months_are_censored():
    lived = lifetimes([episode(survival=0.25), episode(seed=1)])
    assert lived.steps.tolist() == [25, 100]
    assert lived.failed.tolist() == [True, False]
    curve = kaplan_meier(lived)
    assert curve.steps.tolist() == [0, 25]
    assert curve.alive.tolist() == [1, 0.5]
    assert curve.median == 25


def test_nobody_lost():
    lived = lifetimes([episode(), episode(seed=1)])
    curve = kaplan_meier(lived)
    assert (curve.steps.tolist(), curve.alive.tolist()) == ([0], [1])
    assert np.isnan(curve.median)
    assert log_rank(lived, lived) == 1.0
