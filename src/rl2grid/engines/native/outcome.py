"""What became of each agent's last action, noted by compiled code and put into words only when asked."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rl2grid.compile import jit
from rl2grid.grids import Grid, load_grid
from rl2grid.handles import layout_of, opener
from rl2grid.mdp.actions import ActionKind
from rl2grid.mdp.state import F32, I32, Flags, GridState

_MOVE, _SWITCH = int(ActionKind.MOVE), int(ActionKind.SWITCH)


class Outcome(NamedTuple):
    """Structure of arrays of ``n`` environments, right after the agent's own step."""

    cooldown_left: I32  # [n] steps that the line or substation of a topology action still cooled down before it
    terminated: Flags  # [n]
    illegal: Flags  # [n]
    ambiguous: Flags  # [n]
    target_dispatch: F32  # [n, gen] MW
    actual_dispatch: F32  # [n, gen] MW
    storage_power: F32  # [n, storage] MW


def new_outcome(grid: Grid, n: int) -> Outcome:
    """A blank outcome."""
    return Outcome(
        np.zeros(n, np.int32),
        np.zeros(n, np.bool_),
        np.zeros(n, np.bool_),
        np.zeros(n, np.bool_),
        np.zeros((n, grid.n_gen), np.float32),
        np.zeros((n, grid.n_gen), np.float32),
        np.zeros((n, grid.n_storage), np.float32),
    )


def copy_outcome(outcome: Outcome) -> Outcome:
    """A copy that the next step leaves alone."""
    return Outcome._make(array.copy() for array in outcome)


@jit
def note_before(outcome: Outcome, state: GridState, i: int, kind: int, target: int) -> None:
    """Note, before the agent's step, what would refuse its action."""
    outcome.cooldown_left[i] = 0
    if kind == _MOVE:
        outcome.cooldown_left[i] = state.time_before_cooldown_sub[i, target]
    elif kind == _SWITCH:
        outcome.cooldown_left[i] = state.time_before_cooldown_line[i, target]


@jit
def note_after(outcome: Outcome, state: GridState, i: int) -> None:
    """Note, right after the agent's step, what became of its action."""
    outcome.terminated[i] = state.terminated[i]
    outcome.illegal[i] = state.illegal[i]
    outcome.ambiguous[i] = state.ambiguous[i]
    outcome.target_dispatch[i] = state.target_dispatch[i]
    outcome.actual_dispatch[i] = state.actual_dispatch[i]
    outcome.storage_power[i] = state.storage_power[i]


open_outcome = opener("Outcome", layout_of(new_outcome(load_grid("bus14"), 0)))
