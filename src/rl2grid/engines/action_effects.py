"""What became of an agent's action, in words: what was refused or clipped, and why."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from rl2grid.arrays import F32, Flags
from rl2grid.grids import Grid
from rl2grid.mdp.actions import StepAction, decode_continuous
from rl2grid.mdp.legality import AMBIGUOUS, LEGAL, LINE_COOLS_DOWN, TOO_MANY_LINES, TOO_MANY_SUBS, Verdict

TOLERANCE = np.float32(0.05)
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


def refusal(grid: Grid, verdict: Verdict) -> str:
    """Why the rules refuse an action; empty where they do not."""
    if verdict.reason == LEGAL:
        return ""
    if verdict.reason == AMBIGUOUS:
        return "refused: the action has no single meaning"
    if verdict.reason in (TOO_MANY_LINES, TOO_MANY_SUBS):
        of_lines = verdict.reason == TOO_MANY_LINES
        most = grid.rules.max_line_changes if of_lines else grid.rules.max_sub_changes
        noun = f"{'line' if of_lines else 'substation'}{'' if most == 1 else 's'}"
        area = " of one area" if grid.sub_area.any() else ""
        return f"refused: one action may change {most} {noun}{area}"
    target = "line" if verdict.reason == LINE_COOLS_DOWN else "substation"
    return f"refused: {target} {verdict.target} cools down for {verdict.left} more steps"


def clipping(grid: Grid, state: AfterAction, i: int, action: StepAction) -> str:
    """What of a continuous action was not carried out, read from the state right after its step."""
    if action.values is None or state.terminated[i]:
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
          for gen in np.flatnonzero((np.abs(missing) > TOLERANCE) & (asked.redispatch != 0))),
        *(f"{grid.name_storage[unit]} works at {state.storage_power[i, unit]:+.1f} MW instead of "
          f"{asked.storage[unit]:+.1f} MW, as it is {'full' if asked.storage[unit] > 0 else 'empty'}"
          for unit in np.flatnonzero(np.abs(state.storage_power[i] - asked.storage) > TOLERANCE)),
    ]  # fmt: skip
    return f"clipped: {'; '.join(parts)}" if parts else ""
