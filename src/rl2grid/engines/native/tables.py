"""How compiled code finds the arrays of an engine: one address per structure.

Entry points take ``addresses``, int64 [6], of the tables of plant, network, state, memory, flow and opponent; see
:mod:`rl2grid.handles`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rl2grid.engines.native.memory import Memory, new_memory
from rl2grid.engines.native.plant import Plant, new_plant
from rl2grid.grids import Grid, OpponentConfig, load_grid
from rl2grid.handles import Table, layout_of, opener, table_of
from rl2grid.mdp.opponents import OpponentState, new_opponent_state
from rl2grid.mdp.state import GridState, new_state
from rl2grid.powerflow.ac import FlowState, new_flow_state
from rl2grid.powerflow.model import Network, load_network

Addresses = NDArray[np.int64]


@dataclass(frozen=True)
class Arrays:
    """All arrays of ``n`` environments, and the tables by which compiled code finds them."""

    plant: Plant
    network: Network
    state: GridState
    memory: Memory
    flow: FlowState
    opponent: OpponentState

    def tables(self) -> list[Table]:
        """One table per structure; keep them as long as their addresses are used."""
        parts: tuple[Any, ...] = (self.plant, self.network, self.state, self.memory, self.flow, self.opponent)
        return [table_of(part) for part in parts]


def new_arrays(grid: Grid, network: Network, n: int, opponent: bool, outages: int = 0) -> Arrays:
    """Blank arrays for ``n`` environments of ``grid``, with room for ``outages`` planned outages each."""
    attacked = grid if opponent else replace(grid, opponent=OpponentConfig("none"))
    return Arrays(
        new_plant(grid),
        network,
        new_state(grid, n),
        new_memory(grid, n, outages),
        new_flow_state(network, n),
        new_opponent_state(attacked, n),
    )


def addresses_of(tables: list[Table]) -> Addresses:
    """Where the tables lie, int64 [6]."""
    return np.array([table.ctypes.data for table in tables], np.int64)


# Layouts are the same for every grid: names, dtypes and axes.
_EXAMPLE = new_arrays(load_grid("bus14"), load_network(load_grid("bus14")), 1, opponent=False)
open_plant = opener("Plant", layout_of(_EXAMPLE.plant))
open_network = opener("Network", layout_of(_EXAMPLE.network))
open_state = opener("GridState", layout_of(_EXAMPLE.state))
open_memory = opener("Memory", layout_of(_EXAMPLE.memory))
open_flow = opener("FlowState", layout_of(_EXAMPLE.flow))
open_opponent = opener("OpponentState", layout_of(_EXAMPLE.opponent))
