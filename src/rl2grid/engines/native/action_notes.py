"""What became of each agent's last action, noted by compiled code and put into words only when asked."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from rl2grid.arrays import F32, I32, Flags
from rl2grid.compile import jit
from rl2grid.grids import Grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.state import GridState
from rl2grid.structures import allocate, row

_MOVE, _SWITCH = int(ActionKind.MOVE), int(ActionKind.SWITCH)


class ActionNotes(NamedTuple):
    """Structure of arrays of ``n`` environments, right after the agent's own step."""

    cooldown_left: Annotated[
        I32, row("", "that the line or substation of a topology action still cooled down before it", "steps")
    ]
    terminated: Annotated[Flags, row("", "game over")]
    illegal: Annotated[Flags, row("", "the action broke a rule")]
    ambiguous: Annotated[Flags, row("", "the action had no single meaning")]
    target_dispatch: Annotated[F32, row("gen", "dispatch asked for", "MW")]
    actual_dispatch: Annotated[F32, row("gen", "dispatch carried out", "MW")]
    storage_power: Annotated[F32, row("storage", "positive charges", "MW")]


def new_action_notes(grid: Grid, n: int) -> ActionNotes:
    """Blank notes."""
    return allocate(ActionNotes, axis_sizes(grid), n)


def copy_notes(notes: ActionNotes) -> ActionNotes:
    """A copy that the next step leaves alone."""
    return ActionNotes._make(array.copy() for array in notes)


@jit
def note_before(notes: ActionNotes, state: GridState, i: int, kind: int, target: int) -> None:
    """Note, before the agent's step, what would refuse its action."""
    notes.cooldown_left[i] = 0
    if kind == _MOVE:
        notes.cooldown_left[i] = state.time_before_cooldown_sub[i, target]
    elif kind == _SWITCH:
        notes.cooldown_left[i] = state.time_before_cooldown_line[i, target]


@jit
def note_after(notes: ActionNotes, state: GridState, i: int) -> None:
    """Note, right after the agent's step, what became of its action."""
    notes.terminated[i] = state.terminated[i]
    notes.illegal[i] = state.illegal[i]
    notes.ambiguous[i] = state.ambiguous[i]
    notes.target_dispatch[i] = state.target_dispatch[i]
    notes.actual_dispatch[i] = state.actual_dispatch[i]
    notes.storage_power[i] = state.storage_power[i]
