"""Everything that an engine works with, as one value: compiled code is handed its address and passes it on."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from rl2grid.engines.native.action_notes import ActionNotes, new_action_notes
from rl2grid.engines.native.constants import GridConstants, new_constants
from rl2grid.engines.native.hidden_state import HiddenState, new_hidden_state
from rl2grid.engines.native.orders import Orders, new_orders
from rl2grid.grids import Grid, OpponentConfig
from rl2grid.handles import opener
from rl2grid.mdp.opponents import OpponentState, new_opponent_state
from rl2grid.mdp.state import GridState, new_state
from rl2grid.powerflow.ac import FlowState, new_flow_state
from rl2grid.powerflow.cold_lanes import Union, new_union
from rl2grid.powerflow.flow_lanes import FlowLanes, new_flow_lanes
from rl2grid.powerflow.model import Network
from rl2grid.separate_code import Separate, separate_jit


class Environments(NamedTuple):
    """All arrays of ``n`` environments of one grid.

    Compiled functions take it as ``environments`` (a handle, see :mod:`rl2grid.handles`) and the row ``i`` that they
    work on; those that look at nothing but the state take ``(state, i)``, as the functions of :mod:`rl2grid.mdp` do.
    """

    constants: GridConstants
    network: Network
    state: GridState
    hidden: HiddenState
    flow: FlowState
    lanes: FlowLanes
    union: Union
    opponent: OpponentState
    orders: Orders
    notes: ActionNotes


def new_environments(grid: Grid, network: Network, n: int, opponent: bool, outages: int = 0) -> Environments:
    """Blank arrays for ``n`` environments of ``grid``, with room for ``outages`` planned outages each."""
    flow = new_flow_state(network, n)
    attacked = grid if opponent else replace(grid, opponent=OpponentConfig("none"))
    return Environments(
        new_constants(grid),
        network,
        new_state(grid, n),
        new_hidden_state(grid, n, outages),
        flow,
        new_flow_lanes(flow),
        new_union(flow),
        new_opponent_state(attacked, n),
        new_orders(grid, n),
        new_action_notes(grid, n),
    )


open_environments = opener(Environments)
"""From the address of a handle to the environments, in compiled code."""
SEPARATE: list[Separate] = []
"""What ``separate`` has decorated; an engine makes it ready before it plays."""
separate = separate_jit(Environments, SEPARATE)
"""Compiles a function of environments and a number that returns an integer by itself, for compiled callers."""
