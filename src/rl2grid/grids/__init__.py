"""Systems as data: grids, networks and rankings, and the registry of those that exist."""

from rl2grid.grids.grid import (
    GRID_IDS,
    STEPS_PER_HOUR,
    Grid,
    MaintenanceConfig,
    OpponentConfig,
    Rules,
)
from rl2grid.grids.network import Network
from rl2grid.grids.systems import System, find_system, load_grid, system_ids

__all__ = [
    "GRID_IDS",
    "STEPS_PER_HOUR",
    "Grid",
    "MaintenanceConfig",
    "Network",
    "OpponentConfig",
    "Rules",
    "System",
    "find_system",
    "load_grid",
    "system_ids",
]
