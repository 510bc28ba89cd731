"""One grid step of several environments, whose power flows are solved side by side where that can be.

What a row plays does not depend on the others: :mod:`rl2grid.powerflow.warm_lanes`.
"""

from __future__ import annotations

from rl2grid.arrays import I64
from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.engines.native.protections import begin_cascade, find_flow, follow_cascade, prepare
from rl2grid.engines.native.step import begin_step, dispatch_or_lose, end_step, set_scene
from rl2grid.powerflow.ac import CONVERGED, PREPARED
from rl2grid.powerflow.lane_flow import DONE
from rl2grid.powerflow.lanes import WIDTH
from rl2grid.powerflow.newton import may_go_on
from rl2grid.powerflow.topology import is_same_topology
from rl2grid.powerflow.warm_lanes import solve_side_by_side

_FEWEST = 4
"""Flows for which lanes are faster than one after the other: eight take three to four times as long as one."""
_LOST = -1
"""Status of a row whose step has ended before the power flow."""


@jit
def step_side_by_side(environments: Environments, rows: I64, n: int, status: I64) -> None:
    """Play a grid step in the first ``n`` of ``rows``, whose orders are written; ``status`` [row] is workspace."""
    for k in range(n):
        status[k] = _begin(environments, rows[k])
    for k in range(n):
        if status[k] == PREPARED:
            _find_flows(environments, rows, n, status, k)
    for k in range(n):
        if status[k] != _LOST:
            end_step(environments, rows[k], status[k] == CONVERGED and follow_cascade(environments, rows[k], True))


@jit
def _begin(environments: Environments, i: int) -> int:
    """Play the step of row ``i`` up to the power flow; the status of that, or ``_LOST``."""
    if begin_step(environments, i, True) and not dispatch_or_lose(environments, i):
        return _LOST
    set_scene(environments, i)
    begin_cascade(environments, i)
    return prepare(environments, i)


@jit
def _find_flows(environments: Environments, rows: I64, n: int, status: I64, first: int) -> None:
    """Solve the flow of row ``first``, together with those of later rows that may go on beside it."""
    flow, lanes = environments.flow, environments.lanes
    n_lanes = _gather(environments, rows, n, status, first)
    if n_lanes < _FEWEST:
        status[first] = find_flow(environments, rows[first])
        return
    solve_side_by_side(environments.network, flow, lanes, n_lanes, environments.hidden.gen_v, environments.state.a_or)
    for lane in range(n_lanes):
        is_done = lanes.state[lane] == DONE
        status[lanes.place[lane]] = CONVERGED if is_done else find_flow(environments, lanes.row[lane])


@jit
def _gather(environments: Environments, rows: I64, n: int, status: I64, first: int) -> int:
    """Give lanes to the rows whose flows are to be solved beside that of row ``first``; how many there are."""
    flow, lanes = environments.flow, environments.lanes
    if not may_go_on(flow, rows[first]):
        return 0
    topology, n_lanes = flow.topo_vect[rows[first]], 0
    for k in range(first, n):
        i = rows[k]
        if status[k] == PREPARED and may_go_on(flow, i) and is_same_topology(topology, flow.topo_vect[i]):
            lanes.row[n_lanes] = i
            lanes.place[n_lanes] = k
            n_lanes += 1
            if n_lanes == WIDTH:
                break
    return n_lanes
