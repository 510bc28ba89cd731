"""Forecasts: what will happen, with an error that grows like the square root of the horizon."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.arithmetic import rounded, to_gaussian
from rl2grid.scenarios.generator.constants import Constants, ForecastConstants
from rl2grid.scenarios.generator.draws import Channel, Draws


class Forecasts(NamedTuple):
    """Forecasts made in each row for the steps after it; MW and MVAr, float32 [row, horizon, element]."""

    load_p: F32
    load_q: F32
    prod_p: F32


def make_forecasts(
    grid: Grid, constants: Constants, seed: int, month: int, active: I32, reactive: I32, production: I32
) -> Forecasts:
    """The forecasts of a month.

    Errors are random walks over the horizon, drawn anew in every row. Active and reactive demand of a load err
    together; dispatchable generators are known to follow their schedule.

    Args:
        grid: the grid.
        constants: its constants.
        seed: seed of the year.
        month: 0 .. 11.
        active: 0.1 MW, int32 [row + horizon, load]: the month and as many rows after it as the horizon.
        reactive: 0.1 MVAr.
        production: 0.1 MW, int32 [row + horizon, gen].
    """
    known = constants.forecast
    horizon = int(known.horizon[0])
    rows = len(active) - horizon
    load_p = np.empty((rows, horizon, grid.n_load), np.float32)
    load_q, prod_p = np.empty_like(load_p), np.empty((rows, horizon, grid.n_gen), np.float32)
    noise = Draws(seed, 0, Channel.LOAD_FORECAST, month).uniform(load_p.size)
    _forecast_loads(known, noise, active, reactive, load_p, load_q)
    kinds = np.array(grid.gen_type)
    spread = known.wind[0] * (kinds == "wind") + known.solar[0] * (kinds == "solar")
    renewables = np.flatnonzero(spread)
    noise = Draws(seed, 0, Channel.RENEWABLE_FORECAST, month).uniform(rows * horizon * len(renewables))
    _forecast_production(noise, spread, np.floor(10.0 * grid.gen_pmax.astype(np.float64)), production, prod_p)
    return Forecasts(load_p, load_q, prod_p)


@jit
def _forecast_loads(known: ForecastConstants, noise: F64, active: I32, reactive: I32, load_p: F32, load_q: F32) -> None:
    error = np.empty(load_p.shape[2])
    position = 0
    for row in range(load_p.shape[0]):
        error[:] = 1.0
        for ahead in range(load_p.shape[1]):
            for load in range(load_p.shape[2]):
                error[load] += known.load[0] * to_gaussian(noise[position])
                position += 1
                load_p[row, ahead, load] = rounded(active[row + 1 + ahead, load] * error[load]) / 10.0
                load_q[row, ahead, load] = rounded(reactive[row + 1 + ahead, load] * error[load]) / 10.0


@jit
def _forecast_production(noise: F64, spread: F64, pmax: F64, production: I32, prod_p: F32) -> None:
    error = np.empty(prod_p.shape[2])
    position = 0
    for row in range(prod_p.shape[0]):
        error[:] = 1.0
        for ahead in range(prod_p.shape[1]):
            for gen in range(prod_p.shape[2]):
                planned = production[row + 1 + ahead, gen]
                if spread[gen] > 0.0:
                    error[gen] += spread[gen] * to_gaussian(noise[position])
                    position += 1
                    planned = min(max(rounded(planned * error[gen]), 0), pmax[gen])
                prod_p[row, ahead, gen] = planned / 10.0
