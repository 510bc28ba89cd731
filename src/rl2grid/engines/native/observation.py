"""The observed attributes after a step (Grid2Op's ``CompleteObservation``), and the blank ones after a game over."""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.ac import write_flow

_NONE = np.float32(0.0)


@jit
def observe(environments: Environments, i: int) -> None:
    """Write what row ``i`` shows of a converged flow; ``a_or`` and everything that a step counts are there."""
    network, state, hidden, flow = environments.network, environments.state, environments.hidden, environments.flow
    state.gen_p[i] = hidden.gen_p[i]
    state.load_p[i] = hidden.load_p[i]
    write_flow(
        network,
        flow,
        i,
        state.p_or[i],
        state.gen_p[i],
        state.gen_theta[i],
        state.load_theta[i],
        state.storage_theta[i],
    )
    for line in range(state.rho.shape[1]):
        state.rho[i, line] = state.a_or[i, line] / state.thermal_limit[line]
        state.line_status[i, line] = state.topo_vect[i, state.line_or_pos_topo_vect[line]] > 0
    _observe_generators(state, i)


@jit
def _observe_generators(state: GridState, i: int) -> None:
    for gen in range(state.gen_p.shape[1]):
        produced = state.gen_p[i, gen]
        if state.gen_renewable[gen]:
            state.curtailment[i, gen] = (state.gen_p_before_curtail[i, gen] - produced) / state.gen_pmax[gen]
            state.gen_margin_up[i, gen] = 0.0
            state.gen_margin_down[i, gen] = 0.0
            continue
        state.curtailment[i, gen] = 0.0
        room_up = min(state.gen_pmax[gen] - produced, state.gen_max_ramp_up[gen])
        room_down = min(produced - state.gen_pmin[gen], state.gen_max_ramp_down[gen])
        state.gen_margin_up[i, gen] = max(room_up, _NONE)
        state.gen_margin_down[i, gen] = max(room_down, _NONE)


@jit
def blank_row(state: GridState, i: int) -> None:
    """What Grid2Op shows after a game over: no topology, no maintenance, no limits, all else zero."""
    state.gen_p[i] = 0.0
    state.gen_theta[i] = 0.0
    state.load_p[i] = 0.0
    state.load_theta[i] = 0.0
    state.p_or[i] = 0.0
    state.a_or[i] = 0.0
    state.rho[i] = 0.0
    state.line_status[i] = False
    state.topo_vect[i] = -1
    state.timestep_overflow[i] = 0
    state.time_before_cooldown_line[i] = 0
    state.time_before_cooldown_sub[i] = 0
    state.time_next_maintenance[i] = -1
    state.duration_next_maintenance[i] = 0
    state.target_dispatch[i] = 0.0
    state.actual_dispatch[i] = 0.0
    state.gen_margin_up[i] = 0.0
    state.gen_margin_down[i] = 0.0
    state.gen_p_before_curtail[i] = 0.0
    state.curtailment[i] = 0.0
    state.curtailment_limit[i] = 1.0
    state.storage_charge[i] = 0.0
    state.storage_power_target[i] = 0.0
    state.storage_power[i] = 0.0
    state.storage_theta[i] = 0.0
