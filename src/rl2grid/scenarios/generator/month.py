"""A month of a generated year as a scenario."""

from __future__ import annotations

import hashlib
from datetime import datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import I16
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.calendar import MONTH_ROWS, MONTH_STEPS, MONTHS, month_start
from rl2grid.scenarios.generator.constants import load_constants
from rl2grid.scenarios.generator.forecast import make_forecasts
from rl2grid.scenarios.generator.year import generate_year
from rl2grid.scenarios.scenario import Scenario


class RawMonth(NamedTuple):
    """What a month is made of: 0.1 MW and 0.1 MVAr, and as many rows after it as its forecasts look ahead."""

    grid_id: str
    seed: int
    month: int
    load_p: I16  # [row + horizon, load]
    load_q: I16  # [row + horizon, load]
    prod_p: I16  # [row + horizon, gen]


def generate_month(grid: Grid, seed: int, month: int) -> Scenario:
    """Month ``month`` (0 .. 11) of the year of a seed, 8,065 rows of 5 minutes.

    A month is 28 days; the first begins on January 1st, and the last row of one is the first row of the next. The
    same values come out on every machine. Nothing is recorded of planned outages.

    Raises:
        UsageError: there is no such month, or ``seed`` is no integer from 0 to 2^63 - 1.
    """
    return scenario_of(grid, raw_month(grid, seed, month))


def raw_month(grid: Grid, seed: int, month: int) -> RawMonth:
    """The integers of a month; arguments and errors as :func:`generate_month`."""
    if not isinstance(month, (int, np.integer)) or isinstance(month, bool) or not 0 <= month < MONTHS:
        raise UsageError(f"Month {month!r} does not exist: choose an integer from 0 to {MONTHS - 1}.")
    year = generate_year(grid, seed)
    return month_of_year(grid, int(seed), int(month), year.load_p, year.load_q, year.prod_p)


def month_of_year(grid: Grid, seed: int, month: int, load_p: I16, load_q: I16, prod_p: I16) -> RawMonth:
    """A month (0 .. 11) of the series of a year, int16 [row of the year, element]."""
    first = month * MONTH_STEPS
    rows = slice(first, first + MONTH_ROWS + int(load_constants(grid.id).forecast.horizon[0]))
    return RawMonth(grid.id, seed, month, load_p[rows], load_q[rows], prod_p[rows])


def scenario_of(grid: Grid, raw: RawMonth) -> Scenario:
    """The scenario of a month's integers."""
    arrays = arrays_of(grid, raw)
    start = start_of(raw)
    return Scenario(
        id=scenario_id(raw.seed, raw.month),
        grid_id=grid.id,
        source="generated",
        start_datetime=start,
        content_hash=hash_of(start, arrays),
        first_row=0,
        series_rows=MONTH_ROWS,
        **arrays,
    )


def scenario_id(seed: int, month: int) -> str:
    """For example ``generated/17-03``."""
    return f"generated/{seed}-{month:02d}"


def start_of(raw: RawMonth) -> datetime:
    """Time stamp of row 0."""
    return month_start(load_constants(raw.grid_id).year, raw.month)


def arrays_of(grid: Grid, raw: RawMonth) -> dict[str, NDArray[Any]]:
    """The arrays of a month's scenario by name; read-only, contiguous, float32."""
    constants = load_constants(grid.id)
    integers = raw.load_p, raw.load_q, raw.prod_p
    forecasts = make_forecasts(grid, constants, raw.seed, raw.month, *integers)
    arrays: dict[str, NDArray[Any]] = {
        name: (array[:MONTH_ROWS] / 10.0).astype(np.float32)
        for name, array in zip(("load_p", "load_q", "prod_p"), integers, strict=True)
    }
    arrays |= {f"{name}_forecast": array for name, array in forecasts._asdict().items()}
    if constants.voltage is not None:
        horizon = forecasts.load_p.shape[1]
        arrays["prod_v"] = np.tile(constants.voltage, (MONTH_ROWS, 1))
        arrays["prod_v_forecast"] = np.tile(constants.voltage, (MONTH_ROWS, horizon, 1))
    for array in arrays.values():
        array.setflags(write=False)
    return arrays


def hash_of(start: datetime, arrays: dict[str, NDArray[Any]]) -> str:
    """SHA-256 of the first time stamp and of the names, shapes and values of arrays."""
    digest = hashlib.sha256(start.isoformat().encode())
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).data)
    return digest.hexdigest()
