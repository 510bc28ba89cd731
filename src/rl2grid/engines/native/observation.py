"""The observed attributes after a step (Grid2Op's ``CompleteObservation``)."""

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
    for line in range(state.rho.shape[1]):
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
