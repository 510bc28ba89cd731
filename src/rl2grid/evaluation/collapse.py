"""Where a grid was hurt when it collapsed: what the rows of lost episodes name."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.agents.dc_flow import connected_parts
from rl2grid.arrays import F32
from rl2grid.mdp.state import GridState

LIMIT = np.float32(1.0)


class Collapse(NamedTuple):
    """Ids in words, in order and separated by spaces; see :data:`rl2grid.records.episodes.COLUMNS`."""

    last_overloads: str = ""
    last_outages: str = ""
    last_cut_off: str = ""


COMPLETED = Collapse()
"""Nothing collapsed."""


def overloaded_lines(loading: F32) -> str:
    """Ids of the lines above their limit, of the loadings float32 [line]."""
    return _ids(loading > LIMIT)


def collapse(state: GridState, i: int, overloads: str) -> Collapse:
    """What the game over of row ``i`` left; ``overloads``: :func:`overloaded_lines` of the state before it."""
    topology = state.final_topo_vect[i]
    out = (topology[state.line_or_pos_topo_vect] < 0) | (topology[state.line_ex_pos_topo_vect] < 0)
    return Collapse(overloads, _ids(out), _ids(_cut_off(state, i)))


def _cut_off(state: GridState, i: int) -> NDArray[np.bool_]:
    """[sub] whether it has one of the :func:`lost_elements`."""
    return np.bincount(state.element_to_subid, lost_elements(state, i), len(state.sub_info)) > 0


def lost_elements(state: GridState, i: int) -> NDArray[np.bool_]:
    """[topo] loads and generators that the game over of row ``i`` left off, and whatever the balancing generator does
    not reach.

    A storage unit or the end of a line may be off.
    """
    topology, sub = state.final_topo_vect[i], state.element_to_subid
    n_sub = len(state.sub_info)
    busbar = np.where(topology > 0, sub + (topology - 1) * n_sub, -1)
    piece = connected_parts(busbar[state.line_or_pos_topo_vect], busbar[state.line_ex_pos_topo_vect], 2 * n_sub)
    balancing = busbar[state.gen_pos_topo_vect[state.slack_gen[0]]]
    apart = np.ones(len(topology), np.bool_) if balancing < 0 else piece[busbar] != piece[balancing]
    vital = np.zeros(len(topology), np.bool_)
    vital[state.load_pos_topo_vect] = vital[state.gen_pos_topo_vect] = True
    return np.where(busbar < 0, vital, apart)


def _ids(flags: NDArray[np.bool_]) -> str:
    return " ".join(map(str, np.flatnonzero(flags).tolist()))
