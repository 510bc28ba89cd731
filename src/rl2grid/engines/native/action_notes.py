"""What became of each agent's last action, noted by compiled code and put into words only when asked."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from rl2grid.arrays import F32, I32, I64, Flags
from rl2grid.compile import jit
from rl2grid.engines.action_effects import TOLERANCE
from rl2grid.engines.native.constants import GridConstants
from rl2grid.engines.native.orders import Orders
from rl2grid.grids import Grid
from rl2grid.grids.axes import axis_sizes
from rl2grid.mdp.legality import LEGAL, Verdict
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
    worth_a_word: Annotated[Flags, row("", "something of the action was refused or clipped")]


def new_action_notes(grid: Grid, n: int) -> ActionNotes:
    """Blank notes."""
    return allocate(ActionNotes, axis_sizes(grid), n)


def notes_of(notes: ActionNotes, rows: I64) -> ActionNotes:
    """Those of ``rows``, a copy that the next step leaves alone."""
    return ActionNotes._make(array[rows] for array in notes)


def verdict_in(notes: ActionNotes, i: int) -> Verdict:
    """What the rules said of the action of row ``i``."""
    return Verdict(int(notes.verdict[i]), int(notes.verdict_target[i]), int(notes.verdict_left[i]))


@jit
def note_action(notes: ActionNotes, constants: GridConstants, orders: Orders, state: GridState, i: int) -> None:
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
    notes.worth_a_word[i] = orders.verdict[i] != LEGAL or _is_clipped(constants, orders, state, i)


@jit
def _is_clipped(constants: GridConstants, orders: Orders, state: GridState, i: int) -> bool:
    """Whether :func:`rl2grid.engines.action_effects.clipping` has something to say."""
    if not orders.injects[i] or state.terminated[i]:
        return False
    if state.ambiguous[i] or state.illegal[i]:
        return True
    values = orders.injection[i]
    for entry in range(constants.redispatch_gen.shape[0]):
        gen = constants.redispatch_gen[entry]
        ramp = state.gen_max_ramp_up[gen] if values[entry] > 0 else state.gen_max_ramp_down[gen]
        missing = state.target_dispatch[i, gen] - state.actual_dispatch[i, gen]
        if abs(missing) > TOLERANCE and values[entry] * ramp != 0:
            return True
    first_unit = constants.redispatch_gen.shape[0] + constants.curtail_gen.shape[0]
    for unit in range(constants.storage_emax.shape[0]):
        power = values[first_unit + unit]
        most = constants.storage_max_p_absorb[unit] if power > 0 else constants.storage_max_p_prod[unit]
        if abs(state.storage_power[i, unit] - power * most) > TOLERANCE:
            return True
    return False
