"""What Python calls of the compiled engine, one environment at a time."""

from __future__ import annotations

from rl2grid.compile import jit
from rl2grid.engines.native.generation import set_generators
from rl2grid.engines.native.simulation import begin_simulation, finish_simulation
from rl2grid.engines.native.step import begin_step, dispatch_or_lose, finish_step, lose_by_dispatch, reset_row
from rl2grid.engines.native.tables import (
    Addresses,
    open_flow,
    open_memory,
    open_network,
    open_opponent,
    open_plant,
    open_state,
)
from rl2grid.mdp.state import F32
from rl2grid.powerflow.ac import copy_flow

PLANT, NETWORK, STATE, MEMORY, FLOW, OPPONENT = range(6)
"""Entries of ``addresses``."""


@jit
def reset_one(addresses: Addresses, i: int) -> None:
    """Show the first row of environment ``i``, whose series and outages are set."""
    state = open_state(addresses[STATE])
    reset_row(
        open_plant(addresses[PLANT]),
        open_network(addresses[NETWORK]),
        state,
        open_memory(addresses[MEMORY]),
        open_flow(addresses[FLOW]),
        i,
    )


@jit
def begin_one(
    addresses: Addresses, i: int, kind: int, target: int, mask: int, values: F32, refuse_impossible: bool
) -> bool:
    """The step of environment ``i`` up to the redispatch; whether generators have to be dispatched."""
    return begin_step(
        open_plant(addresses[PLANT]),
        open_network(addresses[NETWORK]),
        open_state(addresses[STATE]),
        open_memory(addresses[MEMORY]),
        i,
        kind,
        target,
        mask,
        values,
        refuse_impossible,
    )


@jit
def finish_one(addresses: Addresses, i: int) -> None:
    """The step of environment ``i`` from after the redispatch."""
    finish_step(
        open_plant(addresses[PLANT]),
        open_network(addresses[NETWORK]),
        open_state(addresses[STATE]),
        open_memory(addresses[MEMORY]),
        open_flow(addresses[FLOW]),
        open_opponent(addresses[OPPONENT]),
        i,
    )


@jit
def lose_one(addresses: Addresses, i: int) -> None:
    """No dispatch was found for environment ``i``."""
    lose_by_dispatch(open_state(addresses[STATE]), i)


@jit
def step_one(addresses: Addresses, i: int, kind: int, target: int, mask: int, values: F32) -> None:
    """A whole step of environment ``i`` with exact dispatch."""
    if begin_one(addresses, i, kind, target, mask, values, True):
        state, memory = open_state(addresses[STATE]), open_memory(addresses[MEMORY])
        if not dispatch_or_lose(state, memory, i):
            return
    finish_one(addresses, i)


@jit
def begin_simulation_one(
    addresses: Addresses,
    real: Addresses,
    row: int,
    kind: int,
    target: int,
    mask: int,
    values: F32,
    horizon: int,
    refuse_impossible: bool,
) -> bool:
    """The simulated step up to the redispatch; ``real`` are the addresses of the engine itself."""
    return begin_simulation(
        open_plant(addresses[PLANT]),
        open_network(addresses[NETWORK]),
        open_state(addresses[STATE]),
        open_memory(addresses[MEMORY]),
        open_memory(real[MEMORY]),
        row,
        kind,
        target,
        mask,
        values,
        horizon,
        refuse_impossible,
    )


@jit
def dispatch_one(addresses: Addresses, i: int) -> bool:
    """Find the exact dispatch of environment ``i``, or end its episode."""
    return dispatch_or_lose(open_state(addresses[STATE]), open_memory(addresses[MEMORY]), i)


@jit
def set_generators_one(addresses: Addresses, i: int) -> None:
    """Set the generators of environment ``i`` to the series' production plus the dispatch."""
    set_generators(open_state(addresses[STATE]), open_memory(addresses[MEMORY]), i)


@jit
def finish_simulation_one(addresses: Addresses) -> None:
    """The simulated step from after the redispatch."""
    finish_simulation(
        open_plant(addresses[PLANT]),
        open_network(addresses[NETWORK]),
        open_state(addresses[STATE]),
        open_memory(addresses[MEMORY]),
        open_flow(addresses[FLOW]),
    )


@jit
def copy_flow_one(source: int, i: int, target: int, j: int) -> None:
    """Copy the power flow of an environment; ``source`` and ``target`` are entries FLOW of two engines."""
    copy_flow(open_flow(source), i, open_flow(target), j)
