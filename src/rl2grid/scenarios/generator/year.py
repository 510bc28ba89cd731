"""A year of a grid: demand, wind and sun, dispatch with the losses of the AC power flow, and its repair.

A month must begin secure: no line may be loaded above its limit during its first day, in the reference topology. Where
one does not, that day, with 6 hours of transition before and after, takes its weather, demand and exchanges from
another year of the same seed, the first that is secure; after 16 of them each next one is made calmer. A year that
cannot be repaired so, or whose power flow does not converge in every half hour, is discarded.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np

from rl2grid.arrays import I16, I32, I64
from rl2grid.compile import jit
from rl2grid.errors import UsageError
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.calendar import MONTH_STEPS, MONTHS, ROWS_PER_DAY, ROWS_PER_HOUR, YEAR_ROWS
from rl2grid.scenarios.generator.constants import Constants, load_constants
from rl2grid.scenarios.generator.demand import active_demand, new_demand, reactive_demand
from rl2grid.scenarios.generator.dispatch import Market, dispatch, new_market
from rl2grid.scenarios.generator.draws import Portion
from rl2grid.scenarios.generator.renewables import new_weather, renewable_production
from rl2grid.scenarios.generator.security import assess

MAX_SEED = 2**63 - 1
LONGEST_HORIZON = ROWS_PER_HOUR
"""Rows after the year that its last forecasts need."""
YEAR_LENGTH = YEAR_ROWS + LONGEST_HORIZON
"""Rows of a generated year."""
_ATTEMPTS = 8
_SPARE_DAYS = 60
"""Other years of the seed from which a first day may be taken."""
_CALM_AFTER, _LESS_DEMAND, _LESS_RENEWABLES = 16, 5, 20
"""After so many spare days, each has that much less demand, and wind and sun, than the last, in thousandths."""
_ROUNDS = 12
_TRANSITION = 6 * ROWS_PER_HOUR
_SECURE = 0.99
"""Largest loading of a secure row: other engines may round differently."""
_PROBED = 0.97
"""Largest loading of a first day that is dispatched in quarters of an hour, before the real dispatch."""
_QUARTER = 3
_SAMPLE = 6
"""Rows from one whose losses are solved for to the next."""
_DAY_ROWS = ROWS_PER_DAY + 1


class Year(NamedTuple):
    """Series of a year, and 12 rows more; 0.1 MW and 0.1 MVAr."""

    load_p: I16  # [row, load]
    load_q: I16  # [row, load]
    prod_p: I16  # [row, gen]
    attempt: int
    """Years of this seed that were discarded."""
    spares: tuple[int, ...]
    """For each month 0, or the number of the year that its first day was taken from."""
    short: int
    """Energy that dispatch could not deliver, 0.1 MW rows."""


class _Injections(NamedTuple):
    load_p: I32
    load_q: I32
    prod_p: I32


class _Sample(NamedTuple):
    """What the power flow said of every sixth row."""

    load_p: I32
    prod_p: I32
    losses: I64
    reserve: I64  # [row of the year] thermal production that dispatch found to be needed


class _Setting(NamedTuple):
    grid: Grid
    constants: Constants
    seed: int
    attempt: int
    market: Market


@functools.lru_cache(maxsize=2)
def generate_year(grid: Grid, seed: int) -> Year:
    """The year of a seed; arrays are read-only.

    Raises:
        UsageError: ``seed`` is no integer from 0 to 2^63 - 1.
    """
    if not isinstance(seed, (int, np.integer)) or isinstance(seed, bool) or not 0 <= seed <= MAX_SEED:
        raise UsageError(f"Seed {seed!r} is no seed of a year: choose an integer from 0 to {MAX_SEED}.")
    constants = load_constants(grid.id)
    for attempt in range(_ATTEMPTS):
        market = new_market(grid, constants, Portion(int(seed), attempt, 0, YEAR_LENGTH))
        year = _attempt_year(_Setting(grid, constants, int(seed), attempt, market))
        if year is not None:
            for array in (year.load_p, year.load_q, year.prod_p):
                array.setflags(write=False)
            return year
    raise RuntimeError(f"None of {_ATTEMPTS} years of seed {seed} of {grid.id} can be operated.")


def _attempt_year(setting: _Setting) -> Year | None:
    demand, renewables = _draw(setting, Portion(setting.seed, setting.attempt << 8, 0, YEAR_LENGTH))
    spares = np.zeros(MONTHS, np.int64)
    doubtful = np.arange(MONTHS)
    sample: _Sample | None = None
    series: _Injections | None = None
    for _ in range(_ROUNDS):
        for month in doubtful:
            if not _make_secure(setting, demand, renewables, spares, int(month)):
                return None
        sample = _sample_losses(setting, demand, renewables, sample)
        if sample is None:
            return None
        last = series
        series, short = _operate(setting, demand, renewables, sample)
        doubtful = np.array([m for m in range(MONTHS) if not _begins_secure(setting, series, last, m)], np.int64)
        if not len(doubtful):
            load_p, load_q, prod_p = (array.astype(np.int16) for array in series)
            return Year(load_p, load_q, prod_p, setting.attempt, tuple(spares.tolist()), short)
        _replace_days(setting, demand, renewables, spares, doubtful)
    return None


def _draw(setting: _Setting, portion: Portion) -> tuple[I32, I32]:
    """Demand, wind and sun of a portion of a year of the seed."""
    renewables = renewable_production(new_weather(setting.grid, setting.constants.renewables, portion))
    return active_demand(new_demand(setting.grid, setting.constants, portion), renewables), renewables


def _make_secure(setting: _Setting, demand: I32, renewables: I32, spares: I64, month: int) -> bool:
    """Find the first spare day that is secure for ``month``; whether there is one."""
    while not _looks_secure(setting, demand, renewables, month):
        if spares[month] == _SPARE_DAYS:
            return False
        _replace_days(setting, demand, renewables, spares, np.array([month]))
    return True


def _looks_secure(setting: _Setting, demand: I32, renewables: I32, month: int) -> bool:
    """Whether the first day of ``month`` is secure when it is dispatched for itself, every quarter of an hour."""
    rows = slice(month * MONTH_STEPS, month * MONTH_STEPS + _DAY_ROWS, _QUARTER)
    load_p, prod_p = demand[rows], renewables[rows].copy()
    load_q = reactive_demand(setting.constants.demand, load_p)
    total = load_p.sum(axis=1, dtype=np.int64)
    consumption = total + _usual_losses(setting, total)
    dispatch(setting.market, rows.start, _QUARTER, consumption, np.zeros_like(total), prod_p)
    verdict = assess(setting.grid, setting.constants.voltage, load_p, load_q, prod_p)
    return verdict.converged and float(verdict.loading.max()) <= _PROBED


def _replace_days(setting: _Setting, demand: I32, renewables: I32, spares: I64, months: I64) -> None:
    """Take the first day of ``months`` from the next spare year."""
    for month in months:
        begin = int(month) * MONTH_STEPS
        first, stop = max(begin - _TRANSITION, 0), begin + _DAY_ROWS + _TRANSITION
        spares[month] += 1
        number = (setting.attempt << 8) | int(spares[month])
        other_demand, other_renewables = _draw(setting, Portion(setting.seed, number, first, stop, int(month) + 1))
        calm = max(int(spares[month]) - _CALM_AFTER, 0)
        other_demand = other_demand * (1000 - _LESS_DEMAND * calm) // 1000
        other_renewables = other_renewables * (1000 - _LESS_RENEWABLES * calm) // 1000
        _fade(demand[first:stop], other_demand, begin - first)
        _fade(renewables[first:stop], other_renewables, begin - first)


@jit
def _fade(series: I32, other: I32, begin: int) -> None:
    """Blend ``other`` into ``series``: entirely in the day that starts at row ``begin``, less before and after."""
    for row in range(series.shape[0]):
        outside = max(begin - row, row - begin - (_DAY_ROWS - 1), 0)
        weight = max(_TRANSITION - outside, 0)
        for k in range(series.shape[1]):
            mixed = series[row, k] * (_TRANSITION - weight) + other[row, k] * weight
            series[row, k] = (mixed + _TRANSITION // 2) // _TRANSITION


def _sample_losses(setting: _Setting, load_p: I32, renewables: I32, last: _Sample | None) -> _Sample | None:
    """Losses of every sixth row, dispatched with the usual losses; None where a flow does not converge."""
    total = load_p.sum(axis=1, dtype=np.int64)
    prod_p, reserve = renewables.copy(), np.zeros_like(total)
    dispatch(setting.market, 0, 1, total + _usual_losses(setting, total), reserve, prod_p)
    sampled_p, sampled_g = load_p[::_SAMPLE].copy(), prod_p[::_SAMPLE].copy()
    losses = np.zeros(len(sampled_p), np.int64)
    new = np.arange(len(sampled_p))
    if last is not None:
        losses = last.losses.copy()
        new = np.flatnonzero((sampled_p != last.load_p).any(axis=1) | (sampled_g != last.prod_p).any(axis=1))
    load_q = reactive_demand(setting.constants.demand, sampled_p[new])
    verdict = assess(setting.grid, setting.constants.voltage, sampled_p[new], load_q, sampled_g[new])
    if not verdict.converged:
        return None
    losses[new] = verdict.losses
    return _Sample(sampled_p, sampled_g, losses, reserve)


def _operate(setting: _Setting, load_p: I32, renewables: I32, sample: _Sample) -> tuple[_Injections, int]:
    """Dispatch a year with the losses of its sample; also returns the energy that was not delivered."""
    prod_p, total = renewables.copy(), load_p.sum(axis=1, dtype=np.int64)
    consumption = total + _every_row(sample.losses, len(total))
    short = dispatch(setting.market, 0, 1, consumption, sample.reserve, prod_p)
    return _Injections(load_p.copy(), reactive_demand(setting.constants.demand, load_p), prod_p), int(short)


def _usual_losses(setting: _Setting, total: I64) -> I64:
    losses: I64 = np.floor(total * setting.constants.supply.losses[0]).astype(np.int64)
    return losses


def _begins_secure(setting: _Setting, series: _Injections, last: _Injections | None, month: int) -> bool:
    """Whether the first day of a month is secure; ``last`` had other days, those that stayed were secure."""
    rows = slice(month * MONTH_STEPS, month * MONTH_STEPS + _DAY_ROWS)
    day = [array[rows] for array in series]
    if last is not None and all(np.array_equal(new, old[rows]) for new, old in zip(day, last, strict=True)):
        return True
    verdict = assess(setting.grid, setting.constants.voltage, *day)
    return verdict.converged and float(verdict.loading.max()) <= _SECURE


@jit
def _every_row(sampled: I64, rows: int) -> I64:
    """Straight lines between the sampled rows, level after the last."""
    result = np.empty(rows, np.int64)
    for row in range(rows):
        before, part = row // _SAMPLE, row % _SAMPLE
        after = min(before + 1, sampled.size - 1)
        result[row] = (sampled[before] * (_SAMPLE - part) + sampled[after] * part) // _SAMPLE
    return result
