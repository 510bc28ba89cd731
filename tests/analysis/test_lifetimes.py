"""Time to failure against published values and by hand.

The data are remission times of leukaemia patients in weeks (Freireich et al., 1963; Gehan, 1965), which textbooks
compute by hand: 21 under 6-mercaptopurine, 21 under placebo.
"""

from __future__ import annotations

import numpy as np
from sample_results import episode

from rl2grid.analysis.lifetimes import Lifetimes, kaplan_meier, lifetimes
from rl2grid.records.shares import wilson_interval

FAILED = [6, 6, 6, 7, 10, 13, 16, 22, 23]
CENSORED = [6, 9, 10, 11, 17, 19, 20, 25, 32, 32, 34, 35]
TREATED = Lifetimes(
    np.array(FAILED + CENSORED, np.float64)[None, :, None],
    np.array([True] * len(FAILED) + [False] * len(CENSORED), np.bool_)[None, :, None],
)
PLACEBO = Lifetimes(
    np.array([1, 1, 2, 2, 3, 4, 4, 5, 5, 8, 8, 8, 8, 11, 11, 12, 12, 15, 17, 22, 23], np.float64)[None, :, None],
    np.ones((1, 21, 1), np.bool_),
)


def test_the_published_curve():
    curve = kaplan_meier(TREATED)
    assert curve.steps.tolist() == [0, 6, 7, 10, 13, 16, 22, 23]
    published = [1, 0.857, 0.807, 0.753, 0.690, 0.627, 0.538, 0.448]
    np.testing.assert_allclose(curve.alive, published, atol=5e-4)  # three digits are published
    assert curve.median == 23
    assert sorted(curve.censored) == CENSORED


def test_the_band_has_the_variance_of_greenwood():
    curve = kaplan_meier(TREATED)
    at_risk, lost = np.array([21, 17, 15, 12, 11, 7, 6]), np.array([3, 1, 1, 1, 1, 1, 1])
    deviation = curve.alive[1:] * np.sqrt(np.cumsum(lost / (at_risk * (at_risk - lost))))
    published = [0.0764, 0.0869, 0.0963, 0.1068, 0.1141, 0.1282, 0.1346]
    np.testing.assert_allclose(deviation, published, atol=5e-5)  # four digits are published
    # One run: a life is a month, and the variance of a mean has the denominator n - 1.
    n = 1 + curve.alive[1:] * (1 - curve.alive[1:]) / (deviation**2 * 21 / 20)
    low, high = wilson_interval(curve.alive[1:] * n, n)
    np.testing.assert_allclose([curve.low[1:], curve.high[1:]], [low, high], rtol=1e-9)


def test_a_share_without_censoring_has_its_own_interval():
    curve = kaplan_meier(PLACEBO)
    assert (curve.alive[-1], curve.low[-1]) == (0, 0)
    for alive, low, high in zip(curve.alive, curve.low, curve.high, strict=True):
        np.testing.assert_allclose([low, high], wilson_interval(21 * alive, 21), atol=1e-9)


def test_runs_that_die_alike_do_not_narrow_the_band():
    steps = np.array([3.0, 9.0, 9.0, 20.0])[None, :, None]
    one = Lifetimes(steps, steps < 20)
    three = kaplan_meier(Lifetimes(np.repeat(steps, 3, axis=0), np.repeat(steps < 20, 3, axis=0)))
    np.testing.assert_allclose(three.low, kaplan_meier(one).low)


def test_completed_months_are_censored():
    lived = lifetimes([[episode(survival=0.25), episode(seed=1)]])
    assert lived.steps.tolist() == [[[25, 100]]]
    assert lived.failed.tolist() == [[[True, False]]]
    curve = kaplan_meier(lived)
    assert curve.steps.tolist() == [0, 25]
    assert curve.alive.tolist() == [1, 0.5]
    assert curve.median == 25


def test_nobody_lost():
    lived = lifetimes([[episode(), episode(seed=1)]])
    curve = kaplan_meier(lived)
    assert (curve.steps.tolist(), curve.alive.tolist()) == ([0], [1])
    assert np.isnan(curve.median)
    assert (curve.low[0], curve.high[0]) == (wilson_interval(1, 1)[0], 1)
