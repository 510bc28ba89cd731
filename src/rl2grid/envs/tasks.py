"""The 103 tasks and the keywords that they are made with."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rl2grid.engines import DISPATCHES, ENGINES, HEURISTICS
from rl2grid.errors import UsageError, one_of
from rl2grid.grids import GRID_IDS, Grid, load_grid
from rl2grid.scenarios.splits import SPLITS

VERSION = 0
"""Version of every id; raised when anything that defines a result changes."""

CONSTRAINTS: tuple[str, ...] = ("LSI", "TLO")


@dataclass(frozen=True)
class Task:
    """One task of the benchmark."""

    grid_id: str
    kind: str
    """``"T"``: discrete topology actions. ``"R"``: continuous redispatch, curtailment and storage."""
    level: int
    """Difficulty of a topology task; 0 for continuous ones."""
    constraint: str | None
    """Safety constraint of the task: None, ``"LSI"`` or ``"TLO"``."""

    @property
    def id(self) -> str:
        """The id that ``gymnasium.make`` takes."""
        level = str(self.level) if self.kind == "T" else ""
        constraint = f"-{self.constraint}" if self.constraint else ""
        return f"rl2grid/{self.grid_id}-{self.kind}{level}{constraint}-v{VERSION}"

    @property
    def grid(self) -> Grid:
        return load_grid(self.grid_id)

    @property
    def n_actions(self) -> int:
        """Discrete actions of a topology task, entries of a continuous action otherwise."""
        grid = self.grid
        if self.kind == "T":
            return grid.level_sizes[self.level]
        return int(grid.gen_redispatchable.sum() + grid.gen_renewable.sum()) + grid.n_storage


@functools.cache
def all_tasks() -> dict[str, Task]:
    """Every task by its id: 32 topology, 64 constrained topology and 7 continuous tasks."""
    tasks = []
    for grid_id in GRID_IDS:
        for constraint in (None, *CONSTRAINTS):
            tasks += [Task(grid_id, "T", level, constraint) for level in range(len(load_grid(grid_id).level_sizes))]
        tasks.append(Task(grid_id, "R", 0, None))
    return {task.id: task for task in tasks}


def find_task(task_id: str) -> Task:
    """The task called ``task_id``; the namespace and the version may be left out.

    Raises:
        UsageError: there is no such task.
    """
    name = task_id.removeprefix("rl2grid/")
    for candidate in (f"rl2grid/{name}", f"rl2grid/{name}-v{VERSION}"):
        if candidate in all_tasks():
            return all_tasks()[candidate]
    raise _unknown_task(task_id, name)


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
    grids = [grid_id for grid_id in GRID_IDS if name.startswith(f"{grid_id}-")]
    if not grids:
        return UsageError(
            f"Task {task_id!r} does not exist: an id is <grid>-T<level>[-LSI|-TLO]-v{VERSION} or <grid>-R-v{VERSION} "
            f"with a grid of {', '.join(GRID_IDS)}."
        )
    grid_id = max(grids, key=len)
    levels = ", ".join(str(level) for level in range(len(load_grid(grid_id).level_sizes)))
    return UsageError(
        f"Task {task_id!r} does not exist: the tasks of {grid_id} are {grid_id}-T<level>[-LSI|-TLO]-v{VERSION} "
        f"with level {levels}, and {grid_id}-R-v{VERSION}."
    )


@dataclass(frozen=True)
class TaskOptions:
    """The keywords of ``gymnasium.make`` and ``make_vec``.

    Raises:
        UsageError: a value is not allowed; the message lists those that are.
    """

    engine: str = "native"
    """``"native"``: ours, compiled; ``"reference"``: Grid2Op with LightSim2Grid."""
    heuristic: str | None = None
    """What plays while the grid is safe: None (the agent decides every step), ``"idle"`` or ``"recovery"``."""
    reward: str | tuple[float, float, float] | Callable[..., Any] = "default"
    """A preset (``"default"``, ``"paper"``, ``"released"``), the weights of the three default components,
    or a compiled function ``(state, i) -> (survive, overload, cost)``."""
    split: str = "train"
    """Which scenarios are played: ``"train"`` (months without end), ``"validation"`` or ``"test"`` (20 months each), or
    ``"bundled"``, the series inside the Grid2Op wheel."""
    scenario: str | None = None
    """Play this scenario only."""
    normalize: str | None = "physical"
    """``"physical"``: divide observations by constants of the grid; None: physical units."""
    dispatch: str = "exact"
    """How redispatch is solved: ``"exact"``, or ``"grid2op"`` with Grid2Op's own solver."""
    constraint: str | None = None
    """Which cost is ``info["cost"]``; given by the id of constrained tasks."""
    gamma: float | None = None
    """Adds ``info["discounted_reward"]``: the discounted sum over a transition's grid steps."""
    maintenance: bool = True
    """Whether planned maintenance happens."""
    opponent: bool = True
    """Whether the grid's opponent attacks."""

    def __post_init__(self) -> None:
        _check("engine", self.engine, ENGINES)
        _check("heuristic", self.heuristic, ("None", *HEURISTICS))
        _check("split", self.split, SPLITS)
        _check("normalize", self.normalize, ("physical", "None"))
        _check("dispatch", self.dispatch, DISPATCHES)
        _check("constraint", self.constraint, ("None", *CONSTRAINTS))
        if self.gamma is not None and not (isinstance(self.gamma, int | float) and 0 <= self.gamma <= 1):
            raise UsageError(f"gamma={self.gamma!r} is not allowed: give a discount between 0 and 1, or None.")
        for name in ("maintenance", "opponent"):
            if not isinstance(getattr(self, name), bool):
                raise UsageError(f"{name}={getattr(self, name)!r} is not allowed: choose True or False.")


def _check(keyword: str, value: object, allowed: tuple[str, ...]) -> None:
    if value is None and "None" in allowed:
        return
    if not isinstance(value, str) or value not in allowed or value == "None":
        raise one_of(f"Value for {keyword},", value, allowed)
