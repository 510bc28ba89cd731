"""One grid step of several environments, or a reset, whose power flows are solved side by side where that can be.

What a row plays does not depend on the others: :mod:`rl2grid.powerflow.warm_lanes`,
:mod:`rl2grid.powerflow.cold_lanes`.
"""

from __future__ import annotations

from rl2grid.arrays import I64
from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments, separate
from rl2grid.engines.native.protections import SETTLED, begin_cascade, find_flow, prepare, trip_lines
from rl2grid.engines.native.step import (
    begin_reset,
    begin_step,
    dispatch_or_lose,
    end_step,
    finish_reset,
    set_scene,
)
from rl2grid.powerflow.ac import CONVERGED, DIVERGED, PREPARED
from rl2grid.powerflow.cold_lanes import is_like, solve_cold_side_by_side
from rl2grid.powerflow.flow_lanes import LOST
from rl2grid.powerflow.lane_flow import DONE
from rl2grid.powerflow.lanes import WIDTH
from rl2grid.powerflow.newton import may_go_on
from rl2grid.powerflow.topology import is_same_topology
from rl2grid.powerflow.warm_lanes import solve_warm_side_by_side

_FEWEST_WARM = 4
"""Flows that go on for which lanes are faster than one by one: eight take three to four times as long as one."""
_FEWEST_COLD = 4
"""The same of flows that begin anew."""
_LOST = -1
"""Status of a row whose step has ended before the power flow."""


@jit
def step_side_by_side(environments: Environments, rows: I64, n: int, status: I64) -> None:
    """Play a grid step in the first ``n`` of ``rows``, whose orders are written; ``status`` [row] is workspace."""
    for k in range(n):
        status[k] = _begin(environments, rows[k])
    _settle(environments, rows, n, status, True)
    for k in range(n):
        if status[k] != _LOST:
            end_step(environments, rows[k], status[k] == SETTLED)


@jit
def reset_side_by_side(environments: Environments, rows: I64, n: int, status: I64) -> None:
    """Show the first rows of the series of the first ``n`` of ``rows``; ``status`` [row] is workspace.

    Each as :func:`rl2grid.engines.native.step.reset_row` shows it.
    """
    for k in range(n):
        status[k] = _begin_reset(environments, rows[k])
    _settle(environments, rows, n, status, False)
    for k in range(n):
        finish_reset(environments, rows[k], status[k] == SETTLED)


@jit
def _settle(environments: Environments, rows: I64, n: int, status: I64, soft: bool) -> None:
    """Find flows, and let protections open lines, until no row is PREPARED; ``soft`` as of ``trip_lines``."""
    while _find_all_flows(environments, rows, n, status):
        for k in range(n):
            if status[k] == CONVERGED:
                status[k] = trip_lines(environments, rows[k], soft)


@separate
def _begin_reset(environments: Environments, i: int) -> int:
    """Reset row ``i`` up to the power flow; the status of that."""
    begin_reset(environments, i)
    begin_cascade(environments, i)
    return int(prepare(environments, i))


@separate
def _begin(environments: Environments, i: int) -> int:
    """Play the step of row ``i`` up to the power flow; the status of that, or ``_LOST``."""
    if begin_step(environments, i, True) and not dispatch_or_lose(environments, i):
        return _LOST
    set_scene(environments, i)
    begin_cascade(environments, i)
    return int(prepare(environments, i))


@jit
def _find_all_flows(environments: Environments, rows: I64, n: int, status: I64) -> bool:
    """Find the flows of all rows that are PREPARED; whether there was one."""
    found = False
    for k in range(n):
        if status[k] == PREPARED:
            _find_flows(environments, rows, n, status, k)
            found = True
    return found


@jit
def _find_flows(environments: Environments, rows: I64, n: int, status: I64, first: int) -> None:
    """Solve the flow of row ``first``, together with those of later rows that can be solved beside it."""
    if may_go_on(environments.flow, rows[first]):
        n_lanes = _gather_warm(environments, rows, n, status, first)
        if n_lanes >= _FEWEST_WARM:
            _solve_warm(environments, n_lanes)
            _take_over(environments, n_lanes, status)
            return
    elif environments.flow.known[rows[first]]:
        n_lanes = _gather_cold(environments, rows, n, status, first)
        if n_lanes >= _FEWEST_COLD:
            _solve_cold(environments, n_lanes)
            _take_over(environments, n_lanes, status)
            return
    status[first] = find_flow(environments, rows[first])


@separate
def _solve_warm(environments: Environments, n_lanes: int) -> int:
    """Solve the flows of so many lanes, which go on."""
    state, hidden, lanes = environments.state, environments.hidden, environments.lanes
    solve_warm_side_by_side(environments.network, environments.flow, lanes, n_lanes, hidden.gen_v, state.a_or)
    return n_lanes


@separate
def _solve_cold(environments: Environments, n_lanes: int) -> int:
    """Solve the flows of so many lanes, which begin anew."""
    network, flow, lanes = environments.network, environments.flow, environments.lanes
    gen_v, a_or = environments.hidden.gen_v, environments.state.a_or
    solve_cold_side_by_side(network, flow, lanes, environments.union, n_lanes, gen_v, a_or)
    return n_lanes


@jit
def _gather_warm(environments: Environments, rows: I64, n: int, status: I64, first: int) -> int:
    """Give lanes to the rows that go on as row ``first`` does, with the same pattern; how many there are."""
    flow, n_lanes = environments.flow, 0
    pattern = flow.pattern[rows[first]]
    for k in range(first, n):
        i = rows[k]
        if status[k] == PREPARED and may_go_on(flow, i) and is_same_topology(pattern, flow.pattern[i]):
            n_lanes = _give_lane(environments, i, k, n_lanes)
            if n_lanes == WIDTH:
                break
    return n_lanes


@jit
def _gather_cold(environments: Environments, rows: I64, n: int, status: I64, first: int) -> int:
    """Give lanes to the rows that begin anew as row ``first`` does and are like it; how many there are."""
    network, flow, n_lanes = environments.network, environments.flow, 0
    slack = network.gen_position[network.slack_gen[0]]
    pattern = flow.pattern[rows[first]]
    for k in range(first, n):
        i = rows[k]
        if status[k] != PREPARED or not flow.known[i] or may_go_on(flow, i):
            continue
        other = flow.pattern[i]
        if other[slack] == pattern[slack] and is_like(other, pattern):
            n_lanes = _give_lane(environments, i, k, n_lanes)
            if n_lanes == WIDTH:
                break
    return n_lanes


@jit
def _give_lane(environments: Environments, i: int, k: int, n_lanes: int) -> int:
    """Give the next lane to row ``i``, the caller's ``k``-th; how many lanes there are now."""
    environments.lanes.row[n_lanes] = i
    environments.lanes.place[n_lanes] = k
    return n_lanes + 1


@jit
def _take_over(environments: Environments, n_lanes: int, status: I64) -> None:
    """What the lanes have come to; those that were not accepted are solved alone."""
    lanes = environments.lanes
    for lane in range(n_lanes):
        state, place = lanes.state[lane], lanes.place[lane]
        if state == DONE:
            status[place] = CONVERGED
        elif state == LOST:
            status[place] = DIVERGED
        else:
            status[place] = find_flow(environments, lanes.row[lane])
