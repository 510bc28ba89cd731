"""Economic dispatch: the one cheapest production that meets demand and losses within limits and ramps.

Every dispatchable generator has a quadratic cost, so its marginal cost rises linearly from ``begin`` by ``width``.
A step's programme (least cost, given total production, limits, and ramps from the step before) is then strictly
convex and separable but for one sum; its solution is found through the price. Integers of 0.1 MW: productions at the
price are rounded down, and what is missing is handed out in the order of the generators.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, I64, Flags
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.calendar import ROWS_PER_DAY, seasonal
from rl2grid.scenarios.generator.constants import Constants, SupplyConstants
from rl2grid.scenarios.generator.draws import Channel, Portion
from rl2grid.scenarios.generator.fields import Field, new_independent_field, value

_RAMP_SHARE = 9.8
"""Ramps in 0.1 MW keep 2 percent in hand: rounding must not break them."""
_KEPT_PACE = 0.8
"""Share of their ramps at which thermal units are expected to climb before a peak; some may be at their most."""
_PASSES = 6
"""How often rows are dispatched at most, each time with more reserve."""
_MORE_RESERVE = 1500
"""Reserve beyond what was missing, 0.1 MW."""
_LOWEST_PRICE, _HIGHEST_PRICE = -2.0, 6.0
_HALVINGS = 34


class Market(NamedTuple):
    """What dispatch needs besides demand."""

    supply: SupplyConstants
    ramp: I64  # [unit] 0.1 MW per step
    nuclear: Flags  # [unit]
    thermal: Flags  # [unit]
    drift: Field  # noise of the price of each unit


def new_market(grid: Grid, constants: Constants, portion: Portion) -> Market:
    """The generators of ``grid`` in a portion of a year."""
    supply = constants.supply
    drift = new_independent_field(portion, Channel.PRICE, ROWS_PER_DAY, len(supply.gen))
    steepest = np.minimum(grid.gen_max_ramp_up, grid.gen_max_ramp_down)[supply.gen].astype(np.float64)
    kinds = np.array(grid.gen_type)[supply.gen]
    ramps = np.floor(_RAMP_SHARE * steepest).astype(np.int64)
    return Market(supply, ramps, kinds == "nuclear", kinds == "thermal", drift)


def dispatch(market: Market, first: int, stride: int, consumption: I64, reserve: I64, production: I32) -> int:
    """Dispatch rows ``first``, ``first + stride``, ... of a year; no ramp leads to the first.

    Where the generators cannot produce as little as asked, wind and sun are curtailed in proportion. Where they
    cannot produce as much, production falls short, and the slack generator will deliver the rest in the power flow.
    Nuclear and thermal units foresee demand (:func:`_foresee`), so that ramps seldom lead to either; where production
    falls short, the rows are dispatched again with more thermal production in reserve.

    Args:
        market: the generators.
        first: row of the year to which the first row of the arguments belongs.
        stride: rows of the year from one row of the arguments to the next; ramps allow as many steps.
        consumption: demand and losses, 0.1 MW, int64 [row].
        reserve: production for which thermal units must be ready, 0.1 MW, int64 [row]; increased where that was needed.
        production: int32 [row, gen], 0.1 MW; wind and sun are given, the others are written.

    Returns:
        Energy that was not delivered, 0.1 MW rows.
    """
    missing = np.zeros(consumption.size, np.int64)
    available = production.copy()
    for _ in range(_PASSES):
        production[:] = available
        _dispatch(market, first, stride, consumption, reserve, production, missing)
        if not missing.any():
            break
        for row in range(missing.size):
            if missing[row] > 0:
                reserve[row] += missing[row] + _MORE_RESERVE
    return int(missing.sum())


@jit
def _dispatch(
    market: Market, first: int, stride: int, consumption: I64, reserve: I64, production: I32, missing: I64
) -> None:
    supply, units = market.supply, market.supply.gen.size
    low, high, ceiling = np.empty(units, np.int64), np.empty(units, np.int64), np.empty(units, np.int64)
    floor, slope, begin = np.empty(units), np.empty(units), np.empty(units)
    power = np.empty(units, np.int64)
    foreseen = _foresee(market, first, stride, consumption, reserve, production)
    for k in range(consumption.size):
        row = first + k * stride
        asked = consumption[k]
        for gen in range(production.shape[1]):
            asked -= production[k, gen]
        least = usual = most = 0
        for unit in range(units):
            available = 10.0 * supply.high[unit] * seasonal(supply.guide[unit], row)
            allowed = available
            if market.nuclear[unit]:
                available *= foreseen[k, 0]
                allowed = available
            elif not market.thermal[unit]:
                allowed *= foreseen[k, 1]
            floor[unit] = min(10.0 * supply.low[unit], available)
            slope[unit] = (available - floor[unit]) / supply.width[unit]
            begin[unit] = supply.begin[unit] + supply.wander[0] * value(market.drift, row, unit)
            low[unit], ceiling[unit] = np.int64(np.ceil(floor[unit])), np.int64(np.floor(available))
            high[unit] = np.int64(np.floor(allowed))
            if k > 0:
                step = market.ramp[unit] * stride
                low[unit] = max(low[unit], power[unit] - step)
                ceiling[unit] = max(min(ceiling[unit], power[unit] + step), low[unit])
                high[unit] = max(min(high[unit], power[unit] + step), low[unit])
            least += low[unit]
            usual += high[unit]
            most += ceiling[unit]
        missing[k] = 0
        if asked < least:
            _curtail(production[k], least - asked)
            asked = least
        elif asked > most:
            missing[k] = asked - most
            asked = most
        if asked > usual:
            low[:] = high  # room that was made for thermal units is needed now
            high[:] = ceiling
        _share(asked, floor, slope, begin, low, high, power)
        for unit in range(units):
            production[k, supply.gen[unit]] = power[unit]


@jit
def _foresee(market: Market, first: int, stride: int, consumption: I64, reserve: I64, production: I32) -> F64:
    """Shares of their limits that nuclear units and the others but thermal units may produce at most.

    Nuclear units come down before a valley. Before a peak that all others cannot meet, hydro units make room for
    thermal units, which start as early as their ramps require.

    Returns:
        float64 [row, 2]: nuclear units; hydro units.
    """
    supply = market.supply
    nuclear = thermal = reserved = 0.0
    nuclear_pace, thermal_pace = 1.0, 0.0
    for unit in range(supply.gen.size):
        if market.nuclear[unit]:
            nuclear += 10.0 * supply.high[unit]
            nuclear_pace = min(nuclear_pace, market.ramp[unit] * stride / (10.0 * supply.high[unit]))
        else:
            reserved += 10.0 * supply.low[unit]
        if market.thermal[unit]:
            thermal += 10.0 * supply.high[unit]
            thermal_pace += market.ramp[unit] * stride
    shares = np.ones((consumption.size, 2))
    most, least = 1.0, 0.0
    for k in range(consumption.size - 1, -1, -1):
        asked = float(consumption[k])
        for gen in range(production.shape[1]):
            asked -= production[k, gen]
        if nuclear > 0.0:
            most = min(most + nuclear_pace, 1.0, max((asked - reserved) / nuclear, 0.0))
        hydro = 0.0
        for unit in range(supply.gen.size):
            if not market.nuclear[unit] and not market.thermal[unit]:
                hydro += 10.0 * supply.high[unit] * seasonal(supply.guide[unit], first + k * stride)
        needed = min(max(asked - nuclear * most - hydro, 0.0) + reserve[k], thermal)
        least = max(least - _KEPT_PACE * thermal_pace, needed)
        if least > needed and hydro > 0.0:
            shares[k, 1] = min(max((asked - nuclear * most - least) / hydro, 0.0), 1.0)
        shares[k, 0] = most
    return shares


@jit
def _share(asked: int, floor: F64, slope: F64, begin: F64, low: I64, high: I64, power: I64) -> None:
    """Write the cheapest ``power`` of sum ``asked``, which the limits allow."""
    below, above = _LOWEST_PRICE, _HIGHEST_PRICE
    for _ in range(_HALVINGS):
        price = 0.5 * (below + above)
        total = 0.0
        for unit in range(power.size):
            total += min(max(floor[unit] + slope[unit] * (price - begin[unit]), low[unit]), high[unit])
        if total > asked:
            above = price
        else:
            below = price
    missing = asked
    for unit in range(power.size):
        wanted = np.int64(np.floor(floor[unit] + slope[unit] * (below - begin[unit])))
        power[unit] = min(max(wanted, low[unit]), high[unit])
        missing -= power[unit]
    # Units that the price keeps at their least come last.
    for reluctant in range(2):
        for unit in range(power.size):
            if missing > 0 and power[unit] < high[unit] and (reluctant == 1 or power[unit] > low[unit]):
                power[unit] += 1
                missing -= 1
    while missing > 0:
        for unit in range(power.size):
            if missing > 0 and power[unit] < high[unit]:
                power[unit] += 1
                missing -= 1


@jit
def _curtail(production: I32, surplus: int) -> None:
    """Take ``surplus`` from wind and sun (all that ``production`` holds so far), in proportion."""
    total = 0
    for gen in range(production.size):
        total += production[gen]
    if total <= surplus:
        production[:] = 0
        return
    left = surplus
    for gen in range(production.size):
        cut = surplus * int(production[gen]) // total
        production[gen] -= cut
        left -= cut
    for gen in range(production.size):
        cut = min(left, int(production[gen]))
        production[gen] -= cut
        left -= cut
