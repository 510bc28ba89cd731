"""Batched flows after moves of elements between the busbars of one substation.

With the substation's rows and columns taken out of the Jacobian, its factors are the same for every move: the two
busbars are a border of at most four unknowns. Lanes differ in which element is on which busbar, and in nothing else.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from rl2grid.arrays import F32, F64, I32, U32, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.factors import factorise
from rl2grid.powerflow.flow_state import ABSENT, Equations, Factors, FlowState
from rl2grid.powerflow.lane_flow import (
    LaneFlow,
    add_power,
    any_lane_runs,
    begin_lanes,
    judge_lanes,
    measure_distance,
    measure_lanes,
    square_step,
    squared_change,
    squared_loading,
    step_lanes,
    turn,
    write_loadings,
)
from rl2grid.powerflow.lanes import WIDTH, Lanes, at, fma, larger, load, root, splat, store
from rl2grid.powerflow.model import Network
from rl2grid.powerflow.newton import fill_jacobian
from rl2grid.powerflow.paths import Paths, solve_backward, solve_forward, write_path, write_path_product
from rl2grid.powerflow.topology import is_joined
from rl2grid.structures import allocate, constant, workspace

LARGEST_SITE = 32
"""Elements of a substation whose moves are solved in lanes; those of a larger one are solved one by one."""
ORIGIN, EXTREMITY, GENERATOR, LOAD, STORAGE = range(5)
"""Kinds of elements."""
N_LINES, N_ELEMENTS, IS_SLACK, HAS_SHUNT, N_PARTS = range(5)
"""Entries of :attr:`Site.counts`."""
CONNECTED, SECOND, LINES, LOADS, GENERATORS, STORAGES = range(6)
"""Entries of :attr:`Site.members`."""


class Wiring(NamedTuple):
    """Constants of a grid that a flow of one topology does not need."""

    sub_first_element: Annotated[I32, constant("sub", "entry of its first element in topo_vect")]
    sub_info: Annotated[I32, constant("sub", "number of its elements")]
    element_kind: Annotated[I32, constant("topo", "ORIGIN, EXTREMITY, GENERATOR, LOAD or STORAGE")]
    element_index: Annotated[I32, constant("topo", "line, generator, load or storage")]
    shunt: Annotated[F64, constant("sub 2", "admittance of the shunts on busbar 1", "per unit")]
    limit: Annotated[F64, constant("line", "loading per unit of current at the origin")]
    thermal_limit: Annotated[F32, constant("line", "largest current", "A")]


class Site(NamedTuple):
    """One substation in the base case. Bits stand for elements, in the order of ``topo_vect``."""

    counts: Annotated[I32, workspace("5", "N_LINES, N_ELEMENTS, IS_SLACK, HAS_SHUNT, N_PARTS")]
    members: Annotated[U32, workspace("6", "bits of elements: CONNECTED, SECOND, LINES, LOADS, GENERATORS, STORAGES")]
    part: Annotated[U32, workspace("element", "by part of the rest of the grid: lines that lead to it")]
    line: Annotated[I32, workspace("element", "closed lines: entry k of these arrays is the k-th of them")]
    element: Annotated[I32, workspace("element", "bit of its end here")]
    far: Annotated[I32, workspace("element", "node of its other end")]
    begins: Annotated[I32, workspace("element", "1 if its origin is here")]
    admittance: Annotated[
        F64, workspace("element 8", "here-here, here-there, there-here, there-there, each real, imaginary")
    ]
    voltage: Annotated[F64, workspace("element 2", "of the busbar it is on")]
    outward: Annotated[F64, workspace("element 2", "power here that the other end's voltage makes")]
    inward: Annotated[F64, workspace("element 2", "power there that this end's voltage makes")]
    coupling: Annotated[
        F64,
        workspace("element element 4", "derivative of power into line j by the voltage at line k, through the grid"),
    ]
    supply: Annotated[F64, workspace("element 2", "injection", "per unit")]
    setpoint: Annotated[F64, workspace("element", "of generators", "per unit")]
    label: Annotated[I32, workspace("bus", "by node: part of the rest of the grid")]
    queue: Annotated[I32, workspace("bus", "of searches")]
    block: Annotated[F64, workspace("2 2", "block of an inverse")]
    start: Annotated[F64, workspace("2 2", "base voltage of each busbar, that of the other where one is empty")]

    weight: Annotated[Lanes, workspace("element lane", "1.0 on busbar 2, else 0.0")]
    busbar: Annotated[Lanes, workspace("2 2 lane", "voltages")]
    free: Annotated[
        Lanes, workspace("4 lane", "1.0 for an angle or magnitude to be found: of busbar 1, then of busbar 2")
    ]
    demand: Annotated[Lanes, workspace("2 2 lane", "power set", "per unit")]
    shunt: Annotated[Lanes, workspace("2 2 lane", "admittance", "per unit")]
    own: Annotated[Lanes, workspace("2 2 lane", "sums of here-here admittances and shunt", "per unit")]
    residual: Annotated[Lanes, workspace("4 lane", "mismatch, then Newton step")]
    inverse: Annotated[Lanes, workspace("16 lane", "of the border's Schur complement")]


def new_site(n_bus: int, n_element: int) -> Site:
    """A blank site with room for ``n_element`` elements."""
    return allocate(Site, {"bus": n_bus, "element": n_element, "lane": WIDTH})


@borrowing_jit
def open_site(
    network: Network, wiring: Wiring, flow: FlowState, i: Index, equations: Equations, factors: Factors,
    paths: Paths, lane_flow: LaneFlow, site: Site, sub: Index,
    topo_vect: I32, gen_p: F32, gen_v: F32, load_p: F32, load_q: F32, storage_p: F32,
) -> bool:  # fmt: skip
    """Prepare for moves at ``sub``; False if the batch cannot play them."""
    n_sub = network.nominal_voltage.shape[0]
    n_free = equations.n_free
    _read_elements(network, wiring, site, sub, topo_vect, gen_p, gen_v, load_p, load_q, storage_p)
    first, second = _node_of(flow, i, site, sub, 1), _node_of(flow, i, site, sub + n_sub, 2)
    if not _read_lines(network, wiring, flow, i, site, sub, topo_vect, equations):
        return False
    for part in range(2):
        site.start[0, part] = equations.voltage[first if first >= 0 else second, part]
        site.start[1, part] = equations.voltage[second if second >= 0 else first, part]
    _find_parts(flow, i, equations, site, first, second)
    fill_jacobian(equations, factors)
    for entry in range(equations.admittance_first[n_free + 1]):
        lane_flow.admittance[entry, 0] = equations.admittance[entry, 0]
        lane_flow.admittance[entry, 1] = equations.admittance[entry, 1]
    for node in range(n_free):
        lane_flow.injection[node, 0] = equations.injection[node, 0]
        lane_flow.injection[node, 1] = equations.injection[node, 1]
    for taken in (first, second):
        if taken >= 0:
            _take_out(equations, factors, lane_flow, taken)
    if not factorise(factors):
        return False
    n_lines = site.counts[N_LINES]
    for k in range(n_lines):
        if site.far[k] < n_free:
            write_path(factors, site.far[k], paths, k)
    for j in range(n_lines):
        for k in range(n_lines):
            _couple(paths, site, n_free, j, k)
    return True


@borrowing_jit
def _node_of(flow: FlowState, i: Index, site: Site, bus: Index, busbar: Index) -> Index:
    """Node of a busbar of the site, -1 if it is empty."""
    connected, second = site.members[CONNECTED], site.members[SECOND]
    here = connected & second if busbar == 2 else connected & ~second
    if here == 0 and not (busbar == 1 and site.counts[HAS_SHUNT] == 1):
        return -1
    return np.int64(flow.node_of_bus[i, bus])


@borrowing_jit
def _read_elements(
    network: Network, wiring: Wiring, site: Site, sub: Index, topo_vect: I32, gen_p: F32, gen_v: F32, load_p: F32,
    load_q: F32, storage_p: F32,
) -> None:  # fmt: skip
    """Which elements there are and what they inject."""
    members = site.members
    for k in range(members.shape[0]):
        members[k] = 0
    scale = 1.0 / network.base_power[0]
    site.counts[IS_SLACK] = 0
    site.counts[N_ELEMENTS] = wiring.sub_info[sub]
    site.counts[HAS_SHUNT] = 1 if wiring.shunt[sub, 0] != 0.0 or wiring.shunt[sub, 1] != 0.0 else 0
    for k in range(wiring.sub_info[sub]):
        element = wiring.sub_first_element[sub] + k
        kind, index = wiring.element_kind[element], wiring.element_index[element]
        bit = np.uint32(1) << np.uint32(k)
        site.supply[k, 0] = 0.0
        site.supply[k, 1] = 0.0
        if topo_vect[element] < 1:
            continue
        members[CONNECTED] |= bit
        if topo_vect[element] == 2:
            members[SECOND] |= bit
        if kind == GENERATOR:
            members[GENERATORS] |= bit
            site.setpoint[k] = gen_v[index]
            if index == network.slack_gen[0]:
                site.counts[IS_SLACK] = k + 1
            else:
                site.supply[k, 0] = scale * np.float64(gen_p[index])
        elif kind == LOAD:
            members[LOADS] |= bit
            site.supply[k, 0] = -scale * np.float64(load_p[index])
            site.supply[k, 1] = -scale * np.float64(load_q[index])
        elif kind == STORAGE:
            if storage_p[index] != 0.0:
                members[STORAGES] |= bit
            site.supply[k, 0] = -scale * np.float64(storage_p[index])


@borrowing_jit
def _read_lines(
    network: Network, wiring: Wiring, flow: FlowState, i: Index, site: Site, sub: Index, topo_vect: I32,
    equations: Equations,
) -> bool:  # fmt: skip
    """The closed lines; False if one has both ends here."""
    n = 0
    voltage = equations.voltage
    for k in range(wiring.sub_info[sub]):
        element = wiring.sub_first_element[sub] + k
        kind, line = wiring.element_kind[element], wiring.element_index[element]
        if kind > EXTREMITY or topo_vect[element] < 1:
            continue
        if network.line_or_sub[line] == network.line_ex_sub[line]:
            return False
        origin, extremity = flow.line_or_node[i, line], flow.line_ex_node[i, line]
        if origin == ABSENT:
            return False
        here, there = (origin, extremity) if kind == ORIGIN else (extremity, origin)
        site.members[LINES] |= np.uint32(1) << np.uint32(k)
        site.line[n] = line
        site.element[n] = k
        site.far[n] = there
        site.begins[n] = 1 if kind == ORIGIN else 0
        for part in range(8):
            source = part if kind == ORIGIN else 2 * (3 - part // 2) + part % 2
            site.admittance[n, part] = network.line_admittance[line, source]
        y = site.admittance[n]
        e1, f1, e2, f2 = voltage[here, 0], voltage[here, 1], voltage[there, 0], voltage[there, 1]
        site.voltage[n, 0] = e1
        site.voltage[n, 1] = f1
        real, imaginary = y[2] * e2 - y[3] * f2, y[2] * f2 + y[3] * e2
        site.outward[n, 0] = e1 * real + f1 * imaginary
        site.outward[n, 1] = f1 * real - e1 * imaginary
        real, imaginary = y[4] * e1 - y[5] * f1, y[4] * f1 + y[5] * e1
        site.inward[n, 0] = e2 * real + f2 * imaginary
        site.inward[n, 1] = f2 * real - e2 * imaginary
        n += 1
    site.counts[N_LINES] = n
    return True


@borrowing_jit
def _find_parts(flow: FlowState, i: Index, equations: Equations, site: Site, first: Index, second: Index) -> None:
    """Into which parts the grid falls without the substation, and which lines lead to each."""
    label, queue = site.label, site.queue
    for node in range(equations.n_free + 1):
        label[node] = -1
    n_parts = 0
    for k in range(site.counts[N_LINES]):
        if label[site.far[k]] < 0:
            site.part[n_parts] = 0
            queue[0] = site.far[k]
            label[site.far[k]] = n_parts
            visited, found = 0, 1
            while visited < found:
                node = queue[visited]
                visited += 1
                for entry in range(equations.admittance_first[node], equations.admittance_first[node + 1]):
                    other = equations.admittance_node[entry]
                    joined = is_joined(equations.admittance, entry)
                    if joined and label[other] < 0 and other != first and other != second:
                        label[other] = n_parts
                        queue[found] = other
                        found += 1
            n_parts += 1
        site.part[label[site.far[k]]] |= np.uint32(1) << np.uint32(site.element[k])
    site.counts[N_PARTS] = n_parts


@borrowing_jit
def _take_out(equations: Equations, factors: Factors, lane_flow: LaneFlow, node: Index) -> None:
    """Make rows and columns of a node those of the identity, and its lines nobody's."""
    first, column, block = equations.admittance_first, equations.admittance_node, equations.admittance_panel
    first_unknown, panel, n_free = equations.first_unknown, factors.panel, equations.n_free
    admittance = lane_flow.admittance
    for entry in range(first[node], first[node + 1]):
        admittance[entry, 0] = 0.0
        admittance[entry, 1] = 0.0
        other = np.int64(column[entry])
        if other == node:
            continue
        for back in range(first[other], first[other + 1]):
            if column[back] != node:
                continue
            admittance[back, 0] = 0.0
            admittance[back, 1] = 0.0
            if node < n_free and other < n_free:
                rows = np.int64(first_unknown[other + 1]) - np.int64(first_unknown[other])
                columns = np.int64(first_unknown[node + 1]) - np.int64(first_unknown[node])
                for k in range(rows * columns):
                    panel[np.int64(block[back]) + k] = 0.0
    if node == n_free:
        return
    lane_flow.injection[node, 0] = 0.0
    lane_flow.injection[node, 1] = 0.0
    for k in range(factors.first_panel[node], factors.first_panel[node + 1]):
        panel[k] = 0.0
    own = np.int64(factors.own_panel[node])
    panel[own] = 1.0
    if np.int64(first_unknown[node + 1]) - np.int64(first_unknown[node]) == 2:
        panel[own + 3] = 1.0


@borrowing_jit
def _couple(paths: Paths, site: Site, n_free: Index, j: Index, k: Index) -> None:
    """Derivative of power into line j by angle and magnitude at line k, through the rest of the grid."""
    for part in range(4):
        site.coupling[j, k, part] = 0.0
    if site.far[j] >= n_free or site.far[k] >= n_free:
        return
    block = site.block
    write_path_product(paths, j, k, block)
    p, q = site.inward[k, 0], site.inward[k, 1]
    a, b = block[0, 0] * q - block[0, 1] * p, block[0, 0] * p + block[0, 1] * q
    c, d = block[1, 0] * q - block[1, 1] * p, block[1, 0] * p + block[1, 1] * q
    p, q = site.outward[j, 0], site.outward[j, 1]
    site.coupling[j, k, 0] = q * a + p * c
    site.coupling[j, k, 1] = q * b + p * d
    site.coupling[j, k, 2] = -p * a + q * c
    site.coupling[j, k, 3] = -p * b + q * d


@borrowing_jit
def place_lane(wiring: Wiring, site: Site, lane: Index, sub: Index, second: np.uint32) -> None:
    """Put the elements of ``second`` on busbar 2 of a lane, all others on busbar 1."""
    connected = site.members[CONNECTED]
    for k in range(site.counts[N_ELEMENTS]):
        bit = np.uint32(1) << np.uint32(k)
        site.weight[k, lane] = 1.0 if second & bit else 0.0
    for busbar in range(2):
        here = connected & second if busbar == 1 else connected & ~second
        used = here != 0 or (busbar == 0 and site.counts[HAS_SHUNT] == 1)
        slack_element = site.counts[IS_SLACK] - 1
        is_slack = slack_element >= 0 and (here >> np.uint32(max(slack_element, 0))) & np.uint32(1) == 1
        held = here & site.members[GENERATORS]
        site.free[2 * busbar, lane] = 1.0 if used and not is_slack else 0.0
        site.free[2 * busbar + 1, lane] = 1.0 if used and held == 0 else 0.0
        e, f = site.start[busbar, 0], site.start[busbar, 1]
        if is_slack:
            e, f = 1.0, 0.0
        if held != 0:
            generator = np.int64(0)
            while not (held >> np.uint32(generator)) & np.uint32(1):
                generator += 1
            scale = site.setpoint[generator] / np.sqrt(e * e + f * f)
            e *= scale
            f *= scale
        site.busbar[busbar, 0, lane] = e
        site.busbar[busbar, 1, lane] = f
        for part in range(2):
            site.shunt[busbar, part, lane] = wiring.shunt[sub, part] if busbar == 0 else 0.0


@borrowing_jit
def solve_moves(
    network: Network, wiring: Wiring, flow: FlowState, i: Index, equations: Equations, factors: Factors,
    paths: Paths, lane_flow: LaneFlow, site: Site,
) -> None:  # fmt: skip
    """Solve the flows of all lanes and write their squared loadings."""
    begin_lanes(lane_flow, equations)
    _add_up(site)
    _measure_busbars(lane_flow, equations, site, 1.0)
    _invert_border(site)
    _write_norm(lane_flow, equations, site)
    n_steps = 0
    while judge_lanes(lane_flow, n_steps, network.base_power[0]):
        _solve_bordered(factors, paths, lane_flow, site)
        step_lanes(lane_flow, equations)
        _step_busbars(lane_flow, site)
        n_steps += 1
        if any_lane_runs(lane_flow):
            measure_lanes(lane_flow, equations)
            _measure_busbars(lane_flow, equations, site, 0.0)
            _write_norm(lane_flow, equations, site)
    measure_distance(lane_flow, equations)
    _add_distance_of_busbars(lane_flow, site)
    write_loadings(network, flow, i, wiring.limit, lane_flow)
    _write_loadings_here(network, wiring, lane_flow, site)


@borrowing_jit
def _add_up(site: Site) -> None:
    """Sums over the elements of each busbar."""
    for part in range(2):
        first = second = splat(0.0)
        for k in range(site.counts[N_ELEMENTS]):
            share = load(site.weight, k) * at(site.supply, 2 * k + part)
            second = second + share
            first = first + (at(site.supply, 2 * k + part) - share)
        store(site.demand, part, first)
        store(site.demand, 2 + part, second)
        first, second = load(site.shunt, part), load(site.shunt, 2 + part)
        for k in range(site.counts[N_LINES]):
            share = load(site.weight, site.element[k]) * at(site.admittance, 8 * k + part)
            second = second + share
            first = first + (at(site.admittance, 8 * k + part) - share)
        store(site.own, part, first)
        store(site.own, 2 + part, second)


@borrowing_jit
def _measure_busbars(lane_flow: LaneFlow, equations: Equations, site: Site, contained: float) -> None:
    """Mismatch of the busbars, and what their lines add to the mismatch at their other ends.

    ``contained`` is the share of the base case's flows that the latter holds already: 1 before the first step, when
    the rest of the grid is balanced as it was, else 0.
    """
    voltage = lane_flow.voltage
    e1, f1, e2, f2 = load(site.busbar, 0), load(site.busbar, 1), load(site.busbar, 2), load(site.busbar, 3)
    g1, b1, g2, b2 = load(site.own, 0), load(site.own, 1), load(site.own, 2), load(site.own, 3)
    real1, imaginary1 = g1 * e1 - b1 * f1, g1 * f1 + b1 * e1
    real2, imaginary2 = g2 * e2 - b2 * f2, g2 * f2 + b2 * e2
    for k in range(site.counts[N_LINES]):
        weight = load(site.weight, site.element[k])
        far = np.int64(site.far[k])
        e_far, f_far = load(voltage, 2 * far), load(voltage, 2 * far + 1)
        g, b = at(site.admittance, 8 * k + 2), at(site.admittance, 8 * k + 3)
        real, imaginary = fma(-b, f_far, g * e_far), fma(b, e_far, g * f_far)
        share, imaginary_share = weight * real, weight * imaginary
        real2, imaginary2 = real2 + share, imaginary2 + imaginary_share
        real1, imaginary1 = real1 + (real - share), imaginary1 + (imaginary - imaginary_share)
        e, f = fma(weight, e2 - e1, e1), fma(weight, f2 - f1, f1)
        e = fma(splat(-contained), at(site.voltage, 2 * k), e)
        f = fma(splat(-contained), at(site.voltage, 2 * k + 1), f)
        g, b = at(site.admittance, 8 * k + 4), at(site.admittance, 8 * k + 5)
        real, imaginary = fma(-b, f, g * e), fma(b, e, g * f)
        active = fma(e_far, real, f_far * imaginary)
        reactive = fma(f_far, real, -e_far * imaginary)
        add_power(lane_flow, equations, far, active, reactive)
    active = fma(e1, real1, f1 * imaginary1) - load(site.demand, 0)
    reactive = fma(f1, real1, -e1 * imaginary1) - load(site.demand, 1)
    store(site.residual, 0, active * load(site.free, 0))
    store(site.residual, 1, reactive * load(site.free, 1))
    active = fma(e2, real2, f2 * imaginary2) - load(site.demand, 2)
    reactive = fma(f2, real2, -e2 * imaginary2) - load(site.demand, 3)
    store(site.residual, 2, active * load(site.free, 2))
    store(site.residual, 3, reactive * load(site.free, 3))


@borrowing_jit
def _write_norm(lane_flow: LaneFlow, equations: Equations, site: Site) -> None:
    total = square_step(lane_flow, equations)
    for k in range(4):
        value = load(site.residual, k)
        total = fma(value, value, total)
    store(lane_flow.norm, 0, root(total))


@borrowing_jit
def _invert_border(site: Site) -> None:
    """The Schur complement of the busbars' unknowns at their start, inverted by blocks."""
    for row in range(2):
        for column in range(2):
            for part in range(4):
                total = splat(0.0)
                for j in range(site.counts[N_LINES]):
                    inner = splat(0.0)
                    for k in range(site.counts[N_LINES]):
                        on = load(site.weight, site.element[k])
                        if column == 0:
                            on = splat(1.0) - on
                        inner = fma(on, at(site.coupling, (j * site.coupling.shape[1] + k) * 4 + part), inner)
                    on = load(site.weight, site.element[j])
                    if row == 0:
                        on = splat(1.0) - on
                    total = fma(on, inner, total)
                store(site.inverse, 4 * (2 * row + part // 2) + 2 * column + part % 2, -total)
    for busbar in range(2):
        _add_diagonal(site, busbar)
    for row in range(4):
        for column in range(4):
            place = 4 * row + column
            value = load(site.inverse, place) * load(site.free, row) * load(site.free, column)
            if row == column:
                value = value + (splat(1.0) - load(site.free, row))
            store(site.inverse, place, value)
    _invert(site.inverse)


@borrowing_jit
def _add_diagonal(site: Site, busbar: Index) -> None:
    """Derivatives of a busbar's power by its own voltage, at the start."""
    e, f = load(site.busbar, 2 * busbar), load(site.busbar, 2 * busbar + 1)
    square = fma(e, e, f * f)
    p_own, q_own = square * load(site.own, 2 * busbar), -square * load(site.own, 2 * busbar + 1)
    # What a busbar's equations do not hold (of a generator the reactive power) was left out of the residual.
    p = p_own
    q = q_own
    for k in range(site.counts[N_LINES]):
        on = load(site.weight, site.element[k])
        if busbar == 0:
            on = splat(1.0) - on
        p = fma(on, at(site.outward, 2 * k), p)
        q = fma(on, at(site.outward, 2 * k + 1), q)
    corner = 4 * (2 * busbar) + 2 * busbar
    store(site.inverse, corner, load(site.inverse, corner) + (q_own - q))
    store(site.inverse, corner + 1, load(site.inverse, corner + 1) + (p_own + p))
    store(site.inverse, corner + 4, load(site.inverse, corner + 4) + (p - p_own))
    store(site.inverse, corner + 5, load(site.inverse, corner + 5) + (q_own + q))


@borrowing_jit
def _invert(matrix: Lanes) -> None:
    """Replace a 4 x 4 matrix by its inverse, eliminating its first 2 x 2 block."""
    a, b, c, d = load(matrix, 0), load(matrix, 1), load(matrix, 4), load(matrix, 5)
    scale = splat(1.0) / (a * d - b * c)
    i00, i01, i10, i11 = d * scale, -b * scale, -c * scale, a * scale
    # right = inverse of A times B; left = C times inverse of A
    b0, b1, b2, b3 = load(matrix, 2), load(matrix, 3), load(matrix, 6), load(matrix, 7)
    r00, r01, r10, r11 = i00 * b0 + i01 * b2, i00 * b1 + i01 * b3, i10 * b0 + i11 * b2, i10 * b1 + i11 * b3
    c0, c1, c2, c3 = load(matrix, 8), load(matrix, 9), load(matrix, 12), load(matrix, 13)
    l00, l01, l10, l11 = c0 * i00 + c1 * i10, c0 * i01 + c1 * i11, c2 * i00 + c3 * i10, c2 * i01 + c3 * i11
    s00 = load(matrix, 10) - (c0 * r00 + c1 * r10)
    s01 = load(matrix, 11) - (c0 * r01 + c1 * r11)
    s10 = load(matrix, 14) - (c2 * r00 + c3 * r10)
    s11 = load(matrix, 15) - (c2 * r01 + c3 * r11)
    scale = splat(1.0) / (s00 * s11 - s01 * s10)
    t00, t01, t10, t11 = s11 * scale, -s01 * scale, -s10 * scale, s00 * scale
    u00, u01, u10, u11 = r00 * t00 + r01 * t10, r00 * t01 + r01 * t11, r10 * t00 + r11 * t10, r10 * t01 + r11 * t11
    store(matrix, 0, i00 + (u00 * l00 + u01 * l10))
    store(matrix, 1, i01 + (u00 * l01 + u01 * l11))
    store(matrix, 4, i10 + (u10 * l00 + u11 * l10))
    store(matrix, 5, i11 + (u10 * l01 + u11 * l11))
    store(matrix, 2, -u00)
    store(matrix, 3, -u01)
    store(matrix, 6, -u10)
    store(matrix, 7, -u11)
    store(matrix, 8, -(t00 * l00 + t01 * l10))
    store(matrix, 9, -(t00 * l01 + t01 * l11))
    store(matrix, 12, -(t10 * l00 + t11 * l10))
    store(matrix, 13, -(t10 * l01 + t11 * l11))
    store(matrix, 10, t00)
    store(matrix, 11, t01)
    store(matrix, 14, t10)
    store(matrix, 15, t11)


@borrowing_jit
def _solve_bordered(factors: Factors, paths: Paths, lane_flow: LaneFlow, site: Site) -> None:
    """Turn the mismatches of grid and busbars into Newton steps."""
    step, n_lines, n_free = lane_flow.step, site.counts[N_LINES], factors.n_free
    solve_forward(factors, factors.panel, step)
    p1 = load(site.residual, 0)
    q1 = load(site.residual, 1)
    p2 = load(site.residual, 2)
    q2 = load(site.residual, 3)
    for k in range(n_lines):
        if site.far[k] >= n_free:
            continue
        angle = growth = splat(0.0)
        base = k * paths.unknown.shape[1]
        for place in range(paths.size[k]):
            value = load(step, paths.unknown[k, place])
            angle = fma(at(paths.left, 2 * (base + place)), value, angle)
            growth = fma(at(paths.left, 2 * (base + place) + 1), value, growth)
        p, q = at(site.outward, 2 * k), at(site.outward, 2 * k + 1)
        active, reactive = fma(q, angle, p * growth), fma(q, growth, -p * angle)
        weight = load(site.weight, site.element[k])
        p2, q2 = p2 - weight * active, q2 - weight * reactive
        p1, q1 = p1 - (active - weight * active), q1 - (reactive - weight * reactive)
    p1, q1 = p1 * load(site.free, 0), q1 * load(site.free, 1)
    p2, q2 = p2 * load(site.free, 2), q2 * load(site.free, 3)
    for row in range(4):
        value = load(site.inverse, 4 * row) * p1
        value = fma(load(site.inverse, 4 * row + 1), q1, value)
        value = fma(load(site.inverse, 4 * row + 2), p2, value)
        value = fma(load(site.inverse, 4 * row + 3), q2, value)
        store(site.residual, row, value)
    angle1, growth1 = load(site.residual, 0), load(site.residual, 1)
    angle2, growth2 = load(site.residual, 2), load(site.residual, 3)
    for k in range(n_lines):
        if site.far[k] >= n_free:
            continue
        weight = load(site.weight, site.element[k])
        angle, growth = fma(weight, angle2 - angle1, angle1), fma(weight, growth2 - growth1, growth1)
        p, q = at(site.inward, 2 * k), at(site.inward, 2 * k + 1)
        active, reactive = fma(q, angle, p * growth), fma(q, growth, -p * angle)
        base = k * paths.unknown.shape[1]
        for place in range(paths.size[k]):
            unknown = paths.unknown[k, place]
            value = load(step, unknown)
            value = fma(-at(paths.right, 2 * (base + place)), active, value)
            value = fma(-at(paths.right, 2 * (base + place) + 1), reactive, value)
            store(step, unknown, value)
    solve_backward(factors, factors.panel, step)


@borrowing_jit
def _step_busbars(lane_flow: LaneFlow, site: Site) -> None:
    towards = -load(lane_flow.active, 0)
    for busbar in range(2):
        turn(
            site.busbar,
            2 * busbar,
            load(site.residual, 2 * busbar) * towards,
            load(site.residual, 2 * busbar + 1) * towards,
        )


@borrowing_jit
def _add_distance_of_busbars(lane_flow: LaneFlow, site: Site) -> None:
    """Busbars in use count as the rest of the grid does."""
    farthest = load(lane_flow.distance, 0)
    for busbar in range(2):
        change = squared_change(  # type: ignore[no-untyped-call]
            load(site.busbar, 2 * busbar),
            load(site.busbar, 2 * busbar + 1),
            at(site.start, 2 * busbar),
            at(site.start, 2 * busbar + 1),
        )
        farthest = larger(farthest, root(change) * load(site.free, 2 * busbar))
    store(lane_flow.distance, 0, farthest)


@borrowing_jit
def _write_loadings_here(network: Network, wiring: Wiring, lane_flow: LaneFlow, site: Site) -> None:
    """Squared loadings of the lines that end at the substation."""
    e1, f1, e2, f2 = load(site.busbar, 0), load(site.busbar, 1), load(site.busbar, 2), load(site.busbar, 3)
    for k in range(site.counts[N_LINES]):
        weight = load(site.weight, site.element[k])
        e, f = fma(weight, e2 - e1, e1), fma(weight, f2 - f1, f1)
        line, far = np.int64(site.line[k]), np.int64(site.far[k])
        e_far, f_far = load(lane_flow.voltage, 2 * far), load(lane_flow.voltage, 2 * far + 1)
        if site.begins[k] == 1:
            value = squared_loading(network, wiring.limit, line, e, f, e_far, f_far)
        else:
            value = squared_loading(network, wiring.limit, line, e_far, f_far, e, f)
        store(lane_flow.loading, line, value)
