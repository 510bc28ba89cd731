"""What the metrics of an iteration say of the episodes that ended in it."""

from __future__ import annotations

import numpy as np
import pytest

from rl2grid.algorithms.playing import Tally


def note(tally, ended, final_info):
    n = len(ended)
    nothing = np.zeros(n, np.int64)
    tally.note(np.ones(n, np.int64), 0.1, {"final_info": final_info}, np.array(ended), np.arange(n) * 1.0, nothing)


def test_scores_and_costs_are_means_over_the_episodes_that_ended():
    tally = Tally()
    final = {
        "survival": np.array([0.1, 0.2, 0.9]),
        "scores": {name: np.array([1.0, 2.0, 6.0]) + k for k, name in enumerate(("margin", "overload", "topology"))},
        "episode_costs": {"LSI": np.array([0.0, 1.0, 2.0]), "TLO": np.array([5.0, 50.0, 7.0])},
    }
    note(tally, [True, False, True], final)
    note(tally, [False, True, False], final)
    metrics = tally.metrics()
    assert metrics["charts/episodes"] == 3
    assert metrics["charts/survival"] == pytest.approx(0.4)
    assert metrics["charts/score_margin"] == pytest.approx(3.0)
    assert metrics["charts/score_overload"] == pytest.approx(4.0)
    assert metrics["charts/score_topology"] == pytest.approx(5.0)
    assert metrics["charts/cost_lsi"] == pytest.approx(1.0)
    assert metrics["charts/cost_tlo"] == pytest.approx(62 / 3)


def test_what_an_environment_does_not_report_is_no_metric():
    tally = Tally()
    note(tally, [True, False], {"survival": np.array([0.5, 0.0])})
    assert tally.metrics()["charts/survival"] == 0.5
    assert not {name for name in tally.metrics() if "score" in name or "cost" in name}
