"""The agent's topology action: whether it is legal, what it touches, and how it is merged into the topology.

Only what the project's actions can express; see :class:`rl2grid.mdp.actions.ActionKind`. Lines that an action
touches, and the substations, cool down afterwards even when nothing changed (Grid2Op's topological impact).
"""

from __future__ import annotations

import numpy as np

from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.mdp.actions import ActionKind, is_legal
from rl2grid.mdp.state import GridState

_MOVE, _SWITCH = int(ActionKind.MOVE), int(ActionKind.SWITCH)
_RECONNECT, _RESTORE = int(ActionKind.RECONNECT), int(ActionKind.RESTORE)


@jit
def act_on_topology(environments: Environments, i: int, kind: int, target: int, mask: int) -> None:
    """Merge a topology action into ``topo_vect``, or flag it as illegal and leave everything as it is."""
    state, hidden = environments.state, environments.hidden
    hidden.changed_line[i] = -1
    hidden.changed_sub[i] = -1
    state.illegal[i] = False
    state.ambiguous[i] = False
    if kind == _RESTORE and not _has_element_on_busbar_2(state, i, target):
        return
    if not is_legal(state, i, kind, target):
        state.illegal[i] = True
        return
    if kind == _MOVE:
        hidden.changed_sub[i] = target
        _move(state, i, target, mask)
    elif kind == _RESTORE:
        hidden.changed_sub[i] = target
        _restore(state, i, target)
    elif kind == _SWITCH:
        hidden.changed_line[i] = target
        _switch(environments, i, target)
    elif kind == _RECONNECT:
        hidden.changed_line[i] = target
        close_line(environments, i, target)


@jit
def open_line(state: GridState, i: int, line: int) -> None:
    """Take both ends of a line off their busbars."""
    state.topo_vect[i, state.line_or_pos_topo_vect[line]] = -1
    state.topo_vect[i, state.line_ex_pos_topo_vect[line]] = -1


@jit
def close_line(environments: Environments, i: int, line: int) -> None:
    """Bring each open end of a line back to the busbar it was on last."""
    state, hidden = environments.state, environments.hidden
    for position in (state.line_or_pos_topo_vect[line], state.line_ex_pos_topo_vect[line]):
        if state.topo_vect[i, position] < 0:
            state.topo_vect[i, position] = hidden.last_bus[i, position]


@jit
def remember_busbars(environments: Environments, i: int) -> None:
    """Note the busbar of every element that is on one."""
    state, hidden = environments.state, environments.hidden
    for element in range(state.topo_vect.shape[1]):
        if state.topo_vect[i, element] > 0:
            hidden.last_bus[i, element] = state.topo_vect[i, element]


@jit
def _has_element_on_busbar_2(state: GridState, i: int, sub: int) -> bool:
    first = state.sub_first_element[sub]
    busbars = state.topo_vect[i, first : first + state.sub_info[sub]]
    return bool(np.any(busbars == 2))


@jit
def _move(state: GridState, i: int, sub: int, mask: int) -> None:
    first = state.sub_first_element[sub]
    for k in range(state.sub_info[sub]):
        element = first + k
        # Elements that are off stay off.
        if mask >> k & 1 and state.topo_vect[i, element] > 0:
            state.topo_vect[i, element] = 3 - state.topo_vect[i, element]


@jit
def _restore(state: GridState, i: int, sub: int) -> None:
    first = state.sub_first_element[sub]
    for element in range(first, first + state.sub_info[sub]):
        if state.topo_vect[i, element] == 2:
            state.topo_vect[i, element] = 1


@jit
def _switch(environments: Environments, i: int, line: int) -> None:
    state = environments.state
    origin, extremity = state.line_or_pos_topo_vect[line], state.line_ex_pos_topo_vect[line]
    if state.topo_vect[i, origin] > 0 or state.topo_vect[i, extremity] > 0:
        open_line(state, i, line)
    else:
        close_line(environments, i, line)
