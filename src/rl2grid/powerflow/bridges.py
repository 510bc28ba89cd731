"""Lines whose loss cuts a grid in two."""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import I32, Flags
from rl2grid.powerflow.model import Network


def find_bridges(network: Network, topo_vect: I32) -> Flags:
    """Which closed lines are the only way between their ends, bool [line].

    Args:
        network: electrical model of the grid.
        topo_vect: int32 [topo] busbar (1 or 2) of each element, -1 when disconnected.
    """
    ways = _ways(network, topo_vect)
    bridge = np.zeros(len(network.line_or_sub), np.bool_)
    order: dict[int, int] = {}
    lowest: dict[int, int] = {}
    for root in ways:
        if root in order:
            continue
        order[root] = lowest[root] = len(order)
        path = [(root, -1, iter(ways[root]))]
        while path:
            bus, line_here, rest = path[-1]
            for line, other in rest:
                if line == line_here:
                    continue
                if other not in order:
                    order[other] = lowest[other] = len(order)
                    path.append((other, line, iter(ways[other])))
                    break
                lowest[bus] = min(lowest[bus], order[other])
            else:
                path.pop()
                if path:
                    before = path[-1][0]
                    lowest[before] = min(lowest[before], lowest[bus])
                    bridge[line_here] = lowest[bus] > order[before]
    return bridge


def find_cuts(network: Network, topo_vect: I32) -> Flags:
    """Which bridges hold elements on both sides, bool [line]: without such a line there is no flow.

    The bus that any other bridge leaves behind is empty, and no bus then.

    Args:
        network: electrical model of the grid.
        topo_vect: int32 [topo] busbar (1 or 2) of each element, -1 when disconnected.
    """
    n_sub = len(network.nominal_voltage)
    ends = network.line_or_sub, network.line_ex_sub
    places = network.line_or_position, network.line_ex_position
    subs = np.concatenate((*ends, network.gen_sub, network.load_sub, network.storage_sub))
    busbars = topo_vect[
        np.concatenate((*places, network.gen_position, network.load_position, network.storage_position))
    ]
    buses = np.concatenate(((subs + n_sub * (busbars - 1))[busbars > 0], network.shunt_sub))
    held = np.bincount(buses, minlength=2 * n_sub)
    alone = [
        held[sub + n_sub * (np.maximum(topo_vect[place], 1) - 1)] == 1 for sub, place in zip(ends, places, strict=True)
    ]
    cuts: Flags = find_bridges(network, topo_vect) & ~(alone[0] | alone[1])
    return cuts


def _ways(network: Network, topo_vect: I32) -> dict[int, list[tuple[int, int]]]:
    """Closed lines at each bus, and the bus at the other end."""
    n_sub = len(network.nominal_voltage)
    origins, extremities = topo_vect[network.line_or_position], topo_vect[network.line_ex_position]
    ways: dict[int, list[tuple[int, int]]] = {}
    for line in np.flatnonzero((origins > 0) & (extremities > 0)).tolist():
        origin = int(network.line_or_sub[line] + n_sub * (origins[line] - 1))
        extremity = int(network.line_ex_sub[line] + n_sub * (extremities[line] - 1))
        ways.setdefault(origin, []).append((line, extremity))
        ways.setdefault(extremity, []).append((line, origin))
    return ways
