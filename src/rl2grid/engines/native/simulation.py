"""``simulate``: one step on the forecast, as Grid2Op's ``obs.simulate`` plays it (``docs/simulate.md``)."""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.engines.native.generation import set_generators
from rl2grid.engines.native.protections import flow_with_cascade
from rl2grid.engines.native.series import read_forecast
from rl2grid.engines.native.step import play_order, prepare_dispatch, register
from rl2grid.engines.native.topology import judge_order, open_line
from rl2grid.mdp.state import GridState
from rl2grid.structures import copy_row

_FULL_LOAD = np.float32(1.0)


@jit
def copy_environment(source: Environments, i: int, target: Environments, j: int) -> None:
    """Bring row ``j`` of another engine of the grid to where row ``i`` is, for a step without opponent."""
    copy_row(source.state, i, target.state, j)
    copy_row(source.hidden, i, target.hidden, j)
    copy_row(source.flow, i, target.flow, j)


@jit
def begin_simulation(
    environments: Environments, real: Environments, row: int, horizon: int, refuse_impossible: bool
) -> bool:
    """Play a simulated step in row 0 up to the redispatch; whether generators have to be dispatched.

    Row 0 of ``environments`` is a copy of row ``row`` of the ``real`` ones, with the action to be played.
    Maintenance comes before the agent's action here, and is not forced upon it.
    """
    state = environments.state
    now = state.step[0]
    _skip_counters_to(environments, horizon)
    is_legal = judge_order(environments, 0)  # of the topology observed
    _skip_maintenance_to(state, horizon)
    play_order(environments, 0, is_legal, refuse_impossible)
    read_forecast(environments, 0, real.hidden, row, now, horizon)
    state.step[0] = now + horizon
    return prepare_dispatch(environments, 0)


@jit
def finish_simulation(environments: Environments) -> None:
    """Play the simulated step of row 0 from after the redispatch to the observation."""
    set_generators(environments, 0)
    register(environments, 0, flow_with_cascade(environments, 0, True))


@jit
def _skip_counters_to(environments: Environments, horizon: int) -> None:
    """Counters of row 0 as Grid2Op sets them for a step ``horizon`` steps ahead."""
    state, hidden = environments.state, environments.hidden
    for line in range(state.rho.shape[1]):
        state.time_before_cooldown_line[0, line] = max(state.time_before_cooldown_line[0, line] - (horizon - 1), 0)
        if state.rho[0, line] > _FULL_LOAD:
            state.timestep_overflow[0, line] += horizon - 1
            hidden.protection[0, line] += horizon - 1
    for sub in range(state.time_before_cooldown_sub.shape[1]):
        state.time_before_cooldown_sub[0, sub] = max(state.time_before_cooldown_sub[0, sub] - (horizon - 1), 0)


@jit
def _skip_maintenance_to(state: GridState, horizon: int) -> None:
    """Planned outages of row 0 as they are ``horizon`` steps ahead; opens the lines that are out then."""
    for line in range(state.rho.shape[1]):
        begin, duration = state.time_next_maintenance[0, line], state.duration_next_maintenance[0, line]
        if begin == -1:
            continue
        if begin + duration <= horizon:
            state.time_next_maintenance[0, line] = -1
            state.duration_next_maintenance[0, line] = 0
        elif begin > horizon:
            state.time_next_maintenance[0, line] = begin - horizon
        else:
            state.time_next_maintenance[0, line] = 0
            state.duration_next_maintenance[0, line] = duration - (horizon - begin)
            open_line(state, 0, line)
