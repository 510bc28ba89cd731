"""The seven base grids as data."""

from rl2grid.grids.grid import (
    GRID_IDS,
    STEPS_PER_HOUR,
    Grid,
    MaintenanceConfig,
    OpponentConfig,
    Rules,
    load_grid,
)

__all__ = ["GRID_IDS", "STEPS_PER_HOUR", "Grid", "MaintenanceConfig", "OpponentConfig", "Rules", "load_grid"]
