"""The ledger by agents and heuristics."""

from __future__ import annotations

from sample_ledger import ledger, on, trained, untrained

from rl2grid.analysis.ledger_heuristics import heuristic_table

VANILLA = {"env_keywords": {"heuristic": None}}


def test_agents_have_a_row_and_heuristics_a_column():
    results = ledger(
        untrained("do-nothing", [0.1, 0.2]),
        trained(1, [0.4, 0.4], **VANILLA),
        trained(1, [0.8, 0.9]),
        trained(2, [0.6, 0.9]),
        trained(3, [0.9, 0.9], steps=2000),  # another budget, of fewer trainings
        on("rl2grid/bus36-M-T0-v0", trained(4, [0.5, 0.5])),
    )
    lines = heuristic_table(results).splitlines()
    assert lines[0] == "| task | agent | vanilla | idle |"
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]
    assert [row[:2] for row in cells] == [["bus14-T0", "do-nothing"], ["bus14-T0", "ppo"], ["bus36-M-T0", "ppo"]]
    assert cells[0][2].startswith("0.150 [")
    assert not cells[0][2].endswith(")")  # nothing was trained
    assert cells[0][3] == ""
    assert cells[1][2].startswith("0.400 [")
    assert cells[1][3].startswith("**0.800 [")  # the highest of those that are shown
    assert cells[1][3].endswith("]** (2)")
    assert cells[2][2] == ""
    assert cells[2][3].startswith("**0.500 [")
