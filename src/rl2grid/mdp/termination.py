"""Why an episode was lost, derived from the topology with which the grid collapsed.

Both engines ask :func:`game_over_reason`, so that a reason never depends on how a solver happens to fail.
"""

from __future__ import annotations

import enum

import numpy as np

from rl2grid.arrays import I32
from rl2grid.compile import jit
from rl2grid.mdp.state import GridState


class GameOver(enum.IntEnum):
    """Why an episode was lost; where several reasons hold, the first in this order counts."""

    NONE = 0
    """The episode is not lost."""
    LOAD_DISCONNECTED = 1
    """A load is off, or on a busbar without any closed line."""
    GENERATOR_DISCONNECTED = 2
    """A generator is off, or on a busbar without any closed line."""
    STORAGE_DISCONNECTED = 3
    """A storage unit in use (power not 0) is off, or on a busbar without any closed line."""
    ISLAND = 4
    """A busbar with at least one element is not connected to the generator that balances the grid."""
    DIVERGENCE = 5
    """The grid is in one piece, but no power flow was found."""
    DISPATCH = 6
    """The generators cannot make up for a change of storage or curtailment; the engine notes it, no flow is run."""


GAME_OVER_TEXT: dict[GameOver, str] = {
    GameOver.NONE: "the episode is not lost",
    GameOver.LOAD_DISCONNECTED: "a load was cut off from the grid",
    GameOver.GENERATOR_DISCONNECTED: "a generator was cut off from the grid",
    GameOver.STORAGE_DISCONNECTED: "a storage unit in use was cut off from the grid",
    GameOver.ISLAND: "the grid fell into several pieces",
    GameOver.DIVERGENCE: "no power flow exists that meets the demand (voltage collapse)",
    GameOver.DISPATCH: "the generators could not balance the grid within their limits",
}
"""Each reason in words."""

_LOAD = int(GameOver.LOAD_DISCONNECTED)
_GENERATOR = int(GameOver.GENERATOR_DISCONNECTED)
_STORAGE = int(GameOver.STORAGE_DISCONNECTED)
_ISLAND = int(GameOver.ISLAND)
_DIVERGENCE = int(GameOver.DIVERGENCE)


@jit
def game_over_reason(state: GridState, i: int) -> int:
    """The :class:`GameOver` of row ``i``, whose power flow failed.

    Reads ``final_topo_vect`` and ``storage_power``: the engine calls it with the storage power of the
    lost step still in place, before it blanks the observation. A failed dispatch is the engine's to note
    (``DISPATCH``); then this function is not asked.
    """
    topology = state.final_topo_vect[i]
    busbar = _busbars(topology, state.element_to_subid, state.sub_info.shape[0])
    parent, fed = _connect(busbar, state.line_or_pos_topo_vect, state.line_ex_pos_topo_vect, state.sub_info.shape[0])
    for load in range(state.load_pos_topo_vect.shape[0]):
        if _is_cut_off(busbar[state.load_pos_topo_vect[load]], fed):
            return _LOAD
    for gen in range(state.gen_pos_topo_vect.shape[0]):
        if _is_cut_off(busbar[state.gen_pos_topo_vect[gen]], fed):
            return _GENERATOR
    for unit in range(state.storage_pos_topo_vect.shape[0]):
        in_use = state.storage_power[i, unit] != 0
        if in_use and _is_cut_off(busbar[state.storage_pos_topo_vect[unit]], fed):
            return _STORAGE
    main = _root(parent, busbar[state.gen_pos_topo_vect[state.slack_gen[0]]])
    for element in range(busbar.shape[0]):
        if busbar[element] >= 0 and _root(parent, busbar[element]) != main:
            return _ISLAND
    return _DIVERGENCE


@jit
def _busbars(topology: I32, element_to_subid: I32, n_sub: int) -> I32:
    """Number of the busbar of each element, int32 [topo]; -1 for one that is off."""
    busbar = np.empty(topology.shape[0], np.int32)
    for element in range(topology.shape[0]):
        on = topology[element] > 0
        busbar[element] = element_to_subid[element] + (topology[element] - 1) * n_sub if on else -1
    return busbar


@jit
def _connect(busbar: I32, line_or: I32, line_ex: I32, n_sub: int) -> tuple[I32, I32]:
    """Union-find parents of the busbars, and whether a closed line ends on each (0 or 1)."""
    parent = np.arange(2 * n_sub).astype(np.int32)
    fed = np.zeros(2 * n_sub, np.int32)
    for line in range(line_or.shape[0]):
        origin, extremity = busbar[line_or[line]], busbar[line_ex[line]]
        if origin < 0 or extremity < 0:
            continue
        fed[origin] = 1
        fed[extremity] = 1
        parent[_root(parent, origin)] = _root(parent, extremity)
    return parent, fed


@jit
def _root(parent: I32, busbar: int) -> int:
    while parent[busbar] != busbar:
        parent[busbar] = parent[parent[busbar]]
        busbar = parent[busbar]
    return busbar


@jit
def _is_cut_off(busbar: int, fed: I32) -> bool:
    return busbar < 0 or fed[busbar] == 0
