"""The flat list of ids that Gymnasium knows, and how systems get into it."""

from __future__ import annotations

from rl2grid.benchmark import BENCHMARK
from rl2grid.envs.tasks import tasks_of
from rl2grid.errors import UsageError
from rl2grid.grids import System, find_system, system_ids
from rl2grid.grids.systems import add_system, remove_system
from rl2grid.scenarios.splits import BUNDLED

# Gymnasium is imported where it is needed: at the end of its import this module is (:mod:`rl2grid.envs.on_import`),
# which may not be in the midst of its own then.


def register_system(system: System) -> None:
    """Give a grid everything that the seven have: tasks, scenarios, rankings, evaluation, pages.

    Its tasks are ``rl2grid/<id>-T<level>[-LSI|-TLO]-v0``, ``rl2grid/<id>-R-v0`` and
    ``rl2grid/<id>-H<level>[-LSI|-TLO]-v0``. Workers of vectors and evaluations know it too. It takes the place of an
    earlier system of the same grid, in environments that are made from then on.

    Raises:
        UsageError: its id cannot be part of a task's, or is that of another grid; or there is nothing to play.
    """
    if system.id in {each.id for each in BENCHMARK}:
        raise UsageError(f"Grid {system.id!r} is one of the benchmark: give yours an id of its own.")
    if not system.scenarios.listed(system.grid, BUNDLED):
        raise UsageError(f"System {system.id} has no time series: give it scenarios.")
    add_system(system)
    _register_tasks(system)


def register_all() -> None:
    """Have Gymnasium know the tasks of the benchmark; ids that are registered already stay as they are."""
    for system in BENCHMARK:
        _register_tasks(system)


def unregister_system(grid_id: str) -> None:
    """Forget a system and its tasks, so that another one may take its id.

    Raises:
        UsageError: none of that name is registered.
    """
    import gymnasium

    for task in tasks_of(find_system(grid_id)):
        gymnasium.registry.pop(task.id, None)
    remove_system(grid_id)


def own_systems() -> tuple[System, ...]:
    """The systems that a user has registered, which another process does not know unless they are sent to it."""
    return tuple(system for system in map(find_system, system_ids()) if system not in BENCHMARK)


def _register_tasks(system: System) -> None:
    import gymnasium

    for task in tasks_of(system):
        if task.id in gymnasium.registry:
            continue
        gymnasium.register(
            id=task.id,
            entry_point="rl2grid.envs.grid_env:PowerGridEnv",
            vector_entry_point="rl2grid.envs.vector:PowerGridVectorEnv",
            kwargs={"task": task.id},
        )
