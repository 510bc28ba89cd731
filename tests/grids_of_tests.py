"""Grids for tests of Grid2Op itself, whose environments of seven kinds take longer to make than the tests to run."""

import pytest

from rl2grid.grids import GRID_IDS

SHORTER = ("bus14", "bus36-MO-v1", "bus118-MOB-v1")
"""One of each size: without opponent; with one for all lines; with opponents per area, storage and far forecasts."""

SHORTER_OR_ALL = [grid if grid in SHORTER else pytest.param(grid, marks=pytest.mark.slow) for grid in GRID_IDS]
"""To parametrize with: three grids in the shorter tests, all seven in the longer ones."""
