"""The agent's changes of lines and substations: whether they are legal, and how they are merged into the topology.

Lines and substations that an action touches cool down afterwards, even where nothing changed; see
:mod:`rl2grid.mdp.legality`.
"""

from __future__ import annotations

from rl2grid.compile import jit
from rl2grid.engines.native.environments import Environments
from rl2grid.engines.native.hidden_state import HiddenState
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.legality import AMBIGUOUS, LEGAL, has_element, judge
from rl2grid.mdp.state import GridState

_MOVE, _SWITCH = int(ActionKind.MOVE), int(ActionKind.SWITCH)
_RECONNECT, _RESTORE = int(ActionKind.RECONNECT), int(ActionKind.RESTORE)


@jit
def judge_order(environments: Environments, i: int) -> bool:
    """Whether the rules allow the action that row ``i`` is to play; flags it if they do not."""
    state, orders = environments.state, environments.orders
    if orders.n_changes[i] == 0:
        orders.verdict[i], orders.verdict_target[i], orders.verdict_left[i] = LEGAL, -1, 0
        state.ambiguous[i], state.illegal[i] = False, False
        return True
    verdict, target, left = judge(
        state, i, orders.n_changes[i], orders.kind[i], orders.target[i], orders.mask[i], orders.touches[i]
    )
    orders.verdict[i], orders.verdict_target[i], orders.verdict_left[i] = verdict, target, left
    state.ambiguous[i] = verdict == AMBIGUOUS
    state.illegal[i] = verdict not in (LEGAL, AMBIGUOUS)
    return bool(verdict == LEGAL)


@jit
def touch_nothing(hidden: HiddenState, i: int) -> None:
    """No line and no substation cools down because of what row ``i`` plays."""
    hidden.touched_line[i] = False
    hidden.touched_sub[i] = False


@jit
def merge_topology(environments: Environments, i: int) -> None:
    """Merge the changes of a legal action into ``topo_vect``, in Grid2Op's order: lines, moves, restorations."""
    orders, hidden = environments.orders, environments.hidden
    for k in range(orders.n_changes[i]):
        kind, target = orders.kind[i, k], orders.target[i, k]
        if kind == _SWITCH:
            _switch(environments, i, target)
        elif kind == _RECONNECT:
            close_line(environments, i, target)
        if orders.touches[i, k]:
            if kind in (_SWITCH, _RECONNECT):
                hidden.touched_line[i, target] = True
            else:
                hidden.touched_sub[i, target] = True
    for k in range(orders.n_changes[i]):
        if orders.kind[i, k] == _MOVE:
            _move(environments, i, k)
    for k in range(orders.n_changes[i]):
        if orders.kind[i, k] == _RESTORE:
            _restore(environments, i, k)


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
    busbar, last_bus = environments.state.topo_vect[i], environments.hidden.last_bus[i]
    for element in range(busbar.shape[0]):
        last_bus[element] = busbar[element] if busbar[element] > 0 else last_bus[element]


@jit
def _move(environments: Environments, i: int, k: int) -> None:
    state, orders = environments.state, environments.orders
    sub = orders.target[i, k]
    first = state.sub_first_element[sub]
    for element in range(first, first + state.sub_info[sub]):
        # Elements that are off stay off.
        if has_element(orders.mask[i, k], element - first) and state.topo_vect[i, element] > 0:
            state.topo_vect[i, element] = 3 - state.topo_vect[i, element]


@jit
def _restore(environments: Environments, i: int, k: int) -> None:
    """Bring the elements that were on busbar 2 to busbar 1; a line opened since they were is closed by that."""
    state, orders = environments.state, environments.orders
    sub = orders.target[i, k]
    first = state.sub_first_element[sub]
    for element in range(first, first + state.sub_info[sub]):
        if not has_element(orders.mask[i, k], element - first):
            continue
        is_open = state.topo_vect[i, element] < 0
        state.topo_vect[i, element] = 1
        if is_open:
            _close_line_of(environments, i, element)


@jit
def _close_line_of(environments: Environments, i: int, element: int) -> None:
    state = environments.state
    for line in range(state.line_or_pos_topo_vect.shape[0]):
        if state.line_or_pos_topo_vect[line] == element or state.line_ex_pos_topo_vect[line] == element:
            close_line(environments, i, line)


@jit
def _switch(environments: Environments, i: int, line: int) -> None:
    state = environments.state
    origin, extremity = state.line_or_pos_topo_vect[line], state.line_ex_pos_topo_vect[line]
    if state.topo_vect[i, origin] > 0 or state.topo_vect[i, extremity] > 0:
        open_line(state, i, line)
    else:
        close_line(environments, i, line)
