"""The library of years whose months training plays.

It has :data:`~rl2grid.scenarios.splits.TRAINING_YEARS` years, each of which is one file in the data folder: the
integers that the generator makes, 0.1 MW and 0.1 MVAr, which engines read where they lie, mapped into memory. A year is
made when an episode first plays it. Forecasts are made for the rows in which somebody asks for them.
"""

from __future__ import annotations

import functools
import threading
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rl2grid import compile_notices
from rl2grid.arrays import F32, I16
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.handles import Handle
from rl2grid.scenarios.cache import (
    LEFT_FREE_BYTES,
    cached_series,
    copies_of_other_keys,
    data_folder,
    free_bytes,
    is_cached,
    remove_oldest,
)
from rl2grid.scenarios.fingerprint import generator_fingerprint
from rl2grid.scenarios.folder import FolderContent
from rl2grid.scenarios.generated import expanded_copies
from rl2grid.scenarios.generator.calendar import MONTH_STEPS, month_and_row, month_start
from rl2grid.scenarios.generator.constants import load_constants
from rl2grid.scenarios.generator.forecast import ForecastModel, forecast_model, forecast_row
from rl2grid.scenarios.generator.month import RawMonth, month_of_year
from rl2grid.scenarios.generator.year import YEAR_LENGTH, generate_year
from rl2grid.scenarios.month_names import Months, scenario_id_of
from rl2grid.scenarios.splits import TRAINING_SEEDS, TRAINING_YEARS

_ARRAYS = ("load_p", "load_q", "prod_p")


class TrainingYear(NamedTuple):
    """The series of a year, read-only and mapped into memory: 0.1 MW and 0.1 MVAr."""

    load_p: I16
    """int16 [row, load]."""
    load_q: I16
    """int16 [row, load]."""
    prod_p: I16
    """int16 [row, gen]."""
    content_hash: str
    """SHA-256 of all values."""


class ForecastInMemory(NamedTuple):
    """What makes the forecasts of a grid's months."""

    model: Handle[ForecastModel]
    voltage: F32 | None
    """Set-points, kV, float32 [gen]; None: those of the grid file hold."""


@dataclass(frozen=True, eq=False)
class TrainingMonths:
    """Months of a year of the library, in a row; attributes are those of a :class:`Scenario` where it has them."""

    grid: Grid
    months: Months
    year: TrainingYear
    source: str = "generated"
    first_row: int = 0
    maintenance: None = None
    """Nothing is recorded of planned outages."""

    @functools.cached_property
    def id(self) -> str:
        """For example ``generated/1000017-03+04``."""
        return scenario_id_of(self.months)

    @property
    def n_steps(self) -> int:
        """Steps that can be played from row 0."""
        return self.months.n_months * MONTH_STEPS

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return self.n_steps + 1

    @property
    def series_rows(self) -> int:
        """They are a whole series."""
        return self.n_rows

    @property
    def start_datetime(self) -> datetime:
        """Time stamp of row 0."""
        return month_start(load_constants(self.grid.id).year, self.months.first)

    @property
    def series_start_datetime(self) -> datetime:
        """They are a whole series."""
        return self.start_datetime

    @functools.cached_property
    def content_hash(self) -> str:
        """Names every value, through those of the year."""
        return f"{self.year.content_hash}-{self.months.first:02d}-{self.months.n_months}"

    @property
    def first_row_of_year(self) -> int:
        """Row of the year that is row 0."""
        return self.months.first * MONTH_STEPS

    def rows(self, first: int, stop: int) -> tuple[I16, I16, I16]:
        """Rows ``first`` to ``stop - 1``: active and reactive demand, production; 0.1 MW, int16 [row, element]."""
        part = slice(self.first_row_of_year + first, self.first_row_of_year + stop)
        return self.year.load_p[part], self.year.load_q[part], self.year.prod_p[part]

    def forecasts(self, row: int) -> tuple[F32, F32, F32]:
        """What a row forecasts: active and reactive demand, production; MW, float32 [horizon, element]."""
        model = forecasts_of(self.grid).model
        horizon = int(model.structure.horizon[0])
        later, place = month_and_row(row, self.months.n_months)
        load_p, load_q, prod_p = self.rows(row + 1, row + 1 + horizon)
        forecast = (
            np.empty(load_p.shape, np.float32),
            np.empty(load_q.shape, np.float32),
            np.empty(prod_p.shape, np.float32),
        )
        for k in range(horizon):
            rows = load_p[k], load_q[k], prod_p[k], *(out[k] for out in forecast)
            forecast_row(model.address, self.months.seed, self.months.first + later, place, k + 1, *rows)
        return forecast


def training_months(grid: Grid, months: Months) -> TrainingMonths:
    """Months of the library; the year is made where it is not there.

    Raises:
        UsageError: the data folder cannot be written, or has no room for the library.
    """
    return TrainingMonths(grid, months, training_year(grid, months.seed))


def training_raw_month(grid: Grid, seed: int, month: int) -> RawMonth:
    """A month of the library as the generator makes it; errors as :func:`training_months`."""
    year = training_year(grid, seed)
    return month_of_year(grid, seed, month, year.load_p, year.load_q, year.prod_p)


def training_year(grid: Grid, seed: int) -> TrainingYear:
    """A year of the library, made where it is not there; asking again gives the same arrays.

    Raises:
        UsageError: the data folder cannot be written, or has no room for the library.
    """
    with _LOCK:
        return _open_year(grid, seed, data_folder(), generator_fingerprint(grid))


def is_year_there(grid: Grid, seed: int) -> bool:
    """Whether a year was made; its values are not looked at."""
    return is_cached(grid.id, _file(seed), generator_fingerprint(grid))


def year_bytes(grid: Grid) -> int:
    """What a year takes on disk, a few kilobytes aside."""
    return YEAR_LENGTH * (2 * grid.n_load + grid.n_gen) * np.dtype(np.int16).itemsize


@functools.cache
def forecasts_of(grid: Grid) -> ForecastInMemory:
    """What makes the forecasts of the months of a grid."""
    constants = load_constants(grid.id)
    return ForecastInMemory(Handle(forecast_model(grid, constants)), constants.voltage)


_LOCK = threading.Lock()


@functools.lru_cache(maxsize=8 * TRAINING_YEARS)
def _open_year(grid: Grid, seed: int, data: Path, fingerprint: str) -> TrainingYear:
    def make() -> FolderContent:
        _check_year_room(grid)
        _announce(grid, data)
        year = generate_year(grid, seed)
        arrays: dict[str, Any] = {name: getattr(year, name) for name in _ARRAYS}
        return FolderContent(month_start(load_constants(grid.id).year, 0), arrays)

    series = cached_series(grid.id, _file(seed), fingerprint, make)
    load_p, load_q, prod_p = (series.arrays[name] for name in _ARRAYS)
    return TrainingYear(load_p, load_q, prod_p, series.content_hash)


def _file(seed: int | str) -> str:
    return f"year.{seed}"


def check_library_room(grid: Grid, most: int = TRAINING_YEARS) -> None:
    """Refuse years of the library that do not fit, before a long training begins to make them: all, or ``most``.

    Raises:
        UsageError: less is free than what is still to be written.
    """
    missing = min(_missing_years(grid), most) * year_bytes(grid)
    if not _has_room(grid, missing):
        raise UsageError(
            f"The library of training months of {grid.id} takes {_gigabytes(TRAINING_YEARS * year_bytes(grid))} in "
            f"{data_folder()}, of which up to {_gigabytes(missing)} are still to be written, and "
            f"{_gigabytes(free_bytes())} are free: free some, or set RL2GRID_DATA to a folder with more room."
        )


def has_library_room(grid: Grid) -> bool:
    """Whether what is still to be written of the library fits, and leaves some to others."""
    return _missing_years(grid) * year_bytes(grid) + LEFT_FREE_BYTES <= free_bytes()


def _missing_years(grid: Grid) -> int:
    return sum(not is_year_there(grid, seed) for seed in TRAINING_SEEDS)


def _check_year_room(grid: Grid) -> None:
    """Refuse a year that does not fit. Who plays a few needs no more than these."""
    if not _has_room(grid, year_bytes(grid)):
        raise UsageError(
            f"A year of training months of {grid.id} takes {year_bytes(grid) / 1e6:,.0f} MB in {data_folder()}, and "
            f"{free_bytes() / 1e6:,.0f} MB are free: free some, or set RL2GRID_DATA to a folder with more room."
        )


def _has_room(grid: Grid, needed: int) -> bool:
    """Whether ``needed`` bytes are free; years that another generator made, then expanded months, give way to them."""
    excess = needed - free_bytes()
    if excess > 0:
        stale = copies_of_other_keys(grid.id, _file("*"), generator_fingerprint(grid))
        remove_oldest([*stale, *expanded_copies()], excess)
    return needed <= free_bytes()


@functools.lru_cache(maxsize=64)
def _announce(grid: Grid, data: Path) -> None:
    """Say once what disk is going to be used."""
    compile_notices.say(
        f"making the {TRAINING_YEARS} years of which training on {grid.id} plays the months, as they are needed and "
        f"once only: {_gigabytes(TRAINING_YEARS * year_bytes(grid))} in {data}."
    )


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.1f} GB"
