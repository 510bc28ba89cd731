"""From a topology vector to nodes, admittance matrix and the pattern of the Jacobian's factors."""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F64, I32, U16, U32, U64, Index
from rl2grid.compile import borrowing_jit
from rl2grid.powerflow.bits import count_bits, lowest_bit
from rl2grid.powerflow.flow_state import ABSENT, FlowState
from rl2grid.powerflow.model import Network

_ONE = np.uint64(1)
ADJACENT, _LOWER, _UPPER = 0, 1, 2
"""Sets of each node: joined by a line (itself included); filled columns before and after the diagonal."""


@borrowing_jit
def is_same_topology(kept: I32, topo_vect: I32) -> bool:
    """Whether two topology vectors are equal (without an early exit, so that it runs in SIMD)."""
    difference = np.int32(0)
    for k in range(kept.shape[0]):
        difference |= kept[k] ^ topo_vect[k]
    return bool(difference == 0)


@borrowing_jit
def remember_topology(kept: I32, topo_vect: I32) -> None:
    """Copy a topology vector."""
    for k in range(kept.shape[0]):
        kept[k] = topo_vect[k]


@borrowing_jit
def build_nodes(network: Network, flow: FlowState, i: int, topo_vect: I32) -> bool:
    """Number the buses in use and build the admittance matrix of row ``i``.

    Returns:
        False if a load or generator is disconnected or a bus is not connected to the slack generator's;
        the matrix is then not built.
    """
    if not _place_elements(network, flow, i, topo_vect):
        return False
    _number_nodes(network, flow, i)
    n_node = np.int64(flow.n_node[i])
    adjacent = flow.sets[ADJACENT]
    _join_nodes(flow.line_or_node[i], flow.line_ex_node[i], n_node, adjacent)
    if not _is_connected(n_node, adjacent, flow.sets[_LOWER], flow.diagonal_entry[i]):
        return False
    _join_open_lines(network, flow, i, topo_vect, adjacent)
    _fill_admittance(network, flow, i, adjacent)
    return True


@borrowing_jit
def _place_elements(network: Network, flow: FlowState, i: int, topo_vect: I32) -> bool:
    """Write the bus of every element where its node will be, and mark in ``diagonal_entry`` what a bus holds.

    A mark is 0 for an empty bus, 1 for a bus whose voltage a generator holds, 2 for any other.
    """
    n_sub = network.nominal_voltage.shape[0]
    mark = flow.diagonal_entry[i]
    for bus in range(mark.shape[0]):
        mark[bus] = 0
    line_or, line_ex = flow.line_or_node[i], flow.line_ex_node[i]
    for line in range(line_or.shape[0]):
        origin = topo_vect[network.line_or_position[line]]
        extremity = topo_vect[network.line_ex_position[line]]
        if origin < 1 or extremity < 1:
            line_or[line] = ABSENT
            line_ex[line] = ABSENT
            continue
        line_or[line] = _bus(network.line_or_sub[line], origin, n_sub)
        line_ex[line] = _bus(network.line_ex_sub[line], extremity, n_sub)
        mark[line_or[line]] = 2
        mark[line_ex[line]] = 2
    load_node = flow.load_node[i]
    for load in range(load_node.shape[0]):
        busbar = topo_vect[network.load_position[load]]
        if busbar < 1:
            return False
        load_node[load] = _bus(network.load_sub[load], busbar, n_sub)
        mark[load_node[load]] = 2
    storage_node = flow.storage_node[i]
    for storage in range(storage_node.shape[0]):
        busbar = topo_vect[network.storage_position[storage]]
        if busbar < 1:
            storage_node[storage] = ABSENT
            continue
        storage_node[storage] = _bus(network.storage_sub[storage], busbar, n_sub)
        mark[storage_node[storage]] = 2
    for shunt in range(network.shunt_sub.shape[0]):
        mark[np.uint16(network.shunt_sub[shunt])] = 2
    gen_node = flow.gen_node[i]
    for gen in range(gen_node.shape[0]):
        busbar = topo_vect[network.gen_position[gen]]
        if busbar < 1:
            return False
        gen_node[gen] = _bus(network.gen_sub[gen], busbar, n_sub)
        mark[gen_node[gen]] = 1
    return True


@borrowing_jit
def _bus(sub: Index, busbar: Index, n_sub: Index) -> np.uint16:
    return np.uint16(sub if busbar == 1 else sub + n_sub)


@borrowing_jit
def _number_nodes(network: Network, flow: FlowState, i: int) -> None:
    """Number the buses in use in elimination order, and turn the bus of every element into its node."""
    node_of_bus, mark = flow.node_of_bus[i], flow.diagonal_entry[i]
    first_unknown, node_of_unknown = flow.first_unknown[i], flow.node_of_unknown[i]
    slack = flow.gen_node[i, network.slack_gen[0]]
    node = unknown = 0
    for k in range(flow.order.shape[0]):
        bus = np.uint16(flow.order[k])
        node_of_bus[bus] = ABSENT
        if mark[bus] == 0 or bus == slack:
            continue
        node_of_bus[bus] = node
        first_unknown[node] = unknown
        for _ in range(mark[bus]):
            node_of_unknown[unknown] = node
            unknown += 1
        node += 1
    node_of_bus[slack] = node
    first_unknown[node] = unknown
    flow.n_node[i] = node + 1
    _rename(node_of_bus, flow.line_or_node[i])
    _rename(node_of_bus, flow.line_ex_node[i])
    _rename(node_of_bus, flow.load_node[i])
    _rename(node_of_bus, flow.storage_node[i])
    _rename(node_of_bus, flow.gen_node[i])


@borrowing_jit
def _rename(node_of_bus: U16, place: U16) -> None:
    for k in range(place.shape[0]):
        if place[k] != ABSENT:
            place[k] = node_of_bus[place[k]]


@borrowing_jit
def join_themselves(n_node: Index, adjacent: U64) -> None:
    """Let each of the first nodes have no neighbour but itself."""
    for node in range(n_node):
        for word in range(adjacent.shape[1]):
            adjacent[node, word] = 0
        insert(adjacent, node, node)


@borrowing_jit
def _join_nodes(line_or: U16, line_ex: U16, n_node: Index, adjacent: U64) -> None:
    join_themselves(n_node, adjacent)
    for line in range(line_or.shape[0]):
        if line_or[line] != ABSENT:
            insert(adjacent, line_or[line], line_ex[line])
            insert(adjacent, line_ex[line], line_or[line])


@borrowing_jit
def _join_open_lines(network: Network, flow: FlowState, i: int, topo_vect: I32, adjacent: U64) -> None:
    """Make room in the matrices for open lines, and write the pattern."""
    pattern = flow.pattern[i]
    remember_topology(pattern, topo_vect)
    line_or = flow.line_or_node[i]
    for line in range(line_or.shape[0]):
        if line_or[line] != ABSENT:
            continue
        origin, extremity = ends_on_first(network, flow, i, line)
        pattern[network.line_or_position[line]] = -1 if origin == ABSENT else 1
        pattern[network.line_ex_position[line]] = -1 if extremity == ABSENT else 1
        if origin != ABSENT and extremity != ABSENT:
            insert(adjacent, origin, extremity)
            insert(adjacent, extremity, origin)


@borrowing_jit
def ends_on_first(network: Network, flow: FlowState, i: Index, line: Index) -> tuple[np.uint16, np.uint16]:
    """The nodes of row ``i`` that are busbar 1 at the ends of a line, each ABSENT if nothing is connected to it."""
    node_of_bus = flow.node_of_bus[i]
    return node_of_bus[network.line_or_sub[line]], node_of_bus[network.line_ex_sub[line]]


@borrowing_jit
def is_joined(admittance: F64, entry: Index) -> bool:
    """Whether closed lines lead where an entry of the admittance matrix, float64 [entry, 2], has room for them."""
    return bool(admittance[entry, 0] != 0.0 or admittance[entry, 1] != 0.0)


@borrowing_jit
def insert(sets: U64, k: Index, node: Index) -> None:
    """Add a node to set ``k``."""
    sets[k, node >> 6] |= _ONE << np.uint64(node & 63)


@borrowing_jit
def _below(node: Index) -> np.uint64:
    """The members before ``node`` of its word."""
    return (_ONE << np.uint64(node & 63)) - _ONE


@borrowing_jit
def _is_connected(n_node: Index, adjacent: U64, reached: U64, queue: U16) -> bool:
    """Whether every node is reached from the slack's, the last one; the last two arguments are workspace."""
    slack = n_node - 1
    words = adjacent.shape[1]
    for word in range(words):
        reached[0, word] = 0
    insert(reached, 0, slack)
    queue[0] = slack
    n_reached, visited = 1, 0
    while visited < n_reached:
        node = queue[visited]
        visited += 1
        for word in range(words):
            new = adjacent[node, word] & ~reached[0, word]
            reached[0, word] |= new
            while new != 0:
                queue[n_reached] = 64 * word + lowest_bit(new)
                n_reached += 1
                new &= new - _ONE
    return n_reached == n_node


@borrowing_jit
def _entry(first: U16, adjacent: U64, row: Index, node: Index) -> np.int64:
    """Where ``node`` is in row ``row`` of the admittance matrix."""
    home = np.int64(node) >> 6
    entry = np.int64(first[row]) + count_bits(adjacent[row, home] & _below(node))
    for word in range(home):
        entry += count_bits(adjacent[row, word])
    return np.int64(entry)


@borrowing_jit
def write_entries(n_node: np.int64, adjacent: U64, first: U16, columns: U16, diagonal: U16) -> np.int64:
    """Write where the entries of an admittance matrix are; how many it has."""
    entry = np.int64(0)
    for node in range(n_node):
        first[node] = entry
        for word in range(adjacent.shape[1]):
            rest = adjacent[node, word]
            while rest != 0:
                other = 64 * word + lowest_bit(rest)
                rest &= rest - _ONE
                if other == node:
                    diagonal[node] = entry
                columns[entry] = other
                entry += 1
    first[n_node] = entry
    return entry


@borrowing_jit
def _fill_admittance(network: Network, flow: FlowState, i: int, adjacent: U64) -> None:
    first, columns, values = flow.admittance_first[i], flow.admittance_node[i], flow.admittance[i]
    diagonal = flow.diagonal_entry[i]
    for entry in range(write_entries(np.int64(flow.n_node[i]), adjacent, first, columns, diagonal)):
        values[entry, 0] = 0.0
        values[entry, 1] = 0.0
    line_or, line_ex, line_entry = flow.line_or_node[i], flow.line_ex_node[i], flow.line_entry[i]
    for line in range(line_or.shape[0]):
        origin, extremity = line_or[line], line_ex[line]
        if origin == ABSENT:
            continue
        line_entry[line, 0] = _entry(first, adjacent, origin, extremity)
        line_entry[line, 1] = _entry(first, adjacent, extremity, origin)
        for part in range(2):
            values[diagonal[origin], part] += network.line_admittance[line, part]
            values[line_entry[line, 0], part] += network.line_admittance[line, 2 + part]
            values[line_entry[line, 1], part] += network.line_admittance[line, 4 + part]
            values[diagonal[extremity], part] += network.line_admittance[line, 6 + part]
    for shunt in range(network.shunt_sub.shape[0]):
        entry_here = diagonal[flow.node_of_bus[i, network.shunt_sub[shunt]]]
        values[entry_here, 0] += network.shunt_admittance[shunt, 0]
        values[entry_here, 1] += network.shunt_admittance[shunt, 1]


@borrowing_jit
def measure_pattern(flow: FlowState, i: int) -> tuple[np.int64, np.int64]:
    """Find the fill of the factors of row ``i``; how many columns and values they have."""
    n_free = np.int64(flow.n_node[i]) - 1
    return measure_fill(n_free, flow.first_unknown[i], flow.sets, flow.first_column[i], flow.first_panel[i])


@borrowing_jit
def measure_fill(
    n_free: np.int64, first_unknown: U16, sets: U64, first_column: U32, first_panel: U32
) -> tuple[np.int64, np.int64]:
    """Find the fill of the factors of a matrix, whose nodes' neighbours are in ``sets``; arrays as in ``FlowState``.

    Returns:
        How many columns and values the factors have.
    """
    adjacent, lower, upper = sets[ADJACENT], sets[_LOWER], sets[_UPPER]
    words = adjacent.shape[1]
    for node in range(n_free):
        for word in range(words):
            upper[node, word] = 0
            lower[node, word] = 0
    for node in range(n_free):
        _eliminate(node, n_free, adjacent, upper)
        for word in range(words):
            rest = upper[node, word]
            while rest != 0:
                insert(lower, 64 * word + lowest_bit(rest), node)
                rest &= rest - _ONE
    pairs = n_free  # the slack's set is free
    for word in range(words):
        upper[pairs, word] = 0
    for node in range(n_free):
        if first_unknown[node + 1] - first_unknown[node] == 2:
            insert(upper, pairs, node)
    columns = values = np.int64(0)
    for node in range(n_free):
        first_column[node] = columns
        first_panel[node] = values
        size = np.int64(first_unknown[node + 1]) - np.int64(first_unknown[node])
        width = size
        for word in range(words):
            both = lower[node, word] | upper[node, word]
            width += count_bits(both) + count_bits(both & upper[pairs, word])
        columns += width
        values += size * width
    first_column[n_free] = columns
    first_panel[n_free] = values
    return columns, values


@borrowing_jit
def _eliminate(node: Index, n_free: Index, adjacent: U64, upper: U64) -> None:
    """Complete the columns after ``node``, and hand them on to the first of them.

    What ``upper`` holds so far came from nodes eliminated before. This is the elimination tree's way to find
    the fill (Liu, The role of elimination trees in sparse factorization, 1990).
    """
    here, last = node >> 6, n_free >> 6
    parent = -1
    for word in range(here, adjacent.shape[1]):
        members = upper[node, word] | adjacent[node, word]
        if word == here:
            members &= ~(_below(node) | _ONE << np.uint64(node & 63))
        if word == last:
            members &= _below(n_free)
        if word > last:
            members = np.uint64(0)
        upper[node, word] = members
        if members == 0:
            continue
        if parent < 0:
            parent = 64 * word + lowest_bit(members)
            members &= members - _ONE
        upper[parent, word] |= members


@borrowing_jit
def write_pattern(flow: FlowState, i: int, column: U16) -> None:
    """Write the columns of the factors of row ``i`` and where the Jacobian's blocks go."""
    n_free = np.int64(flow.n_node[i]) - 1
    write_fill(
        n_free, flow.first_unknown[i], flow.sets, flow.first_column[i], flow.own_column[i], flow.first_panel[i],
        flow.own_panel[i], flow.admittance_first[i], flow.admittance_node[i], flow.admittance_panel[i], column,
    )  # fmt: skip


@borrowing_jit
def write_fill(
    n_free: np.int64,
    first_unknown: U16,
    sets: U64,
    first_column: U32,
    own_column: U32,
    first_panel: U32,
    own_panel: U32,
    entry_first: U16,
    entry_node: U16,
    entry_panel: U32,
    column: U16,
) -> None:
    """Write the columns of factors that :func:`measure_fill` has measured, and where the Jacobian's blocks go."""
    lower, upper = sets[_LOWER], sets[_UPPER]
    place = sets[ADJACENT]  # no longer needed: now where each node's columns are
    for node in range(n_free):
        at = _write_columns(lower, node, np.int64(first_column[node]), first_unknown, column, place)
        size = np.int64(first_unknown[node + 1]) - np.int64(first_unknown[node])
        own_column[node] = at
        own_panel[node] = np.int64(first_panel[node]) + size * (at - np.int64(first_column[node]))
        place[node, 0] = at
        for unknown in range(first_unknown[node], first_unknown[node + 1]):
            column[at] = unknown
            at += 1
        _write_columns(upper, node, at, first_unknown, column, place)
        for entry in range(entry_first[node], entry_first[node + 1]):
            if entry_node[entry] < n_free:
                offset = np.int64(place[entry_node[entry], 0]) - np.int64(first_column[node])
                entry_panel[entry] = np.int64(first_panel[node]) + size * offset


@borrowing_jit
def _write_columns(sets: U64, k: Index, at: np.int64, first_unknown: U16, column: U16, place: U64) -> np.int64:
    """Write the unknowns of the nodes of set ``k`` from ``at`` on; where they end."""
    for word in range(sets.shape[1]):
        rest = sets[k, word]
        while rest != 0:
            node = 64 * word + lowest_bit(rest)
            rest &= rest - _ONE
            place[node, 0] = at
            for unknown in range(first_unknown[node], first_unknown[node + 1]):
                column[at] = unknown
                at += 1
    return at
