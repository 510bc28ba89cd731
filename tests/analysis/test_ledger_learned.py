"""The ledger by ways of learning."""

from __future__ import annotations

import pytest
from sample_ledger import cells, ledger, on, trained, untrained

from rl2grid.analysis.ledger_learned import learned_table
from rl2grid.errors import UsageError

_BEGAN = {"started_from": {"algorithm": "imitation", "hyperparameters": {}}}


def test_ways_of_learning_are_compared_on_the_months_that_all_played():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2, 0.9]),
        untrained("greedy", [0.6, 0.7, 0.9]),
        trained(1, [0.8, 0.9]),
        trained(2, [0.6, 0.9]),
        trained(1, [0.9, 0.9], algorithm="dqn"),  # a single one has no cell
        *(on("rl2grid/bus36-M-T0-v0", trained(seed, [0.4, 0.4], algorithm="imitation")) for seed in (1, 2)),
    )
    headings, _, first, second = cells(learned_table(results))
    assert headings == ["task", "months", "do nothing", "search and rules", "planner", "PPO", "imitation"]
    assert first[:5] == ["bus14-T0", "2", "0.150", "0.650", ""]
    assert first[5].startswith("**0.800 [")
    assert first[5].endswith("]** (2 of 1,000)")
    assert first[6] == ""
    assert second[:6] == ["bus36-M-T0", "2", "", "", "", ""]
    assert second[6].startswith("**0.400 [")


def test_of_a_way_the_longest_survival_is_shown_with_its_budget():
    results = ledger(
        *(trained(seed, [0.5, 0.5]) for seed in (1, 2, 3)),
        *(trained(seed, [0.7, 0.7], steps=2000) for seed in (1, 2)),
        *(trained(seed, [0.6, 0.6], algorithm="lagrangian-ppo") for seed in (1, 2)),
    )
    headings, _, row = cells(learned_table(results))
    assert headings[5:] == ["PPO"]
    assert row[5].startswith("**0.700 [")
    assert row[5].endswith("(2 of 2,000)")


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({"algorithm": "sac"}, "SAC, TD3 or DQN"),
        (_BEGAN, "going on from a policy"),
        ({"top_k": 10}, "looking before acting"),
        ({**_BEGAN, "rehearse": 24}, "looking before acting"),
        ({"algorithm": "reinforce"}, "reinforce"),  # of one's own
    ],
)
def test_ways_have_columns_of_their_own(changes, way):
    results = ledger(*(trained(seed, [0.5]) for seed in (1, 2)), *(trained(seed, [0.6], **changes) for seed in (1, 2)))
    headings, _, row = cells(learned_table(results))
    assert headings[5:] == ["PPO", way]
    assert [cell[:8] for cell in row[5:]] == ["0.500 [0", "**0.600 "]


def test_a_ledger_without_repeated_trainings_is_refused():
    with pytest.raises(UsageError, match="trained with several seeds"):
        learned_table(ledger(untrained("greedy", [0.6]), trained(1, [0.8])))
