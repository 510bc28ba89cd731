"""What became of an agent's action, in words: what was refused or clipped, and why."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from rl2grid.arrays import F32, Flags
from rl2grid.grids import Grid
from rl2grid.mdp.actions import ActionKind, StepAction, decode_continuous
from rl2grid.mdp.state import GridState

_TOLERANCE = 0.05
"""MW below which a difference between what was asked and what happened is not worth a word."""


class AfterAction(Protocol):
    """What is read right after the agent's step: a :class:`~rl2grid.mdp.state.GridState` has it."""

    @property
    def terminated(self) -> Flags: ...
    @property
    def illegal(self) -> Flags: ...
    @property
    def ambiguous(self) -> Flags: ...
    @property
    def target_dispatch(self) -> F32: ...
    @property
    def actual_dispatch(self) -> F32: ...
    @property
    def storage_power(self) -> F32: ...


def cooldown_left(state: GridState, i: int, action: StepAction) -> int:
    """Steps that the line or substation of a topology action cools down in the state before it."""
    if action.kind == ActionKind.MOVE:
        return int(state.time_before_cooldown_sub[i, action.target])
    if action.kind == ActionKind.SWITCH:
        return int(state.time_before_cooldown_line[i, action.target])
    return 0


def refusal(action: StepAction, left: int) -> str:
    """Why the rules refuse a topology action whose target cools down; empty where ``left`` is 0."""
    if left == 0:
        return ""
    target = "substation" if action.kind == ActionKind.MOVE else "line"
    return f"refused: {target} {action.target} cools down for {left} more steps"


def clipping(grid: Grid, state: AfterAction, i: int, action: StepAction) -> str:
    """What of a continuous action was not carried out, read from the state right after its step."""
    if action.kind != ActionKind.INJECTION or action.values is None or state.terminated[i]:
        return ""
    if state.ambiguous[i]:
        return "refused: the action has no single meaning"
    if state.illegal[i]:
        return "refused: the redispatch asks a generator for more than its range from pmin to pmax"
    asked = decode_continuous(grid, action.values)
    missing = state.target_dispatch[i] - state.actual_dispatch[i]
    parts = [
        *(f"{grid.name_gen[gen]} is dispatched by {state.actual_dispatch[i, gen]:+.1f} MW of the "
          f"{state.target_dispatch[i, gen]:+.1f} MW asked for, by its limits or to keep the balance"
          for gen in np.flatnonzero((np.abs(missing) > _TOLERANCE) & (asked.redispatch != 0))),
        *(f"{grid.name_storage[unit]} works at {state.storage_power[i, unit]:+.1f} MW instead of "
          f"{asked.storage[unit]:+.1f} MW, as it is {'full' if asked.storage[unit] > 0 else 'empty'}"
          for unit in np.flatnonzero(np.abs(state.storage_power[i] - asked.storage) > _TOLERANCE)),
    ]  # fmt: skip
    return f"clipped: {'; '.join(parts)}" if parts else ""
