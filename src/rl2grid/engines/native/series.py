"""Rows of the time series and planned outages, read by compiled code where they lie.

Environments share the memory-mapped arrays of a scenario; each holds the address of its first row only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.core.extending import intrinsic
from numpy.typing import NDArray

from rl2grid.compile import jit
from rl2grid.engines.native.memory import LOAD_P, LOAD_Q, PROD_P, PROD_V, Memory
from rl2grid.mdp.state import F32, GridState
from rl2grid.powerflow.model import Network


@intrinsic  # type: ignore[untyped-decorator]
def _float32_at(typing_context: Any, address: Any, index: Any) -> Any:
    """The float32 number ``index`` places after ``address``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = builder.inttoptr(arguments[0], ir.FloatType().as_pointer())
        return builder.load(builder.gep(pointer, [arguments[1]]))

    return types.float32(types.int64, types.int64), generate


@jit
def read_row(memory: Memory, network: Network, i: int, step: int) -> None:
    """Read what the series says of step ``step`` of row ``i``: demand, production, voltages."""
    _copy(memory.series[i, LOAD_P], step, memory.load_p[i])
    _copy(memory.series[i, LOAD_Q], step, memory.load_q[i])
    _copy(memory.series[i, PROD_P], step, memory.new_p[i])
    _read_voltages(memory.series[i, PROD_V], step, memory, network, i)


@jit
def read_forecast(memory: Memory, network: Network, i: int, source: Memory, row: int, step: int, horizon: int) -> None:
    """Read into row ``i`` what row ``row`` of ``source`` forecasts at ``step`` for ``horizon`` steps later.

    Without forecast set-points the measured voltages are kept, as Grid2Op does.
    """
    place = np.int64(step) * source.horizons[row] + horizon - 1
    _copy(source.forecast[row, LOAD_P], place, memory.load_p[i])
    _copy(source.forecast[row, LOAD_Q], place, memory.load_q[i])
    _copy(source.forecast[row, PROD_P], place, memory.new_p[i])
    if source.forecast[row, PROD_V] != 0:
        _read_voltages(source.forecast[row, PROD_V], place, memory, network, i)
        return
    for gen in range(memory.gen_v.shape[1]):
        measured = np.float32(source.gen_v[row, gen] * network.nominal_voltage[network.gen_sub[gen]])
        memory.gen_v[i, gen] = measured / network.gen_kilovolt[gen]


@jit
def _read_voltages(address: int, row: int, memory: Memory, network: Network, i: int) -> None:
    n_gen = memory.gen_v.shape[1]
    for gen in range(n_gen):
        if address == 0:
            memory.gen_v[i, gen] = network.gen_setpoint[gen]
        else:
            # Grid2Op divides in single precision.
            memory.gen_v[i, gen] = _value(address, row * n_gen + gen) / network.gen_kilovolt[gen]


@jit
def _copy(address: int, row: int, out: F32) -> None:
    for k in range(out.shape[0]):
        out[k] = _value(address, row * out.shape[0] + k)


@jit
def _value(address: int, index: int) -> np.float32:
    value: np.float32 = _float32_at(np.int64(address), np.int64(index))  # type: ignore[call-arg]
    return value


@jit
def begin_outages(memory: Memory, i: int) -> None:
    """Point every line of row ``i`` at its first planned outage."""
    memory.next_outage[i] = -1
    for k in range(memory.outage_count[i] - 1, -1, -1):
        memory.next_outage[i, memory.outage_line[i, k]] = k


@jit
def plan_outages(memory: Memory, state: GridState, i: int, step: int) -> None:
    """Write when the next outage of each line begins at ``step`` and how long it lasts.

    The rows of :func:`rl2grid.scenarios.maintenance.maintenance_times`, one after the other.
    """
    for line in range(memory.next_outage.shape[1]):
        k = memory.next_outage[i, line]
        if k >= 0 and memory.outage_end[i, k] <= step:
            following = k + 1 < memory.outage_count[i] and memory.outage_line[i, k + 1] == line
            k = k + 1 if following else -1
            memory.next_outage[i, line] = k
        if k < 0:
            state.time_next_maintenance[i, line] = -1
            state.duration_next_maintenance[i, line] = 0
            continue
        begin = memory.outage_begin[i, k]
        state.time_next_maintenance[i, line] = max(begin - step, 0)
        state.duration_next_maintenance[i, line] = memory.outage_end[i, k] - max(begin, step)


def outages_of(matrix: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Outages of a matrix [row, line], int32 [outage, 3]: line, first row, row after the last; by line and row."""
    lines = np.flatnonzero(matrix.any(axis=0))
    padded = np.zeros((len(lines), len(matrix) + 2), np.int8)
    padded[:, 1:-1] = matrix[:, lines].T
    change = np.diff(padded, axis=1)
    which, begin = np.nonzero(change == 1)
    _, end = np.nonzero(change == -1)
    return np.stack([lines[which], begin, end], axis=1).astype(np.int32)
