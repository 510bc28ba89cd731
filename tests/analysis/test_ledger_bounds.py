"""What is left to gain, beside what the ledger holds."""

from __future__ import annotations

from dataclasses import replace

import pytest
from sample_ledger import ledger, trained, untrained

from rl2grid.analysis.ledger_bounds import headroom_table
from rl2grid.errors import UsageError
from rl2grid.records.ledger import HashedTest


def by_rules(test: HashedTest, heuristic: str) -> HashedTest:
    return replace(test, configuration={**test.configuration, "heuristic": heuristic})


def test_everybody_is_compared_on_the_months_of_the_bound():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2, 1.0]),
        untrained("greedy", [0.3, 0.9, 1.0]),
        untrained("planner", [0.6, 0.4, 0.0], rules=2),
        by_rules(untrained("planner", [0.7, 0.1, 1.0]), "careful"),  # by earlier rules: of nobody's mean
        trained(1, [0.2, 0.2, 1.0]),
        trained(2, [0.4, 0.4, 1.0]),
    )
    bound = by_rules(untrained("foresight", [0.8, 0.5]), "idle")
    header, _, row = headroom_table(results, ledger(bound)).splitlines()
    assert header == (
        "| task | heuristic | months | do nothing | search and rules | planner | learned | with foresight | anybody | "
        "the planner reaches |"
    )
    # Who survives longest of all months is shown by the months of the bound; anybody: 0.8 and 0.9.
    assert row == (
        "| bus14-T0 | `idle` | 2 | 0.150 | 0.600 greedy | 0.500 | 0.300 ppo + idle | 0.650 | **0.850** | 59% |"
    )


def test_what_somebody_survived_by_earlier_rules_can_be_survived():
    results = ledger(untrained("planner", [0.2, 0.2], rules=2), by_rules(untrained("planner", [0.9, 0.1]), "idle"))
    assert "| **0.600** | 33% |" in headroom_table(results, ledger(untrained("foresight", [0.3, 0.3])))


def test_who_played_fewer_or_other_months_is_left_out():
    results = ledger(
        untrained("planner", [1.0]),
        replace(
            untrained("greedy", [1.0, 1.0]), months={**untrained("greedy", [1.0, 1.0]).months, "split": "validation"}
        ),
    )
    row = headroom_table(results, ledger(untrained("foresight", [0.3, 0.3]))).splitlines()[2]
    assert row == "| bus14-T0 |  | 2 |  |  |  |  | 0.300 | **0.300** |  |"


def test_without_bounds_it_is_said_how_to_get_them():
    with pytest.raises(UsageError, match=r"bounds\.py play"):
        headroom_table({}, {})
