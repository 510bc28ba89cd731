"""The order in which buses are eliminated: chosen once per grid, kept for every topology."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rl2grid.powerflow.model import Network


def elimination_order(network: Network) -> NDArray[np.int32]:
    """Buses by minimum degree on the topology with every element on busbar 1, int32 [bus].

    Busbar 2 follows busbar 1 of its substation; the substation of the slack generator comes last.
    """
    n_sub = len(network.nominal_voltage)
    neighbours, unknowns = _neighbours(network), _unknowns(network)
    slack = _slack_sub(network)
    left = set(range(n_sub)) - {slack}
    order = []
    while left:
        sub = min(left, key=lambda each: (sum(unknowns[other] for other in neighbours[each]), each))
        left.remove(sub)
        order.append(sub)
        _eliminate(neighbours, sub)
    order.append(slack)
    return np.array([bus for sub in order for bus in (sub, sub + n_sub)], np.int32)


def reference_fill(network: Network, order: NDArray[np.int32]) -> tuple[int, int]:
    """Columns and values that the factors need with every element on busbar 1."""
    neighbours, unknowns = _neighbours(network), _unknowns(network)
    columns = values = 0
    for bus in order[:-2:2].tolist():
        own, after = unknowns[bus], sum(unknowns[other] for other in neighbours[bus])
        columns += own + after + own * len(neighbours[bus])
        values += own * (own + 2 * after)
        _eliminate(neighbours, bus)
    return columns, values


def _eliminate(neighbours: list[set[int]], sub: int) -> None:
    """Connect the neighbours of ``sub`` with each other and take it out."""
    for other in neighbours[sub]:
        neighbours[other] |= neighbours[sub]
        neighbours[other] -= {sub, other}


def _neighbours(network: Network) -> list[set[int]]:
    """Substations that lines connect with each substation, the slack substation left out."""
    slack = _slack_sub(network)
    neighbours: list[set[int]] = [set() for _ in network.nominal_voltage]
    for origin, extremity in zip(network.line_or_sub.tolist(), network.line_ex_sub.tolist(), strict=True):
        if slack not in (origin, extremity) and origin != extremity:
            neighbours[origin].add(extremity)
            neighbours[extremity].add(origin)
    return neighbours


def _slack_sub(network: Network) -> int:
    return int(network.gen_sub[network.slack_gen[0]])


def _unknowns(network: Network) -> list[int]:
    """Unknowns of each substation: its angle, and its magnitude where no generator holds it."""
    with_generator = set(network.gen_sub.tolist())
    return [1 if sub in with_generator else 2 for sub in range(len(network.nominal_voltage))]
