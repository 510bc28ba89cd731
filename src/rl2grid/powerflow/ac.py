"""AC power flow of many environments, one row each: what a Grid2Op step asks of LightSim2Grid."""

from __future__ import annotations

import math

import numpy as np

from rl2grid.arrays import F32, F64, I32, U16
from rl2grid.compile import borrowing_jit, owning_jit
from rl2grid.powerflow.flow_state import ABSENT, FlowState, equations_of, factors_of, forget_flow, new_flow_state
from rl2grid.powerflow.lanes import root, where_less
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.newton import go_on_cold, may_go_on, solve_cold, solve_warm
from rl2grid.powerflow.topology import build_nodes, is_same_topology, measure_pattern, remember_topology, write_pattern

__all__ = [
    "CONVERGED",
    "DISCONNECTED",
    "DIVERGED",
    "PREPARED",
    "FlowState",
    "forget_flow",
    "new_flow_state",
    "prepare_flow",
    "run_flow",
    "solve_flow",
    "write_currents",
    "write_flow",
]

CONVERGED = 0
"""Status of a flow that was solved."""
DISCONNECTED = 1
"""A load, generator or working storage is disconnected, or a bus is not connected to the slack generator's."""
DIVERGED = 2
"""LightSim2Grid's recipe finds no solution, or generators on one bus have different set-points."""
PREPARED = 3
"""Nothing speaks against solving it."""
_SETPOINT_TOLERANCE = 1e-7
"""Per unit, as LightSim2Grid."""
_LOWEST_KILOVOLT = 1e-7
"""LightSim2Grid, which divides power by voltage, shows no current below it (Newton's method may find that a bus
without load has no voltage)."""


@borrowing_jit
def run_flow(
    network: Network,
    flow: FlowState,
    i: int,
    topo_vect: I32,
    gen_p: F32,
    gen_v: F32 | F64,
    load_p: F32,
    load_q: F32,
    storage_p: F32,
) -> int:
    """Solve the AC power flow of row ``i``, as ``LightSimBackend.runpf`` does.

    Args:
        network: electrical model of the grid.
        flow: rows made by :func:`new_flow_state` for ``network``; row ``i`` is read and written.
        i: row.
        topo_vect: int32 [topo] busbar (1 or 2) of each element, -1 when disconnected.
        gen_p: float32 [gen] MW.
        gen_v: float32 or float64 [gen] voltage set-point, per unit of the nominal voltage.
        load_p: float32 [load] MW.
        load_q: float32 [load] MVAr.
        storage_p: float32 [storage] MW, positive charges.

    Returns:
        :data:`CONVERGED`, :data:`DISCONNECTED` or :data:`DIVERGED`; only after the first do the voltages mean
        anything.
    """
    status = prepare_flow(network, flow, i, topo_vect, gen_p, gen_v, load_p, load_q, storage_p)
    return solve_flow(network, flow, i, topo_vect, gen_v) if status == PREPARED else status


@borrowing_jit
def prepare_flow(
    network: Network,
    flow: FlowState,
    i: int,
    topo_vect: I32,
    gen_p: F32,
    gen_v: F32 | F64,
    load_p: F32,
    load_q: F32,
    storage_p: F32,
) -> int:
    """Write the equations of the flow of row ``i``; arguments as of :func:`run_flow`.

    Returns:
        :data:`PREPARED`; or :data:`DISCONNECTED` or :data:`DIVERGED`, if there is nothing to solve.
    """
    if not (flow.known[i] and is_same_topology(flow.topo_vect[i], topo_vect)):
        remember_topology(flow.topo_vect[i], topo_vect)
        flow.warm[i] = False
        flow.connected[i] = build_nodes(network, flow, i, topo_vect)
        flow.known[i] = True
        if flow.connected[i]:
            columns, values = measure_pattern(flow, i)
            flow.known[i] = columns <= flow.column.shape[1] and values <= flow.panel.shape[1]  # else it has no room
            if flow.known[i]:
                write_pattern(flow, i, flow.column[i])
    if not flow.connected[i] or not _storages_are_connected(flow, i, storage_p):
        return DISCONNECTED
    _write_injections(network, flow, i, gen_p, load_p, load_q, storage_p)
    if not _slack_is_finite(flow, i) or _has_conflicting_setpoints(flow, i, gen_v):
        flow.warm[i] = False
        return DIVERGED
    return PREPARED


@borrowing_jit
def solve_flow(network: Network, flow: FlowState, i: int, topo_vect: I32, gen_v: F32 | F64) -> int:
    """Solve what :func:`prepare_flow` has written; :data:`CONVERGED` or :data:`DIVERGED`."""
    if flow.known[i]:
        converged = _solve(network, flow, i, gen_v, flow.column[i], flow.panel[i])
    else:
        converged = _solve_beside(network, flow, i, topo_vect, gen_v)
    flow.warm[i] = converged and flow.known[i]
    return CONVERGED if converged else DIVERGED


@borrowing_jit
def _solve(network: Network, flow: FlowState, i: int, gen_v: F32 | F64, column: U16, panel: F64) -> bool:
    """Solve from the voltages of the last flow if that may be, else cold."""
    equations, factors = equations_of(flow, i), factors_of(flow, i, column, panel, flow.sparse_row)
    if may_go_on(flow, i) and solve_warm(network, flow, i, gen_v, equations, factors):
        return True
    _write_start(flow, i, gen_v)
    return solve_cold(network, flow, i, equations, factors)


@borrowing_jit
def finish_cold(network: Network, flow: FlowState, i: int, n_steps: int, ratio: float) -> bool:
    """Solve alone what was begun cold beside others; whether it converges.

    Args:
        network: electrical model of the grid.
        flow: row ``i`` holds the voltages and factors that it has come to.
        i: row.
        n_steps: Newton steps behind it.
        ratio: of the mismatch to the one before the last of them, infinite before the first.
    """
    equations, factors = equations_of(flow, i), factors_of(flow, i, flow.column[i], flow.panel[i], flow.sparse_row)
    flow.warm[i] = go_on_cold(network, flow, i, equations, factors, n_steps, ratio)
    return bool(flow.warm[i])


@owning_jit
def _solve_beside(network: Network, flow: FlowState, i: int, topo_vect: I32, gen_v: F32 | F64) -> bool:
    """Solve a topology with more fill than the row has room for, in arrays of its own."""
    build_nodes(network, flow, i, topo_vect)  # once more: others may have used the workspace since
    columns, values = measure_pattern(flow, i)
    column, panel = np.empty(columns, np.uint16), np.empty(values, np.float64)
    write_pattern(flow, i, column)
    return _solve(network, flow, i, gen_v, column, panel)


@borrowing_jit
def _storages_are_connected(flow: FlowState, i: int, storage_p: F32) -> bool:
    node = flow.storage_node[i]
    connected = True
    for storage in range(node.shape[0]):
        connected &= node[storage] != ABSENT or storage_p[storage] == 0.0
    return connected


@borrowing_jit
def _write_injections(
    network: Network, flow: FlowState, i: int, gen_p: F32, load_p: F32, load_q: F32, storage_p: F32
) -> None:
    injection = flow.injection[i]
    gen_node, load_node, storage_node = flow.gen_node[i], flow.load_node[i], flow.storage_node[i]
    scale = 1.0 / network.base_power[0]
    for node in range(flow.n_node[i]):
        injection[node, 0] = 0.0
        injection[node, 1] = 0.0
    set_gen_p = flow.gen_p[i]
    for gen in range(gen_node.shape[0]):
        set_gen_p[gen] = gen_p[gen]
        if gen != network.slack_gen[0]:
            injection[gen_node[gen], 0] += scale * np.float64(gen_p[gen])
    for load in range(load_node.shape[0]):
        injection[load_node[load], 0] -= scale * np.float64(load_p[load])
        injection[load_node[load], 1] -= scale * np.float64(load_q[load])
    for storage in range(storage_node.shape[0]):
        if storage_node[storage] != ABSENT:
            injection[storage_node[storage], 0] -= scale * np.float64(storage_p[storage])


@borrowing_jit
def _slack_is_finite(flow: FlowState, i: int) -> bool:
    """Whether the active power set at the slack's bus, which no equation contains, is a number."""
    return math.isfinite(flow.injection[i, np.int64(flow.n_node[i]) - 1, 0])


@borrowing_jit
def _has_conflicting_setpoints(flow: FlowState, i: int, gen_v: F32 | F64) -> bool:
    """Whether generators on one bus want different voltages, which LightSim2Grid refuses to solve."""
    gen_node, setpoint = flow.gen_node[i], flow.step
    for gen in range(gen_node.shape[0]):
        setpoint[gen_node[gen]] = gen_v[gen]
    conflict = False
    for gen in range(gen_node.shape[0]):
        conflict |= abs(setpoint[gen_node[gen]] - gen_v[gen]) > _SETPOINT_TOLERANCE
    return conflict


@borrowing_jit
def _write_start(flow: FlowState, i: int, gen_v: F32 | F64) -> None:
    """Magnitudes of a cold start."""
    magnitude, gen_node = flow.magnitude[i], flow.gen_node[i]
    for node in range(flow.n_node[i]):
        magnitude[node] = 1.0
    for gen in range(gen_node.shape[0]):
        magnitude[gen_node[gen]] = gen_v[gen]


@borrowing_jit
def write_currents(network: Network, flow: FlowState, i: int, a_or: F32) -> None:
    """Current at the origin of each line after a converged flow: float32 [line], A, 0 on open lines."""
    voltage, origins, extremities = flow.voltage[i], flow.line_or_node[i], flow.line_ex_node[i]
    for line in range(origins.shape[0]):
        origin, extremity = origins[line], extremities[line]
        if origin == ABSENT:
            a_or[line] = 0.0
            continue
        current = line_current(
            network, line, voltage[origin, 0], voltage[origin, 1], voltage[extremity, 0], voltage[extremity, 1]
        )
        a_or[line] = amperes(current)


@borrowing_jit
def line_current(network: Network, line: int, e1, f1, e2, f2):  # type: ignore[no-untyped-def]
    """Current at the origin of a line, kA, given the voltages of both ends, per unit: numbers, or lanes of them."""
    y = network.line_admittance[line]
    real = y[0] * e1 - y[1] * f1 + y[2] * e2 - y[3] * f2
    imaginary = y[0] * f1 + y[1] * e1 + y[2] * f2 + y[3] * e2
    nominal = network.nominal_voltage[network.line_or_sub[line]]
    base = network.base_power[0] / (math.sqrt(3.0) * nominal)
    current = root(real * real + imaginary * imaginary) * base
    lowest = _LOWEST_KILOVOLT * _LOWEST_KILOVOLT
    return where_less((e1 * e1 + f1 * f1) * (nominal * nominal), lowest, 0.0, current)


@borrowing_jit
def amperes(current: float) -> np.float32:
    """A current in kA as LightSimBackend gives it: rounded, then in A."""
    return np.float32(current) * np.float32(1000.0)


@borrowing_jit
def write_flow(
    network: Network,
    flow: FlowState,
    i: int,
    p_or: F32,
    gen_p: F32,
    gen_theta: F32,
    load_theta: F32,
    storage_theta: F32,
) -> None:
    """What Grid2Op's observation shows of a converged flow, all float32.

    Args:
        network: electrical model of the grid.
        flow: rows of environments.
        i: row.
        p_or: [line] MW entering each line at its origin, 0 on open lines.
        gen_p: [gen] MW, as given to :func:`run_flow`; the slack generator produces what balances the flow.
        gen_theta: [gen] degrees.
        load_theta: [load] degrees.
        storage_theta: [storage] degrees, 0 when disconnected.
    """
    voltage, origins, extremities = flow.voltage[i], flow.line_or_node[i], flow.line_ex_node[i]
    for line in range(origins.shape[0]):
        origin, extremity = origins[line], extremities[line]
        if origin == ABSENT:
            p_or[line] = 0.0
            continue
        y = network.line_admittance[line]
        e1, f1, e2, f2 = voltage[origin, 0], voltage[origin, 1], voltage[extremity, 0], voltage[extremity, 1]
        real = y[0] * e1 - y[1] * f1 + y[2] * e2 - y[3] * f2
        imaginary = y[0] * f1 + y[1] * e1 + y[2] * f2 + y[3] * e2
        p_or[line] = (e1 * real + f1 * imaginary) * network.base_power[0]
    set_gen_p = flow.gen_p[i]
    for gen in range(gen_p.shape[0]):
        gen_p[gen] = set_gen_p[gen]
    gen_p[network.slack_gen[0]] = _slack_balance(flow, i) * network.base_power[0]
    _write_degrees(flow.angle[i], flow.gen_node[i], gen_theta)
    _write_degrees(flow.angle[i], flow.load_node[i], load_theta)
    _write_degrees(flow.angle[i], flow.storage_node[i], storage_theta)


@borrowing_jit
def _slack_balance(flow: FlowState, i: int) -> float:
    """Production of the slack generator, per unit."""
    slack = np.uint16(flow.n_node[i] - 1)
    first, column, value = flow.admittance_first[i], flow.admittance_node[i], flow.admittance[i]
    voltage = flow.voltage[i]
    real = imaginary = 0.0
    for entry in range(first[slack], first[slack + np.uint16(1)]):
        other = column[entry]
        real += value[entry, 0] * voltage[other, 0] - value[entry, 1] * voltage[other, 1]
        imaginary += value[entry, 0] * voltage[other, 1] + value[entry, 1] * voltage[other, 0]
    return float(voltage[slack, 0] * real + voltage[slack, 1] * imaginary - flow.injection[i, slack, 0])


@borrowing_jit
def _write_degrees(angle: F64, place: U16, degrees: F32) -> None:
    for k in range(place.shape[0]):
        degrees[k] = 0.0 if place[k] == ABSENT else angle[place[k]] * (180.0 / math.pi)
