"""Forecasts: what will happen, with an error that grows like the square root of the horizon.

Errors are random walks over the horizon, drawn anew in every row. Active and reactive demand of a load err together;
dispatchable generators are known to follow their schedule. Each number is a function of the year, the month and the
row, so that those of a whole month (:func:`make_forecasts`) and of one row (:func:`forecast_row`) are the same.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I16, I64
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.handles import opener
from rl2grid.philox import fill_uniforms, stream_key
from rl2grid.scenarios.generator.arithmetic import rounded, to_gaussian
from rl2grid.scenarios.generator.constants import Constants
from rl2grid.scenarios.generator.draws import Channel, Draws, channel_key
from rl2grid.streams import Purpose
from rl2grid.structures import constant

_LOADS, _RENEWABLES = int(Channel.LOAD_FORECAST), int(Channel.RENEWABLE_FORECAST)
_SERIES = int(Purpose.SERIES)


class Forecasts(NamedTuple):
    """Forecasts made in each row for the steps after it; MW and MVAr, float32 [row, horizon, element]."""

    load_p: F32
    load_q: F32
    prod_p: F32


class ForecastModel(NamedTuple):
    """How the forecasts of a grid err."""

    horizon: Annotated[I64, constant("1", "that each row forecasts", "steps")]
    load: Annotated[F64, constant("1", "standard deviation of one step, relative to demand")]
    spread: Annotated[F64, constant("gen", "the same of wind and sun; 0: follows its schedule")]
    renewables: Annotated[I64, constant("1", "how many of wind and sun there are")]
    pmax: Annotated[F64, constant("gen", "no more is forecast", "0.1 MW")]


_open_model = opener(ForecastModel)


def forecast_model(grid: Grid, constants: Constants) -> ForecastModel:
    """The model of a grid."""
    known, kinds = constants.forecast, np.array(grid.gen_type)
    spread = known.wind[0] * (kinds == "wind") + known.solar[0] * (kinds == "solar")
    return ForecastModel(
        known.horizon.astype(np.int64),
        known.load.astype(np.float64),
        spread.astype(np.float64),
        np.array([np.count_nonzero(spread)], np.int64),
        np.floor(10.0 * grid.gen_pmax.astype(np.float64)),
    )


def make_forecasts(
    grid: Grid, constants: Constants, seed: int, month: int, active: I16, reactive: I16, production: I16
) -> Forecasts:
    """The forecasts of a month.

    Args:
        grid: the grid.
        constants: its constants.
        seed: seed of the year.
        month: 0 .. 11.
        active: 0.1 MW, int16 [row + horizon, load]: the month and as many rows after it as the horizon.
        reactive: 0.1 MVAr.
        production: 0.1 MW, int16 [row + horizon, gen].
    """
    model = forecast_model(grid, constants)
    horizon = int(model.horizon[0])
    rows = len(active) - horizon
    load_p = np.empty((rows, horizon, grid.n_load), np.float32)
    load_q, prod_p = np.empty_like(load_p), np.empty((rows, horizon, grid.n_gen), np.float32)
    noise = Draws(seed, 0, Channel.LOAD_FORECAST, month).uniform(load_p.size)
    _forecast_loads(model.load[0], noise.reshape(load_p.shape), active, reactive, load_p, load_q)
    renewables = int(model.renewables[0])
    noise = Draws(seed, 0, Channel.RENEWABLE_FORECAST, month).uniform(rows * horizon * renewables)
    _forecast_production(model.spread, model.pmax, noise.reshape(rows, horizon, renewables), production, prod_p)
    return Forecasts(load_p, load_q, prod_p)


@jit
def forecast_row(
    address: int,
    seed: int,
    month: int,
    row: int,
    steps: int,
    active: I16,
    reactive: I16,
    production: I16,
    load_p: F32,
    load_q: F32,
    prod_p: F32,
) -> None:
    """What row ``row`` of a month forecasts for ``steps`` steps later.

    Args:
        address: of the handle to the grid's :class:`ForecastModel`.
        seed: seed of the year.
        month: 0 .. 11.
        row: of the month.
        steps: 1 to the horizon.
        active: what will happen then, 0.1 MW, int16 [load].
        reactive: 0.1 MVAr, int16 [load].
        production: 0.1 MW, int16 [gen].
        load_p: output, MW, float32 [load].
        load_q: output, MVAr, float32 [load].
        prod_p: output, MW, float32 [gen].
    """
    model = _open_model(address)
    before = row * model.horizon[0]
    noise = np.empty((steps, active.size))
    fill_uniforms(seed, stream_key(channel_key(0, _LOADS, month), _SERIES), before * active.size, noise.reshape(-1))
    error = np.ones(active.size)
    for step in range(steps):
        _add_load_errors(model.load[0], noise[step], error)
    _err_loads(error, active, reactive, load_p, load_q)
    renewables = model.renewables[0]
    noise = np.empty((steps, renewables))
    fill_uniforms(seed, stream_key(channel_key(0, _RENEWABLES, month), _SERIES), before * renewables, noise.reshape(-1))
    error = np.ones(production.size)
    for step in range(steps):
        _add_production_errors(model.spread, noise[step], error)
    _err_production(model.spread, model.pmax, error, production, prod_p)


@jit
def _forecast_loads(load: float, noise: F64, active: I16, reactive: I16, load_p: F32, load_q: F32) -> None:
    error = np.empty(load_p.shape[2])
    for row in range(load_p.shape[0]):
        error[:] = 1.0
        for ahead in range(load_p.shape[1]):
            _add_load_errors(load, noise[row, ahead], error)
            then = row + 1 + ahead
            _err_loads(error, active[then], reactive[then], load_p[row, ahead], load_q[row, ahead])


@jit
def _forecast_production(spread: F64, pmax: F64, noise: F64, production: I16, prod_p: F32) -> None:
    error = np.empty(prod_p.shape[2])
    for row in range(prod_p.shape[0]):
        error[:] = 1.0
        for ahead in range(prod_p.shape[1]):
            _add_production_errors(spread, noise[row, ahead], error)
            _err_production(spread, pmax, error, production[row + 1 + ahead], prod_p[row, ahead])


@jit
def _add_load_errors(load: float, noise: F64, error: F64) -> None:
    for k in range(error.size):
        error[k] += load * to_gaussian(noise[k])


@jit
def _err_loads(error: F64, active: I16, reactive: I16, load_p: F32, load_q: F32) -> None:
    for load in range(error.size):
        load_p[load] = rounded(active[load] * error[load]) / 10.0
        load_q[load] = rounded(reactive[load] * error[load]) / 10.0


@jit
def _add_production_errors(spread: F64, noise: F64, error: F64) -> None:
    position = 0
    for gen in range(error.size):
        if spread[gen] > 0.0:
            error[gen] += spread[gen] * to_gaussian(noise[position])
            position += 1


@jit
def _err_production(spread: F64, pmax: F64, error: F64, production: I16, prod_p: F32) -> None:
    for gen in range(error.size):
        if spread[gen] > 0.0:
            prod_p[gen] = min(max(rounded(production[gen] * error[gen]), 0), pmax[gen]) / 10.0
        else:
            prod_p[gen] = production[gen] / 10.0
