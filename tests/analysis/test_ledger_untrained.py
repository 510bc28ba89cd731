"""Who learns nothing, a row per task."""

from __future__ import annotations

from sample_ledger import ledger, on, trained, untrained

from rl2grid.analysis.ledger_untrained import untrained_table

BUS14 = "rl2grid/bus14-T0-v0"

RESULTS = ledger(
    on(BUS14, untrained("do-nothing", [0.1, 0.2])),
    on(BUS14, untrained("do-nothing", [0.2, 0.2]), heuristic="careful"),
    on("rl2grid/bus14-R-v0", untrained("do-nothing", [0.1, 0.2, 0.6])),
    on(BUS14, untrained("greedy", [0.6, 0.7])),
    on(BUS14, untrained("greedy", [0.7, 0.7]), heuristic="idle"),
    on(BUS14, untrained("planner", [0.9, 0.7])),
    trained(1, [1.0, 1.0]),
    on("rl2grid/bus36-M-T1-v0", untrained("rehearsal", [0.4, 0.5])),
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


def test_an_agent_that_its_column_is_not_called_after_is_named() -> None:
    results = ledger(
        on(BUS14, untrained("planner", [0.9, 0.7])),
        on(BUS14, untrained("planner-open", [0.9, 0.9])),
        on(BUS14, untrained("planner-open", [0.9, 0.95]), heuristic="idle"),
    )
    assert "| **0.925** planner-open, `idle` (2 months) |" in untrained_table(results).splitlines()[2]
