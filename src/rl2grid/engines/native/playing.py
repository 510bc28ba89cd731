"""The series that an environment plays, and where compiled code finds its rows."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.native.hidden_state import HiddenState
from rl2grid.engines.worlds import Outlook, SeriesName, other_values
from rl2grid.grids import Grid
from rl2grid.scenarios.library import open_series
from rl2grid.scenarios.scenario import Scenario
from rl2grid.scenarios.training_years import TrainingMonths, forecasts_of

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

_NAMES = ("load_p", "load_q", "prod_p", "prod_v")
"""In the order of the columns of :attr:`HiddenState.series`."""
_ENDLESS = 2**31 - 1


class Playing:
    """A series from a row on; it keeps the arrays alive, of which compiled code knows the addresses only."""

    def __init__(
        self, name: SeriesName | Outlook, source: Scenario | TrainingMonths | Outlook, series: I64, forecast: I64
    ) -> None:
        self.name = name
        """What a world says of the series."""
        self.source = source
        """What holds the arrays."""
        self.series = series
        """int64 [4], as :attr:`HiddenState.series`."""
        self.forecast = forecast
        """int64 [4], as :attr:`HiddenState.forecast`."""
        self.reference = weakref.ref(self)

    def begin(self, hidden: HiddenState, i: int) -> None:
        """Let environment ``i`` play it from its first row, with the forecasts that were made."""
        assert not isinstance(self.source, Outlook)
        hidden.horizons[i] = horizons_of(self.source)
        hidden.last_row[i] = _ENDLESS
        hidden.year[i] = 0
        if isinstance(self.source, TrainingMonths):
            assert isinstance(self.name, SeriesName)
            hidden.year[i], hidden.month[i], hidden.n_months[i] = self.source.months
            hidden.month_row[i] = self.name.start
        self.go_on(hidden, i)

    def go_on(self, hidden: HiddenState, i: int) -> None:
        """Point environment ``i`` at the series."""
        hidden.series[i] = self.series
        hidden.forecast[i] = self.forecast


def playing_series(series: Scenario | TrainingMonths, start: int) -> Playing:
    """A series from row ``start`` on."""
    return playing_months(series, start) if isinstance(series, TrainingMonths) else playing_scenario(series, start)


def playing_months(months: TrainingMonths, start: int) -> Playing:
    """Months of the library from row ``start`` on."""
    forecasts, year = forecasts_of(months.grid), months.year
    row = months.first_row_of_year + start
    series = [_address_of(array, row) for array in (year.load_p, year.load_q, year.prod_p)]
    series.append(0 if forecasts.voltage is None else int(forecasts.voltage.ctypes.data))
    forecast = np.array([forecasts.model.address, 0, 0, 0], np.int64)
    return Playing(SeriesName(months.id, months.content_hash, start), months, np.array(series, np.int64), forecast)


def playing_scenario(scenario: Scenario, start: int) -> Playing:
    """A scenario from row ``start`` on."""
    series = [_address(getattr(scenario, name), start) for name in _NAMES]
    forecast = [_address(getattr(scenario, f"{name}_forecast"), start) for name in _NAMES]
    name = SeriesName(scenario.id, scenario.content_hash, start)
    return Playing(name, scenario, np.array(series, np.int64), np.array(forecast, np.int64))


def playing_outlook(outlook: Outlook) -> Playing:
    """An imagined future, which is its own forecast."""
    series = [_address(getattr(outlook, name), -outlook.first_step) for name in _NAMES]
    return Playing(outlook, outlook, np.array(series, np.int64), np.zeros(len(_NAMES), np.int64))


def playing_named(grid: Grid, name: SeriesName | Outlook) -> Playing:
    """The series of a world that comes from elsewhere.

    Raises:
        UsageError: there is no such scenario, or its values are not those of then.
    """
    if isinstance(name, Outlook):
        return playing_outlook(name)
    series = open_series(grid.id, name.scenario_id)
    if series.content_hash != name.content_hash:
        raise other_values(grid.id, name)
    return playing_series(series, name.start)


def horizons_of(scenario: Scenario | TrainingMonths) -> int:
    """Steps that each row forecasts."""
    if isinstance(scenario, TrainingMonths):
        return int(forecasts_of(scenario.grid).model.structure.horizon[0])
    return 0 if scenario.load_p_forecast is None else int(scenario.load_p_forecast.shape[1])


def _address(array: F32 | None, row: int) -> int:
    """Address of a row of a series, 0 if there is none."""
    if array is None:
        return 0
    assert array.dtype == np.float32
    return _address_of(array, row)


def _address_of(array: NDArray[Any], row: int) -> int:
    assert array.flags.c_contiguous
    return int(array.ctypes.data) + row * array.strides[0]
