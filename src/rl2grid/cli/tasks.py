"""Tables that the command line prints."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from rl2grid.envs.tasks import Task, all_tasks, tasks_of
from rl2grid.grids import find_system
from rl2grid.mdp.features import observation_size


def print_tasks(grid_id: str | None) -> None:
    """All tasks, or those of one grid, with their sizes.

    Raises:
        UsageError: there is no such grid.
    """
    chosen = tuple(all_tasks().values()) if grid_id is None else tasks_of(find_system(grid_id))
    table = Table(title=f"{len(chosen)} tasks", title_justify="left")
    table.add_column("id", no_wrap=True)
    for name in ("subs", "lines", "gens", "loads", "storages", "observation", "actions"):
        table.add_column(name, justify="right")
    table.add_column("contingencies")
    table.add_column("constraint")
    for task in chosen:
        grid = task.grid
        sizes = (grid.n_sub, grid.n_line, grid.n_gen, grid.n_load, grid.n_storage)
        table.add_row(
            task.id,
            *(str(size) for size in sizes),
            str(observation_size(grid, task.kind)),
            f"{task.n_actions:,} discrete" if task.kind == "T" else f"{task.n_actions} continuous",
            _contingencies(task),
            task.constraint or "",
        )
    # A table cut to the width of a pipe would lose columns.
    console = Console()
    Console(width=console.width if console.is_terminal else 160).print(table)


def _contingencies(task: Task) -> str:
    parts = ["maintenance"]
    if task.grid.opponent.kind != "none":
        parts.append(f"{task.grid.opponent.kind.replace('_', '-')} opponent")
    return ", ".join(parts)
