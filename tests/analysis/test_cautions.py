"""What is too little to prove anything is said, and what is enough is left alone."""

from __future__ import annotations

import pytest
from sample_results import TASK, result

from rl2grid.analysis.cautions import FEWEST_MONTHS, MONTHS_OF_SOLVED, cautions, task_cautions
from rl2grid.records.methods import Method, group_methods

LOST = [[0.5], [0.25], [0.75], [0.1]] * 60


def trained(runs: int, months: int) -> list:
    survivals = LOST[:months]
    return [
        result(
            "ppo", survivals, agent_hash=f"h{seed}", agent_identity={"trained_with": {"algorithm": "ppo", "seed": seed}}
        )
        for seed in range(runs)
    ]


def methods(*results) -> tuple[Method, ...]:
    return group_methods(results)[TASK]


def test_enough_needs_no_words():
    assert task_cautions(methods(*trained(3, FEWEST_MONTHS), result("do-nothing", LOST[:FEWEST_MONTHS]))) == []


@pytest.mark.parametrize(
    ("months", "words"),
    [(1, "One month says nothing of other months"), (2, "2 months are too few"), (19, "19 months are too few")],
)
def test_few_months_are_named(months, words):
    (sentence,) = task_cautions(methods(result("do-nothing", LOST[:months])))
    assert sentence.startswith(words)


@pytest.mark.parametrize(("runs", "words"), [(1, "ppo: one training."), (2, "ppo: 2 trainings.")])
def test_few_trainings_are_named(runs, words):
    (sentence,) = task_cautions(methods(*trained(runs, 20), result("do-nothing", LOST[:20])))
    assert sentence.startswith(words)


def test_what_is_nearly_solved_needs_many_months():
    def words(months: int) -> list[str]:
        return task_cautions(methods(result("greedy", [[1.0]] * months), result("do-nothing", LOST[:months])))

    (sentence,) = words(20)
    assert sentence.startswith("greedy: hardly a month was lost, and what 20 months did not show")
    assert words(MONTHS_OF_SOLVED) == []


def test_tasks_share_a_sentence():
    other = "rl2grid/bus14-T1-v0"
    results = [result("a", LOST[:3]), result("a", LOST[:3], task=other)]
    (sentence,) = cautions(group_methods(results))
    assert sentence.startswith("bus14-T0, bus14-T1: 3 months are too few")
    (alone,) = cautions(group_methods(results[:1]))
    assert alone.startswith("3 months")
