"""What Python calls of the compiled engine, one environment at a time; ``address`` is that of a handle."""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import I64
from rl2grid.compile import jit
from rl2grid.engines.native.environments import open_environments
from rl2grid.engines.native.generation import set_generators
from rl2grid.engines.native.side_by_side import reset_side_by_side
from rl2grid.engines.native.simulation import begin_simulation, copy_environment, finish_simulation
from rl2grid.engines.native.step import begin_step, dispatch_or_lose, finish_step, lose_by_dispatch, reset_row


@jit
def reset_one(address: int, i: int) -> None:
    """Show the first row of environment ``i``, whose series and outages are set."""
    reset_row(open_environments(address), i)


@jit
def reset_rows(address: int, rows: I64) -> None:
    """:func:`reset_one` for each of ``rows``, int64 [k], together."""
    reset_side_by_side(open_environments(address), rows, rows.shape[0], np.empty(rows.shape[0], np.int64))


@jit
def begin_one(address: int, i: int, refuse_impossible: bool) -> bool:
    """The step of environment ``i`` up to the redispatch; whether generators have to be dispatched."""
    return begin_step(open_environments(address), i, refuse_impossible)


@jit
def finish_one(address: int, i: int) -> None:
    """The step of environment ``i`` from after the redispatch."""
    finish_step(open_environments(address), i)


@jit
def lose_one(address: int, i: int) -> None:
    """No dispatch was found for environment ``i``."""
    lose_by_dispatch(open_environments(address).state, i)


@jit
def step_one(address: int, i: int) -> None:
    """A whole step of environment ``i`` with exact dispatch."""
    environments = open_environments(address)
    if begin_step(environments, i, True) and not dispatch_or_lose(environments, i):
        return
    finish_step(environments, i)


@jit
def begin_simulation_one(address: int, real: int, row: int, horizon: int, refuse_impossible: bool) -> bool:
    """The simulated step up to the redispatch; ``real`` is the address of the engine's own environments."""
    return begin_simulation(open_environments(address), open_environments(real), row, horizon, refuse_impossible)


@jit
def dispatch_one(address: int, i: int) -> bool:
    """Find the exact dispatch of environment ``i``, or end its episode."""
    return dispatch_or_lose(open_environments(address), i)


@jit
def set_generators_one(address: int, i: int) -> None:
    """Set the generators of environment ``i`` to the series' production plus the dispatch."""
    set_generators(open_environments(address), i)


@jit
def finish_simulation_one(address: int) -> None:
    """The simulated step from after the redispatch."""
    finish_simulation(open_environments(address))


@jit
def copy_one(source: int, i: int, target: int, j: int) -> None:
    """Bring environment ``j`` of another engine of the grid to where ``i`` is, for a step without opponent."""
    copy_environment(open_environments(source), i, open_environments(target), j)
