"""What the grid does on its own while it is safe (paper, Section 3.2).

*Idle* does nothing. *Recovery* brings the grid back to its reference, one thing per step and without
looking ahead: :func:`recovery_action` on topology tasks, :func:`reconnect_action` on redispatching tasks.

*Careful* is not in the paper. It tries what recovery would do, and the rest of it in the same order, on the forecast
for the next step, and plays the first that keeps the grid safe. It leaves a substation split while a line is out that
was out when the agent split it: undone too early, a split cannot be made again before the substation's cooldown is
over, and the line that it relieves may trip by then. The engines ask :func:`careful_candidate` what to try.
"""

from __future__ import annotations

import numpy as np

from rl2grid.arrays import F32
from rl2grid.compile import jit
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.state import GridState

SAFE_RHO = np.float32(0.95)
"""The grid is safe while every line is loaded strictly less; float32, as the loadings it is compared with."""

CAREFUL_RHO = np.float32(0.95)
"""Careful plays what keeps every line loaded less, by the forecast for the next step."""

LEAST_DISPATCH = np.float32(0.01)
"""MW; a unit that is shifted by less is at rest."""

_NOTHING, _RECONNECT, _RESTORE = int(ActionKind.NOTHING), int(ActionKind.RECONNECT), int(ActionKind.RESTORE)


@jit
def is_safe(state: GridState, i: int) -> bool:
    """Whether every line of row ``i`` is loaded less than 95%: the heuristic plays, not the agent."""
    return _all_below(state.rho[i], SAFE_RHO)


@jit
def is_at_rest(state: GridState, i: int) -> bool:
    """Whether every generator of row ``i`` produces what its series says: no agent has to bring it back."""
    at_rest = True
    for gen in range(state.actual_dispatch.shape[1]):
        at_rest &= np.abs(state.actual_dispatch[i, gen]) < LEAST_DISPATCH
    return bool(at_rest)


@jit
def recovery_action(state: GridState, i: int) -> tuple[int, int]:
    """The next step of the recovery heuristic in row ``i``, as (:class:`ActionKind`, target).

    Reconnect the lowest-numbered line that may legally be reconnected; else bring back the lowest-numbered
    substation that may legally be changed and has a connected element on busbar 2; else nothing.
    """
    kind, line = reconnect_action(state, i)
    if kind == _RECONNECT:
        return kind, line
    for sub in range(state.sub_info.shape[0]):
        if state.time_before_cooldown_sub[i, sub] == 0 and _is_split(state, i, sub):
            return _RESTORE, sub
    return _NOTHING, 0


@jit
def reconnect_action(state: GridState, i: int) -> tuple[int, int]:
    """Reconnect the lowest-numbered line that may legally be reconnected in row ``i``; else nothing."""
    for line in range(state.line_status.shape[1]):
        if not state.line_status[i, line] and state.time_before_cooldown_line[i, line] == 0:
            return _RECONNECT, line
    return _NOTHING, 0


@jit
def careful_candidate(state: GridState, i: int, begin: int) -> int:
    """The next thing of row ``i`` that the careful heuristic may try on the forecast.

    Candidates are numbered: line k is closed by number k, substation k brought back by number ``n_line + k``.

    Args:
        state: the state.
        i: the row.
        begin: least number.

    Returns:
        The least number from ``begin`` on that is legal and has something to do; -1 if there is none.
    """
    n_line = len(state.thermal_limit)
    for line in range(begin, n_line):
        if not state.line_status[i, line] and state.time_before_cooldown_line[i, line] == 0:
            return line
    for sub in range(max(begin - n_line, 0), len(state.sub_info)):
        if state.time_before_cooldown_sub[i, sub] == 0 and _is_split(state, i, sub) and not _relieves(state, i, sub):
            return n_line + sub
    return -1


@jit
def candidate_action(state: GridState, candidate: int) -> tuple[int, int]:
    """The action of a number that :func:`careful_candidate` returns, as (:class:`ActionKind`, target)."""
    n_line = len(state.thermal_limit)
    if candidate < n_line:
        return _RECONNECT, candidate
    return _RESTORE, candidate - n_line


@jit
def is_careful_enough(forecast: GridState, j: int) -> bool:
    """Whether row ``j``, a forecast of what follows an action, is one that the careful heuristic allows."""
    return bool(not forecast.terminated[j]) and _all_below(forecast.rho[j], CAREFUL_RHO)


@jit
def remember_nothing(state: GridState, i: int) -> None:
    """Begin an episode of row ``i``: nothing was lost, split or attacked."""
    state.open_since[i] = -1
    state.split_since[i] = -1
    state.attacked_at[i] = -1


@jit
def remember_topology(state: GridState, i: int) -> None:
    """Note after a grid step of row ``i`` which lines are out and which substations split, and since when."""
    for line in range(state.line_status.shape[1]):
        if state.line_status[i, line]:
            state.open_since[i, line] = -1
        elif state.open_since[i, line] < 0:
            state.open_since[i, line] = state.step[i]
    for sub in range(state.sub_info.shape[0]):
        if not _is_split(state, i, sub):
            state.split_since[i, sub] = -1
        elif state.split_since[i, sub] < 0:
            state.split_since[i, sub] = state.step[i]


@jit
def remember_move(state: GridState, i: int, sub: int) -> None:
    """Note that the agent has just moved elements of a substation that may have been split before."""
    if state.split_since[i, sub] >= 0:
        state.split_since[i, sub] = state.step[i]


@jit
def _is_split(state: GridState, i: int, sub: int) -> bool:
    first = state.sub_first_element[sub]
    split = False
    for element in range(first, first + state.sub_info[sub]):
        split |= state.topo_vect[i, element] == 2
    return bool(split)


@jit
def _relieves(state: GridState, i: int, sub: int) -> bool:
    """Whether a line is out that was out when the substation was last split."""
    opened = state.open_since[i]
    relieves = False
    for line in range(opened.shape[0]):
        relieves |= 0 <= opened[line] < state.split_since[i, sub]
    return bool(relieves)


@jit
def _all_below(values: F32, limit: np.float32) -> bool:
    """Whether all are less; a value that is no number is not. No array is made: it is asked after every step."""
    below = True
    for k in range(values.shape[0]):
        below &= values[k] < limit
    return bool(below)
