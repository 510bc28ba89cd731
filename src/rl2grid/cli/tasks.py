"""``rl2grid tasks``: the tasks and their sizes."""

from __future__ import annotations

import argparse
from typing import Any

from rl2grid.analysis.table import Cell, Column, ResultTable
from rl2grid.cli.output import Output
from rl2grid.envs.tasks import Task, all_tasks, tasks_of
from rl2grid.grids import find_system
from rl2grid.mdp.features import observation_size

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
    chosen = tuple(all_tasks().values()) if options.grid is None else tasks_of(find_system(options.grid))
    records = [_record(task) for task in chosen]
    rows = tuple(
        tuple(Cell(text) for text in _cells(task, record)) for task, record in zip(chosen, records, strict=True)
    )
    output.table(ResultTable("tasks", "", _COLUMNS, rows), records, title=f"{len(chosen)} tasks")
    return 0


def _record(task: Task) -> dict[str, Any]:
    grid = task.grid
    return {
        "id": task.id,
        "grid": grid.id,
        "kind": task.kind,
        "level": task.level if task.changes_topology else None,
        "substations": grid.n_sub,
        "lines": grid.n_line,
        "generators": grid.n_gen,
        "loads": grid.n_load,
        "storages": grid.n_storage,
        "observation": observation_size(grid, task.kind),
        "actions": task.n_actions,
        "topology_actions": task.n_topology_actions,
        "continuous_actions": task.n_injections,
        "opponent": None if grid.opponent.kind == "none" else grid.opponent.kind,
        "constraint": task.constraint,
    }


def _cells(task: Task, record: dict[str, Any]) -> tuple[str, ...]:
    sizes = ("substations", "lines", "generators", "loads", "storages", "observation")
    opponent = record["opponent"]
    return (
        task.id,
        *(str(record[name]) for name in sizes),
        task.actions_in_words,
        "maintenance" if opponent is None else f"maintenance, {opponent.replace('_', '-')} opponent",
        task.constraint or "",
    )
