"""``simulate``: one step on the forecast, as Grid2Op's ``obs.simulate`` plays it (``docs/simulate.md``)."""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32
from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.engines.native.generation import decode_injection, request_is_impossible, set_generators
from rl2grid.engines.native.series import read_forecast
from rl2grid.engines.native.step import nobody_injects, prepare_dispatch, run_and_register
from rl2grid.engines.native.topology import act_on_topology, open_line
from rl2grid.mdp.actions import ActionKind

_INJECTION = int(ActionKind.INJECTION)
_FULL_LOAD = np.float32(1.0)


@jit
def begin_simulation(
    environments: Environments,
    real: Environments,
    row: int,
    kind: int,
    target: int,
    mask: int,
    values: F32,
    horizon: int,
    refuse_impossible: bool,
) -> bool:
    """Play a simulated step in row 0 up to the redispatch; whether generators have to be dispatched.

    Row 0 of ``environments`` is a copy of row ``row`` of the ``real`` ones. Maintenance comes before the agent's
    action here, and is not forced upon it.
    """
    state = environments.state
    now = state.step[0]
    _skip_to(environments, horizon)
    act_on_topology(environments, 0, kind, target, mask)
    injects = kind == _INJECTION
    if injects and refuse_impossible and request_is_impossible(environments, 0, values):
        state.illegal[0] = True
        injects = False
    nobody_injects(environments.hidden, 0)
    if injects:
        decode_injection(environments, 0, values)
    read_forecast(environments, 0, real.hidden, row, now, horizon)
    state.step[0] = now + horizon
    return prepare_dispatch(environments, 0)


@jit
def finish_simulation(environments: Environments) -> None:
    """Play the simulated step of row 0 from after the redispatch to the observation."""
    set_generators(environments, 0)
    run_and_register(environments, 0)


@jit
def _skip_to(environments: Environments, horizon: int) -> None:
    """Counters of row 0 as Grid2Op sets them for a step ``horizon`` steps ahead."""
    state, hidden = environments.state, environments.hidden
    for line in range(state.rho.shape[1]):
        state.time_before_cooldown_line[0, line] = max(state.time_before_cooldown_line[0, line] - (horizon - 1), 0)
        if state.rho[0, line] > _FULL_LOAD:
            state.timestep_overflow[0, line] += horizon - 1
            hidden.protection[0, line] += horizon - 1
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
    for sub in range(state.time_before_cooldown_sub.shape[1]):
        state.time_before_cooldown_sub[0, sub] = max(state.time_before_cooldown_sub[0, sub] - (horizon - 1), 0)
