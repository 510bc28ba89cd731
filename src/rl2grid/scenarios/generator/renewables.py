"""Wind and sun.

After ChroniX2Grid: wind is a squashed sum of fields that last a week, hours and minutes, stronger in winter; sun is
its elevation (latitude 46 degrees) times a cloudiness that lasts a day and hours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F64, I32, I64
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.scenarios.generator.arithmetic import exponential, rounded, sine
from rl2grid.scenarios.generator.calendar import ROWS_PER_DAY
from rl2grid.scenarios.generator.constants import RenewableConstants
from rl2grid.scenarios.generator.draws import Channel, Draws, Portion
from rl2grid.scenarios.generator.fields import Field, neighbourly, new_field, value

_WEEK_ROWS, _HOURS_ROWS, _GUST_ROWS = 7 * ROWS_PER_DAY, 72, 6
_CLOUD_DAY_ROWS, _CLOUD_HOURS_ROWS = ROWS_PER_DAY, 24
_MOST = 0.95
"""Share of pmax that wind and sun reach at most."""
_SINE_LATITUDE, _COSINE_LATITUDE = 0.7193398, 0.6946584
_SINE_TILT = 0.3978
"""Sine of the largest declination of the sun."""


class Weather(NamedTuple):
    """One possible wind and sun, row by row."""

    portion: Portion
    n_gen: int
    wind: float  # factor on the capacity factor of the wind model
    solar: float  # share of pmax under a clear sky at the zenith
    variety: float  # factor on what the wind differs by from its mean
    gustiness: float  # standard deviation of gusts
    winds: I64  # [wind] generators
    suns: I64  # [sun]
    wind_pmax: F64
    sun_pmax: F64
    week: Field
    hours: Field
    gusts: Field
    cloud_day: Field
    cloud_hours: Field


def new_weather(grid: Grid, known: RenewableConstants, portion: Portion) -> Weather:
    """The weather of a portion of a year.

    How much wind and sun the grid has (``mixes``) does not depend on the attempt.
    """
    kinds = np.array(grid.gen_type)
    winds, suns = np.flatnonzero(kinds == "wind"), np.flatnonzero(kinds == "solar")
    near_winds, near_suns = (neighbourly(grid, grid.gen_to_subid[gens]) for gens in (winds, suns))
    mix = float(known.mixes[int(Draws(portion.seed, 0, Channel.MIX).uniform(1)[0] * len(known.mixes))])
    return Weather(
        portion,
        grid.n_gen,
        mix * float(known.wind[0]),
        mix * float(known.solar[0]),
        float(known.variety[0]),
        float(known.gusts[0]),
        winds,
        suns,
        grid.gen_pmax[winds].astype(np.float64),
        grid.gen_pmax[suns].astype(np.float64),
        new_field(portion, Channel.WIND_WEEK, _WEEK_ROWS, near_winds),
        new_field(portion, Channel.WIND_HOURS, _HOURS_ROWS, near_winds),
        new_field(portion, Channel.WIND_GUSTS, _GUST_ROWS, near_winds),
        new_field(portion, Channel.SOLAR_DAY, _CLOUD_DAY_ROWS, near_suns),
        new_field(portion, Channel.SOLAR_HOURS, _CLOUD_HOURS_ROWS, near_suns),
    )


def renewable_production(weather: Weather) -> I32:
    """Production of wind and sun of a portion, 0.1 MW, int32 [row, gen]; others are 0."""
    first = weather.portion.first
    production = np.zeros((weather.portion.stop - first, weather.n_gen), np.int32)
    _fill_wind(weather, first, production)
    _fill_sun(weather, first, production)
    return production


@jit
def _fill_wind(weather: Weather, first: int, production: I32) -> None:
    for k in range(production.shape[0]):
        row = first + k
        season = 0.7 + 0.3 * sine(row / (365.0 * ROWS_PER_DAY) - 30.0 / 365.0 + 0.25)
        for wind in range(weather.winds.size):
            change = 0.08 * value(weather.hours, row, wind) + 0.09 * value(weather.week, row, wind)
            speed = season * (0.3 + weather.variety * change) + weather.gustiness * value(weather.gusts, row, wind)
            share = weather.wind * (1.0 - exponential(-0.1 * exponential(4.0 * speed)))
            production[k, weather.winds[wind]] = rounded(10.0 * weather.wind_pmax[wind] * min(share, _MOST))


@jit
def _fill_sun(weather: Weather, first: int, production: I32) -> None:
    for k in range(production.shape[0]):
        row = first + k
        sine_tilt = -_SINE_TILT * sine(row / (365.0 * ROWS_PER_DAY) + 10.0 / 365.0 + 0.25)
        cosine_tilt = np.sqrt(1.0 - sine_tilt * sine_tilt)
        noon = sine((row % ROWS_PER_DAY) / ROWS_PER_DAY - 0.5 + 0.25)
        elevation = _SINE_LATITUDE * sine_tilt + _COSINE_LATITUDE * cosine_tilt * noon
        if elevation <= 0.0:
            continue
        clear = weather.solar * np.sqrt(elevation) * np.sqrt(np.sqrt(elevation))
        for sun in range(weather.suns.size):
            sky = 0.75 + 0.12 * value(weather.cloud_day, row, sun) + 0.06 * value(weather.cloud_hours, row, sun)
            share = min(clear * min(max(sky, 0.08), 1.05), _MOST)
            production[k, weather.suns[sun]] = rounded(10.0 * weather.sun_pmax[sun] * share)
