"""Demand: weekly habits, season, weather that neighbours share, and noise.

After the demand model of ChroniX2Grid: reference week x season x (1 + regional noise) x (1 + 5-minute noise);
interconnections wander around a daily curve instead, and take a share of the wind and sun that ordinary demand leaves.
Reactive demand is linear in active demand.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, I64
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.arithmetic import rounded, to_gaussian
from rl2grid.scenarios.generator.calendar import ROWS_PER_DAY, day_kinds, seasonal
from rl2grid.scenarios.generator.constants import Constants, DemandConstants
from rl2grid.scenarios.generator.draws import Channel, Draws, Portion
from rl2grid.scenarios.generator.fields import Field, neighbourly, new_field, new_independent_field, value

_REGIONAL_ROWS = 96
_SLOW_ROWS = 4 * ROWS_PER_DAY
_FAST_ROWS = 48
_CHUNK = ROWS_PER_DAY
"""Rows whose 5-minute noise is drawn at once."""


class Demand(NamedTuple):
    """One possible demand, row by row."""

    portion: Portion
    known: DemandConstants
    kinds: I64  # [day] kind of day
    regional: Field
    slow: Field
    fast: Field


def new_demand(grid: Grid, constants: Constants, portion: Portion) -> Demand:
    """The demand of a portion of a year."""
    near = neighbourly(grid, grid.load_to_subid)
    return Demand(
        portion,
        constants.demand,
        day_kinds(constants.year, portion.stop // ROWS_PER_DAY + 2),
        new_field(portion, Channel.DEMAND_SLOW, _REGIONAL_ROWS, near),
        new_independent_field(portion, Channel.INTERCHANGE_SLOW, _SLOW_ROWS, grid.n_load),
        new_independent_field(portion, Channel.INTERCHANGE_FAST, _FAST_ROWS, grid.n_load),
    )


def active_demand(demand: Demand, renewables: I32) -> I32:
    """Active demand of a portion, 0.1 MW, int32 [row, load].

    Args:
        demand: demand of the portion.
        renewables: its wind and sun, 0.1 MW, int32 [row, gen].
    """
    seed, attempt, first, stop, _ = demand.portion
    n = len(demand.known.base)
    active = np.empty((stop - first, n), np.int32)
    for chunk in range(first // _CHUNK, (stop - 1) // _CHUNK + 1):
        begin, end = max(chunk * _CHUNK, first), min((chunk + 1) * _CHUNK, stop)
        draws = Draws(seed, attempt, Channel.DEMAND_NOISE, chunk).uniform((end - chunk * _CHUNK) * n)
        noise = draws.reshape(-1, n)[begin - chunk * _CHUNK :]
        _fill(
            demand.known,
            demand.regional,
            demand.slow,
            demand.fast,
            demand.kinds,
            noise,
            renewables[begin - first : end - first],
            begin,
            active[begin - first : end - first],
        )
    return active


def reactive_demand(known: DemandConstants, active: I32) -> I32:
    """Reactive demand that goes with an active one, 0.1 MVAr, int32 [row, load]."""
    reactive = np.empty(active.shape, np.int32)
    _fill_reactive(known, active, reactive)
    return reactive


@jit
def _fill(
    known: DemandConstants,
    regional: Field,
    slow: Field,
    fast: Field,
    kinds: I64,
    noise: F64,
    renewables: I32,
    first: int,
    active: I32,
) -> None:
    for k in range(active.shape[0]):
        row = first + k
        # Hourly values hold in the middle of their hour; counted from the day before, so that none is negative.
        position = (row + 282) / 12.0
        whole = int(np.floor(position))
        part = position - whole
        hour, next_hour = whole % 24, (whole + 1) % 24
        day, next_day = max(whole // 24 - 1, 0), max((whole + 1) // 24 - 1, 0)
        season = seasonal(known.season, row)
        before = season * (1.0 - part) * known.kind[kinds[day], hour]
        after = season * part * known.kind[kinds[next_day], next_hour]
        surplus = 0
        for gen in range(renewables.shape[1]):
            surplus += renewables[k, gen]
        for load in range(active.shape[1]):
            if known.base[load] == 0.0:
                continue
            habit = before * known.shape[load, hour] + after * known.shape[load, next_hour]
            weather = 1.0 + known.regional[0] * value(regional, row, load)
            weather += known.slow[load] * value(slow, row, load)
            random = known.noise[0] * to_gaussian(noise[k, load])
            active[k, load] = rounded(10.0 * known.base[load] * habit * weather * (1.0 + random))
            surplus -= active[k, load]
        unusual = (surplus / 10.0 - seasonal(known.surplus, row)) * seasonal(known.absorbing, row)
        for load in range(active.shape[1]):
            if known.base[load] > 0.0:
                continue
            curve = (1.0 - part) * known.curve[load, hour] + part * known.curve[load, next_hour]
            drift = known.slow[load] * value(slow, row, load) + known.fast[load] * value(fast, row, load)
            usual = seasonal(known.mean[load], row)
            power = usual + curve + drift + known.absorb[load] * unusual
            power += known.noise[0] * to_gaussian(noise[k, load]) * abs(usual)
            active[k, load] = rounded(10.0 * min(max(power, known.low[load]), known.high[load]))


@jit
def _fill_reactive(known: DemandConstants, active: I32, reactive: I32) -> None:
    for row in range(active.shape[0]):
        for load in range(active.shape[1]):
            reactive[row, load] = rounded(10.0 * known.reactive[load, 0] + known.reactive[load, 1] * active[row, load])
