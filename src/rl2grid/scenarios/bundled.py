"""The series inside the Grid2Op wheel, which need no download.

bus14 borrows four real months of two other environments, ``rte_case14_realistic`` and
``rte_case14_redisp``. These have bus14's substations, loads and lines, some under other names and in
another order, so their columns are matched by substation. Substation 5 has one generator there, of
wind, 70 MW, called ``gen_5_2`` like bus14's wind generator of 70 MW, which takes its column; bus14's
second one there, ``gen_5_3`` (sun), is not among theirs and stays at 0 MW. The other generators are
alone on their substations and never exceed bus14's pmax. Voltage set-points, which in
``rte_case14_redisp`` refer to other nominal voltages, are those of bus14's own series, where they never
change. What the two record as outages is left out; nothing is recorded.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.cache import CachedSeries, cached_series
from rl2grid.scenarios.folder import FolderContent, read_folder, source_key


def wheel_data_folder() -> Path:
    """The ``data`` folder of the installed Grid2Op, found without importing it.

    Raises:
        UsageError: Grid2Op is not installed.
    """
    spec = importlib.util.find_spec("grid2op")
    if spec is None or not spec.submodule_search_locations:
        raise UsageError("Grid2Op, whose wheel holds the bundled scenarios, is not installed: pip install grid2op.")
    return Path(spec.submodule_search_locations[0]) / "data"


@functools.cache
def bundled_folders(grid: Grid) -> Mapping[str, Path]:
    """Name of every bundled series of ``grid`` and the folder that holds it, in a fixed order."""
    folders: dict[str, Path] = {}
    for environment in grid.bundled_names:
        mix = environment.partition("/")[2]
        other = "" if _is_own(grid, environment) else environment
        prefix = f"{mix or other}/" if mix or other else ""
        parent = wheel_data_folder() / environment / "chronics"
        folders |= {prefix + path.name: path for path in sorted(parent.iterdir()) if path.is_dir()}
    return folders


def load_bundled(grid: Grid, name: str) -> CachedSeries:
    """The series called ``name`` (one of :func:`bundled_folders`), from the local copy or the wheel."""
    folders = bundled_folders(grid)
    path, first = folders[name], next(iter(folders.values()))
    if _is_own(grid, path.relative_to(wheel_data_folder()).parts[0]):
        return cached_series(grid.id, f"bundled.{name}", source_key(grid, path), lambda: read_folder(grid, path))
    return cached_series(
        grid.id, f"bundled.{name}", source_key(grid, path, first), lambda: _read_other_grid(grid, path, first)
    )


def interconnections(grid: Grid) -> tuple[int, ...]:
    """Loads that stand for a neighbouring grid and may be negative.

    Their reactive demand is negative somewhere in a bundled series; that of a real load never is.
    """
    negative = np.zeros(grid.n_load, np.bool_)
    for name in bundled_folders(grid):
        negative |= (load_bundled(grid, name).arrays["load_q"] < 0).any(axis=0)
    return tuple(np.flatnonzero(negative).tolist())


def _is_own(grid: Grid, environment: str) -> bool:
    """Whether an environment of the wheel is the grid itself or a mix of it, and not a look-alike."""
    return environment.partition("/")[0] == grid.bundled_names[0].partition("/")[0]


def _read_other_grid(grid: Grid, path: Path, own: Path) -> FolderContent:
    """A series of a grid with other names, with the voltage set-points of the folder ``own``."""
    content = read_folder(grid, path, by_substation=True)
    rows, horizon = content.arrays["load_p_forecast"].shape[:2]
    voltages = read_folder(grid, own).arrays["prod_v"][0]
    content.arrays["prod_v"] = np.tile(voltages, (rows, 1))
    content.arrays["prod_v_forecast"] = np.tile(voltages, (rows, horizon, 1))
    return content
