"""Rows of the time series and planned outages, read by compiled code where they lie.

Environments share the memory-mapped arrays of a series; each holds the address of its first row only. A series is
float32 numbers, forecasts included, or, in the months of the library that training plays, the integers of the generator
(:mod:`rl2grid.scenarios.training_years`), whose forecasts are made when somebody asks for them and whose voltages are
one row for all.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32, I16
from rl2grid.compile import jit, owning_jit
from rl2grid.engines.native.environments import Environments
from rl2grid.engines.native.hidden_state import LOAD_P, LOAD_Q, PROD_P, PROD_V, HiddenState
from rl2grid.memory import float32_at, int16_at
from rl2grid.scenarios.generator.calendar import month_and_row
from rl2grid.scenarios.generator.forecast import forecast_row


@jit
def read_row(environments: Environments, i: int, step: int) -> None:
    """Read what the series says of step ``step`` of row ``i``: demand, production, voltages."""
    _read_series(environments, i, environments.hidden, i, step)


@jit
def read_forecast(environments: Environments, i: int, source: HiddenState, row: int, step: int, horizon: int) -> None:
    """Read into row ``i`` what row ``row`` of ``source`` forecasts at ``step`` for ``horizon`` steps later.

    Without forecast set-points the measured voltages are kept, as Grid2Op does. An imagined future is its own forecast.
    """
    if source.forecast[row, LOAD_P] == 0:
        _read_series(environments, i, source, row, step + horizon)
        return
    if source.year[row] > 0:
        _make_forecast(environments, i, source, row, step, horizon)
        _forecast_voltages(source.series[row, PROD_V], 0, environments, i, source, row)
        return
    hidden = environments.hidden
    place = np.int64(step) * source.horizons[row] + horizon - 1
    _copy(source.forecast[row, LOAD_P], place, hidden.load_p[i])
    _copy(source.forecast[row, LOAD_Q], place, hidden.load_q[i])
    _copy(source.forecast[row, PROD_P], place, hidden.new_p[i])
    _forecast_voltages(source.forecast[row, PROD_V], place, environments, i, source, row)


@jit
def _forecast_voltages(
    address: int, place: int, environments: Environments, i: int, source: HiddenState, row: int
) -> None:
    network, hidden = environments.network, environments.hidden
    if address != 0:
        _read_voltages(address, place, environments, i)
        return
    for gen in range(hidden.gen_v.shape[1]):
        measured = np.float32(source.gen_v[row, gen] * network.nominal_voltage[network.gen_sub[gen]])
        hidden.gen_v[i, gen] = measured / network.gen_kilovolt[gen]


@jit
def _read_series(environments: Environments, i: int, source: HiddenState, row: int, step: int) -> None:
    """Read into row ``i`` what the series of row ``row`` of ``source`` says of step ``step``."""
    hidden = environments.hidden
    if source.year[row] > 0:
        _copy_tenths(source.series[row, LOAD_P], step, hidden.load_p[i])
        _copy_tenths(source.series[row, LOAD_Q], step, hidden.load_q[i])
        _copy_tenths(source.series[row, PROD_P], step, hidden.new_p[i])
        _read_voltages(source.series[row, PROD_V], 0, environments, i)
        return
    place = min(step, source.last_row[row])
    _copy(source.series[row, LOAD_P], place, hidden.load_p[i])
    _copy(source.series[row, LOAD_Q], place, hidden.load_q[i])
    _copy(source.series[row, PROD_P], place, hidden.new_p[i])
    _read_voltages(source.series[row, PROD_V], place, environments, i)


@jit
def _read_voltages(address: int, row: int, environments: Environments, i: int) -> None:
    network, hidden = environments.network, environments.hidden
    n_gen = hidden.gen_v.shape[1]
    for gen in range(n_gen):
        if address == 0:
            hidden.gen_v[i, gen] = network.gen_setpoint[gen]
        else:
            # Grid2Op divides in single precision.
            hidden.gen_v[i, gen] = _value(address, row * n_gen + gen) / network.gen_kilovolt[gen]


@jit
def _copy(address: int, row: int, out: F32) -> None:
    for k in range(out.shape[0]):
        out[k] = _value(address, row * out.shape[0] + k)


@jit
def _copy_tenths(address: int, row: int, out: F32) -> None:
    for k in range(out.shape[0]):
        out[k] = _integer(address, row * out.shape[0] + k) / 10.0


@owning_jit
def _make_forecast(environments: Environments, i: int, source: HiddenState, row: int, step: int, horizon: int) -> None:
    """What training months forecast; voltages excepted."""
    hidden = environments.hidden
    active = _integers(source.series[row, LOAD_P], step + horizon, hidden.load_p.shape[1])
    reactive = _integers(source.series[row, LOAD_Q], step + horizon, hidden.load_q.shape[1])
    production = _integers(source.series[row, PROD_P], step + horizon, hidden.new_p.shape[1])
    later, place = month_and_row(source.month_row[row] + step, source.n_months[row])
    forecast_row(
        source.forecast[row, LOAD_P],
        source.year[row],
        source.month[row] + later,
        place,
        horizon,
        active,
        reactive,
        production,
        hidden.load_p[i],
        hidden.load_q[i],
        hidden.new_p[i],
    )


@owning_jit
def _integers(address: int, row: int, size: int) -> I16:
    values = np.empty(size, np.int16)
    for k in range(size):
        values[k] = _integer(address, row * size + k)
    return values


@jit
def _integer(address: int, index: int) -> np.int16:
    value: np.int16 = int16_at(np.int64(address), np.int64(index))
    return value


@jit
def _value(address: int, index: int) -> np.float32:
    value: np.float32 = float32_at(np.int64(address), np.int64(index))
    return value


@jit
def begin_outages(hidden: HiddenState, i: int) -> None:
    """Point every line of the blank row ``i`` at its first planned outage."""
    for k in range(hidden.outage_count[i] - 1, -1, -1):
        hidden.next_outage[i, hidden.outage_line[i, k]] = k


@jit
def plan_outages(environments: Environments, i: int, step: int) -> None:
    """Write when the next outage of each line begins at ``step`` and how long it lasts.

    The rows of :func:`rl2grid.scenarios.maintenance.maintenance_times`, one after the other.
    """
    state, hidden = environments.state, environments.hidden
    state.time_next_maintenance[i] = -1
    state.duration_next_maintenance[i] = 0
    for k in range(hidden.outage_count[i] - 1, -1, -1):
        line = hidden.outage_line[i, k]
        if hidden.next_outage[i, line] != k:
            continue
        if hidden.outage_end[i, k] <= step:
            is_followed = k + 1 < hidden.outage_count[i] and hidden.outage_line[i, k + 1] == line
            hidden.next_outage[i, line] = k + 1 if is_followed else -1
        following = hidden.next_outage[i, line]
        if following < 0:
            continue
        begin = hidden.outage_begin[i, following]
        state.time_next_maintenance[i, line] = max(begin - step, 0)
        state.duration_next_maintenance[i, line] = hidden.outage_end[i, following] - max(begin, step)
