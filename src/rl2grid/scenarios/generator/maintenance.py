"""Which lines are maintained in generated months."""

from __future__ import annotations

from rl2grid.grids import Grid, MaintenanceConfig, load_grid

_ALIKE = {"bus36-MO-v0": "bus36-M", "bus36-MO-v1": "bus36-M", "bus118-M": "bus118-MOB-v0"}
"""Grids whose bundled series record their outages, and the grid of the same lines that samples them.

All recorded outages are of lines that the other grid maintains too, last from 9 to 17 hours and fall on working days.
"""


def generated_maintenance(grid: Grid) -> MaintenanceConfig:
    """How planned outages of a generated month are sampled: as the grid samples them, or one of the same lines."""
    if grid.maintenance.lines:
        return grid.maintenance
    return load_grid(_ALIKE[grid.id]).maintenance
