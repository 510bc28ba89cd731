"""The ledger by what was learned."""

from __future__ import annotations

import pytest
from sample_ledger import ledger, on, trained, untrained

from rl2grid.analysis.ledger_learned import learned_table
from rl2grid.errors import UsageError


def test_methods_of_several_trainings_are_compared_on_the_months_that_all_played():
    other = "rl2grid/bus36-M-T0-v0"
    results = ledger(
        untrained("do-nothing", [0.1, 0.2, 0.9]),
        untrained("greedy", [0.6, 0.7, 0.9]),
        trained(1, [0.8, 0.9]),
        trained(2, [0.6, 0.9]),
        trained(1, [0.9, 0.9], algorithm="dqn"),  # a single one has no cell
        on(other, trained(3, [0.5, 0.5])),
        on(other, trained(1, [0.4, 0.4], algorithm="imitation")),
        on(other, trained(2, [0.4, 0.4], algorithm="imitation")),
        on(other, trained(4, [0.5, 0.5])),
        on(other, trained(5, [0.9, 0.9], steps=2000)),  # more decisions than most tasks had
        on(other, trained(6, [0.9, 0.9], steps=2000)),
    )
    lines = learned_table(results).splitlines()
    methods = "imitation, 1,000 labels | ppo, 1,000"
    assert lines[0] == f"| task | months | do nothing | search and rules | planner | {methods} |"
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]
    assert cells[0][:6] == ["bus14-T0", "2", "0.150", "0.650", "", ""]
    assert cells[0][6].startswith("**0.800 [")
    assert cells[0][6].endswith("]** (2)")
    assert cells[1][:5] == ["bus36-M-T0", "2", "", "", ""]
    assert cells[1][5].startswith("0.400 [")
    assert cells[1][6].startswith("**0.500 [")


def test_a_ledger_without_repeated_trainings_is_refused():
    with pytest.raises(UsageError, match="trained with several seeds"):
        learned_table(ledger(untrained("greedy", [0.6]), trained(1, [0.8])))
