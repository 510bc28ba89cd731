"""A grid of one's own: bus14 under another name, with two recorded series."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from rl2grid.envs.registration import register_system, unregister_system
from rl2grid.grids import System, find_system
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.library import load_scenario
from rl2grid.scenarios.recorded import RecordedScenarios
from rl2grid.scenarios.scenario import STEP

ROWS = 289


def own_series(first: int = 0) -> FolderContent:
    """A day of bus14."""
    scenario = load_scenario("bus14", "bundled/0000")
    arrays = {name: array[first : first + ROWS] for name, array in scenario.arrays().items()}
    return FolderContent(scenario.start_datetime + first * STEP, arrays)


def own_system(name: str = "mine") -> System:
    """The system, not registered."""
    shipped = find_system("bus14")
    grid = replace(shipped.grid, id=name, bundled_names=(), level_sizes=shipped.grid.level_sizes[-1:])
    series = {"first": own_series(), "second": own_series(ROWS - 2)}
    scenarios = RecordedScenarios(series, splits={"train": ("first",), "validation": ("second",)})
    return System(grid, shipped.network, scenarios, environment=shipped.environment)


@contextmanager
def registered(system: System) -> Iterator[System]:
    """Know a system until the end of the block."""
    register_system(system)
    try:
        yield system
    finally:
        unregister_system(system.id)
