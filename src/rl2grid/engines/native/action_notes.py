"""What became of each agent's last action, noted by compiled code and put into words only when asked."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from rl2grid.arrays import F32, I32, Flags
from rl2grid.compile import jit
from rl2grid.engines.native.orders import Orders
from rl2grid.grids import Grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.mdp.legality import Verdict
from rl2grid.mdp.state import GridState
from rl2grid.structures import allocate, row


class ActionNotes(NamedTuple):
    """Structure of arrays of ``n`` environments, right after the agent's own step."""

    verdict: Annotated[I32, row("", "what the rules said, `rl2grid.mdp.legality.LEGAL` or why it was not played")]
    verdict_target: Annotated[I32, row("", "the line or substation that cooled down, else -1")]
    verdict_left: Annotated[I32, row("", "that it still cooled down before the action", "steps")]
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


def verdict_in(notes: ActionNotes, i: int) -> Verdict:
    """What the rules said of the action of row ``i``."""
    return Verdict(int(notes.verdict[i]), int(notes.verdict_target[i]), int(notes.verdict_left[i]))


@jit
def note_action(notes: ActionNotes, orders: Orders, state: GridState, i: int) -> None:
    """Note, right after the agent's step, what became of its action."""
    notes.verdict[i] = orders.verdict[i]
    notes.verdict_target[i] = orders.verdict_target[i]
    notes.verdict_left[i] = orders.verdict_left[i]
    notes.terminated[i] = state.terminated[i]
    notes.illegal[i] = state.illegal[i]
    notes.ambiguous[i] = state.ambiguous[i]
    notes.target_dispatch[i] = state.target_dispatch[i]
    notes.actual_dispatch[i] = state.actual_dispatch[i]
    notes.storage_power[i] = state.storage_power[i]
