"""What ``rl2grid tasks`` says of every task, and the file of it for the seven grids of the benchmark.

To read seven grids takes NumPy and half a second, a file a millisecond: ``data/tasks.json`` is written by
``python -m rl2grid.cli.task_records``, and a test compares it with the grids.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rl2grid.envs.tasks import Task

FILE = Path(__file__).with_name("data") / "tasks.json"
_REGISTRATION = "rl2grid.envs.registration"
"""Through this module a user's own systems are registered: where nobody has imported it, there are none."""


def task_records() -> list[dict[str, Any]]:
    """One record per task, in the order of :func:`rl2grid.tasks`; those of a user's own systems are the last."""
    return [*shipped_records(), *_own_records()]


def shipped_records() -> list[dict[str, Any]]:
    """The tasks of the benchmark, from the file."""
    records: list[dict[str, Any]] = json.loads(FILE.read_text(encoding="utf-8"))
    return records


def records_of(tasks: Iterable[Task]) -> list[dict[str, Any]]:
    """One record per task, from the grids."""
    return [_record(task) for task in tasks]


def _own_records() -> list[dict[str, Any]]:
    if _REGISTRATION not in sys.modules:
        return []
    from rl2grid.envs.registration import own_systems
    from rl2grid.envs.tasks import tasks_of

    return records_of(task for system in own_systems() for task in tasks_of(system))


def _record(task: Task) -> dict[str, Any]:
    from rl2grid.mdp.features import observation_size

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


def _write() -> None:
    from rl2grid.benchmark import BENCHMARK
    from rl2grid.envs.tasks import tasks_of
    from rl2grid.records.files import write_text

    records = records_of(task for system in BENCHMARK for task in tasks_of(system))
    lines = ",\n".join(json.dumps(record) for record in records)
    write_text(FILE, f"[\n{lines}\n]\n")


if __name__ == "__main__":
    _write()
