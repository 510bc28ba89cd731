"""The library of training years, where compiled code finds it."""

from __future__ import annotations

import functools
import threading
from pathlib import Path

import numpy as np

from rl2grid.arrays import I64
from rl2grid.engines.native.beginning import Library
from rl2grid.grids import Grid, find_system
from rl2grid.handles import Handle
from rl2grid.scenarios.cache import data_folder
from rl2grid.scenarios.generator.calendar import MONTH_STEPS, month_start
from rl2grid.scenarios.generator.constants import load_constants
from rl2grid.scenarios.making import make_library_beside
from rl2grid.scenarios.month_names import MONTHS, Months, scenario_id_of
from rl2grid.scenarios.outage_draws import most_outages, outage_model
from rl2grid.scenarios.splits import FIRST_TRAINING_SEED, TRAINING_YEARS
from rl2grid.scenarios.training_years import TrainingMonths, TrainingYear, forecasts_of, training_year


class TrainingLibrary:
    """The years of a grid: those that somebody has played stay open for all engines of the process.

    Idle processes begin to make what is missing (:func:`rl2grid.scenarios.making.make_library_beside`).

    Args:
        grid: the grid, whose system has constants of the generator.
    """

    def __init__(self, grid: Grid) -> None:
        make_library_beside(grid)
        self._grid = grid
        self._lock = threading.Lock()
        forecasts = forecasts_of(grid)
        voltage = 0 if forecasts.voltage is None else int(forecasts.voltage.ctypes.data)
        year = load_constants(grid.id).year
        outages = outage_model(
            find_system(grid.id).scenarios.maintenance(grid, "generated"),
            [month_start(year, month) for month in range(MONTHS - 1)],
            2 * MONTH_STEPS + 1,
        )
        self._handle = Handle(
            Library(
                np.zeros((TRAINING_YEARS, 3), np.int64),
                np.array([voltage], np.int64),
                np.array([forecasts.model.address], np.int64),
                forecasts.model.structure.horizon.astype(np.int32),
                outages,
            )
        )
        self.address = self._handle.address
        """Of the handle to the :class:`~rl2grid.engines.native.beginning.Library`."""
        self.most_outages = most_outages(outages)
        """No episode has more."""
        self.scenario_ids = np.array(
            [[scenario_id_of(_months(year, month)) for month in range(MONTHS - 1)] for year in range(TRAINING_YEARS)],
            object,
        )
        """Of each year and each first of two months, object [year, month]."""
        self._years: dict[int, TrainingYear] = {}
        self._months: dict[tuple[int, int], TrainingMonths] = {}

    def open(self, years: I64) -> None:
        """Have ``years``, 0 for the first, made where they are not there, and mapped into memory.

        Raises:
            UsageError: the data folder cannot be written, or has no room for the library.
        """
        addresses = self._handle.structure.address
        with self._lock:
            # The last first: who makes the library beside begins with the first.
            for number in np.unique(years[addresses[years, 0] == 0])[::-1].tolist():
                year = training_year(self._grid, FIRST_TRAINING_SEED + number)
                self._years[number] = year
                addresses[number] = [array.ctypes.data for array in (year.load_p, year.load_q, year.prod_p)]

    def months(self, year: int, month: int) -> TrainingMonths:
        """Two months in a row of an open year."""
        found = self._months.get((year, month))
        if found is None:
            found = TrainingMonths(self._grid, _months(year, month), self._years[year])
            self._months[year, month] = found
        return found


def _months(year: int, month: int) -> Months:
    return Months(FIRST_TRAINING_SEED + year, month, 2)


def training_library(grid: Grid) -> TrainingLibrary:
    """The library of a grid in the present data folder."""
    return _library(grid, data_folder())


@functools.cache
def _library(grid: Grid, data: Path) -> TrainingLibrary:
    return TrainingLibrary(grid)
