"""What the AC power flow says of generated injections, in the reference topology and without any protection."""

from __future__ import annotations

import copy
import functools
import threading
from typing import NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32, I64
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.handles import Handle, opener
from rl2grid.powerflow.ac import CONVERGED, FlowState, new_flow_state, run_flow, write_currents, write_flow
from rl2grid.powerflow.model import Network, load_network
from rl2grid.scenarios.generator.arithmetic import rounded
from rl2grid.structures import copy_row


class _Rows(threading.local):
    """Rows of power flows, one for each grid; every thread has its own."""

    def __init__(self) -> None:
        self.of_grid: dict[Grid, Handle[FlowState]] = {}


_ROWS = _Rows()
_open_network, _open_flow = opener(Network), opener(FlowState)
"""Handles and float64, as the engine has them: the power flow is compiled once for all."""


class Verdict(NamedTuple):
    """Result of the power flow of several rows."""

    converged: bool
    """Whether all of them were solved."""
    losses: I64
    """[row] 0.1 MW."""
    slack: F32
    """[row] production of the slack generator, MW."""
    loading: F32
    """[row] largest current over thermal limit."""


def assess(grid: Grid, voltage: F32 | None, active: I32, reactive: I32, production: I32) -> Verdict:
    """Solve the AC power flow of every row; injections in 0.1 MW and 0.1 MVAr, int32 [row, load] and [row, gen].

    Args:
        grid: one of the seven grids.
        voltage: set-points, kV, float32 [gen]; None: those of the grid file.
        active: demand.
        reactive: reactive demand.
        production: scheduled production.
    """
    network = load_network(grid)
    setpoint = network.gen_setpoint.astype(np.float32) if voltage is None else voltage / network.gen_kilovolt
    losses, rows = np.zeros(len(active), np.int64), len(active)
    slack, loading = np.zeros(rows, np.float32), np.zeros(rows, np.float32)
    converged = _assess(
        _network_of(grid).address,
        _blank_flow(grid).address,
        np.ones(grid.dim_topo, np.int32),
        setpoint.astype(np.float32).astype(np.float64),
        np.zeros(grid.n_storage, np.float32),
        grid.thermal_limit,
        active,
        reactive,
        production,
        losses,
        slack,
        loading,
    )
    return Verdict(bool(converged), losses, slack, loading)


@functools.cache
def _network_of(grid: Grid) -> Handle[Network]:
    return Handle(load_network(grid))


def _blank_flow(grid: Grid) -> Handle[FlowState]:
    """A row of this thread that remembers no flow: the next one is solved cold."""
    rows = _ROWS.of_grid
    if grid not in rows:
        rows[grid] = Handle(copy.deepcopy(_cold_flow(grid)))
    copy_row(_cold_flow(grid), 0, rows[grid].structure, 0)
    return rows[grid]


@functools.cache
def _cold_flow(grid: Grid) -> FlowState:
    """A row that nobody writes to: finding its order of elimination takes longer than solving a day."""
    return new_flow_state(load_network(grid), 1)


@jit
def _assess(
    network_address: int,
    flow_address: int,
    topology: I32,
    setpoint: F64,
    storage: F32,
    limit: F32,
    active: I32,
    reactive: I32,
    production: I32,
    losses: I64,
    slack: F32,
    loading: F32,
) -> bool:
    network, flow = _open_network(network_address), _open_flow(flow_address)
    load_p, load_q = np.empty(active.shape[1], np.float32), np.empty(active.shape[1], np.float32)
    gen_p, solved = np.empty(production.shape[1], np.float32), np.empty(production.shape[1], np.float32)
    current, line_p = np.empty(limit.size, np.float32), np.empty(limit.size, np.float32)
    gen_angle, load_angle, storage_angle = np.empty_like(gen_p), np.empty_like(load_p), np.empty_like(storage)
    balancing = network.slack_gen[0]
    for row in range(active.shape[0]):
        balance = 0
        for load in range(load_p.size):
            load_p[load] = active[row, load] / 10.0
            load_q[load] = reactive[row, load] / 10.0
            balance -= active[row, load]
        for gen in range(gen_p.size):
            gen_p[gen] = production[row, gen] / 10.0
            if gen != balancing:
                balance += production[row, gen]
        if run_flow(network, flow, 0, topology, gen_p, setpoint, load_p, load_q, storage) != CONVERGED:
            return False
        write_currents(network, flow, 0, current)
        write_flow(network, flow, 0, line_p, solved, gen_angle, load_angle, storage_angle)
        slack[row] = solved[balancing]
        losses[row] = balance + rounded(10.0 * solved[balancing])
        for line in range(limit.size):
            loading[row] = max(loading[row], current[line] / limit[line])
    return True
