"""Who learns nothing, a row per task."""

from __future__ import annotations

from dataclasses import replace

from sample_ledger import ledger, trained, untrained

from rl2grid.analysis.ledger_untrained import untrained_table
from rl2grid.records.ledger import HashedTest


def of(test: HashedTest, task: str, heuristic: str | None = None) -> HashedTest:
    return replace(test, configuration={**test.configuration, "task": f"rl2grid/{task}-v0", "heuristic": heuristic})


RESULTS = ledger(
    of(untrained("do-nothing", [0.1, 0.2]), "bus14-T0"),
    of(untrained("do-nothing", [0.2, 0.2]), "bus14-T0", "careful"),
    of(untrained("do-nothing", [0.1, 0.2, 0.6]), "bus14-R"),
    of(untrained("greedy", [0.6, 0.7]), "bus14-T0"),
    of(untrained("greedy", [0.7, 0.7]), "bus14-T0", "idle"),
    of(untrained("planner", [0.9, 0.7]), "bus14-T0"),
    trained(1, [1.0, 1.0]),
    of(untrained("rehearsal", [0.4, 0.5]), "bus36-M-T1"),
)


def test_who_does_nothing_has_one_value_on_a_grid_and_others_their_best_heuristic() -> None:
    lines = untrained_table(RESULTS).splitlines()
    assert lines[0] == "| task | do nothing | `recovery` | `careful` | greedy search | planner | rehearsal |"
    assert lines[2:] == [
        "| bus14-T0 | 0.300 (3 months) |  | 0.200 (2 months) | 0.700 `idle` (2 months) | **0.800** (2 months) |  |",
        "| bus14-R | **0.300** (3 months) |  | 0.200 (2 months) |  |  |  |",
        "| bus36-M-T1 |  |  |  |  |  | **0.450** (2 months) |",
    ]


def test_time_stands_beside_the_very_row_that_was_timed() -> None:
    milliseconds = {("bus14-T0", "greedy", None): (3.0, 9.0), ("bus14-T0", "planner", None): (4.698, 24.661)}
    line = untrained_table(RESULTS, milliseconds).splitlines()[2]
    assert "0.700 `idle` (2 months)" in line
    assert "**0.800** (4.7, 25 ms, 2 months)" in line
