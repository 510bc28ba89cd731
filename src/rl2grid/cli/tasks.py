"""``rl2grid tasks``: the tasks and their sizes."""

from __future__ import annotations

import argparse
from typing import Any

from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.cli.output import Output
from rl2grid.cli.task_records import task_records
from rl2grid.errors import one_of

_COLUMNS = (
    Column("id", words=True),
    *map(Column, ("subs", "lines", "gens", "loads", "storages", "observation", "actions")),
    Column("contingencies", words=True),
    Column("constraint", words=True),
)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of the command."""
    parser.add_argument("--grid", default=None, help="only the tasks of this grid")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace, output: Output) -> int:
    records = _chosen(options.grid)
    rows = tuple(tuple(Cell(text) for text in _cells(record)) for record in records)
    output.table(ResultTable("tasks", "", _COLUMNS, rows), records, title=f"{len(records)} tasks")
    return 0


def _chosen(grid: str | None) -> list[dict[str, Any]]:
    records = task_records()
    grids = tuple(dict.fromkeys(record["grid"] for record in records))
    if grid is not None and grid not in grids:
        raise one_of("Grid", grid, grids)
    return [record for record in records if grid in (None, record["grid"])]


def _cells(record: dict[str, Any]) -> tuple[str, ...]:
    sizes = ("substations", "lines", "generators", "loads", "storages", "observation")
    opponent = record["opponent"]
    return (
        record["id"],
        *(str(record[name]) for name in sizes),
        _actions(record),
        "maintenance" if opponent is None else f"maintenance, {opponent.replace('_', '-')} opponent",
        record["constraint"] or "",
    )


def _actions(record: dict[str, Any]) -> str:
    kinds = ((record["topology_actions"], "discrete"), (record["continuous_actions"], "continuous"))
    return " and ".join(f"{number:,} {kind}" for number, kind in kinds if number)
