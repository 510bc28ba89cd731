"""The power flow of a step and what the protections do about it (Grid2Op's ``Backend.next_grid_state``)."""

from __future__ import annotations

from rl2grid.compile import jit
from rl2grid.engines.native.memory import Memory
from rl2grid.engines.native.plant import Plant
from rl2grid.engines.native.topology import open_line
from rl2grid.mdp.state import GridState
from rl2grid.powerflow.ac import CONVERGED, FlowState, run_flow, write_currents
from rl2grid.powerflow.model import Network


@jit
def flow_with_cascade(
    plant: Plant, network: Network, state: GridState, memory: Memory, flow: FlowState, i: int, soft: bool
) -> bool:
    """Run the power flow, trip overloaded lines, and repeat until nothing trips; False if no flow is found.

    A line trips at once above the hard limit, and when it was overloaded in more steps than allowed; a step
    counts once, however many rounds the cascade has. Currents are left in ``a_or``.

    Args:
        plant: constants of the grid.
        network: the electrical model.
        state: row ``i`` holds the topology, which loses the tripped lines.
        memory: row ``i`` holds the injections; ``tripped`` is written.
        flow: workspace of the power flow.
        i: the row.
        soft: whether overloads are counted; not so in the first row of an episode.
    """
    memory.tripped[i] = False
    memory.counted[i] = False
    memory.running_count[i] = memory.protection[i]
    while True:
        status = run_flow(
            network,
            flow,
            i,
            state.topo_vect[i],
            memory.gen_p[i],
            memory.gen_v[i],
            memory.load_p[i],
            memory.load_q[i],
            state.storage_power[i],
        )
        if status != CONVERGED:
            return False
        write_currents(network, flow, i, state.a_or[i])
        if not _trip_lines(plant, state, memory, i, soft):
            return True


@jit
def _trip_lines(plant: Plant, state: GridState, memory: Memory, i: int, soft: bool) -> bool:
    """Open what the protections open; whether anything was opened."""
    any_tripped = False
    for line in range(state.a_or.shape[1]):
        if state.topo_vect[i, state.line_or_pos_topo_vect[line]] < 0:
            continue
        current = state.a_or[i, line]
        if soft and current > state.thermal_limit[line] and not memory.counted[i, line]:
            memory.counted[i, line] = True
            memory.running_count[i, line] += 1
        if current > plant.hard_limit[line] or memory.running_count[i, line] > plant.overflow_allowed[0]:
            memory.tripped[i, line] = True
            open_line(state, i, line)
            any_tripped = True
    return any_tripped
