"""From costs to scores: against Grid2Op's code, and by hand."""

from types import SimpleNamespace

import numpy as np
import pytest
from grid2op.Reward._newRenewableSourcesUsageScore import _NewRenewableSourcesUsageScore
from grid2op.utils import ScoreL2RPN2020
from sample_results import episode

from rl2grid.errors import UsageError
from rl2grid.records.l2rpn import (
    Baselines,
    cost_2020,
    cost_2022,
    operation_of,
    operational_score,
    read_scores,
    renewable_score,
    score_columns,
    scores_of,
    write_scores,
)

DEAREST = 70.0


def operation(**costs):
    names = ("cost_losses", "cost_redispatch", "cost_curtailment", "cost_storage", "cost_blackout")
    return {
        **dict.fromkeys((*names, "storage_energy"), 0.0),
        "renewable_used": 9.0,
        "renewable_available": 10.0,
        **costs,
    }


def score_there(costs, played, demand, nothing, nothing_played, reconnecting):
    """What Grid2Op computes of costs and demand of each step; it drops the last cost of an episode."""
    steps = len(demand)
    scorer = object.__new__(ScoreL2RPN2020)
    scorer.env = SimpleNamespace(gen_cost_per_MW=np.array([DEAREST, 1.0]))
    scorer.min_losses_ratio, scorer.max_step = 0.8, -1

    def statistics(values):
        def get(name):
            if name == "load_p":
                return np.array([[0.0], *([load] for load in demand)]), np.zeros((steps + 1, 1), int)
            return values, np.zeros((len(values), 1), int)

        return SimpleNamespace(get=get)

    scorer.stat_dn, scorer.stat_no_overflow_rp = statistics(nothing), statistics(reconnecting)
    found, _, _ = scorer._compute_episode_score(
        0,
        {"nb_timestep_played": played},
        [{"_scores": cost} for cost in costs],
        {"0": {"nb_step": nothing_played + 1}, "max_step": -1},
        {"0": {"nb_step": steps + 1}},
    )
    return float(found)


@pytest.mark.parametrize("played", [3, 17, 30])
@pytest.mark.parametrize("nothing_played", [8, 30])
def test_a_score_is_that_of_grid2op(played, nothing_played):
    rng = np.random.default_rng(played + nothing_played)
    demand = rng.uniform(90, 110, 30)
    costs, nothing, reconnecting = (rng.uniform(400, 500, steps) for steps in (played, nothing_played, 30))

    def whole(steps_of, last):
        return operation(cost_losses=steps_of[:-1].sum(), cost_blackout=DEAREST * demand[last:].sum())

    baselines = Baselines(DEAREST * demand.sum(), whole(nothing, nothing_played), whole(reconnecting, 30))
    expected = score_there(costs, played, demand, nothing, nothing_played, reconnecting)
    found = operational_score(whole(costs, played), baselines, cost_2020)
    assert found == pytest.approx(expected, abs=1e-3)
    assert -100 < found < 100


def test_the_four_points():
    baselines = Baselines(10_000.0, operation(cost_blackout=6000.0), operation(cost_losses=1000.0))
    points = {0.0: 100, 500.0: 90, 1000.0: 80, 3500.0: 40, 6000.0: 0, 8000.0: -50, 10_000.0: -100}
    for cost, score in points.items():
        assert operational_score(operation(cost_redispatch=cost), baselines, cost_2020) == pytest.approx(score)
    equal = Baselines(10_000.0, operation(cost_losses=1000.0), operation(cost_losses=1000.0))
    assert operational_score(operation(cost_curtailment=500.0), equal, cost_2020) == 50


def test_storage_has_a_price_of_its_own_in_2022():
    played = operation(cost_losses=1.0, cost_storage=50.0, storage_energy=3.0)
    assert (cost_2020(played), cost_2022(played)) == (51, 31)


@pytest.mark.parametrize("share", [100.0, 93.0, 80.0, 65.0, 50.0])
def test_the_renewable_part_is_that_of_grid2op(share):
    expected = 100 * float(_NewRenewableSourcesUsageScore._surlinear_func_curtailment(share))
    assert renewable_score(share, 100.0) == pytest.approx(expected, abs=1e-9)


def test_the_renewable_part_has_a_floor_and_a_month_without_renewables():
    assert renewable_score(10.0, 100.0) == -100
    assert renewable_score(0.0, 0.0) == 100


def test_the_score_of_2023_shares_out_the_weight_of_alerts():
    baselines = Baselines(10_000.0, operation(cost_blackout=6000.0), operation(cost_losses=1000.0))
    scores = scores_of(operation(cost_losses=1000.0, renewable_used=10.0), baselines)
    assert (scores.score_2020, scores.renewable_2023) == (80, pytest.approx(100))
    assert scores.score_2023 == pytest.approx((0.6 * 80 + 0.15 * 100) / 0.75)


def test_scores_are_stored_with_what_they_follow_from(tmp_path):
    episodes = [episode("may", cost_losses=float(seed), seed=seed, **ZEROS) for seed in (0, 1)]
    baselines = Baselines(10_000.0, operation(cost_blackout=6000.0), operation(cost_losses=1000.0))
    scores = write_scores(tmp_path, episodes, [baselines] * 2)
    assert read_scores(tmp_path, episodes) == scores
    assert read_scores(tmp_path, [episode("june", **ZEROS, cost_losses=0.0)]) is None
    assert read_scores(tmp_path / "elsewhere", episodes) is None
    table = score_columns([episodes], [scores])["score_2020"]
    assert table.values.shape == (1, 1, 2)
    assert table.values[0, 0, 0] == 100


def test_episodes_that_do_not_say_what_they_cost_have_no_score():
    with pytest.raises(UsageError, match="evaluate them again"):
        operation_of(episode())


ZEROS = dict.fromkeys(
    (
        *("cost_redispatch", "cost_curtailment", "cost_storage", "cost_blackout", "storage_energy"),
        *("renewable_used", "renewable_available"),
    ),
    0.0,
)
