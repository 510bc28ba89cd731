"""The ledger as a table."""

from __future__ import annotations

from pathlib import Path

from rl2grid.analysis.ledger_table import ledger_table
from rl2grid.records.ledger import read_ledger

ROOT = Path(__file__).parents[2]


def test_the_table_of_the_documentation_is_the_ledger():
    table = ledger_table(read_ledger(ROOT / "benchmarks" / "results" / "baselines.json").values())
    assert table in (ROOT / "docs" / "results.md").read_text()


def test_seeds_stand_together_with_their_mean():
    table = ledger_table(read_ledger(ROOT / "benchmarks" / "results" / "baselines.json").values())
    (row,) = [line for line in table.splitlines() if line.startswith("| bus14-T0 | sac | recovery")]
    assert "**0.961** of 0.952, 0.954, 0.978" in row
