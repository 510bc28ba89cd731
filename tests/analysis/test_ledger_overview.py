"""The ledger at a glance."""

from __future__ import annotations

from sample_ledger import ledger, on, trained, untrained

from rl2grid.analysis.ledger_overview import overview_table


def test_each_kind_shows_its_best_and_the_best_of_a_task_is_bold():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2]),
        untrained("greedy", [0.6, 0.7]),
        untrained("recovery", [0.2, 0.3]),
        trained(1, [0.8, 0.9]),
        trained(2, [0.6, 0.9]),
        on("rl2grid/bus36-M-H1-v0", untrained("planner", [0.5, 0.7])),
        on("rl2grid/bus36-M-T1-v0", untrained("planner", [0.5, 0.5])),
        on("rl2grid/bus36-M-T1-v0", untrained("rehearsal", [0.6, 0.6])),
    )
    lines = overview_table(results).splitlines()
    assert lines[0] == "| task | do nothing | search and rules | planner | learned |"
    assert lines[2:] == [
        "| bus14-T0 | 0.150 (2 months) | 0.650 greedy (2 months) |  | **0.800** ppo + idle (2 trainings, 2 months) |",
        "| bus36-M-T1 |  |  | **0.600** rehearsal (2 months) |  |",
        "| bus36-M-H1 |  |  | **0.600** (2 months) |  |",
    ]
