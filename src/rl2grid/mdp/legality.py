"""Which actions of several changes have a single meaning, and which of them the rules allow: Grid2Op's verdicts.

Grid2Op looks first at whether an action is ambiguous (``BaseAction.is_ambiguous``), then at what it touches
(``BaseAction.get_topological_impact``) and whether the rules allow that (``DefaultRules``, ``RulesByArea``). An
ambiguous or illegal action is played as do nothing, its injection included.

A line is touched by its switch and its reconnection, even where nothing changes. A substation is touched by a move
or a restoration of any of its elements, except the ends of open lines that the same action switches.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rl2grid.arrays import I32, Flags
from rl2grid.compile import jit
from rl2grid.mdp.actions import ActionKind, Change, Masks, StepAction, write_mask
from rl2grid.mdp.state import GridState

LEGAL, AMBIGUOUS, TOO_MANY_LINES, TOO_MANY_SUBS, LINE_COOLS_DOWN, SUB_COOLS_DOWN = range(6)
"""Verdicts."""

_MOVE, _SWITCH = int(ActionKind.MOVE), int(ActionKind.SWITCH)
_RECONNECT, _RESTORE = int(ActionKind.RECONNECT), int(ActionKind.RESTORE)
_BITS = 64


class Verdict(NamedTuple):
    """What the rules say of an action."""

    reason: int
    """:data:`LEGAL`, or why it is not played."""
    target: int
    """The line or substation that cools down, else -1."""
    left: int
    """Steps for which it still does."""


_ALLOWED = Verdict(LEGAL, -1, 0)


@jit
def judge(
    state: GridState, i: int, count: int, kinds: I32, targets: I32, masks: Masks, touches: Flags
) -> tuple[int, int, int]:
    """Whether environment ``i`` may play an action now, as the fields of a :class:`Verdict`.

    Args:
        state: row ``i`` holds the last observation.
        i: the row.
        count: number of changes.
        kinds: what each does, at least [count], an :class:`~rl2grid.mdp.actions.ActionKind`.
        targets: line or substation of each, all different.
        masks: elements that each moves, [change, word]; for a restoration those on busbar 2 are written.
        touches: written: whether each touches its line or substation, which then cools down.
    """
    for k in range(count):
        if kinds[k] == _RESTORE:
            _find_second_busbar(state, i, targets[k], masks[k])
    if count > 1 and _is_ambiguous(state, count, kinds, targets, masks):
        return AMBIGUOUS, -1, 0
    for k in range(count):
        touches[k] = _touches(state, i, count, kinds, targets, masks, k)
    if count > 1:
        for k in range(count):
            if touches[k] and _exceeds_the_limit(state, count, kinds, targets, touches, k):
                return TOO_MANY_LINES if _is_of_line(kinds[k]) else TOO_MANY_SUBS, -1, 0
    for k in range(count):
        if not touches[k]:
            continue
        of_line, target = _is_of_line(kinds[k]), int(targets[k])
        left = int(state.time_before_cooldown_line[i, target] if of_line else state.time_before_cooldown_sub[i, target])
        if left > 0:
            return LINE_COOLS_DOWN if of_line else SUB_COOLS_DOWN, target, left
    return LEGAL, -1, 0


def verdict_on(state: GridState, i: int, action: StepAction) -> Verdict:
    """:func:`judge` for an action as a value."""
    count = len(action.changes)
    if count <= 1:
        return _verdict_on_one(state, i, action.changes[0]) if count else _ALLOWED
    kinds = np.array([change.kind for change in action.changes], np.int32)
    targets = np.array([change.target for change in action.changes], np.int32)
    masks = np.zeros((count, -(-int(state.sub_info.max()) // _BITS)), np.uint64)
    for change, row in zip(action.changes, masks, strict=True):
        write_mask(change.mask, row)
    return Verdict(*judge(state, i, count, kinds, targets, masks, np.zeros(count, np.bool_)))


def _verdict_on_one(state: GridState, i: int, change: Change) -> Verdict:
    """As :func:`judge`; a compiled function would first look at every array of the state."""
    target = change.target
    if change.is_of_line:
        left = int(state.time_before_cooldown_line[i, target])
        return Verdict(LINE_COOLS_DOWN, target, left) if left > 0 else _ALLOWED
    left = int(state.time_before_cooldown_sub[i, target])
    if left <= 0:
        return _ALLOWED
    first = int(state.sub_first_element[target])
    here = state.topo_vect[i, first : first + int(state.sub_info[target])]
    touches = (here == 2).any() if change.kind == _RESTORE else change.mask != 0
    return Verdict(SUB_COOLS_DOWN, target, left) if touches else _ALLOWED


@jit
def has_element(mask: NDArray[np.uint64], k: int) -> bool:
    """Whether bit ``k`` is set in a mask, uint64 [word]."""
    return bool((mask[k // _BITS] >> np.uint64(k % _BITS)) & np.uint64(1) != 0)


@jit
def _is_of_line(kind: int) -> bool:
    return kind in (_SWITCH, _RECONNECT)


@jit
def _find_second_busbar(state: GridState, i: int, sub: int, mask: NDArray[np.uint64]) -> None:
    """Write the elements of a substation that are on busbar 2."""
    mask[:] = np.uint64(0)
    first = state.sub_first_element[sub]
    for k in range(state.sub_info[sub]):
        if state.topo_vect[i, first + k] == 2:
            mask[k // _BITS] |= np.uint64(1) << np.uint64(k % _BITS)


@jit
def _is_ambiguous(state: GridState, count: int, kinds: I32, targets: I32, masks: Masks) -> bool:
    """Whether a line is to be reconnected and one of its ends moved: the busbar that it returns to has two names."""
    for k in range(count):
        if kinds[k] != _RECONNECT:
            continue
        line = targets[k]
        if _moves(state, count, kinds, targets, masks, state.line_or_pos_topo_vect[line]) or _moves(
            state, count, kinds, targets, masks, state.line_ex_pos_topo_vect[line]
        ):
            return True
    return False


@jit
def _moves(state: GridState, count: int, kinds: I32, targets: I32, masks: Masks, element: int) -> bool:
    sub = state.element_to_subid[element]
    for k in range(count):
        if kinds[k] == _MOVE and targets[k] == sub:
            return has_element(masks[k], element - state.sub_first_element[sub])
    return False


@jit
def _touches(state: GridState, i: int, count: int, kinds: I32, targets: I32, masks: Masks, k: int) -> bool:
    if _is_of_line(kinds[k]):
        return True
    sub = targets[k]
    first = state.sub_first_element[sub]
    for element in range(first, first + state.sub_info[sub]):
        if has_element(masks[k], element - first) and not _closes_with(state, i, count, kinds, targets, element):
            return True
    return False


@jit
def _closes_with(state: GridState, i: int, count: int, kinds: I32, targets: I32, element: int) -> bool:
    """Whether an element is an end of an open line that the same action switches or reconnects."""
    for k in range(count):
        if not _is_of_line(kinds[k]):
            continue
        line = targets[k]
        is_end = state.line_or_pos_topo_vect[line] == element or state.line_ex_pos_topo_vect[line] == element
        if is_end and not state.line_status[i, line]:
            return True
    return False


@jit
def _exceeds_the_limit(state: GridState, count: int, kinds: I32, targets: I32, touches: Flags, k: int) -> bool:
    """Whether change ``k`` is one of too many of lines, or of substations, in its area."""
    of_line = _is_of_line(kinds[k])
    area = _area(state, of_line, targets[k])
    touched = 0
    for other in range(count):
        if touches[other] and _is_of_line(kinds[other]) == of_line:
            touched += _area(state, of_line, targets[other]) == area
    return bool(touched > state.max_changes[0 if of_line else 1])


@jit
def _area(state: GridState, of_line: bool, target: int) -> int:
    """Area of a substation; a line belongs to that of its origin."""
    return int(state.sub_area[state.line_or_to_subid[target] if of_line else target])
