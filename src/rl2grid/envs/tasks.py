"""The tasks of every system: for the seven of the benchmark the 103 of the paper and 96 joint ones."""

from __future__ import annotations

import functools
from dataclasses import dataclass

from rl2grid.errors import UsageError
from rl2grid.grids import Grid, System, find_system, load_grid, system_ids
from rl2grid.mdp.constraint_table import CONSTRAINTS
from rl2grid.mdp.features import changes_topology, injects

VERSION = 0
"""Version of every id; raised when anything that defines a result changes."""


@dataclass(frozen=True)
class Task:
    """One task of the benchmark."""

    grid_id: str
    kind: str
    """``"T"``: discrete topology actions. ``"R"``: continuous redispatch, curtailment and storage. ``"H"``: joint, both
    in one decision."""
    level: int
    """Which topology actions there are, from few to all; 0 where there are none."""
    constraint: str | None
    """Safety constraint of the task: None or a name of :data:`~rl2grid.mdp.constraint_table.CONSTRAINTS`."""

    @property
    def id(self) -> str:
        """The id that ``gymnasium.make`` takes."""
        level = str(self.level) if self.changes_topology else ""
        constraint = f"-{self.constraint}" if self.constraint else ""
        return f"rl2grid/{self.grid_id}-{self.kind}{level}{constraint}-v{VERSION}"

    @property
    def grid(self) -> Grid:
        return load_grid(self.grid_id)

    @property
    def changes_topology(self) -> bool:
        """Whether there are topology actions: of tasks ``T`` and ``H``."""
        return changes_topology(self.kind)

    @property
    def injects(self) -> bool:
        """Whether agents redispatch, curtail and store: in tasks ``R`` and ``H``."""
        return injects(self.kind)

    @property
    def n_topology_actions(self) -> int:
        """Discrete actions, do nothing among them; 0 where there are none."""
        return self.grid.level_sizes[self.level] if self.changes_topology else 0

    @property
    def n_injections(self) -> int:
        """Entries of a continuous action; 0 where there are none."""
        grid = self.grid
        if not self.injects:
            return 0
        return int(grid.gen_redispatchable.sum() + grid.gen_renewable.sum()) + grid.n_storage

    @property
    def n_actions(self) -> int:
        """Discrete actions of a topology task, entries of a continuous action, both together of a joint task."""
        return self.n_topology_actions + self.n_injections

    @property
    def actions_in_words(self) -> str:
        """How many actions there are of which kind."""
        discrete = f"{self.n_topology_actions:,} discrete" if self.changes_topology else ""
        continuous = f"{self.n_injections} continuous" if self.injects else ""
        return " and ".join(filter(None, (discrete, continuous)))


def all_tasks() -> dict[str, Task]:
    """Every task by its id.

    For the seven grids 32 topology, 64 constrained topology and 7 continuous tasks, the 103 of the paper; and 32 joint
    and 64 constrained joint ones.
    """
    return {task.id: task for grid_id in system_ids() for task in tasks_of(find_system(grid_id))}


@functools.lru_cache(maxsize=64)
def tasks_of(system: System) -> tuple[Task, ...]:
    """The tasks of one system.

    Topology by level, with and without constraint; the continuous one; and joint ones by level, likewise.
    """
    levels = range(len(system.grid.level_sizes))
    topology, joint = (
        [Task(system.id, kind, level, constraint) for constraint in (None, *CONSTRAINTS) for level in levels]
        for kind in ("T", "H")
    )
    return (*topology, Task(system.id, "R", 0, None), *joint)


def find_task(task: Task | str) -> Task:
    """The task with the id ``task``, whose namespace and version may be left out; a task is its own.

    Ids are read once, where they come from: the command line, ``gymnasium.make``, a file, a call of the user. What
    lies behind hands the task on.

    Raises:
        UsageError: there is no such task.
    """
    if isinstance(task, Task):
        return task
    name, tasks = task.removeprefix("rl2grid/"), all_tasks()
    for candidate in (f"rl2grid/{name}", f"rl2grid/{name}-v{VERSION}"):
        if candidate in tasks:
            return tasks[candidate]
    raise _unknown_task(task, name)


def short_id(task_id: str) -> str:
    """What is typed and printed for a task: its id without the namespace and the version."""
    return task_id.removeprefix("rl2grid/").removesuffix(f"-v{VERSION}")


def constraint_of(task: Task, keyword: str | None) -> str | None:
    """The constraint of environments of ``task`` that are made with the keyword ``constraint``.

    Raises:
        UsageError: the id and the keyword name different ones.
    """
    if task.constraint and keyword and keyword != task.constraint:
        raise UsageError(
            f"constraint={keyword!r} contradicts task {task.id!r}: leave it out, or choose the task without "
            f"{task.constraint} in its id."
        )
    return task.constraint or keyword


def _unknown_task(task_id: str, name: str) -> UsageError:
    # The longest grid that begins the name: "bus36-MO-v0-T9" is about bus36-MO-v0.
    grids = [grid_id for grid_id in system_ids() if name.startswith(f"{grid_id}-")]
    if not grids:
        return UsageError(
            f"Task {task_id!r} does not exist: an id is <grid>-T<level>[-LSI|-TLO]-v{VERSION}, <grid>-R-v{VERSION} or "
            f"<grid>-H<level>[-LSI|-TLO]-v{VERSION} with a grid of {', '.join(system_ids())}."
        )
    grid_id = max(grids, key=len)
    levels = ", ".join(str(level) for level in range(len(load_grid(grid_id).level_sizes)))
    return UsageError(
        f"Task {task_id!r} does not exist: the tasks of {grid_id} are {grid_id}-T<level>[-LSI|-TLO]-v{VERSION} and "
        f"{grid_id}-H<level>[-LSI|-TLO]-v{VERSION} with level {levels}, and {grid_id}-R-v{VERSION}."
    )
