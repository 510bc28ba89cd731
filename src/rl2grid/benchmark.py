"""The seven systems of the benchmark (paper, Table 1), registered in the way in which a user's own are."""

from __future__ import annotations

import functools
import json
from importlib import resources
from pathlib import Path
from typing import Any

from rl2grid.grids import GRID_IDS, System
from rl2grid.grids.grid import read_grid
from rl2grid.grids.network import read_network
from rl2grid.grids.rankings import read_shipped_ranking
from rl2grid.grids.systems import Scenarios, add_system
from rl2grid.scenarios.bundled import wheel_data_folder

MAINTAINED_LIKE = {"bus36-MO-v0": "bus36-M", "bus36-MO-v1": "bus36-M", "bus118-M": "bus118-MOB-v0"}
"""Grids whose bundled series record their outages, and the grid of the same lines that samples them.

All recorded outages are of lines that the other grid maintains too, last from 9 to 17 hours and fall on working days.
"""


def _scenarios(grid_id: str) -> Scenarios:
    # Imported where it is needed: importing rl2grid shall not take long.
    from rl2grid.scenarios.months import GeneratedScenarios
    from rl2grid.scenarios.shipped import ShippedScenarios

    return GeneratedScenarios(ShippedScenarios(), MAINTAINED_LIKE.get(grid_id))


def _constants(grid_id: str) -> dict[str, Any]:
    file = resources.files("rl2grid.scenarios") / "generator" / "data" / f"{grid_id}.json"
    record: dict[str, Any] = json.loads(file.read_text())
    return record


def _environment(bundled_name: str) -> Path:
    return wheel_data_folder() / bundled_name


def _shipped(grid_id: str) -> System:
    """The system of a grid whose files are shipped; all but the grid is read when it is needed."""
    grid = read_grid(grid_id)
    return System(
        grid,
        functools.partial(read_network, grid),
        functools.partial(_scenarios, grid_id),
        functools.partial(read_shipped_ranking, grid_id),
        functools.partial(_environment, grid.bundled_names[0]),
        functools.partial(_constants, grid_id),
    )


BENCHMARK: tuple[System, ...] = tuple(_shipped(grid_id) for grid_id in GRID_IDS)
"""The seven, in the order of the paper's Table 1."""

for _system in BENCHMARK:
    add_system(_system)
