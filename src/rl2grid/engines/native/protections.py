"""The power flow of a step and what the protections do about it (Grid2Op's ``Backend.next_grid_state``)."""

from __future__ import annotations

from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments, separate
from rl2grid.engines.native.topology import open_line
from rl2grid.powerflow.ac import CONVERGED, PREPARED, prepare_flow, solve_flow, write_currents

SETTLED = 4
"""Status of a flow after which no line trips, beside those of :mod:`rl2grid.powerflow.ac`."""


@jit
def flow_with_cascade(environments: Environments, i: int, soft: bool) -> bool:
    """Run the power flow, trip overloaded lines, and repeat until nothing trips; False if no flow is found.

    A line trips at once above the hard limit, and when it was overloaded in more steps than allowed; a step
    counts once, however many rounds the cascade has. Currents are left in ``a_or``.

    Args:
        environments: row ``i`` holds the topology, which loses the tripped lines, and the injections.
        i: the row.
        soft: whether overloads are counted; not so in the first row of an episode.
    """
    begin_cascade(environments, i)
    status = prepare(environments, i)
    while status == PREPARED:
        status = find_flow(environments, i)
        if status == CONVERGED:
            status = trip_lines(environments, i, soft)
    return bool(status == SETTLED)


@jit
def begin_cascade(environments: Environments, i: int) -> None:
    """Nothing has tripped yet."""
    hidden = environments.hidden
    hidden.tripped[i] = False
    hidden.counted[i] = False
    hidden.running_count[i] = hidden.protection[i]


@separate
def prepare(environments: Environments, i: int) -> int:
    """:func:`rl2grid.powerflow.ac.prepare_flow` with the topology and the injections of row ``i``."""
    network, state, hidden, flow = environments.network, environments.state, environments.hidden, environments.flow
    return prepare_flow(
        network,
        flow,
        i,
        state.topo_vect[i],
        hidden.gen_p[i],
        hidden.gen_v[i],
        hidden.load_p[i],
        hidden.load_q[i],
        state.storage_power[i],
    )


@separate
def find_flow(environments: Environments, i: int) -> int:
    """Solve a flow that is PREPARED, and write the currents if it is CONVERGED; its status."""
    network, state, flow = environments.network, environments.state, environments.flow
    status = solve_flow(network, flow, i, state.topo_vect[i], environments.hidden.gen_v[i])
    if status == CONVERGED:
        write_currents(network, flow, i, state.a_or[i])
    return status


@jit
def trip_lines(environments: Environments, i: int, soft: bool) -> int:
    """Open what the protections open after a flow; ``SETTLED`` if that is nothing, else what comes of :func:`prepare`.

    Arguments as of :func:`flow_with_cascade`.
    """
    return prepare(environments, i) if _open_tripped(environments, i, soft) else SETTLED


@jit
def _open_tripped(environments: Environments, i: int, soft: bool) -> bool:
    """Open what the protections open; whether anything was opened."""
    if not _any_line_is_in_doubt(environments, i):
        return False
    constants, state, hidden = environments.constants, environments.state, environments.hidden
    any_tripped = False
    for line in range(state.a_or.shape[1]):
        if state.topo_vect[i, state.line_or_pos_topo_vect[line]] < 0:
            continue
        current = state.a_or[i, line]
        if soft and current > state.thermal_limit[line] and not hidden.counted[i, line]:
            hidden.counted[i, line] = True
            hidden.running_count[i, line] += 1
        if current > constants.hard_limit[line] or hidden.running_count[i, line] > constants.overflow_allowed[0]:
            hidden.tripped[i, line] = True
            open_line(state, i, line)
            any_tripped = True
    return any_tripped


@jit
def _any_line_is_in_doubt(environments: Environments, i: int) -> bool:
    """Whether a line is overloaded, above its hard limit, or was overloaded too often; in most steps none is."""
    constants, state = environments.constants, environments.state
    current, count, allowed = state.a_or[i], environments.hidden.running_count[i], constants.overflow_allowed[0]
    in_doubt = False
    for line in range(current.shape[0]):
        in_doubt |= (current[line] > state.thermal_limit[line]) | (current[line] > constants.hard_limit[line])
        in_doubt |= count[line] > allowed
    return in_doubt
