"""The flat list of ids that Gymnasium knows, and how systems get into it."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path

import gymnasium

from rl2grid.benchmark import BENCHMARK
from rl2grid.envs.tasks import tasks_of
from rl2grid.errors import UsageError
from rl2grid.grids import System, find_system, system_ids
from rl2grid.grids.systems import add_system, remove_system
from rl2grid.scenarios.splits import BUNDLED

VARIABLE = "RL2GRID_SYSTEMS"
"""Environment variable that names what registers a user's systems when ``rl2grid`` is imported: modules or Python
files, separated as in ``PATH``. Commands and the processes that they start know the systems by it."""


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
    _register(system)


def register_all() -> None:
    """Register the seven systems of the benchmark; ids that are registered already stay as they are."""
    for system in BENCHMARK:
        _register(system)


def register_from_environment() -> None:
    """Import what :data:`VARIABLE` names.

    Raises:
        UsageError: there is no such module or file.
    """
    for name in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        if name.endswith(".py"):
            _run_file(Path(name))
            continue
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            raise UsageError(
                f"{VARIABLE} names {name!r}, which cannot be imported ({error}): give modules or Python files."
            ) from error


def unregister_system(grid_id: str) -> None:
    """Forget a system and its tasks, so that another one may take its id.

    Raises:
        UsageError: none of that name is registered.
    """
    for task in tasks_of(find_system(grid_id)):
        gymnasium.registry.pop(task.id, None)
    remove_system(grid_id)


def own_systems() -> tuple[System, ...]:
    """The systems that a user has registered, which another process does not know unless they are sent to it."""
    return tuple(system for system in map(find_system, system_ids()) if system not in BENCHMARK)


def _register(system: System) -> None:
    add_system(system)
    for task in tasks_of(find_system(system.id)):
        if task.id in gymnasium.registry:
            continue
        gymnasium.register(
            id=task.id,
            entry_point="rl2grid.envs.grid_env:PowerGridEnv",
            vector_entry_point="rl2grid.envs.vector:PowerGridVectorEnv",
            kwargs={"task": task.id},
        )


def _run_file(file: Path) -> None:
    name = f"rl2grid_systems_{file.stem}"
    if name in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(name, file)
    if not file.is_file() or spec is None or spec.loader is None:
        raise UsageError(f"{VARIABLE} names {file}, and there is no such file: give modules or Python files.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
