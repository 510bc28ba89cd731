"""What the generator knows of each grid, fitted to the bundled series by ``benchmarks/calibration.py``."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import F32, F64, I64
from rl2grid.grids import System, find_system


class DemandConstants(NamedTuple):
    """Demand of ordinary loads and of interconnections; all arrays. ``kind``: working day, Saturday, Sunday."""

    base: F64  # [load] MW; 0 for interconnections
    shape: F64  # [load, 24] demand of a working day by hour, relative to base
    kind: F64  # [3, 24] factor of the kind of day
    season: F64  # [12] factor in the middle of each calendar month
    regional: F64  # [1] standard deviation of what neighbours share, relative
    noise: F64  # [1] of what changes every 5 minutes
    reactive: F64  # [load, 2] MVAr = first + second * MW
    mean: F64  # [load, 12] MW of interconnections in the middle of each calendar month; 0 for ordinary loads
    curve: F64  # [load, 24] MW by hour around the mean
    slow: F64  # [load] standard deviation that lasts days: MW for interconnections, relative for ordinary loads
    fast: F64  # [load] standard deviation that lasts hours, MW; 0 for ordinary loads
    low: F64  # [load] bounds of interconnections, MW
    high: F64  # [load]
    absorb: F64  # [load] MW that interconnections take of every MW of surplus, over the year; 0 for ordinary loads
    absorbing: F64  # [12] factor on that in the middle of each calendar month
    surplus: F64  # [12] MW of wind and sun less ordinary demand, usual in the middle of each calendar month


class RenewableConstants(NamedTuple):
    """Wind and sun; all arrays."""

    wind: F64  # [1] factor on the capacity factor of the wind model
    solar: F64  # [1] share of pmax under a clear sky at the zenith
    variety: F64  # [1] factor on what the wind differs by from its mean
    gusts: F64  # [1] standard deviation of gusts
    mixes: F64  # [mix] factor on both; a year has one of them


class SupplyConstants(NamedTuple):
    """Quadratic costs of dispatchable generators, which produce more the higher the price is; all arrays."""

    gen: I64  # [unit] id of the generator
    low: F64  # [unit] MW at least
    high: F64  # [unit] MW at most, before the guide
    begin: F64  # [unit] price at which it begins to produce more than low
    width: F64  # [unit] rise of the price that brings it to high
    guide: F64  # [unit, 12] share of high available in the middle of each calendar month
    wander: F64  # [1] standard deviation of what the prices of units drift by
    losses: F64  # [1] share of demand, before the power flow tells


class ForecastConstants(NamedTuple):
    """Standard deviation of one-step forecasts, relative to the value (load) or to it (wind, sun); all arrays."""

    horizon: I64  # [1] steps
    load: F64  # [1]
    wind: F64  # [1]
    solar: F64  # [1]


@dataclass(frozen=True)
class Constants:
    """Everything fitted for one grid."""

    hash: str
    """Short hash of all of them."""
    year: int
    """Calendar year that generated series carry."""
    demand: DemandConstants
    renewables: RenewableConstants
    supply: SupplyConstants
    forecast: ForecastConstants
    voltage: F32 | None
    """[gen] kV; None: the grid file's set-points hold."""


_SECTIONS: dict[str, Any] = {
    "demand": DemandConstants,
    "renewables": RenewableConstants,
    "supply": SupplyConstants,
    "forecast": ForecastConstants,
}


def load_constants(grid_id: str) -> Constants:
    """The constants of a grid.

    Raises:
        UsageError: there is no such grid, or nothing was fitted for it.
    """
    return _constants(find_system(grid_id))


@functools.lru_cache(maxsize=16)
def _constants(system: System) -> Constants:
    return constants_from_record(system.required_constants())


def constants_from_record(record: Mapping[str, Any]) -> Constants:
    """The constants that a data file holds."""
    sections: dict[str, Any] = {
        name: kind(**{field: _array(field, item) for field, item in record[name].items()})
        for name, kind in _SECTIONS.items()
    }
    voltage = record["voltage"]
    digest = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
    return Constants(
        hash=digest[:16],
        year=record["year"],
        voltage=None if voltage is None else np.array(voltage, np.float32),
        **sections,
    )


def _array(name: str, item: list[Any]) -> NDArray[Any]:
    return np.array(item, np.int64 if name in ("gen", "horizon") else np.float64)
